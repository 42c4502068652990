"""Builds the screen of `acsard top` from a robot's state, as tables of rich.

This module is pure. The least important tables come last, where a terminal with few lines cuts them
off.
Text from the bus reaches the terminal only through `clean`, and only inside rich's `Text`, which
does not interpret markup.
"""

from __future__ import annotations

import math
from collections.abc import Iterable, Sequence

from msgspec import Struct
from rich.cells import cell_len
from rich.console import Group, RenderableType
from rich.styled import Styled
from rich.table import Table
from rich.text import Text

from acsard.core.formatting import lasting, printable, rough, signed
from acsard.core.messages.schema import Info, RobotState, SourceState
from acsard.core.messages.short_texts import cause_numbers, power
from acsard.core.messages.state_warnings import WARNING, brief, warnings
from acsard.core.motion.gyro import STATUS
from acsard.core.values import NS_PER_S, TWO_WHEELS
from acsard.daemon.latencies import NAMES
from acsard.terminal.output import table

# Styles in the notation of rich.
MODE_STYLES = {
    "driving": "bold white on green",
    "ready": "bold white on blue",
    "waiting": "bold black on yellow",
    "shutdown": "bold black on yellow",
    "inactive": "bold black on white",
    "stopped": "bold white on red",
    "fault": "bold white on red",
}

LINK_STYLES = {"up": "bold green", "booting": "bold yellow"}

# Cells of the tables on the left, with the gap, and on the right.
PAIR_WIDTHS = 40, 40


class ScreenData(Struct, frozen=True):
    """What the screen of `acsard top` shows. Rates compare `state` with the earlier `before`."""

    robot_id: str
    endpoint: str
    state: RobotState | None
    before: RobotState | None = None
    age: float = 0.0  # since `state` arrived, or since the wait for the first one began
    info: Info | None = None
    undecodable: int = 0  # messages since the last readable state
    hint: str = ""
    silent: bool = False  # no state has arrived for too long
    # s between `before` and `state` on this computer; other stamps: an adjusted clock
    passed: float = 0.0


def screen(data: ScreenData, width: int) -> Group:
    state = data.state
    if data.silent:
        head: list[RenderableType] = [_header(data), _silence(data)]
    elif state is None:
        words = "waiting for the first state message of the daemon"
        head = [_header(data), Text(words, "yellow")]
    else:
        head = [_header(data), mode_line(state)]
    if state is None:
        return Group(*head)
    if problems := warnings(state):
        words = f"{WARNING}: {problems[0]}" if len(problems) == 1 else brief(problems)
        head.append(Text(clean(words), "yellow"))
    parts = [_pose(state), _wheels(state), _link(data, state), _timing(state)]
    body = Group(*_in_pairs(parts, width), _sources(state), _facts(data, state))
    return Group(*head, Styled(body, "dim" if data.silent else ""))


def _in_pairs(parts: Sequence[Table], width: int) -> Sequence[Table]:
    # Below each other on a narrow terminal.
    if width < sum(PAIR_WIDTHS):
        return parts
    # `rich.columns` would find the widths by itself, but takes twice as long.
    grid = Table.grid(padding=0)  # versions of rich differ in what a width includes
    for column_width in PAIR_WIDTHS:
        grid.add_column(width=column_width)
    for left, right in zip(parts[::2], parts[1::2], strict=True):
        grid.add_row(left, right)
    return [grid]


def _header(data: ScreenData) -> Text:
    head = Text.assemble((clean(data.robot_id), "bold"), "  ", clean(data.endpoint))
    if data.info is not None:
        head.append(f"  acsard {clean(data.info.version)}", "dim")
    if data.state is not None:
        head.append(f"  seen {rough(data.age)} ago", "dim")
    return head.append(f"  {data.hint}")


