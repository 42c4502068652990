"""A line for each robot of a fleet, for any width; pure, and without a library."""

from __future__ import annotations

import math
from collections.abc import Sequence

from msgspec import Struct

from acsard.messages.schema import RobotState
from acsard.messages.text import printable
from acsard.top.teleop import reason

SILENT_S = 2.0

HEADS = ("ROBOT", "MODE", "M/S", "LINK", "VERSION", "HEARD", "WHY")

ROOM = (32, 8, 6, 7, 10, 6)
"""At most so wide each but the last, which has what is left; the first is the longest id."""

NAME, WHY = 12, 20
"""So much of the last column is kept free of a long name, unless that gets narrower than this."""

NARROW = (0, 1, 2, 5, 6)
"""The columns that a narrow terminal has, below `WIDE`."""

WIDE = 72

URGENT = ("fault", "stopped", "GONE", "SILENT")
"""What needs a person, and is above the others, whose lines may be too many."""


class Row(Struct, frozen=True):
    """What is known of one robot."""

    robot_id: str
    here: bool
    """Its daemon runs."""
    state: RobotState | None
    age: float
    """Since `state` came, s; inf when only an answer that may be a storage's has."""
    version: str
    silence: float = SILENT_S
    """The age from which on it is no news any more, s."""


def table(rows: Sequence[Row], width: int, height: int | None = None) -> list[str]:
    """Heads and a line for each robot, at most `width` long and `height` many, the urgent first."""
    shown = range(len(HEADS)) if width >= WIDE else NARROW
    cells = [HEADS, *map(told, sorted(rows, key=_order))]
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
    """At most `room` long: what is left out is the middle, or where fewer then look the same."""
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
    """Its cells, in the order of `HEADS`."""
    name = printable(row.robot_id)
    if row.state is None:
        why = "waiting for its state" if row.here else "not there"
        return (name, "-", "-", "-", printable(row.version) or "-", "never", why)
    state, why = row.state, reason(row.state)
    if absence := _absence(row):
        why = f"{absence}, was: {why}"
    return (
        name,
        printable(state.mode),
        _speed(state),
        printable(state.link),
        printable(row.version) or "-",
        _age(row.age),
        why,
    )


def _speed(state: RobotState) -> str:
    """m/s; "-" without feedback."""
    if state.linear is None:
        return "-"
    return f"{state.linear + 0.0:+.2f}" if math.isfinite(state.linear) else "?"


def _absence(row: Row) -> str:
    if not row.here:
        return "GONE"
    return "SILENT" if row.state is not None and row.age > row.silence else ""


def _order(row: Row) -> tuple[int, str]:
    """What it is now comes before what it was."""
    what = _absence(row) or ("" if row.state is None else row.state.mode)
    return URGENT.index(what) if what in URGENT else len(URGENT), row.robot_id


def _age(seconds: float) -> str:
    if seconds == math.inf:
        return "never"
    if seconds < 9.95:
        return f"{seconds:.1f} s"
    for size, unit in ((1.0, "s"), (60.0, "min"), (3600.0, "h")):
        if seconds < 99.5 * size:
            return f"{seconds / size:.0f} {unit}"
    return f"{seconds / 86400:.0f} d"
