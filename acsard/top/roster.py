"""One line per robot of a fleet, for any width. This module is pure."""

from __future__ import annotations

from collections.abc import Sequence

from acsard.client.fleet import Row
from acsard.core.formatting import printable, rough, signed
from acsard.top.teleop import reason

HEADS = ("ROBOT", "MODE", "M/S", "LINK", "VERSION", "FILE", "SEEN", "WHY")

ROOM = (32, 8, 6, 7, 10, 7, 6)
"""Maximum width of each column but the last, which takes the rest. The first is as wide as its
longest id."""

NAME, WHY = 12, 20
"""Minimum widths of the first and last column. A long id may not narrow the last column below its
minimum, unless the first would fall below its own."""

NARROW = (0, 1, 2, 6, 7)
"""Columns of a terminal that is narrower than `WIDE`."""

FILE = 5
"""Column that marks a robot whose settings differ from its configuration file. The table has this
column only if there is such a robot."""

WIDE = 72

URGENT = ("fault", "stopped", "GONE", "SILENT")
"""Modes that need attention; they are listed first, because the lines may not all fit."""


def table(rows: Sequence[Row], width: int, height: int | None = None) -> list[str]:
    """Return a header and a line for each robot, the urgent ones first.

    There are at most `height` lines of at most `width` characters.
    """
    cells = [HEADS, *map(told, sorted(rows, key=_order))]
    marked = any(row[FILE] for row in cells[1:])
    wide = [n for n in range(len(HEADS)) if n != FILE or marked]
    shown = wide if width >= WIDE else NARROW
    widest = [max(len(row[n]) for row in cells) for n in range(len(HEADS))]
    rooms = [min(room, most) for room, most in zip(widest, (*ROOM, WHY), strict=True)]
    rest = sum(rooms[n] + 2 for n in shown[1:])
    rooms[0] = min(rooms[0], max(NAME, width - rest))
    lines = [
        "  ".join(
            [name.ljust(rooms[0])]
            + [row[n][: rooms[n]].ljust(rooms[n]) for n in shown[1:-1]]
            + [row[-1]]
        ).rstrip()
        for name, row in zip(shortened([row[0] for row in cells], rooms[0]), cells, strict=True)
    ]
    cut = [line if len(line) <= width else f"{line[: width - 1]}…" for line in lines]
    if height is None or len(cut) <= height:
        return cut
    return [*cut[: max(1, height - 1)], f"and {len(cut) - height + 1} more"[:width]][:height]


def shortened(names: Sequence[str], room: int) -> list[str]:
    """Shorten names to `room` characters by cutting out a part in the same place of each.

    The cut is in the middle, unless more names stay distinct with a cut elsewhere.
    """
    if all(len(name) <= room for name in names):
        return list(names)

    def cut(head: int) -> list[str]:
        tail = room - 1 - head
        return [
            name if len(name) <= room else f"{name[:head]}…{name[len(name) - tail :]}"
            for name in names
        ]

    from_the_middle = sorted(range(room), key=lambda head: abs(2 * head - room + 1))
    return max(map(cut, from_the_middle), key=lambda found: len(set(found)))


def told(row: Row) -> tuple[str, ...]:
    """Return the cells of a row in the order of `HEADS`."""
    name = printable(row.robot_id)
    if row.state is None:
        why = "waiting for its state" if row.here else "not there"
        return (name, "-", "-", "-", printable(row.version) or "-", "", "never", why)
    state, why = row.state, reason(row.state)
    if state.settings_differ:
        why = f"{why}; settings: {printable(state.settings_differ)}"
    if absence := _absence(row):
        why = f"{absence}, was: {why}"
    return (
        name,
        printable(state.mode),
        signed(state.linear, 2, 6),
        printable(state.link),
        printable(row.version) or "-",
        "differs" if state.settings_differ else "",
        rough(row.age),
        why,
    )


def _absence(row: Row) -> str:
    if not row.here:
        return "GONE"
    return "SILENT" if row.state is not None and row.silent else ""


def _order(row: Row) -> tuple[int, str]:
    """Sort by urgency, then by id. Absence counts before the last reported mode."""
    what = _absence(row) or ("" if row.state is None else row.state.mode)
    return URGENT.index(what) if what in URGENT else len(URGENT), row.robot_id
