"""Collects the robots that `acsard fleet` shows, and formats them as a table of any width."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

from acsard.bus.robot_discovery import ALL_ROBOTS, count_text, no_robot_text
from acsard.client.fleet import Fleet, Row
from acsard.core.formatting import printable, rough, signed
from acsard.core.messages.schema import RobotState
from acsard.core.messages.state_warnings import SAME_AS_REASON, brief, charge, warnings

COLUMN_HEADS = ("ROBOT", "MODE", "M/S", "LINK", "BATTERY", "PLACE", "VERSION", "SEEN", "WHY")

COLUMN_WIDTHS = (32, 8, 6, 7, 7, 22, 21, 6)
"""Maximum widths, in characters, of all columns except the last, which gets the remaining width."""

NAME, WHY = 12, 32
"""Minimum widths of the columns ROBOT (`NAME`) and WHY (`WHY`), characters. On a narrow terminal,
ROBOT shrinks to its minimum before WHY becomes shorter than its minimum."""

BATTERY_COLUMN = COLUMN_HEADS.index("BATTERY")
"""Index of the column BATTERY.

The table has this column only if any robot reports a battery.
"""

URGENT = ("fault", "stopped", "GONE", "SILENT")
"""Modes and kinds of absence that need attention, the most urgent first.

The table lists the robots in this order, and then all remaining robots, those with a warning first.
"""


def table(rows: Sequence[Row], width: int, height: int | None = None) -> list[str]:
    """Return a header line, and a line for each robot, the urgent robots first.

    There are at most `height` lines, or any number if `height` is None. If some robots do not fit,
    the last line says how many. A line has at most `width` characters.
    """
    cells = [COLUMN_HEADS, *map(row_cells, sorted(rows, key=_order))]
    widest = [max(len(row[n]) for row in cells) for n in range(len(COLUMN_HEADS))]
    rooms = [min(room, most) for room, most in zip(widest, (*COLUMN_WIDTHS, WHY), strict=True)]
    powered = any(row[BATTERY_COLUMN] for row in cells[1:])
    columns = [n for n in range(len(COLUMN_HEADS)) if n != BATTERY_COLUMN or powered]
    # If the terminal is too narrow, these columns are left out one by one, in this order.
    for column in map(COLUMN_HEADS.index, ("VERSION", "PLACE", "LINK", "BATTERY")):
        if column in columns and sum(rooms[n] + 2 for n in columns) - 2 > width:
            columns.remove(column)
    rest = sum(rooms[n] + 2 for n in columns[1:])
    rooms[0] = min(rooms[0], max(NAME, width - rest))
    lines = [
        "  ".join(
            [name.ljust(rooms[0])]
            + [row[n][: rooms[n]].ljust(rooms[n]) for n in columns[1:-1]]
            + [row[-1]]
        ).rstrip()
        for name, row in zip(shortened([row[0] for row in cells], rooms[0]), cells, strict=True)
    ]
    cut = [line if len(line) <= width else f"{line[: width - 1]}…" for line in lines]
    if height is None or len(cut) <= height:
        return cut
    return [*cut[: max(1, height - 1)], f"and {len(cut) - height + 1} more"[:width]][:height]


def shortened(names: Sequence[str], room: int) -> list[str]:
    """Return the names, each with at most `room` characters.

    In a longer name, "…" replaces a part. The "…" is at the same position in all shortened names:
    near the middle, or at another position if that keeps more names distinct.
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
    return max(map(cut, from_the_middle), key=lambda variant: len(set(variant)))


def row_cells(row: Row) -> tuple[str, ...]:
    """Return the texts of the table cells for a robot, in the order of the headings
    `COLUMN_HEADS`."""
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
    same = SAME_AS_REASON.get(state.code)
    problems = [warning for warning in warnings(state) if warning.what != same]
    parts = [printable(state.reason)]
    if problems:
        parts.insert(1 if state.mode in URGENT else 0, brief(problems))
    details = [(warning.what.replace("_", " "), warning.text) for warning in problems]
    details.append(("speed limit", state.speed_limit))
    return "; ".join(parts + [f"{what}: {printable(text)}" for what, text in details if text])


def _place(state: RobotState) -> str:
    figures = (state.x, 1), (state.y, 1), (math.degrees(state.yaw), 0)
    return " ".join(signed(value, decimals, 7).strip() for value, decimals in figures) + "°"


def _absence(row: Row) -> str:
    if not row.here:
        return "GONE"
    return "SILENT" if row.state is not None and row.silent else ""


def _order(row: Row) -> tuple[int, str]:
    """Return the sort key of a robot. Urgent robots come first (see `URGENT`).

    The key of a robot that is gone or silent depends on this fact, and not on its last mode.
    """
    what = _absence(row) or ("" if row.state is None else row.state.mode)
    if what in URGENT:
        return URGENT.index(what), row.robot_id
    warned = row.state is not None and warnings(row.state)
    return len(URGENT) + (not warned), row.robot_id


class Roster(Fleet):
    """The robots that `acsard fleet` shows, and the reason why robots may be missing."""

    def rows(self) -> list[Row]:
        """Send the queries that are due, and return one row per robot."""
        self.send_queries(self.due())
        return super().rows()

    def gather(self) -> list[Row]:
        """Wait for the first reports of the robots, and return one row per robot.

        The wait ends when all robots that the user named have reported, or after 1.5 s. If no robot
        is present then, the wait goes on until a robot is present, because the first answer can be
        late on a busy computer. If no robot is present after 3 s in all, return [].
        """
        began, rows = time.monotonic(), self.rows()
        while not self.all_reported:
            present = any(row.here or row.state for row in rows)
            if time.monotonic() - began >= (1.5 if present else 3.0):
                return self.rows() if present else []
            time.sleep(0.05)
            rows = self.rows()
        return self.rows()

    @property
    def all_reported(self) -> bool:
        """Whether all robots that the user named have reported; False without named robots."""
        with self._lock:
            known = list(self._known.values())
        named = ALL_ROBOTS not in self._ids
        return named and all(
            robot.here and robot.version and robot.follower.is_confirmed for robot in known
        )

    @property
    def presence_text(self) -> str:
        """A sentence with the number of present robots; "" if the user named robots."""
        with self._lock:
            here = sum(robot.here for robot in self._known.values())
        return count_text(self._robot.where.endpoint, here) if ALL_ROBOTS in self._ids else ""

    @property
    def left_out_text(self) -> str:
        """A sentence which says that the table leaves out some robots; "" if it leaves out none."""
        if not self.left_out:
            return ""
        return (
            f"there are more than {self._most} robots, and this list shows only {self._most} "
            "of them: to choose the robots, use --id robot1,robot2"
        )

    def hint(self) -> str:
        """Return a sentence for an empty table. It explains why no robot is shown."""
        if ALL_ROBOTS in self._ids:
            return no_robot_text(self._robot.where.endpoint)
        return (
            "none of the robots named with --id is present: correct --id, or start the daemons of "
            "these robots"
        )
