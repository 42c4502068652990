"""The sections of the wide screen show each value in its place and with its unit."""

from __future__ import annotations

from msgspec.structs import replace

from acsard.core.messages.schema import Time
from tests.each import each
from tests.unit.top.screens import (
    INFO,
    SEEN,
    STATE,
    line_with,
    lines_of,
    of,
    painted,
)


@each("wheels", [[], [1.0], [1.0] * 9, [float("nan")] * 4])
def test_wheels_that_are_not_four_numbers_are_shown_as_far_as_they_go(wheels: list[float]) -> None:
    assert len(lines_of(of(wheels=wheels))) == 24 - 1


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


def test_the_link_is_reported_with_its_port() -> None:
    assert line_with("link ").startswith("link up on /dev/acsar ─")
    long = "/dev/serial/by-id/usb-Arduino__www.arduino.cc__0043_7543331393435190A0A1-if00"
    assert "on usb-Arduino__www.arduino.cc" in line_with(
        "link ", replace(SEEN, info=replace(INFO, port=long))
    )
    sim = replace(SEEN, info=replace(INFO, simulated=True))
    assert line_with("link ", sim).startswith("link up on the built-in SIMULATOR")
    assert line_with("link ", replace(SEEN, info=None)).startswith("link up ─")
