"""The screen shows the important facts about a robot, and no message from the bus can break it."""

from __future__ import annotations

import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from rich.cells import cell_len

from acsard.core.messages.schema import (
    Latency,
    RobotState,
    SourceState,
    Spread,
    Time,
)
from acsard.core.motion.modes import Mode
from acsard.daemon.latencies import NAMES
from acsard.top.screen import MODE_STYLES, ScreenData
from tests.each import each
from tests.unit.top.screens import INFO, MEASURED, SEEN, STATE, line_with, lines_of, of, painted

ENOUGH = "\x1b[2J\x1b]0;x\x07[red]\u202e\x9b1m\n"
"""Hostile text with many kinds of control sequences.

It clears the screen, sets the title, is markup, reverses direction, colours and breaks the line.
"""


# content of the screen


@each("mode", list(Mode))
def test_every_mode_has_a_badge_of_its_colour_and_its_reason(mode: Mode) -> None:
    data = of(mode=mode.value, reason="because")
    assert lines_of(data)[1].strip() == f"{mode.value.upper()}   because"
    background = {"green": 42, "blue": 44, "yellow": 43, "white": 47, "red": 41}
    colour = background[MODE_STYLES[mode.value].rpartition(" ")[2]]
    assert re.search(rf"\x1b\[[0-9;]*{colour}m {mode.value.upper()} ", painted(data))


def test_stopped_and_fault_share_a_style_that_no_other_mode_has() -> None:
    assert MODE_STYLES["stopped"] == MODE_STYLES["fault"]
    assert (
        len({MODE_STYLES[m] for m in ("driving", "ready", "waiting", "stopped", "inactive")}) == 5
    )


# no state for some time


@pytest.mark.parametrize("state", [STATE, None])
def test_a_silent_robot_is_shown_by_a_red_line(state: RobotState | None) -> None:
    data = replace(SEEN, state=state, age=3.4, silent=True)
    assert "NOTHING RECEIVED FOR 3 s: is the daemon running?" in lines_of(data)[1]
    assert painted(data).count("41m") == 1
    assert not any("DRIVING" in line for line in lines_of(data))


def test_the_last_values_before_a_silence_stay_dimmed() -> None:
    data = replace(SEEN, age=100.0, silent=True)
    assert "NOTHING RECEIVED FOR 1 min 40 s" in lines_of(data)[1]
    assert re.search(r"\x1b\[2mx     \+1.250", painted(data))


@pytest.mark.parametrize("width", [40, 80])
def test_without_a_link_no_old_speed_is_shown(width: int) -> None:
    there, no_link = ("\n".join(lines_of(of(link=link), width)) for link in ("up", "down"))
    assert "m/s" in no_link
    assert not re.search(r"[+-]\d+\.\d+ (m/s|rad/s)", no_link)
    assert re.search(r"[+-]\d+\.\d+ m/s", there)
    assert "+12.00" in there
    assert "+12.00" not in no_link


# any message from the bus


def test_a_usual_screen_fits_80_by_24() -> None:
    five = [SourceState(f"source{n}", n, None, "a command", "command") for n in range(5)]
    counters = dict.fromkeys(STATE.counters, 10**7) | {"lines_superseded": 12_345}
    refused = "source nav: the twist contains NaN or infinity"
    lines = lines_of(of(sources=five, counters=counters, refused=refused))
    assert len(lines) <= 24
    assert max(map(cell_len, lines)) <= 80


@each("width", (40, 60, 80, 160))
def test_every_figure_is_on_a_screen_of_any_width(width: int) -> None:
    state = of(
        mode="waiting", refused="source nav: the twist contains NaN or infinity", gyro="used",
        certificate_expiry="expires in 12 days",
        counters=STATE.counters
        | {"lines_superseded": 12_345, "bus_overrun": 7, "line_malformed": 30, "command_stale": 4},
    )  # fmt: skip
    text = " ".join(" ".join(lines_of(state, width)).split())
    for figure in (
        "WAITING", "x +1.250 m", "y -0.500 m", "yaw +57.3°", "forward +0.500 m/s",
        "turn -0.600 rad/s", "front +12.00 +8.00", "rear +12.50 -7.50", "50 0.0 s", "10 3.0 s",
        "app has priority", "link up", "expires in 12 days", "lines in 100.0/s 1,300",
        "lines out 100.0/s 1,301", "superseded 12,345", "commands 20.0/s 220", "missed periods 3",
        "bus overrun 7", "malformed 30", "stale 4", "the twist contains NaN", "the gyro",
        "/dev/acsar",
    ):  # fmt: skip
        assert figure in text, figure
    assert text.count("63 µs 891 µs 9.7 ms") == 6


