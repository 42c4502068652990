"""The screens of `acsard drive`, `top`, `fleet` and `echo --short`, and laws for any text.

The screens are in `words/`, for three widths, and once with their colours. `pytest --approve
tests/unit/test_cli_screens.py` writes them anew: read `git diff` then.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from rich.cells import cell_len
from rich.console import RenderableType

from acsard.core.messages.schema import (
    BatterySummary,
    Latency,
    RobotState,
    SourceState,
    Spread,
    Time,
)
from acsard.core.messages.short_texts import short
from acsard.core.motion.modes import Mode
from acsard.daemon.latencies import NAMES
from acsard.top import drive_screen, screen
from acsard.top.drive_screen import Teleop, velocity
from acsard.top.fleet_table import table
from acsard.top.roster import Row
from acsard.top.screen import MODE_STYLES, ScreenData, rate
from tests.each import each
from tests.unit.screens import INFO, SEEN, STATE, UNMEASURED, drawn, lines_of, of

WORDS = Path(__file__).with_name("words")

REASON = "the microcontroller's lines come 0.50 s apart; set mcu.reply_period = 0.50 in acsard.toml"
MANY = [SourceState(f"source{n}", n, None, "a command", "command") for n in range(40)]

WAITING = replace(
    STATE, mode="waiting", code="reply_period", reason=REASON, linear=0.0, angular=0.0, source=""
)
WARNED = replace(
    WAITING,
    emergency_stop="released",
    bumpers=[False, True],
    battery=BatterySummary(22.41, 21.0, -1.2, "warning"),
    certificate="expires",
    certificate_days=10.0,
    certificate_expiry="expires in 10 days",
    recording_error="/var/lib/acsard/recordings: No space left on device",
    gyro="silent",
    refused="source nav: the twist contains NaN or infinity",
    counters=STATE.counters
    | {"lines_superseded": 12_345, "bus_overrun": 7, "line_malformed": 30, "line_implausible": 12}
    | {"command_stale": 4, "commands_of_new_senders": 40, "imu_second_sender": 1200},
)

TOP = {
    "a robot that drives": SEEN,
    "before the first state": ScreenData("acsar", "tcp/127.0.0.1:7448", None),
    "a silent robot": replace(SEEN, age=100.0, silent=True),
    "another version": replace(SEEN, age=3.0, undecodable=9, silent=True),
    "a robot with warnings": replace(SEEN, state=WARNED),
    "a stopped robot": of(
        mode="stopped", code="stopped", reason="stopped by ann; type `acsard call clear`"
    ),
    "a simulator without a link": replace(
        of(link="down", settings_differ="limits.linear_speed = 0.2, not 1.0"),
        info=replace(INFO, simulated=True),
        before=None,
        passed=0.0,
    ),
    "many sources": of(sources=MANY),
    "after a clear": of(sources=[replace(source, age=None) for source in STATE.sources]),
    "two driven wheels": of(wheels=STATE.wheels[:2]),
    "without measurements": of(latencies=dict.fromkeys(STATE.latencies, UNMEASURED)),
}

TELEOP = Teleop(
    "acsar", "tcp/127.0.0.1:7448", "teleop", 0.5, 1.0, WAITING, 0.1, limits=velocity(0.2, 0.5)
)
OBJECTED = replace(TELEOP, objection="app has the same priority and came first")
STILL = replace(STATE, linear=0.0, angular=0.0, wheels=[0.0] * 4)
LONG = (
    "teleop may be late: its delays must be steady for 0.25 s if its clock is new here, for 1.5 s "
    "if that was set; the microcontroller's lines come 0.50 s apart; if it reports by its own "
    "clock, set mcu.reply_period = 0.50, and look at the cable"
)
DRIVE = {
    "the keys do not drive": OBJECTED,
    "before the first state": replace(TELEOP, state=None),
    "a silent robot": replace(TELEOP, age=7.0, silent=True),
    "a long reason": replace(TELEOP, state=replace(WAITING, reason=LONG), objection=LONG),
}
ENDS = {
    "it stands": replace(TELEOP, state=STILL),
    "it moves": replace(TELEOP, state=STATE),
    "it reports no speed": replace(TELEOP, state=replace(STILL, linear=None, wheels=[])),
    "it is silent": replace(TELEOP, age=7.0, silent=True),
}

READY = replace(STATE, mode="ready", code="no_command", reason="waiting for a command", linear=0.0)
PRESSED = (
    "emergency stop pressed at the robot; release it at the robot, then type `acsard call clear`"
)
ROBOTS = {
    "driving": replace(STATE, speed_limit="0.3 m/s, set by x"),
    "ready": replace(READY, certificate="valid"),
    "no-speed": replace(READY, linear=None, battery=BatterySummary(24.56, None, None, "ok")),
    "warned": WARNED,
    "fault": replace(
        STATE, mode="fault", code="wheel_runaway", reason="a wheel is stuck",
        settings_differ="limits.linear_speed = 0.8, not 1.0",
    ),
    "pressed": replace(
        STATE, mode="stopped", code="emergency_stop", reason=PRESSED, emergency_stop="pressed"
    ),
    "no-estop": replace(READY, emergency_stop="silent"),
    "latch-file": replace(READY, latch_file_error="no room"),
    "wheel-fault": replace(READY, wheel_fault="rear left wheel is left out"),
    "empty": replace(READY, battery=BatterySummary(20.0, None, None, "stop")),
    "no-battery": replace(READY, battery=BatterySummary(None, None, None, "unknown")),
    "older": replace(READY, version="0.2.0.dev0+g1a2b3c4d5"),
    "odd-version": replace(READY, version="unreadable"),
    **{f"{side}-of-the-robots-in-the-warehouse": READY for side in ("1", "2")},
}  # fmt: skip
FLEET = [
    *(Row(name, True, state, 0.1) for name, state in ROBOTS.items()),
    Row("gone", False, replace(STATE, version="0.1.9"), 90.0),
    Row("expired", False, replace(STATE, certificate_days=0.001), 90.0),
    Row("silent", True, STATE, 7.0, silent=True),
    Row("new", True, None, 0.1),
    Row("not-there", False, None, 0.1),
]


def screens(width: int) -> dict[str, RenderableType]:
    """Return all screens of this width, by the verb and the situation."""
    found: dict[str, RenderableType] = {
        f"top: {name}": screen.screen(data, width) for name, data in TOP.items()
    }
    found |= {f"drive: {name}": drive_screen.screen(data) for name, data in DRIVE.items()}
    found |= {f"drive has ended: {name}": drive_screen.last_report(d) for name, d in ENDS.items()}
    return found | {"fleet": table(FLEET, width), "fleet in few lines": table(FLEET, width, 6)}


def page(texts: dict[str, list[str]]) -> str:
    parts = ([f"--- {name}", *map(str.rstrip, lines)] for name, lines in texts.items())
    return "\n".join(line for part in parts for line in part) + "\n"


@pytest.mark.parametrize("width", [40, 80, 160])
def test_each_screen_fits_its_width_and_is_the_approved_one(
    width: int, approved: Callable[[Path, str], None]
) -> None:
    found = {name: drawn(what, width).splitlines() for name, what in screens(width).items()}
    assert all(cell_len(line) <= width for lines in found.values() for line in lines)
    assert all(len(lines) < 24 for name, lines in found.items() if name.startswith("drive"))
    found["echo state --short"] = [short(state) for state in (STATE, WAITING, WARNED)]
    approved(WORDS / f"screens_{width}.txt", page(found))


def test_each_screen_has_the_approved_colours(approved: Callable[[Path, str], None]) -> None:
    badges = {f"mode {mode}": screen.mode_line(replace(STATE, mode=mode.value)) for mode in Mode}
    found = {
        name: drawn(what, 80, colour=True).replace("\x1b", "^").splitlines()
        for name, what in (badges | screens(80)).items()
    }
    approved(WORDS / "screens_colours.txt", page(found))


def test_a_usual_screen_fits_80_by_24() -> None:
    five = [SourceState(f"source{n}", n, None, "a command", "command") for n in range(5)]
    counters = dict.fromkeys(STATE.counters, 10**7) | {"lines_superseded": 12_345}
    refused = "source nav: the twist contains NaN or infinity"
    assert len(lines_of(of(sources=five, counters=counters, refused=refused))) <= 24


# any message from the bus

HOSTILE = "\x1b[2J\x1b]0;x\x07[red]\u202e\x9b1m\n"
"""It clears the screen, sets the title, is markup, reverses direction, colours, breaks the line."""


def harmless(sent: str) -> bool:
    """Return whether the only control sequences in this text are colours and line ends."""
    rest = re.sub(r"\x1b\[[0-9;]*m", "", sent).replace("\n", "")
    return all(sign.isprintable() for sign in rest)


anything = st.text(max_size=120) | st.just(HOSTILE)
number = st.floats()
integer = st.integers(-(2**70), 2**70)
spread = st.builds(Spread, integer, number, number, number)
states = st.builds(
    RobotState,
    stamp=st.builds(Time, st.integers(-(2**31), 2**31 - 1), st.integers(0, 10**9 - 1)),
    mode=st.sampled_from(list(MODE_STYLES)) | anything,
    reason=anything, x=number, y=number, yaw=st.floats(-4, 4), linear=number, angular=number,
    wheels=st.lists(number, max_size=6), link=anything, source=anything, version=anything,
    sources=st.lists(
        st.builds(SourceState, anything, integer, number | st.none(), anything), max_size=9
    ),
    refused=anything,
    counters=st.dictionaries(
        st.sampled_from(["lines", "lines_sent", "missed_periods", "bus_overrun", "line_malformed"])
        | anything.map("command_{}".format),
        integer,
        max_size=9,
    ),
    certificate_expiry=anything,
    latencies=st.dictionaries(st.sampled_from(NAMES), st.builds(Latency, spread, spread)),
)  # fmt: skip


@settings(max_examples=10)
@given(states, states | st.none(), st.floats(0, 1e12), anything, st.integers(20, 140))
def test_any_state_fits_any_terminal_and_is_printable(
    state: RobotState, before: RobotState | None, age: float, text: str, width: int
) -> None:
    teleop = replace(TELEOP, state=state, robot_id=text, objection=text)
    shown: dict[str, RenderableType] = {
        "top": screen.screen(ScreenData(text, text, state, before, age, INFO, 0, "q"), width),
        "drive": drive_screen.screen(teleop),
        "drive has ended": drive_screen.last_report(teleop),
        "fleet": table([Row(text, True, state, age)], width),
    }
    for verb, what in shown.items():
        assert max(map(cell_len, drawn(what, width).splitlines())) <= width, verb
        assert harmless(drawn(what, width, colour=True)), verb


@each(
    ("later", "earlier", "seconds", "text"),
    [
        (300, 200, 1.0, "100.0/s"),
        (9999, 0, 10.0, "999.9/s"),
        (10_000, 0, 10.0, " 1000/s"),
        (20_000, 0, 2.0, "10000/s"),
        (10, 200, 1.0, "    -/s"),  # the daemon restarted
        (300, 200, 0.0, "    -/s"),  # there is only one state
        (300, 200, -5.0, "    -/s"),  # the clock was set
    ],
)
def test_an_unknown_rate_is_not_invented(
    later: int, earlier: int, seconds: float, text: str
) -> None:
    assert rate(later, earlier, seconds) == text
