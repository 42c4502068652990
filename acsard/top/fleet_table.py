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
from acsard.host.version import order

COLUMN_HEADS = ("ROBOT", "MODE", "M/S", "LINK", "BATTERY", "PLACE", "VERSION", "SEEN", "WHY")

# Maximum widths of all columns except the last, which gets the rest.
COLUMN_WIDTHS = (32, 8, 6, 7, 7, 22, 33, 6)

# Minimum widths. On a narrow terminal, ROBOT shrinks to its minimum first.
NAME, WHY = 12, 32

# The table has this column only if any robot reports a battery.
BATTERY_COLUMN = COLUMN_HEADS.index("BATTERY")

# Listed first, in this order; then robots with a warning.
URGENT = ("fault", "stopped", "GONE", "SILENT")


def table(rows: Sequence[Row], width: int, height: int | None = None) -> list[str]:
    """Return a header line, and a line for each robot, the urgent ones first.

    If some do not fit into `height` lines, the last line says how many.
    """
    newest = max((order(row.state.version) for row in rows if row.state), default=())
    cells = [COLUMN_HEADS, *(row_cells(row, newest) for row in sorted(rows, key=_order))]
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
    """Return the names in at most `room` characters, with "…" where most of them stay distinct."""
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


def row_cells(row: Row, newest: tuple[int, ...]) -> tuple[str, ...]:
    """Return the texts of a robot's cells, in the order of `COLUMN_HEADS`.

    `newest` is the order of the newest version in the table.
    """
    name = printable(row.robot_id)
    if row.state is None:
        why = "waiting for its state" if row.here else "not there"
        return (name, "-", "-", "-", "", "-", "-", "never", why)
    state, absence = row.state, _absence(row)
    return (
        name,
        printable(state.mode),
        signed(state.linear, 2, 6),
        printable(state.link),
        charge(state.battery),
        _place(state),
        _version(state, newest),
        rough(row.age),
        f"{absence}, was: {_why(state)}" if absence else _why(state),
    )


def _version(state: RobotState, newest: tuple[int, ...]) -> str:
    text = printable(state.version) or "-"
    return f"{text} older" if () < order(state.version) < newest else text


def _why(state: RobotState) -> str:
    same = SAME_AS_REASON.get(state.code)
    problems = [warning for warning in warnings(state) if warning.what != same]
    parts = [printable(state.why)]
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
    what = _absence(row) or ("" if row.state is None else row.state.mode)
    if what in URGENT:
        return URGENT.index(what), row.robot_id
    warned = row.state is not None and warnings(row.state)
    return len(URGENT) + (not warned), row.robot_id


class Roster(Fleet):
    """The robots that `acsard fleet` shows, and the reason why robots may be missing."""

    def rows(self) -> list[Row]:
        self.send_queries(self.due())
        return super().rows()

    def gather(self) -> list[Row]:
        """Wait for the first reports, and return one row per robot.

        The wait ends when all named robots have reported, or after 1.5 s; without any robot after 3
        s, because the first answer can be late on a busy computer.
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
        """Whether all robots that the user named have reported."""
        with self._lock:
            known = list(self._known.values())
        named = ALL_ROBOTS not in self._ids
        return named and all(robot.here and robot.follower.is_confirmed for robot in known)

    @property
    def presence_text(self) -> str:
        """How many robots are present, or "" if the user named robots."""
        with self._lock:
            here = sum(robot.here for robot in self._known.values())
        return count_text(self._robot.where.endpoint, here) if ALL_ROBOTS in self._ids else ""

    @property
    def left_out_text(self) -> str:
        """That the table leaves out some robots, or ""."""
        if not self.left_out:
            return ""
        return (
            f"there are more than {self._most} robots, and this list shows only {self._most} "
            "of them: to choose the robots, use --id robot1,robot2"
        )

    def hint(self) -> str:
        """Return why an empty table shows no robot."""
        if ALL_ROBOTS in self._ids:
            return no_robot_text(self._robot.where.endpoint)
        return (
            "none of the robots named with --id is present: correct --id, or start the daemons of "
            "these robots"
        )
