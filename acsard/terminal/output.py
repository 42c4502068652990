"""Prints tables and sentences, in color on a terminal and as plain text elsewhere.

No text is interpreted as markup. Text from other programs may contain control characters, so the
caller must make it printable first.
"""

from __future__ import annotations

import io
import os
import select
import sys
from collections.abc import Collection, Iterable, Sequence
from typing import TextIO

from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

# At this width no row is wrapped, so that a person can copy one from the terminal.
UNLIMITED_WIDTH = 10_000

# Widest line of output that contains sentences.
MAX_TEXT_WIDTH = 100


def table(
    rows: Iterable[Sequence[str | Text]],
    heads: Sequence[str | Text] = (),
    right: Collection[int] = (),
    gap: int = 2,
) -> Table:
    """Return a table; `right` has the numbers of its right-aligned columns, `gap` the spaces
    between.
    """
    cells = list(rows)
    made = Table(
        box=None, show_header=bool(heads), header_style="", pad_edge=False, padding=(0, gap, 0, 0)
    )
    for n in range(max(map(len, [heads, *cells]))):
        head = heads[n] if n < len(heads) else ""
        made.add_column(head, justify="right" if n in right else "left", overflow="fold")
    for row in cells:
        made.add_row(*row)
    return made


def has_screen() -> bool:
    """Return whether standard output is a terminal that can show a full screen."""
    return sys.stdout.isatty() and os.environ.get("TERM", "") not in ("", "dumb", "unknown")


def has_room(stream: TextIO) -> bool:
    """Return whether a short text can be written now, without a wait for its reader."""
    try:
        return bool(select.select([], [stream], [], 0.0)[1])
    except (OSError, ValueError):
        return False  # the stream is closed


def show(*parts: RenderableType, most: int = UNLIMITED_WIDTH) -> None:
    """Print each part, such as a table or a text, in lines of at most `most` characters."""
    console = _console(sys.stdout)
    if console.is_terminal and most < UNLIMITED_WIDTH:
        console.print(Group(*parts), width=min(most, console.width))
    else:
        print(plain(*parts, width=most), flush=True)


def show_whole(text: Text) -> None:
    """Print a text without wrapping, so that a person can copy a command from it."""
    console = _console(sys.stdout)
    if console.is_terminal:
        console.print(text, soft_wrap=True)
    else:
        print(text.plain, flush=True)


def plain(*parts: RenderableType, width: int = UNLIMITED_WIDTH) -> str:
    file = io.StringIO()
    _console(file, width).print(Group(*parts))
    return "\n".join(line.rstrip() for line in file.getvalue().splitlines())


def _console(file: TextIO, width: int | None = None) -> Console:
    return Console(
        file=file,
        width=width,
        force_terminal=file.isatty(),
        color_system="auto" if file.isatty() else None,
        markup=False,
        emoji=False,
        highlight=False,
    )