def _silence(data: ScreenData) -> Text:
    since = lasting(int(min(data.age, 1e9)))
    words = f" NOTHING RECEIVED FOR {since}: is the daemon running? "
    if data.undecodable:
        words = f" NOTHING READABLE FOR {since}: is the daemon a different version? "
    return Text(words, "bold white on red")


def mode_line(state: RobotState) -> Text:
    """Return the mode in its color, the reason, and the numbers of the causes."""
    badge = Text(f" {clean(state.mode).upper()[:12]} ", MODE_STYLES.get(state.mode, "reverse"))
    why = clean(state.why) + clean(cause_numbers(state))
    return Text().append_text(badge).append(f"  {why}", "bold")


def _table(
    heads: Sequence[str | Text], rows: Iterable[Sequence[str | Text]], right: Sequence[int] = ()
) -> Table:
    made = table(rows, heads, right)
    made.header_style = "cyan"
    return made


def _measured(state: RobotState, value: float | None, decimals: int, width: int) -> str:
    # Without a link no old speed is shown.
    return signed(value if state.link == "up" else None, decimals, width)


def _pose(state: RobotState) -> Table:
    forward = _measured(state, state.linear, 3, 7)
    turn = _measured(state, state.angular, 3, 7)
    rows = [
        (f"x   {signed(state.x, 3, 8)} m", f"forward {forward} m/s"),
        (f"y   {signed(state.y, 3, 8)} m", f"turn    {turn} rad/s"),
        (f"yaw {signed(math.degrees(state.yaw), 1, 8)}°", ""),
    ]
    return _table(("pose", "twist"), rows)


def _wheels(state: RobotState) -> Table:
    right, left, rear_left, rear_right = (*state.wheels[:4], *[math.nan] * 4)[:4]
    axles = [("front", left, right), ("rear", rear_left, rear_right)]
    if len(state.wheels) == len(TWO_WHEELS):
        axles = [("", left, right)]
    rows = [(axle, *(_measured(state, v, 2, 7) for v in speeds)) for axle, *speeds in axles]
    return _table(("wheels, rad/s", "left", "right"), rows, (1, 2))


def _link(data: ScreenData, state: RobotState) -> Table:
    before = data.before or state
    # The stamps give the exact time between the two states. If this time differs by more than 0.2 s
    # (a network's delay) from the time between the arrivals of the states, the robot's clock was
    # set. In this case, use the time between the arrivals.
    seconds = (state.stamp.to_ns() - before.stamp.to_ns()) / NS_PER_S
    if abs(seconds - data.passed) > 0.2:
        seconds = data.passed

    def counted(label: str, name: str, rates: bool = False) -> tuple[str, str, Text]:
        now, then = state.counters.get(name, 0), before.counters.get(name, 0)
        style = "yellow" if now > then and not rates else ""
        return label, rate(now, then, seconds) if rates else "", Text(f"{now:,}", style)

    rows = [
        counted("lines in", "lines", True),
        counted("lines out", "lines_sent", True),
        counted("commands", "commands", True),
        counted("missed periods", "missed_periods"),
        counted("superseded", "lines_superseded"),
    ]
    for label, name in (
        ("bus overrun", "bus_overrun"), ("new senders", "commands_of_new_senders"),
    ):  # fmt: skip
        if state.counters.get(name, 0):
            rows.append(counted(label, name))
    up = Text.assemble("link ", (clean(state.link), LINK_STYLES.get(state.link, "bold red")))
    return _table((up, "rate", "total"), rows, (1, 2))


def _timing(state: RobotState) -> Table:
    rows = []
    for name in NAMES:
        latency = state.latencies.get(name)
        figures = latency.last_minute if latency else None
        if figures is None or figures.count <= 0:
            rows.append((name, *["-".rjust(6)] * 3))
            continue
        values = (figures.p50, figures.p99, figures.max)
        rows.append((name, *(rough(1e-6 * us, 1e-6).rjust(6) for us in values)))
    return _table(("last minute", "p50", "p99", "max"), rows, (1, 2, 3))