@each("wheels", [[], [1.0], [1.0] * 9, [float("nan")] * 4])
def test_wheels_that_are_not_four_numbers_are_shown_as_far_as_they_go(wheels: list[float]) -> None:
    assert len(lines_of(of(wheels=wheels))) == len(lines_of(SEEN))


@each("set_by", [3600, -3600, 1, -1])
@each("width", [80, 60])
def test_a_robot_s_clock_that_is_set_changes_no_rate(set_by: int, width: int) -> None:
    stepped = replace(STATE, stamp=Time(1000 + set_by, 0))
    text = " ".join("\n".join(lines_of(replace(SEEN, state=stepped, passed=1.0), width)).split())
    assert "100.0/s 1,300" in text
    assert "20.0/s 220" in text


def test_counters_of_trouble_stand_out_while_they_grow() -> None:
    counters = {"line_malformed": 3, "line_implausible": 12, "command_stale": 4, "line_zero": 0}
    data = of(counters=counters | {"missed_periods": 4})
    assert line_with("rejected", data).split(maxsplit=1)[1] == (
        "lines implausible 12, malformed 3 · commands stale 4"
    )
    assert "\x1b[33mimplausible 12\x1b[0m" in painted(data)
    assert re.search(r"\x1b\[33m +4\x1b", painted(data))
    assert "\x1b[33m" not in painted(replace(data, before=data.state))


def test_a_source_without_a_command_that_counts_is_not_said_to_be_unseen() -> None:
    """After a `clear`, the age of each source is null until its next command."""
    cleared = [replace(source, age=None) for source in STATE.sources]
    lines = lines_of(of(sources=cleared))
    assert not any("never" in line for line in lines)
    assert [line.split()[-3:] for line in lines if "teleop" in line] == [["-", "a", "command"]]


def test_a_hostile_text_changes_only_its_own_field() -> None:
    source = SourceState(ENOUGH, 1, 0.0, ENOUGH, "late")
    hostile = ScreenData(
        ENOUGH,
        ENOUGH,
        replace(
            STATE, mode=ENOUGH, reason=ENOUGH, link=ENOUGH, source=ENOUGH, refused=ENOUGH,
            certificate_expiry=ENOUGH, sources=[source], counters={f"line_{ENOUGH}": 1},
            latencies={ENOUGH: MEASURED},
        ),
        info=replace(INFO, port=ENOUGH, version=ENOUGH),
    )  # fmt: skip
    assert harmless(painted(hostile))
    text = "\n".join(lines_of(hostile))
    assert text.count("[red]") >= 7
    assert "last minute" in text


def harmless(sent: str) -> bool:
    """Return whether the only control sequences in this text are colours and line ends."""
    rest = re.sub(r"\x1b\[[0-9;]*m", "", sent).replace("\n", "")
    return all(sign.isprintable() for sign in rest)


anything = st.text(max_size=120) | st.just(ENOUGH)
number = st.floats()
integer = st.integers(-(2**70), 2**70)
spread = st.builds(Spread, integer, number, number, number)
states = st.builds(
    RobotState,
    stamp=st.builds(Time, st.integers(-(2**31), 2**31 - 1), st.integers(0, 10**9 - 1)),
    mode=st.sampled_from(list(MODE_STYLES)) | anything,
    reason=anything, x=number, y=number, yaw=number, linear=number, angular=number,
    wheels=st.lists(number, max_size=6), link=anything, source=anything,
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


@pytest.mark.slow
@settings(max_examples=40)
@given(states, states | st.none(), number, anything, anything, st.integers(20, 140))
def test_any_state_fits_any_terminal_and_is_printable(
    state: RobotState,
    before: RobotState | None,
    age: float,
    robot_id: str,
    endpoint: str,
    width: int,
) -> None:
    data = ScreenData(robot_id, endpoint, state, before, age, INFO, 0, "q quits")
    assert max(map(cell_len, lines_of(data, width))) <= width
    assert harmless(painted(data, width))
