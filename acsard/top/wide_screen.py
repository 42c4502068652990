"""Builds the lines of `acsard top` below the robot's mode, for a wide terminal.

This module is pure.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence

from rich.text import Text

from acsard.core.formatting import rough, signed
from acsard.core.messages.schema import Info, RobotState, SourceState, Spread
from acsard.core.messages.short_texts import power
from acsard.core.motion.gyro import STATUS_TEXTS
from acsard.core.values import NS_PER_S
from acsard.daemon.latencies import NAMES
from acsard.top.text import ScreenData, bar, clean, count, rate, row, rule, seen

# Widest screen: longer lines are harder to read.
MAX_COLUMNS = 116

MOST_REASONS, MOST_PORT = 16, 34

LINK_STYLES = {"up": "green", "booting": "yellow"}

# A short and a long explanation: at most 21 and 56 cells. `a → b` is the time from a to b.
LATENCY_ROWS = {
    "period_lateness": (
        "period due → step",
        "from the due time (or first missed one) to step start",
    ),
    "step_time": ("work of one step", "from the start of a step to the end of its work"),
    "command_age": ("arrival → each line", "from a command's arrival to each line that carries it"),
    "command_to_wire": (
        "arrival → first line",
        "from a command's arrival to the first line it causes",
    ),
    "feedback_to_bus": (
        "line read → published",
        "from reading a line to publishing its messages",
    ),
    "mcu_round_trip": (
        "line out → answer in",
        "from sending a line to its answer (checked link only)",
    ),
}


def motion(state: RobotState, width: int) -> list[Text]:
    """Return lines with pose and twist on the left, and the wheel speeds on the right."""
    (right, left, rear_left, rear_right), scale = speeds(state)
    cells = 6 + max(0, width - 80) // 2
    at = ((0, "pose and twist"), (40, "wheels rad/s"), (56, "left"), (68 + cells, "right"))
    place = f"x {signed(state.x, 3, 8)} m  y {signed(state.y, 3, 8)} m  "
    place += f"yaw {signed(math.degrees(state.yaw), 1, 6)}°"
    twist = f"forward {signed(state.linear, 3, 7)} m/s  turn {signed(state.angular, 3, 7)} rad/s"
    rows = ((place, "front", left, right), (twist, "rear", rear_left, rear_right))
    lines = [rule(width, at)]
    for text, axle, speed, other in rows:
        line = Text(text.ljust(40))
        line.append(axle.ljust(6), "dim")
        line.append_text(wheel(speed, scale, cells)).append("  ")
        lines.append(line.append_text(wheel(other, scale, cells)))
    return lines


def speeds(state: RobotState) -> tuple[tuple[float, ...], float]:
    """Return the measured wheel speeds, NaN if unknown, and that of a full bar, rad/s."""
    wheels = (*state.wheels[:4], *[math.nan] * (4 - len(state.wheels)))
    top = max((abs(speed) for speed in wheels if math.isfinite(speed)), default=0.0)
    return wheels, next((s for s in (20.0, 40.0, 80.0) if top <= s), 100.0)


def wheel(speed: float, scale: float, cells: int) -> Text:
    """Return a speed in rad/s (or NaN) as a symbol of its direction, a number and a bar."""
    if speed == 0.0 or not math.isfinite(speed):
        sign, style = "·", "dim"
    else:
        sign, style = ("▲", "green") if speed > 0 else ("▼", "magenta")
    number = "-".rjust(7) if math.isnan(speed) else signed(speed, 2, 7)
    return Text.assemble(
        (sign, style), number, "  ", (bar(speed, scale, cells).ljust(cells), style)
    )


def sources(state: RobotState, room: int, width: int) -> list[Text]:
    """Return a heading, and at most `room` lines, of which the last one counts the rest."""
    room_name = 13 + max(0, width - 80) // 2
    start = room_name + 3
    at = ((0, "sources"), (start, "priority"), (start + 10, "seen"), (start + 17, "waits for"))
    lines = [rule(width, at)]
    top_sources = state.sources[: room if len(state.sources) <= room else room - 1]
    lines += [_source(source, state, room_name) for source in top_sources]
    if len(top_sources) < len(state.sources):
        lines.append(Text(hidden(state.sources[len(top_sources) :]), "dim"))
    return lines if state.sources else [*lines, Text("  none", "dim")]


def hidden(left: Sequence[SourceState]) -> str:
    """Return a line that counts the sources that do not fit, and names some of them."""
    names = ", ".join(clean(source.name) for source in left[:MOST_REASONS])
    return f"  and {count(len(left))} more: {names}"


def drives(source: SourceState, state: RobotState) -> bool:
    return source.name == state.source and state.mode == "driving" and not source.waits_for


def waits(source: SourceState, state: RobotState) -> str:
    """Return why a command source does not drive the robot, or that it drives."""
    if source.waits_for:
        return clean(source.waits_for)
    if drives(source, state):
        return "nothing: it drives"
    return f"nothing, but the robot is {clean(state.mode)}"


def _source(source: SourceState, state: RobotState, room: int) -> Text:
    drive = drives(source, state)
    live = drive or source.wait != "command"
    mark, style = ("▶ ", "bold green") if drive else ("  ", "" if live else "dim")
    name = Text(clean(source.name))
    name.truncate(room, overflow="ellipsis", pad=True)
    figures = f"{count(source.priority):>8}  {seen(source.age):<7}"
    return Text(f"{mark}{name.plain} {figures}{waits(source, state)}", style)


def link(data: ScreenData, state: RobotState, width: int) -> list[Text]:
    """Return lines about the serial link, commands, rejected inputs and what the robot reports."""
    before = data.before or state
    head = title(data, state)
    titles: list[tuple[int, str | Text]] = [(0, head)]
    if state.certificate_expiry:
        expiry = certificate(state)
        titles.append((max(head.cell_len + 2, width - expiry.cell_len - 4), expiry))
    counted = rates(data, state, before)
    superseded = state.counters.get("lines_superseded", 0)
    lines = [
        rule(width, titles),
        row("lines", f"in {counted('lines'):<21} out {counted('lines_sent'):<21}").append(
            f" superseded {count(superseded)}"
        ),
        row("commands", f"   {counted('commands'):<21} ").append_text(missed(state, before)),
    ]
    if met := state.counters.get("commands_of_new_senders", 0):
        lines[-1].append(f"  of new senders {count(met)}", "dim")
    if lost := overrun(state):
        lines[-1].append("  ").append_text(lost)
    if state.gyro != "off":
        lines.append(_gyro(state.gyro))
    if inputs := board(state):
        lines.append(row("board", inputs))
    lines += _refusals(state, before)
    return lines


def title(data: ScreenData, state: RobotState) -> Text:
    """Return the heading of the serial link: its state and port."""
    heading = Text.assemble(
        "link ", (clean(state.link), f"bold {LINK_STYLES.get(state.link, 'red')}")
    )
    if data.info is not None:
        sim = data.info.simulated
        heading.append(" on ", "dim").append("the built-in SIMULATOR" if sim else _port(data.info))
    return heading


def certificate(state: RobotState) -> Text:
    style = "" if state.certificate == "valid" else "bold red"
    return Text(f"certificate {clean(state.certificate_expiry)}", style)


def rates(data: ScreenData, state: RobotState, before: RobotState) -> Callable[[str], str]:
    """Return a function that shows the rate since `before`, and the total, of a counter."""
    # The stamps give the exact time between the two states. If this time differs by more than 0.2 s
    # (a network's delay) from the time between the arrivals of the states, the robot's clock was
    # set. In this case, use the time between the arrivals.
    seconds = (state.stamp.to_ns() - before.stamp.to_ns()) / NS_PER_S
    if abs(seconds - data.passed) > 0.2:
        seconds = data.passed

    def counted(name: str) -> str:
        now, then = state.counters.get(name, 0), before.counters.get(name, 0)
        return f"{rate(now, then, seconds)} of {count(now)}"

    return counted


def board(state: RobotState) -> str:
    """Return emergency stop, bumpers and battery in words, or ""."""
    parts = [f"emergency stop {clean(state.emergency_stop)}"] if state.emergency_stop else []
    if state.bumpers is not None:
        parts.append(f"bumpers {''.join('X' if bumper else '.' for bumper in state.bumpers)}")
    if state.battery is not None:
        parts += ["battery", *power(state.battery)]
    return "  ".join(parts)


def overrun(state: RobotState) -> Text:
    """Say how many bus messages the daemon dropped because too many arrived."""
    lost = state.counters.get("bus_overrun", 0)
    return Text(f"bus overrun {count(lost)}" if lost else "", "yellow")


def _gyro(does: str) -> Text:
    good = does in ("used", "waiting for rest", "waiting for turn")
    status = next(
        (f"{name}: {words}" for name, words in STATUS_TEXTS.items() if name == does), clean(does)
    )
    return row("gyro", status, "" if good else "yellow")


def _port(info: Info) -> str:
    port = clean(info.port)
    return port if len(port) <= MOST_PORT else port.rpartition("/")[2][:MOST_PORT]


def missed(state: RobotState, before: RobotState) -> Text:
    """Say how many control periods the daemon missed, in yellow if more than `before`."""
    missed = state.counters.get("missed_periods", 0)
    grows = missed > before.counters.get("missed_periods", 0)
    return Text(f"missed periods {count(missed)}", "yellow" if grows else "")


def _refusals(state: RobotState, before: RobotState) -> list[Text]:
    kinds = [
        Text(f"{kind} ").append_text(Text(", ").join(parts))
        for kind, parts in refused(state, before)
    ]
    joined = Text(" · ").join(kinds) if kinds else Text("nothing", "dim")
    last = row("last one", clean(state.refused)) if state.refused else row("last one", "-", "dim")
    return [row("rejected", "").append_text(joined), last]


def refused(state: RobotState, before: RobotState) -> list[tuple[str, list[Text]]]:
    """Return the rejected inputs by kind, each with its reason; yellow if more than `before`."""
    kinds = []
    for kind, prefix in (("lines", "line_"), ("commands", "command_"), ("gyro", "imu_")):
        counters = [(n, c) for n, c in state.counters.items() if n.startswith(prefix) and c]
        counters.sort(key=lambda item: -item[1])
        parts = []
        for name, number in counters[:MOST_REASONS]:
            grows = number > before.counters.get(name, 0)
            text = f"{clean(name.removeprefix(prefix)).replace('_', ' ')} {count(number)}"
            parts.append(Text(text, "yellow" if grows else ""))
        if parts:
            kinds.append((kind, parts))
    return kinds


def timing(state: RobotState, width: int) -> list[Text]:
    long = width >= MAX_COLUMNS
    room = 56 if long else 21
    start = 16 + room
    at = ((0, "timing"), (start + 2, "last minute"), (start + 23, "since start"))
    heads = "".join(f"{name:>7}" for name in ("p50", "p99", "max"))
    lines = [rule(width, at), Text(f"{'':{start}}{heads}{heads}", "dim")]
    for name in NAMES:
        line = Text(f"{name:<16}").append(LATENCY_ROWS[name][long].ljust(room), "dim")
        latency = state.latencies.get(name)
        for figures in (latency.last_minute, latency.since_start) if latency else (None, None):
            line.append_text(spread(figures))
        lines.append(line)
    return lines


def spread(figures: Spread | None) -> Text:
    """Return median, 99th percentile and maximum of a latency in columns of 7 cells, "-" if
    unknown.
    """
    if figures is None or figures.count <= 0:
        return Text("-".rjust(7) * 3, "dim")
    p50, p99, most = (
        rough(1e-6 * us, 1e-6).rjust(7) for us in (figures.p50, figures.p99, figures.max)
    )
    return Text.assemble(p50, (p99, "bold"), (most, "dim"))
