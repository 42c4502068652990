"""Lines that only repeat the daemon's own lines are an echo. Lines with measured speeds are not."""

from __future__ import annotations

import math
from collections import deque

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.config.settings import WheelMap
from acsard.core.link.codec import Codec
from acsard.core.link.echo_detector import (
    COMPARED_LINES,
    MIN_REPEATED_LINES,
    EchoDetector,
)
from acsard.core.values import WheelSpeeds
from tests.each import each

CODEC = Codec(WheelMap())


class Echoes:
    """An echo detector, and a board whose report arrives some lines later."""

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
        self.detector.written(written(speed))

    def report(self, speed: float) -> bool:
        line = written(speed)[:-2]
        return self.detector.report(line, CODEC.decode(line))


def written(speed: float) -> bytes:
    return CODEC.encode(WheelSpeeds(speed, -speed, speed, speed))


def test_twenty_equal_reports_through_a_change_of_speed_are_an_echo() -> None:
    bench = Echoes()
    assert not any(bench.exchange(0.0) for _ in range(MIN_REPEATED_LINES - 1))
    assert bench.exchange(5.0)


def test_fewer_than_twenty_equal_reports_are_not_an_echo_despite_speed_changes() -> None:
    bench = Echoes()
    flags = [bench.exchange(speed) for speed in (0, *range(MIN_REPEATED_LINES - 1))]
    assert flags == [False] * (MIN_REPEATED_LINES - 1) + [True]


@pytest.mark.parametrize("speed", [0.0, 10.0])
def test_without_a_change_of_speed_no_report_is_an_echo(speed: float) -> None:
    bench = Echoes()
    assert not any(bench.exchange(speed) for _ in range(1000))


def test_small_speed_changes_add_up_to_an_echo() -> None:
    bench = Echoes()
    flags = [bench.exchange(step % 2 * 0.5) for step in range(40)]
    assert flags.index(True) == MIN_REPEATED_LINES - 1
    bench = Echoes()
    flags = [bench.exchange(5.0 + step % 2 * 0.05) for step in range(80)]
    assert flags.index(True) in (40, 41)  # 40 changes of 0.05 rad/s, with float rounding


def test_a_differing_report_restarts_the_count_of_equal_reports() -> None:
    bench = Echoes()
    for speed in range(MIN_REPEATED_LINES - 1):
        assert not bench.exchange(speed)
    assert not bench.exchange(30.0, 29.99)
    flags = [bench.exchange(speed) for speed in (0, *range(MIN_REPEATED_LINES - 1))]
    assert flags == [False] * (MIN_REPEATED_LINES - 1) + [True]


@each("lag", range(COMPARED_LINES))
def test_an_echo_is_found_at_every_lag_of_the_kept_lines(lag: int) -> None:
    bench = Echoes()
    flags = [bench.exchange(step // 7 % 40 * 0.5, lag=lag) for step in range(200)]
    assert any(flags)
    assert flags.index(True) < 40 + lag


def test_an_echo_that_arrives_in_batches_is_found() -> None:
    bench = Echoes()
    flags = []
    for step in range(0, 60, 2):
        bench.send(step)
        bench.send(step)
        flags += [bench.report(step), bench.report(step)]
    assert flags.index(True) == MIN_REPEATED_LINES - 1


DRIVE = [*[0.0] * 30, *[0.2 * n for n in range(50)]]
"""Speeds at 100 Hz: rest, and a ramp of 1 m/s2 with wheels of 0.05 m."""


@each("others", [1, 2])
@each("late", [0, 3])
def test_board_replies_between_the_echoes_do_not_delay_the_detection(
    others: int, late: int
) -> None:
    bench = Echoes()
    for number, speed in enumerate(DRIVE):
        measured = 0.9 * DRIVE[max(0, number - 4)]
        echo = bench.exchange(speed, lag=late)
        if echo:
            break
        assert not any(bench.report(measured) for _ in range(others))
    assert number - late - 30 == 10  # lines after the start of the ramp: 10 changes of 0.2 rad/s


def test_occasional_board_reports_do_not_delay_the_detection() -> None:
    bench = Echoes()
    for number, speed in enumerate(DRIVE):
        if number % 10 == 7:
            assert not bench.report(DRIVE[max(0, number - 5)] + 0.03)
        if bench.exchange(speed):
            break
    assert number - 30 == 10


def test_a_steady_ramp_shows_no_echo() -> None:
    bench = Echoes()
    assert not any(bench.exchange(0.013 * n) for n in range(3000))  # rounded to 0.01 rad/s
    bench = Echoes()
    assert not any(bench.exchange(0.03 * n) for n in range(400))
    assert bench.exchange(0.03 * 399)  # the end of the ramp shows the echo


@pytest.mark.slow
@each("acceleration", [3.0, 5.0, 20.0, 400.0])
@each("lag", [1, 2, 3, 7])
@each("reports", [1, 2, 3])
def test_a_motor_that_lags_by_a_whole_number_of_lines_is_not_an_echo(
    acceleration: float, lag: int, reports: int
) -> None:
    """The board reports the exact mean speed since its last report."""
    bench, speed, decay = Echoes(), 0.0, math.exp(-1.0 / (lag * reports))
    sent = 0.0
    for goal in (0.0, 4.0, 9.0, -3.0, 0.0):
        for _ in range(round(1200.0 / acceleration) + 60):
            sent += max(-acceleration / 100, min(acceleration / 100, goal - sent))
            bench.send(sent)
            line = round(sent, 2)
            for _ in range(reports):
                behind, speed = speed - line, line + (speed - line) * decay
                assert not bench.report(line + behind * (1.0 - decay) * lag * reports)


@each("others", [1, 2, 3])
def test_a_motor_that_reaches_a_new_speed_within_some_reports_is_not_an_echo(others: int) -> None:
    bench = Echoes()
    for number in range(400):
        speed, before = number // 40 % 2 * 6.0, (number // 40 + 1) % 2 * 6.0
        share = (number % 40 + 1) / (others + 1)
        assert not bench.exchange(speed, before + (speed - before) * min(1.0, share))


def test_a_report_that_equals_a_line_older_than_the_kept_ones_is_not_an_echo() -> None:
    bench = Echoes()
    assert not any(bench.exchange(step // 7 % 40 * 0.5, lag=COMPARED_LINES) for step in range(2000))


def test_reports_at_another_rate_than_the_lines_are_not_an_echo() -> None:
    bench = Echoes()
    for step in range(2000):
        bench.send(step // 2 % 40)
        if step % 5 == 0:
            assert not bench.report(step // 2 % 40)


def test_the_mean_of_two_lines_is_not_an_echo() -> None:
    bench, before = Echoes(), 0.0
    for step in range(2000):
        speed = step // 7 % 40 * 0.5
        assert not bench.exchange(speed, (speed + before) / 2)
        before = speed


def test_forgetting_restarts_the_count_of_equal_reports() -> None:
    bench = Echoes()
    for speed in range(MIN_REPEATED_LINES - 1):
        assert not bench.exchange(speed)
    bench.detector.forget()
    assert not bench.report(MIN_REPEATED_LINES - 2)
    assert not bench.exchange(1.0)


@given(st.lists(st.tuples(st.floats(-40, 40), st.floats(-3, 3)), min_size=1, max_size=200))
def test_measured_speeds_are_not_an_echo(lines: list[tuple[float, float]]) -> None:
    bench = Echoes()
    for sent, error in lines:
        wrong = sent + (error if abs(error) > 0.02 else 0.02)
        assert not bench.exchange(sent, wrong)
