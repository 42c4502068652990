"""Collects the robots that `acsard fleet` shows, and formats them as a table of any width."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

from msgspec.structs import replace

from acsard.client.fleet import Fleet, Row
from acsard.core.formatting import printable, rough, signed
from acsard.core.messages.schema import RobotState
from acsard.core.messages.state_warnings import brief, charge, warnings
from acsard.daemon.bus.robot_discovery import ALL, nobody, seen
from acsard.top.drive_screen import reason

HEADS = ("ROBOT", "MODE", "M/S", "LINK", "BATTERY", "PLACE", "VERSION", "SEEN", "WHY")

ROOM = (32, 8, 6, 7, 7, 22, 21, 6)
"""Maximum widths, in characters, of all columns except the last, which gets the remaining width."""

NAME, WHY = 12, 32
"""Minimum widths of the columns ROBOT and WHY, characters. If the terminal is too narrow, ROBOT
shrinks to its minimum before WHY becomes shorter."""

BATTERY = HEADS.index("BATTERY")
"""Index of the column with the state of charge. The table has this column only if a robot reports a
battery."""

URGENT = ("fault", "stopped", "GONE", "SILENT")
"""Modes and kinds of absence that need attention. The table lists robots in this order.

Other robots follow, first those with a warning.
"""


def table(rows: Sequence[Row], width: int, height: int | None = None) -> list[str]:
    """Return a header and a line for each robot, the urgent robots first.

    There are at most `height` lines of at most `width` characters.
    """
    cells = [HEADS, *map(told, sorted(rows, key=_order))]
    widest = [max(len(row[n]) for row in cells) for n in range(len(HEADS))]
    rooms = [min(room, most) for room, most in zip(widest, (*ROOM, WHY), strict=True)]
    powered = any(row[BATTERY] for row in cells[1:])
    shown = [n for n in range(len(HEADS)) if n != BATTERY or powered]
    # If the terminal is too narrow, these columns are left out one by one, in this order.
    for column in map(HEADS.index, ("VERSION", "PLACE", "LINK", "BATTERY")):
        if column in shown and sum(rooms[n] + 2 for n in shown) - 2 > width:
            shown.remove(column)
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
    """Shorten each name that has more than `room` characters, by cutting out a part of it.

    The cut begins after the same number of characters in each name. It is near the middle of the
    shortened names, unless a cut elsewhere keeps more names distinct.
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
    """Return the texts of the cells of a robot's row, in the order of the headings `HEADS`."""
    name = printable(row.robot_id)
    if row.state is None:
        why = "waiting for its state" if row.here else "not there"
        return (name, "-", "-", "-", "", "-", printable(row.version) or "-", "never", why)
    state, absence = row.state, _absence(row)
    return (
        name,
        printable(state.mode),
        signed(state.linear, 2, 6),
        printable(state.link),
        charge(state.battery),
        _place(state),
        printable(row.version) or "-",
        rough(row.age),
        f"{absence}, was: {_why(state)}" if absence else _why(state),
    )


def _why(state: RobotState) -> str:
    """Return the warnings in brief, the reason of the mode, and details of the warnings.

    The details also contain the speed limit, if there is one. If the mode is one of `URGENT`, its
    reason comes first.
    """
    why = reason(state)
    found, parts = [one for one in warnings(state) if one.brief not in why], [why]
    if found:
        parts.insert(1 if state.mode in URGENT else 0, brief(found))
    details = [(one.what.replace("_", " "), one.text) for one in found]
    details.append(("speed limit", state.speed_limit))
    return "; ".join(parts + [f"{what}: {printable(text)}" for what, text in details if text])


def _place(state: RobotState) -> str:
    """Return the pose as text: x and y in m, and the heading in degrees."""
    figures = (state.x, 1), (state.y, 1), (math.degrees(state.yaw), 0)
    return " ".join(signed(value, decimals, 7).strip() for value, decimals in figures) + "°"


def _absence(row: Row) -> str:
    if not row.here:
        return "GONE"
    return "SILENT" if row.state is not None and row.silent else ""


def _order(row: Row) -> tuple[int, str]:
    """Return the sort key of a row: the urgency, then the robot's id.

    For a robot that is gone or silent, the absence counts instead of the mode.
    """
    what = _absence(row) or ("" if row.state is None else row.state.mode)
    if what in URGENT:
        return URGENT.index(what), row.robot_id
    warned = row.state is not None and warnings(row.state)
    return len(URGENT) + (not warned), row.robot_id


class Roster(Fleet):
    """The robots that `acsard fleet` shows, and the reason why others may be missing."""

    def rows(self) -> list[Row]:
        """Query silent robots, and return one row per robot."""
        self.ask(self.due())
        return [replace(row, here=bool(row.here)) for row in super().rows()]

    def gather(self) -> list[Row]:
        """Wait for the robots, and return the rows.

        The wait ends when all robots that the user named have reported, but at most after 1.5 s.
        If no robot is present by then, the wait continues up to 3 s, because the first answer is
        late on a busy computer. If no robot is present after 3 s, return [].
        """
        began, rows = time.monotonic(), self.rows()
        while not self.whole:
            present = any(row.here or row.state for row in rows)
            if time.monotonic() - began >= (1.5 if present else 3.0):
                return self.rows() if present else []
            time.sleep(0.05)
            rows = self.rows()
        return self.rows()

    @property
    def whole(self) -> bool:
        """Whether all robots that the user named have reported; False if the user named none."""
        with self._lock:
            known = list(self._known.values())
        named = ALL not in self._ids
        return named and all(one.here and one.version and one.follower.heard for one in known)

    @property
    def seen(self) -> str:
        """A sentence with the number of visible robots, or "" if the user named the robots."""
        with self._lock:
            here = sum(bool(one.here) for one in self._known.values())
        return seen(self._robot.where.endpoint, here) if ALL in self._ids else ""

    @property
    def more(self) -> str:
        """A sentence which says that some robots are left out, or "" if no robot is left out."""
        if not self.left_out:
            return ""
        return (
            f"there are more than {self._most} robots, and this list leaves out the others: name "
            "the robots to list with --id robot1,robot2"
        )

    def hint(self) -> str:
        """Return a sentence that explains why there are no robots to show."""
        if ALL in self._ids:
            return nobody(self._robot.where.endpoint)
        return "no robot that you named with --id is present: correct --id, or start their daemons"
