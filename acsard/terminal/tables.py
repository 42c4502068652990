"""Tables for the output of the tools, drawn by the library rich; pure.

No cell is read as markup if the table is printed by `output`.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Sequence

from rich.table import Table
from rich.text import Text


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
