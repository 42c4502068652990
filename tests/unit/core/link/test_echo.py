"""Reports that equal the sent lines while the speeds change come from an echo."""

from __future__ import annotations

from collections import deque

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.config.settings import WheelMap
from acsard.core.link.codec import Codec
from acsard.core.link.negotiation import LINES, REPORTS, EchoDetector
from acsard.core.values import WheelSpeeds
from tests.each import each

CODEC = Codec(WheelMap())


class Bench:
    """A detector, and a far end whose report arrives some lines later."""

    def __init__(self) -> None:
        self.detector = EchoDetector()
        self.waiting: deque[float] = deque()

    def exchange(self, sent: float, back: float | None = None, lag: int = 0) -> bool:
        """Send a line and process the report that is due.

        By default the report repeats an earlier line.
        """
        self.send(sent)
        self.waiting.append(sent if back is None else back)
        return len(self.waiting) > lag and self.report(self.waiting.popleft())

    def send(self, speed: float) -> None:
        self.detector.left(written(speed))

    def report(self, speed: float) -> bool:
        line = written(speed)[:-2]
        return self.detector.report(line, CODEC.decode(line))


def written(speed: float) -> bytes:
    return CODEC.encode(WheelSpeeds(speed, -speed, speed, speed))


def test_twenty_equal_reports_through_a_change_of_speed_are_an_echo() -> None:
    bench = Bench()
    assert not any(bench.exchange(0.0) for _ in range(REPORTS - 1))
    assert bench.exchange(5.0)


def test_a_change_alone_does_not_make_an_echo_before_there_are_twenty() -> None:
    bench = Bench()
    found = [bench.exchange(speed) for speed in range(REPORTS)]
    assert found == [False] * (REPORTS - 1) + [True]


@pytest.mark.parametrize("speed", [0.0, 10.0])
def test_without_a_change_of_speed_nothing_is_an_echo(speed: float) -> None:
    bench = Bench()
    assert not any(bench.exchange(speed) for _ in range(1000))


def test_small_changes_count_by_their_sum() -> None:
    bench = Bench()
    found = [bench.exchange(step % 2 * 0.5) for step in range(40)]
    assert found.index(True) == REPORTS - 1
    bench = Bench()
    found = [bench.exchange(5.0 + step % 2 * 0.05) for step in range(80)]
    assert found.index(True) in (40, 41)  # 40 changes of 0.05 rad/s, with float rounding


def test_one_report_that_differs_begins_the_run_anew() -> None:
    bench = Bench()
    for speed in range(REPORTS - 1):
        assert not bench.exchange(speed)
    assert not bench.exchange(30.0, 29.99)
    found = [bench.exchange(speed) for speed in range(REPORTS)]
    assert found == [False] * (REPORTS - 1) + [True]


@each("lag", range(LINES))
def test_an_echo_is_found_however_many_lines_later_it_comes(lag: int) -> None:
    bench = Bench()
    found = [bench.exchange(step // 7 % 40 * 0.5, lag=lag) for step in range(200)]
    assert any(found)
    assert found.index(True) < 40 + lag


def test_an_echo_that_comes_in_batches_is_found() -> None:
    bench = Bench()
    found = []
    for step in range(0, 60, 2):
        bench.send(step)
        bench.send(step + 1)
        found += [bench.report(step), bench.report(step + 1)]
    assert found.index(True) == REPORTS - 1


def test_a_report_older_than_the_lines_that_are_kept_is_no_echo() -> None:
    bench = Bench()
    assert not any(bench.exchange(step // 7 % 40 * 0.5, lag=LINES) for step in range(2000))


def test_reports_at_another_pace_than_the_lines_are_no_echo() -> None:
    bench = Bench()
    for step in range(2000):
        bench.send(step // 2 % 40)
        if step % 5 == 0:
            assert not bench.report(step // 2 % 40)


def test_the_mean_of_two_lines_is_no_echo() -> None:
    bench, before = Bench(), 0.0
    for step in range(2000):
        speed = step // 7 % 40 * 0.5
        assert not bench.exchange(speed, (speed + before) / 2)
        before = speed


def test_an_opening_begins_anew() -> None:
    bench = Bench()
    for speed in range(REPORTS - 1):
        assert not bench.exchange(speed)
    bench.detector.forget()
    assert not bench.report(REPORTS - 2)
    assert not bench.exchange(1.0)


@given(st.lists(st.tuples(st.floats(-40, 40), st.floats(-3, 3)), min_size=1, max_size=200))
def test_what_a_board_measures_is_no_echo(lines: list[tuple[float, float]]) -> None:
    bench = Bench()
    for sent, error in lines:
        wrong = sent + (error if abs(error) > 0.02 else 0.02)
        assert not bench.exchange(sent, wrong)
