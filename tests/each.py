"""Provide `@each`: like `parametrize`, but as one test for all parameter sets.

Ten thousand tests of a microsecond take longer to distribute and report than to run. A failure
names its parameter set.
"""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable
from typing import Any


def each(names: str | tuple[str, ...], sets: Iterable[Any]) -> Callable[[Any], Any]:
    """Run the test for each of these parameter sets.

    Stacked decorators give all combinations. All sets share the same fixtures, so a fixture must
    not keep state.
    """
    every = list(sets)
    given = (names,) if isinstance(names, str) else names

    def decorate(test: Callable[..., None]) -> Callable[..., None]:
        @functools.wraps(test)
        def all_of_them(**fixtures: Any) -> None:
            assert every, "there is nothing to test"
            for values in every:
                chosen = dict(zip(given, (values,) if len(given) == 1 else values, strict=True))
                try:
                    test(**fixtures, **chosen)
                except BaseException as error:
                    error.add_note(f"with {chosen}")
                    raise

        signature = inspect.signature(test)
        left = [one for name, one in signature.parameters.items() if name not in given]
        all_of_them.__signature__ = signature.replace(parameters=left)  # type: ignore[attr-defined]
        return all_of_them

    return decorate
