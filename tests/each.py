"""Helpers for the parameter sets of tests.

`@each` is like `parametrize`, but one test loops over all sets. Ten thousand tests of a microsecond
would take longer to distribute and report than to run. A failure names its parameter set. `more`
marks a set that only the nightly job runs.
"""

from __future__ import annotations

import asyncio
import functools
import inspect
from collections.abc import Callable, Coroutine, Iterable
from typing import Any

import pytest

STORY_S = 60.0
"""The longest time of a test that is a coroutine."""


def more(*values: Any) -> Any:
    """Return a parameter set with more random cases, which only the nightly job runs."""
    return pytest.param(*values, marks=[pytest.mark.slow, pytest.mark.nightly])


def run(test: Coroutine[Any, Any, None]) -> None:
    """Run a coroutine test in a new event loop, with a time limit of `STORY_S`."""

    async def story() -> None:
        async with asyncio.timeout(STORY_S):
            await test
        # Closing the loop would cancel a task that still cleans up, for example one that ends a
        # child process, and the child's pipes would outlive the loop.
        ending = [task for task in asyncio.all_tasks() if task.cancelling()]
        await asyncio.gather(*ending, return_exceptions=True)

    asyncio.run(story())


def each(names: str | tuple[str, ...], sets: Iterable[Any]) -> Callable[[Any], Any]:
    """Run the test for each of these parameter sets.

    Stacked decorators give all combinations. All sets share the same fixtures, so a fixture must
    not keep state.
    """
    every = list(sets)
    keys = (names,) if isinstance(names, str) else names

    def decorate(test: Callable[..., Any]) -> Callable[..., None]:
        @functools.wraps(test)
        def all_of_them(**fixtures: Any) -> None:
            assert every, "there is nothing to test"
            for values in every:
                chosen = dict(zip(keys, (values,) if len(keys) == 1 else values, strict=True))
                try:
                    story = test(**fixtures, **chosen)
                    if inspect.iscoroutine(story):
                        run(story)
                except BaseException as error:
                    error.add_note(f"with {chosen}")
                    raise

        signature = inspect.signature(test)
        left = [parameter for name, parameter in signature.parameters.items() if name not in keys]
        all_of_them.__signature__ = signature.replace(parameters=left)  # type: ignore[attr-defined]
        return all_of_them

    return decorate