def _sources(state: RobotState) -> Table:
    rows = [
        (
            Text(f"{'▶ ' if _drives(source, state) else '  '}{clean(source.name)}", no_wrap=True),
            f"{source.priority:,}",
            # After a `clear` no command counts, although some have been seen.
            "-" if source.age is None else rough(source.age),
            _waits(source, state),
        )
        for source in state.sources
    ]
    return _table(("sources", "priority", "seen", "waits for"), rows, (1, 2))


def _drives(source: SourceState, state: RobotState) -> bool:
    return source.name == state.source and state.mode == "driving" and not source.waits_for


def _waits(source: SourceState, state: RobotState) -> str:
    parts = [clean(source.waits_for) or f"nothing, but the robot is {clean(state.mode)}"]
    if _drives(source, state):
        parts = ["nothing: it drives"]
    elif source.wait == "neutral" and source.linear is not None and source.angular is not None:
        parts.append(f"it sends {source.linear:.3f} m/s, {source.angular:.3f} rad/s")
    if source.longest_gap:
        parts.append(f"usable commands up to {source.longest_gap:.1f} s apart")
    return "; ".join(parts)


def _facts(data: ScreenData, state: RobotState) -> Table:
    rows: list[tuple[str, str | Text]] = []
    if data.info is not None:
        where = "the built-in SIMULATOR" if data.info.simulated else clean(data.info.port)
        rows.append(("port", where))
    if state.gyro != "off":
        words = {str(does): f"{does}: {why.text}" for does, why in STATUS.items()}
        rows.append(("gyro", words.get(state.gyro, clean(state.gyro))))
    if inputs := _board(state):
        rows.append(("board", inputs))
    if state.certificate_expiry:
        rows.append(("certificate", clean(state.certificate_expiry)))
    if state.settings_differ:
        rows.append(("set", f"{clean(state.settings_differ)} as at the daemon's start"))
    rows += [
        ("rejected", _rejected(state, data.before or state)),
        ("last one", clean(state.refused) or "-"),
    ]
    return _table(("", ""), rows)


def _board(state: RobotState) -> str:
    parts = [f"emergency stop {clean(state.emergency_stop)}"] if state.emergency_stop else []
    if state.bumpers is not None:
        parts.append(f"bumpers {''.join('X' if bumper else '.' for bumper in state.bumpers)}")
    if state.battery is not None:
        parts += ["battery", *power(state.battery)]
    return "  ".join(parts)


def _rejected(state: RobotState, before: RobotState) -> Text:
    kinds = []
    for kind, prefix in (("lines", "line_"), ("commands", "command_"), ("gyro", "imu_")):
        counters = [(n, c) for n, c in state.counters.items() if n.startswith(prefix) and c]
        counters.sort(key=lambda item: -item[1])
        parts = [
            Text(
                f"{clean(name.removeprefix(prefix)).replace('_', ' ')} {number:,}",
                "yellow" if number > before.counters.get(name, 0) else "",
            )
            for name, number in counters
        ]
        if parts:
            kinds.append(Text(f"{kind} ").append_text(Text(", ").join(parts)))
    return Text(" · ").join(kinds) if kinds else Text("nothing")


def clean(text: str) -> str:
    """Return at most 256 characters of a text, with visible ones instead of control characters."""
    return "".join(c if cell_len(c) else "\ufffd" for c in printable(text[:256]))


def rate(later: int, earlier: int, seconds: float) -> str:
    """Return a counter's increase per second in at least 7 characters; "-/s" if not plausible."""
    # After a clock change or a restart of the daemon, a wrong rate must not be shown.
    if not 0.05 <= seconds <= 60.0 or not 0 <= later - earlier < 10**6:
        return "-/s".rjust(7)
    hz = (later - earlier) / seconds
    return f"{hz:5.1f}/s" if hz < 999.95 else f"{hz:5.0f}/s"
