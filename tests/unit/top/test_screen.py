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
from acsard.top.text import MODE_STYLES, ScreenData
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


def test_a_long_reason_continues_below_and_moves_no_other_line() -> None:
    reason = (
        "the microcontroller's lines come 0.50 s apart; if it reports by its own clock, set "
        "mcu.reply_period = 0.50"
    )
    short, long = (
        lines_of(of(mode="waiting", reason="x")),
        lines_of(of(mode="waiting", reason=reason)),
    )
    assert " ".join(f"{long[1]} {long[2]}".split()) == f"WAITING {reason}"
    assert short[3:] == long[3:]


# no state for some time


@pytest.mark.parametrize("state", [STATE, None])
def test_a_silent_robot_is_shown_by_three_red_lines(state: RobotState | None) -> None:
    data = replace(SEEN, state=state, age=3.4, silent=True)
    assert "NOTHING RECEIVED FOR 3 s: is the daemon running?" in lines_of(data)[2]
    assert painted(data).count("41m") == 3  # three lines in red
    assert not any("DRIVING" in line for line in lines_of(data))


def test_the_last_values_before_a_silence_stay_dimmed() -> None:
    data = replace(SEEN, age=100.0, silent=True)
    assert "NOTHING RECEIVED FOR 1 min 40 s" in lines_of(data)[2]
    assert "+1.250 m" in line_with("yaw", data)
    assert len(lines_of(data)) == 24
    assert re.search(r"\x1b\[2mx   \+1.250", painted(data))


@pytest.mark.parametrize("width", [40, 80])
def test_without_a_link_no_old_speed_is_shown(width: int) -> None:
    there, no_link = ("\n".join(lines_of(of(link=link), width)) for link in ("up", "down"))
    assert "m/s" in no_link
    assert not re.search(r"[+-]\d+\.\d+ (m/s|rad/s)", no_link)
    assert re.search(r"[+-]\d+\.\d+ m/s", there)
    assert "▲" not in no_link


# any message from the bus


def test_a_usual_screen_fits_80_by_24_without_truncation() -> None:
    four = [*STATE.sources, SourceState("spare", 1, None, "a command", "command")]
    counters = dict.fromkeys(STATE.counters, 10**7) | {"lines_superseded": 12_345}
    lines = lines_of(
        of(
            sources=four,
            counters=counters,
            refused="source nav: the twist contains NaN or infinity",
        )
    )
    assert len(lines) == 24
    assert max(map(cell_len, lines)) == 80
    assert not any(line.endswith("…") for line in lines)


def test_a_larger_screen_has_empty_lines_between_its_parts() -> None:
    assert lines_of(SEEN, 116, 40).count("") == 3
    assert lines_of(SEEN, 80, None) == lines_of(SEEN, 80, 40)


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
    assert text.count("[red]") >= 8
    assert "timing" in text


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
@given(
    states, states | st.none(), number, anything, anything, st.integers(1, 140), st.integers(1, 50)
)
def test_any_state_fits_any_terminal_and_is_printable(
    state: RobotState,
    before: RobotState | None,
    age: float,
    robot_id: str,
    endpoint: str,
    width: int,
    height: int,
) -> None:
    data = ScreenData(robot_id, endpoint, state, before, age, INFO, 0, "q quits")
    lines = lines_of(data, width, height)
    assert len(lines) <= height
    assert max(map(cell_len, lines)) <= width
    assert harmless(painted(data, width, height))
