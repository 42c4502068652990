"""Progress of those actions of `acsard recording` that take minutes, shown on a terminal."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from acsard.recording.file import Recording


@contextmanager
def telling(recording: Recording) -> Iterator[Callable[[int], None]]:
    """Yield a function that shows the progress; call it with the wall-clock time reached, in ns.

    The progress line is erased at the end. If standard error is not a terminal, nothing is shown.
    """
    from acsard.recording.end_record import read_end

    if not sys.stderr.isatty():
        yield lambda wall_ns: None
        return
    began_ns, last = recording.about.wall_ns, read_end(recording.path)
    whole = f" of {(last.last_ns - began_ns) / 1e9:.0f}" if last else ""

    def tell(wall_ns: int) -> None:
        text = f"\r{(wall_ns - began_ns) / 1e9:.0f}{whole} s"
        print(text, end="", file=sys.stderr, flush=True)

    try:
        yield tell
    finally:
        print("\r\x1b[K", end="", file=sys.stderr, flush=True)
