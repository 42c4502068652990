"""The sections of the wide screen show each value in its place and with its unit."""

from __future__ import annotations

import re

import pytest
from msgspec.structs import replace

from acsard.core.messages.schema import Latency, SourceState, Time
from acsard.daemon.latencies import NAMES
from acsard.top.wide_screen import LATENCY_ROWS
from tests.each import each
from tests.unit.top.screens import (
    BEFORE,
    INFO,
    SEEN,
    STATE,
    UNMEASURED,
    line_with,
    lines_of,
    of,
    painted,
)


def test_commands_of_new_senders_are_counted_as_commands_and_not_as_rejected() -> None:
    counters = {**STATE.counters, "commands_of_new_senders": 40}
    lines = lines_of(replace(SEEN, state=replace(STATE, counters=counters)))
    (line,) = [line for line in lines if "of new senders 40" in line]
    assert line.startswith("commands")
    assert any(line.startswith("rejected") and "nothing" in line for line in lines)


def test_pose_and_twist_have_their_units() -> None:
    assert "x   +1.250 m  y   -0.500 m  yaw  +57.3°" in line_with("yaw")
    assert "forward  +0.500 m/s  turn  -0.600 rad/s" in line_with("forward")


def test_the_wheels_are_where_they_are_on_the_robot() -> None:
    assert re.search(r"front ▲ \+12.00 .*▲  \+8.00", line_with("front"))
    assert re.search(r"rear  ▲ \+12.50 .*▼  -7.50", line_with("rear"))


@each("wheels", [[], [1.0], [1.0] * 9, [float("nan")] * 4])
def test_wheels_that_are_not_four_numbers_are_shown_as_far_as_they_go(wheels: list[float]) -> None:
    assert len(lines_of(of(wheels=wheels))) == 24 - 1


def test_sources_show_priority_age_and_what_they_wait_for() -> None:
    assert line_with("teleop").split() == ["teleop", "100", "never", "a", "command"]
    assert line_with("▶").split() == ["▶", "app", "50", "0.0", "s", "nothing:", "it", "drives"]
    assert "app has priority" in line_with("  nav")


def test_a_source_of_a_stopped_robot_is_not_shown_as_driving() -> None:
    data = of(mode="stopped", reason="stopped by request; call srv/clear")
    assert "▶" not in "".join(lines_of(data))
    assert "the robot is stopped" in line_with("  app  ", data)


def test_sources_that_do_not_fit_are_counted() -> None:
    many = [SourceState(f"source{n}", n, None, "a command", "command") for n in range(40)]
    lines = lines_of(of(sources=many))
    assert len(lines) == 24
    assert any("and 37 more: source3, source4" in line for line in lines)
    assert "mcu_round_trip" in lines[-1]
    assert not any("more:" in line for line in lines_of(of(sources=many[:4])))


def test_rates_are_taken_between_two_states() -> None:
    assert "in 100.0/s of 1,300" in line_with("superseded")
    assert "out 100.0/s of 1,301" in line_with("superseded")
    assert "20.0/s of 220" in line_with("commands  ")
    assert "-/s of 1,300" in line_with("superseded", replace(SEEN, before=None, passed=0.0))
    assert "-/s of 1,200" in line_with("superseded", replace(SEEN, state=BEFORE, before=STATE))


@each("set_by", [3600, -3600, 1, -1])
@each("width", [80, 60])
def test_a_robot_s_clock_that_is_set_changes_no_rate(set_by: int, width: int) -> None:
    stepped = replace(STATE, stamp=Time(1000 + set_by, 0))
    text = "\n".join(lines_of(replace(SEEN, state=stepped, passed=1.0), width))
    assert "100.0/s of 1,300" in text
    assert "20.0/s of 220" in text


def test_missed_periods_are_counted_and_stand_out_while_they_grow() -> None:
    assert line_with("missed").endswith("missed periods 3")
    grown = of(counters=STATE.counters | {"missed_periods": 4})
    assert "\x1b[33mmissed periods 4\x1b[0m" in painted(grown)
    assert "\x1b[33mmissed" not in painted(SEEN)


def test_rejects_are_shown_by_reason_and_stand_out_while_they_grow() -> None:
    counters = {"line_malformed": 3, "line_implausible": 12, "command_stale": 4, "line_zero": 0}
    data = of(counters=counters, refused="source nav: the twist contains NaN or infinity")
    assert line_with("rejected", data).split(maxsplit=1)[1] == (
        "lines implausible 12, malformed 3 · commands stale 4"
    )
    assert "source nav: the twist contains NaN or infinity" in line_with("last one", data)
    assert "\x1b[33mimplausible 12\x1b[0m" in painted(data)
    assert "\x1b[33mimplausible" not in painted(replace(data, before=data.state))
    assert "nothing" in line_with("rejected")


@each("does", ["used", "silent", "disagrees", "not believed"])
def test_the_state_of_the_gyro_is_shown_if_there_is_one(does: str) -> None:
    assert line_with("gyro", of(gyro=does)).split(maxsplit=1)[1].startswith(does)
    assert not any("gyro" in line for line in lines_of(SEEN))


def test_samples_of_a_gyro_that_do_not_count_are_among_the_rejects() -> None:
    data = of(counters={"imu_second_sender": 1200, "imu_out_of_range": 3})
    assert "gyro second sender 1,200, out of range 3" in line_with("rejected", data)


def test_the_link_is_reported_with_its_port() -> None:
    assert line_with("link ").startswith("link up on /dev/acsar ─")
    long = "/dev/serial/by-id/usb-Arduino__www.arduino.cc__0043_7543331393435190A0A1-if00"
    assert "on usb-Arduino__www.arduino.cc" in line_with(
        "link ", replace(SEEN, info=replace(INFO, port=long))
    )
    sim = replace(SEEN, info=replace(INFO, simulated=True))
    assert line_with("link ", sim).startswith("link up on the built-in SIMULATOR")
    assert line_with("link ", replace(SEEN, info=None)).startswith("link up ─")


def test_the_certificate_is_shown_if_there_is_one() -> None:
    assert "certificate" not in "".join(lines_of(SEEN))
    assert "certificate valid for 700 days" in line_with(
        "link ", of(certificate_expiry="valid for 700 days")
    )
    ended = of(certificate_expiry="expired 3 days ago: TLS refuses every client")
    assert "certificate expired 3 days ago" in line_with("link ", ended)


def test_each_figure_is_shown_for_the_last_minute_and_since_the_start() -> None:
    for name in NAMES:
        cells = re.split(r"\s{2,}|(?<=s) ", line_with(name).removeprefix(name).strip())
        assert cells[-6:] == ["63 µs", "891 µs", "9.7 ms", "56 µs", "112 µs", "8.0 ms"]
        assert LATENCY_ROWS[name][0] in line_with(name)
        assert LATENCY_ROWS[name][1] in line_with(name, width=116)


@pytest.mark.parametrize("figures", [{}, dict.fromkeys(NAMES, UNMEASURED)])
def test_a_figure_without_a_measurement_is_a_dash(figures: dict[str, Latency]) -> None:
    for name in NAMES:
        assert line_with(name, of(latencies=figures)).split()[-6:] == ["-"] * 6
