"""One screen of a robot's state: it tells what matters, and holds whatever comes on the bus."""

from __future__ import annotations

import io
import re

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace
from rich.cells import cell_len
from rich.console import Console

from acsard.drive.modes import Mode
from acsard.messages.schema import Figure, Info, RobotState, SourceState, Spread, Time
from acsard.runtime.figures import NAMES
from acsard.top.sections import FIGURES
from acsard.top.seen import Seen
from acsard.top.view import MODES, screen

MEASURED = Figure(Spread(9000, 56.2, 112.2, 8000.0), Spread(6000, 63.1, 891.0, 9700.0))
UNMEASURED = Figure(Spread(0, 0.0, 0.0, 0.0), Spread(0, 0.0, 0.0, 0.0))

STATE = RobotState(
    stamp=Time(1000, 0),
    mode="driving",
    reason="driving: commanded by app",
    x=1.25,
    y=-0.5,
    yaw=1.0,
    linear=0.5,
    angular=-0.6,
    wheels=[8.0, 12.0, 12.5, -7.5],
    link="up",
    source="app",
    sources=[
        SourceState("teleop", 100, None, "a command"),
        SourceState("app", 50, 0.02, ""),
        SourceState("nav", 10, 3.0, "app has the higher priority: until it is silent"),
    ],
    refused="",
    counters={"lines": 1300, "lines_sent": 1301, "commands": 220, "missed_periods": 3},
    figures=dict.fromkeys(NAMES, MEASURED),
)
BEFORE = replace(
    STATE,
    stamp=Time(999, 0),
    counters={"lines": 1200, "lines_sent": 1201, "commands": 200, "missed_periods": 3},
)
INFO = Info("acsar", "0.1.0", 7, "/dev/acsar", False, 100.0, [], [])
SEEN = Seen("acsar", "tcp/127.0.0.1:7448", STATE, BEFORE, 0.05, INFO, 0, "q leaves")

ENOUGH = "\x1b[2J\x1b]0;x\x07[red]\u202e\x9b1m\n"
"""Clears the screen, sets the title, is markup, turns the writing round, colours, ends the line."""


def lines_of(seen: Seen, width: int = 80, height: int | None = 24) -> list[str]:
    """The screen as it is read."""
    console = Console(width=width, file=io.StringIO(), color_system=None)
    with console.capture() as captured:
        console.print(screen(seen, width, height))
    return captured.get().rstrip("\n").split("\n")


def painted(seen: Seen, width: int = 80, height: int | None = 24) -> str:
    """The screen as it is sent to a terminal."""
    console = Console(
        width=width, file=io.StringIO(), force_terminal=True, color_system="256", _environ={}
    )
    with console.capture() as captured:
        console.print(screen(seen, width, height))
    return captured.get()


def line_with(text: str, seen: Seen = SEEN, width: int = 80) -> str:
    found = [line for line in lines_of(seen, width) if text in line]
    assert len(found) == 1, (text, found)
    return found[0]


def of(**changes: object) -> Seen:
    """The usual screen with another state."""
    return replace(SEEN, state=replace(STATE, **changes))


# what it tells


def test_the_head_says_who_where_and_how_fresh() -> None:
    head = lines_of(SEEN)[0]
    for told in ("acsar", "tcp/127.0.0.1:7448", "0.1.0", "heard 0.1 s ago", "q leaves"):
        assert told in head


@pytest.mark.parametrize("mode", list(Mode))
def test_every_mode_has_a_badge_of_its_colour_and_its_reason(mode: Mode) -> None:
    seen = of(mode=mode.value, reason="because")
    assert lines_of(seen)[1].strip() == f"{mode.value.upper()}   because"
    background = {"green": 42, "blue": 44, "yellow": 43, "white": 47, "red": 41}
    colour = background[MODES[mode.value].rpartition(" ")[2]]
    assert re.search(rf"\x1b\[[0-9;]*{colour}m {mode.value.upper()} ", painted(seen))


def test_trouble_and_driving_look_unlike_anything_else() -> None:
    assert MODES["stopped"] == MODES["fault"]
    assert len({MODES[m] for m in ("driving", "ready", "waiting", "stopped", "inactive")}) == 5


def test_the_reason_does_not_say_the_mode_again() -> None:
    assert lines_of(SEEN)[1].strip() == "DRIVING   commanded by app"


def test_a_long_reason_goes_on_below_and_moves_nothing() -> None:
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


def test_pose_and_twist_have_their_units() -> None:
    assert "x   +1.250 m  y   -0.500 m  yaw  +57.3°" in line_with("yaw")
    assert "forward  +0.500 m/s  turn  -0.600 rad/s" in line_with("forward")


