"""Prints tables and sentences: within the width of a terminal, in its colours, or plain elsewhere.

No text is read as markup. A stranger's text must be made printable before.
"""

from __future__ import annotations

import io
import os
import sys
from collections.abc import Collection, Iterable, Sequence
from typing import TextIO

from rich.console import Console, Group, RenderableType
from rich.table import Table
from rich.text import Text

WHOLE = 10_000
"""Width in characters within which no row of a table is wrapped, so that it can be copied."""

SENTENCES = 100
"""Width in characters of output that has sentences."""


def table(
    rows: Iterable[Sequence[str | Text]],
    heads: Sequence[str] = (),
    right: Collection[int] = (),
    gap: int = 2,
) -> Table:
    """Return rows as a table in columns; those in `right` are right-aligned."""
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
    """Return whether standard output is a terminal that can show a whole screen."""
    return sys.stdout.isatty() and os.environ.get("TERM", "") not in ("", "dumb", "unknown")


def show(*parts: RenderableType, most: int = WHOLE) -> None:
    """Print each part on lines of its own, with whole rows or at most `most` characters wide."""
    console = _console(sys.stdout)
    if console.is_terminal and most < WHOLE:
        console.print(Group(*parts), width=min(most, console.width))
    else:
        print(plain(*parts, width=most), flush=True)


def show_whole(text: Text) -> None:
    """Print a text without wrapping it, so that a command in it can be copied from the terminal."""
    console = _console(sys.stdout)
    if console.is_terminal:
        console.print(text, soft_wrap=True)
    else:
        print(text.plain, flush=True)


def plain(*parts: RenderableType, width: int = WHOLE) -> str:
    file = io.StringIO()
    _console(file, width).print(Group(*parts))
    return "\n".join(line.rstrip() for line in file.getvalue().splitlines())


def _console(file: TextIO, width: int | None = None) -> Console:
    """Return a console that takes no text for markup, for an emoji or for a number to highlight."""
    return Console(
        file=file,
        width=width,
        force_terminal=file.isatty(),
        color_system="auto" if file.isatty() else None,
        markup=False,
        emoji=False,
        highlight=False,
    )
