"""Builds the parts of the screen of `acsard top` for a narrow terminal. This module is pure.

The narrow screen shows the same values as the wide screen (`wide_screen.py`). The latencies since
the start of the daemon come last, so a terminal with few lines cuts them off first.
"""

from __future__ import annotations

import math
from textwrap import wrap

from rich.cells import cell_len
from rich.text import Text

from acsard.core.formatting import signed
from acsard.core.messages.schema import RobotState
from acsard.daemon.latencies import NAMES
from acsard.top.text import ScreenData, clean, count, flow, rule, seen
from acsard.top.wide_screen import (
    board,
    certificate,
    drives,
    hidden,
    missed,
    overrun,
    rates,
    refused,
    speeds,
    spread,
    title,
    waits,
    wheel,
)

# Terminals with fewer cells per line get the narrow layout.
MIN_WIDE_COLUMNS = 80

BAR_WIDTH = 4


def motion(state: RobotState, width: int) -> list[Text]:
    """Return lines with pose and twist, then with the speeds of the front and rear wheels."""
    figures = [
        f"x {signed(state.x, 3, 8)} m",
        f"y {signed(state.y, 3, 8)} m",
        f"yaw {signed(math.degrees(state.yaw), 1, 6)}°",
        f"forward {signed(state.linear, 3, 7)} m/s",
        f"turn {signed(state.angular, 3, 7)} rad/s",
    ]
    lines = [
        rule(width, [(0, "pose and twist")]),
        *flow([Text(value) for value in figures], width, 0),
    ]
    lines.append(Text("wheels rad/s", "cyan"))
    (right, left, rear_left, rear_right), scale = speeds(state)
    for axle, value, other in (("front", left, right), ("rear", rear_left, rear_right)):
        line = Text(f"  {axle:<6}", "dim").append_text(wheel(value, scale, BAR_WIDTH)).append(" ")
        lines.append(line.append_text(wheel(other, scale, BAR_WIDTH)))
    return lines


def sources(state: RobotState, room: int, width: int) -> list[Text]:
    """Return lines about each command source: priority, age of the last command, status.

    If they need more than about `room` lines, the last one counts the sources that do not fit.
    """
    lines = [rule(width, [(0, "sources"), (16, "priority"), (26, "seen")])]
    left = list(state.sources)
    while left:
        source = left[0]
        mark = "▶ " if drives(source, state) else "  "
        name = Text(clean(source.name))
        name.truncate(13, overflow="ellipsis", pad=True)
        rows = [Text(f"{mark}{name.plain} {count(source.priority):>8}  {seen(source.age)}")]
        rows += folded(f"status: {waits(source, state)}", width, 4)
        if len(lines) > 1 and len(lines) + len(rows) > room:
            break
        lines += rows
        left.pop(0)
    if left:
        lines.append(Text(hidden(left), "dim"))
    return lines if state.sources else [*lines, Text("  none", "dim")]


def link(data: ScreenData, state: RobotState, width: int) -> list[Text]:
    """Return lines about the serial link, the commands and the rejected inputs."""
    before = data.before or state
    lines = [rule(width, [(0, title(data, state))])]
    if state.certificate_expiry:
        lines += flow([certificate(state)], width, 2)
    counted = rates(data, state, before)
    figures = [
        Text(f"lines in {counted('lines')}"),
        Text(f"lines out {counted('lines_sent')}"),
        Text(f"commands {counted('commands')}"),
    ]
    superseded = state.counters.get("lines_superseded", 0)
    figures += [Text(f"superseded {count(superseded)}"), missed(state, before), overrun(state)]
    if met := state.counters.get("commands_of_new_senders", 0):
        figures.append(Text(f"commands of new senders {count(met)}"))
    lines += flow([figure for figure in figures if figure], width, 0)
    if state.gyro != "off":
        lines += folded(f"gyro {clean(state.gyro)}", width, 2, labelled=True)
    if inputs := board(state):
        lines += folded(f"board {inputs}", width, 2, labelled=True)
    kinds = refused(state, before)
    for kind, parts in kinds:
        lines += flow([Text(f"rejected {kind}"), *parts], width, 2)
    if not kinds:
        lines.append(Text("rejected nothing"))
    last = f"last one {clean(state.refused) or '-'}"
    return [*lines, *folded(last, width, 2, labelled=True)]


def timing(state: RobotState, width: int) -> list[Text]:
    heads = "".join(f"{name:>7}" for name in ("p50", "p99", "max"))
    lines = [rule(width, [(0, "timing")])]
    for since, last in (("last minute", True), ("since start", False)):
        lines.append(Text(f"{since:<16}{heads}", "dim"))
        for name in NAMES:
            latency = state.latencies.get(name)
            figures = (latency.last_minute if last else latency.since_start) if latency else None
            lines.append(Text(f"{name:<16}").append_text(spread(figures)))
    return lines


def folded(text: str, width: int, inset: int, *, labelled: bool = False) -> list[Text]:
    """Wrap a text, with lines indented by `inset` cells, except a first line with a label."""
    first = "" if labelled else " " * inset
    wide = max((cell_len(piece) for piece in text), default=1)  # a character may be two cells wide
    room, rest = max(inset + 1, width // max(1, wide)), " " * inset
    return [Text(piece) for piece in wrap(text, room, initial_indent=first, subsequent_indent=rest)]