def test_the_wheels_are_where_they_are_on_the_robot() -> None:
    assert re.search(r"front ▲ \+12.00 .*▲  \+8.00", line_with("front"))
    assert re.search(r"rear  ▲ \+12.50 .*▼  -7.50", line_with("rear"))


@pytest.mark.parametrize("wheels", [[], [1.0], [1.0] * 9, [float("nan")] * 4])
def test_wheels_that_are_not_four_numbers_are_shown_as_far_as_they_go(wheels: list[float]) -> None:
    assert len(lines_of(of(wheels=wheels))) == 24 - 1


def test_sources_tell_priority_age_and_what_they_wait_for() -> None:
    assert line_with("teleop").split() == ["teleop", "100", "never", "a", "command"]
    assert line_with("▶").split() == ["▶", "app", "50", "0.0", "s", "nothing:", "it", "drives"]
    assert "app has the higher priority" in line_with("  nav")


def test_a_source_that_is_heard_by_a_stopped_robot_is_not_said_to_drive() -> None:
    seen = of(mode="stopped", reason="stopped by request; call srv/clear")
    assert "▶" not in "".join(lines_of(seen))
    assert "the robot is stopped" in line_with("  app  ", seen)


def test_sources_that_do_not_fit_are_counted() -> None:
    many = [SourceState(f"source{n}", n, None, "a command") for n in range(40)]
    told = lines_of(of(sources=many))
    assert len(told) == 24
    assert any("and 37 more: source3, source4" in line for line in told)
    assert "mcu_round_trip" in told[-1]
    assert not any("more:" in line for line in lines_of(of(sources=many[:4])))


def test_rates_are_taken_between_two_states() -> None:
    assert "in 100.0/s of 1,300" in line_with("superseded")
    assert "out 100.0/s of 1,301" in line_with("superseded")
    assert "20.0/s of 220" in line_with("commands  ")
    assert "-/s of 1,300" in line_with("superseded", replace(SEEN, before=None))
    assert "-/s of 1,200" in line_with("superseded", replace(SEEN, state=BEFORE, before=STATE))


def test_missed_periods_are_counted_and_stand_out_while_they_grow() -> None:
    assert line_with("missed").endswith("missed periods 3")
    grown = of(counters=STATE.counters | {"missed_periods": 4})
    assert "\x1b[33mmissed periods 4\x1b[0m" in painted(grown)
    assert "\x1b[33mmissed" not in painted(SEEN)


def test_rejects_are_told_by_reason_and_stand_out_while_they_grow() -> None:
    counters = {"line_malformed": 3, "line_impossible": 12, "command_stale": 4, "line_zero": 0}
    seen = of(counters=counters, refused="source nav: NaN or infinity")
    assert line_with("rejected", seen).split(maxsplit=1)[1] == (
        "lines impossible 12, malformed 3 · commands stale 4"
    )
    assert "source nav: NaN or infinity" in line_with("last one", seen)
    assert "\x1b[33mimpossible 12\x1b[0m" in painted(seen)
    assert "\x1b[33mimpossible" not in painted(replace(seen, before=seen.state))
    assert "nothing" in line_with("rejected")


def test_the_link_is_told_with_its_port() -> None:
    assert line_with("link ").startswith("link up on /dev/acsar ─")
    long = "/dev/serial/by-id/usb-Arduino__www.arduino.cc__0043_7543331393435190A0A1-if00"
    assert "on usb-Arduino__www.arduino.cc" in line_with(
        "link ", replace(SEEN, info=replace(INFO, port=long))
    )
    sim = replace(SEEN, info=replace(INFO, simulated=True))
    assert line_with("link ", sim).startswith("link up on the built-in SIMULATOR")
    assert line_with("link ", replace(SEEN, info=None)).startswith("link up ─")


def test_the_certificate_is_told_when_there_is_one() -> None:
    assert "certificate" not in "".join(lines_of(SEEN))
    assert "certificate valid for 700 days" in line_with(
        "link ", of(certificate="valid for 700 days")
    )
    ended = of(certificate="ended 3 days ago: nobody can join any more")
    assert "certificate ended 3 days ago" in line_with("link ", ended)


def test_each_figure_is_told_for_the_last_minute_and_since_the_start() -> None:
    for name in NAMES:
        told = re.split(r"\s{2,}|(?<=s) ", line_with(name).removeprefix(name).strip())
        assert told[-6:] == ["63 µs", "891 µs", "9.7 ms", "56 µs", "112 µs", "8.0 ms"]
        assert FIGURES[name][0] in line_with(name)
        assert FIGURES[name][1] in line_with(name, width=116)


