"""Reports that equal the lines sent while the speeds change are an echo, no board."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.config.settings import WheelMap
from acsard.mcu.codec import Codec
from acsard.mcu.echo import REPORTS, EchoDetector
from acsard.values import WheelSpeeds

MS = 1_000_000
CODEC = Codec(WheelMap())


class Bench:
    """A detector at 115200 baud; a line takes 2.9 ms on the wire."""

    def __init__(self) -> None:
        self.detector, self.now_ns = EchoDetector(115200), 0

    def exchange(self, sent: float, back: float | None = None, after_ms: float = 5.0) -> bool:
        """Send a line, take the report that comes this much later; by default the same line."""
        self.send(sent)
        return self.report(sent if back is None else back, after_ms)

    def send(self, speed: float) -> None:
        self.now_ns += 10 * MS
        self.detector.left(written(speed), self.now_ns)

    def report(self, speed: float, after_ms: float = 5.0) -> bool:
        line, at_ns = written(speed)[:-2], self.now_ns + int(after_ms * MS)
        return self.detector.report(line, CODEC.decode(line), at_ns)


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
    assert found.index(True) in (40, 41)  # 40 changes of 0.05 rad/s, as floats add up


def test_one_report_that_differs_begins_the_run_anew() -> None:
    bench = Bench()
    for speed in range(REPORTS - 1):
        assert not bench.exchange(speed)
    assert not bench.exchange(30.0, 29.99)
    found = [bench.exchange(speed) for speed in range(REPORTS)]
    assert found == [False] * (REPORTS - 1) + [True]


def test_a_board_without_any_lag_that_reports_the_line_before_is_no_echo() -> None:
    bench, before = Bench(), 0.0
    for step in range(2000):
        speed = step // 7 % 40 * 0.5
        assert not bench.exchange(speed, before)
        before = speed


@pytest.mark.parametrize("after_ms", [0.0, 1.0, 2.9, 9.9])
def test_an_echo_is_found_whether_or_not_it_waits_for_the_wire(after_ms: float) -> None:
    bench = Bench()
    assert any(bench.exchange(step % 3, after_ms=after_ms) for step in range(2 * REPORTS))


def test_an_echo_that_crosses_the_next_line_is_found() -> None:
    bench = Bench()
    found = []
    bench.send(0.0)
    for step in range(1, 3 * REPORTS):
        bench.send(step)  # on the wire when the one before comes back
        found.append(bench.report(step - 1, 2.0))
    assert any(found)


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
