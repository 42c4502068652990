"""Collects the robots that `acsard fleet` shows, and formats them as a table."""

from __future__ import annotations

import math
import time
from collections.abc import Sequence

from msgspec.structs import replace
from rich.table import Table
from rich.text import Text

from acsard.bus.robot_discovery import ALL_ROBOTS, count_text, no_robot_text
from acsard.client.fleet import Fleet, Row
from acsard.core.formatting import printable, rough, signed
from acsard.core.messages.schema import RobotState
from acsard.core.messages.state_warnings import SAME_AS_REASON, brief, charge, warnings
from acsard.host.version import order

# On a narrower terminal, a column is left out; BATTERY also if no robot reports one.
COLUMNS = {
    "ROBOT": 0, "MODE": 0, "M/S": 60, "LINK": 90, "BATTERY": 70, "PLACE": 100, "VERSION": 120,
    "SEEN": 50, "WHY": 0,
}  # fmt: skip

# Listed first, in this order; then robots with a warning.
URGENT = ("fault", "stopped", "GONE", "SILENT")


def table(rows: Sequence[Row], width: int, most: int | None = None) -> Table:
    """Return a table with a row for each robot, but at most `most`, the urgent ones first."""
    newest = max((order(row.state.version) for row in rows if row.state), default=())
    powered = any(row.state and row.state.battery for row in rows)
    shown = [name for name, least in COLUMNS.items() if width >= least]
    if not powered and "BATTERY" in shown:
        shown.remove("BATTERY")
    made = Table(box=None, pad_edge=False, padding=(0, 2, 0, 0), header_style="bold cyan")
    if most is not None and len(rows) > most:
        made.caption, made.caption_justify = f"and {len(rows) - most} more", "left"
    for name in shown:
        folds = name in ("ROBOT", "WHY")
        made.add_column(name, no_wrap=not folds, overflow="fold", max_width=None if folds else 33)
    for row in sorted(rows, key=_order)[:most]:
        cells = dict(zip(COLUMNS, row_cells(row, newest), strict=True))
        texts = [Text(cells[name]) for name in shown]
        texts[-1].no_wrap, texts[-1].overflow = True, "ellipsis"  # one line for each robot
        made.add_row(*texts, style=_style(row))
    return made


def _style(row: Row) -> str:
    if _urgency(row) in URGENT:
        return "bold red"
    return "bold yellow" if row.state is not None and warnings(row.state) else ""


def row_cells(row: Row, newest: tuple[int, ...]) -> tuple[str, ...]:
    """Return the texts of a robot's cells, in the order of `COLUMNS`.

    `newest` is the order of the newest version in the table.
    """
    name = printable(row.robot_id)
    if row.state is None:
        why = "not there" if not row.here else "waiting for its state"
        if absence(row) == "SILENT":
            why = "SILENT: its daemon is there and does not answer"
        return (name, "-", "-", "-", "", "-", "-", "never", why)
    state, lost = row.state, absence(row)
    return (
        name,
        printable(state.mode),
        signed(state.linear, 2, 6),
        printable(state.link),
        charge(state.battery),
        _place(state),
        _version(state, newest),
        rough(row.age),
        f"{lost}, was: {_why(state)}" if lost else _why(state),
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


def absence(row: Row) -> str:
    """Return "GONE" for a robot without a daemon, "SILENT" for one that hangs, or ""."""
    if not row.here:
        return "GONE"
    return "SILENT" if row.silent else ""


def _urgency(row: Row) -> str:
    return absence(row) or ("" if row.state is None else row.state.mode)


def _order(row: Row) -> tuple[int, str]:
    if (what := _urgency(row)) in URGENT:
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

        The wait ends when all named robots have reported; for "*" it takes 1.5 s. Without any
        robot, or if a named one is missing, it takes 3 s, because the first answer can be late on a
        busy computer. A robot that has not reported then is silent.
        """
        began, rows = time.monotonic(), self.rows()
        while (passed := time.monotonic() - began) < 3.0:
            present = any(row.here or row.state for row in rows)
            if present and self.all_reported and (passed >= 1.5 or ALL_ROBOTS not in self._ids):
                break
            time.sleep(0.05)
            rows = self.rows()
        return [replace(row, silent=True) if math.isinf(row.age) else row for row in rows]

    @property
    def all_reported(self) -> bool:
        """Whether all robots that the user named have reported."""
        with self._lock:
            named = [self._known.get(name) for name in self._ids if name != ALL_ROBOTS]
        return all(
            robot is not None and robot.here and robot.follower.is_confirmed for robot in named
        )

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
        """Return why no robot is there."""
        if tuple(self._ids) == (ALL_ROBOTS,):
            return no_robot_text(self._robot.where.endpoint)
        return (
            f"none of these robots is visible at {self._robot.where.endpoint}: start their daemons,"
            " or correct --id or [fleet] robots"
        )