@pytest.mark.parametrize("figures", [{}, dict.fromkeys(NAMES, UNMEASURED)])
def test_a_figure_without_a_measurement_is_a_dash(figures: dict[str, Figure]) -> None:
    for name in NAMES:
        assert line_with(name, of(figures=figures)).split()[-6:] == ["-"] * 6


# no news


def test_before_the_first_state_it_says_what_it_waits_for() -> None:
    assert lines_of(Seen("acsar", "tcp/x:1", None))[1] == "waiting for the first state"


@pytest.mark.parametrize("state", [STATE, None])
def test_silence_is_said_big(state: RobotState | None) -> None:
    seen = replace(SEEN, state=state, age=3.4)
    assert "NO NEWS FOR 3 s: is the daemon running?" in lines_of(seen)[2]
    assert painted(seen).count("41m") == 3  # three lines in red
    assert not any("DRIVING" in line for line in lines_of(seen))


def test_a_slow_state_is_not_silent_before_its_time() -> None:
    assert "NO NEWS" not in "".join(lines_of(replace(SEEN, age=9.0, silence=30.0)))
    assert "NO NEWS FOR 30 s" in lines_of(replace(SEEN, age=30.0, silence=30.0))[2]


def test_what_was_known_before_the_silence_stays_dimmed() -> None:
    seen = replace(SEEN, age=100.0)
    assert "NO NEWS FOR 2 min" in lines_of(seen)[2]
    assert "+1.250 m" in line_with("yaw", seen)
    assert len(lines_of(seen)) == 24
    assert re.search(r"\x1b\[2mx   \+1.250", painted(seen))


def test_messages_of_another_form_are_told_from_silence() -> None:
    (told,) = [
        line for line in lines_of(replace(SEEN, age=3.0, undecodable=9)) if "FOR 3 s" in line
    ]
    assert "another version" in told


# it holds whatever comes


def test_a_usual_screen_fits_80_by_24_with_nothing_cut() -> None:
    four = [*STATE.sources, SourceState("spare", 1, None, "a command")]
    counters = dict.fromkeys(STATE.counters, 10**7) | {"lines_superseded": 12_345}
    told = lines_of(of(sources=four, counters=counters, refused="source nav: NaN or infinity"))
    assert len(told) == 24
    assert max(map(cell_len, told)) == 80
    assert not any(line.endswith("…") for line in told)


def test_a_larger_one_has_air_between_its_parts() -> None:
    assert lines_of(SEEN, 116, 40).count("") == 3
    assert lines_of(SEEN, 80, None) == lines_of(SEEN, 80, 40)


def test_a_hostile_text_changes_nothing_but_its_own_place() -> None:
    source = SourceState(ENOUGH, 1, 0.0, ENOUGH)
    hostile = Seen(
        ENOUGH,
        ENOUGH,
        replace(
            STATE, mode=ENOUGH, reason=ENOUGH, link=ENOUGH, source=ENOUGH, refused=ENOUGH,
            certificate=ENOUGH, sources=[source], counters={f"line_{ENOUGH}": 1},
            figures={ENOUGH: MEASURED},
        ),
        info=replace(INFO, port=ENOUGH, version=ENOUGH),
    )  # fmt: skip
    assert harmless(painted(hostile))
    told = "\n".join(lines_of(hostile))
    assert told.count("[red]") >= 8
    assert "timing" in told


def harmless(sent: str) -> bool:
    """Nothing but colours and ends of line is in it that a terminal would obey."""
    rest = re.sub(r"\x1b\[[0-9;]*m", "", sent).replace("\n", "")
    return all(sign.isprintable() for sign in rest)


anything = st.text(max_size=120) | st.just(ENOUGH)
number = st.floats()
integer = st.integers(-(2**70), 2**70)
spread = st.builds(Spread, integer, number, number, number)
states = st.builds(
    RobotState,
    stamp=st.builds(Time, st.integers(-(2**31), 2**31 - 1), st.integers(0, 10**9 - 1)),
    mode=st.sampled_from(list(MODES)) | anything,
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
    certificate=anything,
    figures=st.dictionaries(st.sampled_from(NAMES), st.builds(Figure, spread, spread)),
)  # fmt: skip


@settings(max_examples=40)
@given(
    states, states | st.none(), number, anything, anything, st.integers(1, 140), st.integers(1, 50)
)
def test_any_state_fits_any_terminal_and_is_harmless_there(
    state: RobotState,
    before: RobotState | None,
    age: float,
    robot_id: str,
    endpoint: str,
    width: int,
    height: int,
) -> None:
    seen = Seen(robot_id, endpoint, state, before, age, INFO, 0, "q leaves")
    told = lines_of(seen, width, height)
    assert len(told) <= height
    assert max(map(cell_len, told)) <= width
    assert harmless(painted(seen, width, height))
