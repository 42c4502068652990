"""Good lines in a row bring the link up. Silence, damage and restarts bring it down."""

from __future__ import annotations

from typing import get_args

import pytest

from acsard.core.link.link_state import (
    BAD_LINES,
    GOOD_LINES,
    TRANSITIONS,
    Input,
    Link,
    State,
)

MS = 1_000_000
QUIET_NS = 100 * MS


class Bench:
    """A link to an MCU that sends a good line every 10 ms."""

    def __init__(self, checked: bool = False) -> None:
        self.link, self.checked, self.now_ns = Link(), checked, 1000 * MS
        self.link.apply("opened")

    def good(self, count: int = 1, ms: float = 10, may_rise: bool = True) -> str:
        for _ in range(count):
            self.now_ns += int(ms * MS)
            self.link.good(self.now_ns, QUIET_NS)
            self.link.judge(self.now_ns, may_rise, self.checked)
        return self.link.state

    def wait(self, ms: float) -> str:
        self.now_ns += int(ms * MS)
        self.link.judge(self.now_ns, True, self.checked)
        return self.link.state


def test_every_state_goes_down_when_the_port_closes() -> None:
    assert {state for state, sign in TRANSITIONS if sign == "closed"} == set(get_args(State)) - {
        "down"
    }


def test_the_link_does_not_come_up_while_it_may_not_rise() -> None:
    bench = Bench()
    assert bench.good(GOOD_LINES + 1, may_rise=False) == "booting"
    assert bench.good() == "up"


def test_lines_further_apart_than_the_silence_limit_are_reported_and_make_no_link() -> None:
    bench = Bench()
    bench.good(2, ms=101)
    assert bench.link.sparse_s == 0.0  # a single silence proves nothing
    assert bench.good(10, ms=101) == "booting"
    assert bench.link.sparse_s == pytest.approx(0.101)
    bench.good()
    assert bench.link.sparse_s == 0.0


def test_bad_lines_alone_do_not_take_the_link_down_but_are_reported() -> None:
    for checked, state in ((False, "up"), (True, "stale")):
        bench = Bench(checked)
        bench.good(GOOD_LINES)
        for _ in range(BAD_LINES - 1):
            bench.link.bad(bench.checked)
        assert (bench.link.state, bench.link.damaged) == ("up", False)
        bench.link.bad(bench.checked)
        assert (bench.link.state, bench.link.damaged) == (state, True)
        assert bench.good() == "up"
        assert not bench.link.damaged


def test_one_good_line_opens_a_checked_link_and_a_bad_one_opens_nothing() -> None:
    bench = Bench(checked=True)
    bench.link.bad(bench.checked)
    bench.link.judge(bench.now_ns, True, bench.checked)
    assert bench.link.state == "booting"
    assert bench.good() == "up"


@pytest.mark.parametrize(
    ("sign", "state"),
    [("closed", "down"), ("opened", "booting"), ("restarted", "booting"), ("damaged", "stale")],
)
def test_after_the_link_ends_good_lines_are_counted_from_zero(sign: Input, state: State) -> None:
    bench = Bench()
    bench.good(GOOD_LINES)
    bench.link.apply(sign)
    assert bench.link.state == state
    assert bench.good(GOOD_LINES - 1) == state


def test_the_first_line_of_a_session_has_no_time_since_a_previous_line() -> None:
    bench = Bench()
    assert bench.link.good(bench.now_ns, QUIET_NS) is None
    assert bench.link.good(bench.now_ns + 7, QUIET_NS) == 7
    bench.link.apply("restarted")
    assert bench.link.silent(bench.now_ns + 8)
    assert bench.link.good(bench.now_ns + 9, QUIET_NS) is None
