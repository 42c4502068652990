"""Formats the robots that `acsard fleet` shows as a table. This module is pure."""

from __future__ import annotations

import math
from collections.abc import Sequence

from rich.table import Table
from rich.text import Text

from acsard.core.formatting import printable, rough, signed
from acsard.core.messages.schema import RobotState
from acsard.core.messages.state_warnings import beside_reason, brief, charge, warnings
from acsard.host.version import order
from acsard.top.roster import Row, absence

DAY_S = 86400.0

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
        f"{lost}{_expired(row)}, was: {_why(state)}" if lost else _why(state),
    )


def _expired(row: Row) -> str:
    # The last `state` says when, whatever the robot does now: it may be switched off as well.
    days = row.state.certificate_days if row.state else None
    if days is None or row.age < days * DAY_S:
        return ""
    return " (its certificate has ended by now: type `acsard doctor` on the robot)"


def _version(state: RobotState, newest: tuple[int, ...]) -> str:
    text = printable(state.version) or "-"
    return f"{text} older" if () < order(state.version) < newest else text


def _why(state: RobotState) -> str:
    problems = beside_reason(state)
    parts = [printable(state.why)]
    if problems:
        parts.insert(1 if state.mode in URGENT else 0, brief(problems))
    details = [(warning.what.replace("_", " "), warning.text) for warning in problems]
    details += [("speed limit", state.speed_limit), ("set", state.settings_differ)]
    return "; ".join(parts + [f"{what}: {printable(text)}" for what, text in details if text])


def _place(state: RobotState) -> str:
    figures = (state.x, 1), (state.y, 1), (math.degrees(state.yaw), 0)
    return " ".join(signed(value, decimals, 7).strip() for value, decimals in figures) + "°"


def _urgency(row: Row) -> str:
    return absence(row) or ("" if row.state is None else row.state.mode)


def _order(row: Row) -> tuple[int, str]:
    if (what := _urgency(row)) in URGENT:
        return URGENT.index(what), row.robot_id
    warned = row.state is not None and warnings(row.state)
    return len(URGENT) + (not warned), row.robot_id
