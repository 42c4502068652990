"""The watch reports the cause of a late period. It reads the kernel's files in its own thread."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from acsard.core.values import Event
from acsard.daemon import late_watch
from acsard.daemon.late_watch import LateWatch
from acsard.host import clock
from acsard.host.kernel_counters import Conditions, Kernel, Program, Reading, Scheduled
from tests.system.harness import until

MS = 1_000_000


class PlannedKernel(Kernel):
    """A stand-in for the kernel with values from the test. It records the threads that read it."""

    def __init__(self) -> None:
        super().__init__(Path("/nonexistent"))
        self.reading, self.threads = Reading(), set[str]()
        self.readings = self.searches = 0

    def read(self, conditions: Conditions | None = None) -> Reading:
        self.threads.add(threading.current_thread().name)
        self.readings += 1
        return self.reading

    def busiest(self, seconds: float) -> Program | None:
        self.searches += 1
        return Program(812, "hog", 150 * MS)


@pytest.fixture(autouse=True)
def times(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> Path:
    """The file with the thread's waiting times, replaced so that a busy machine adds no cause."""
    path = tmp_path / "schedstat"
    path.write_bytes(b"0 0 1\n")
    monkeypatch.setattr(late_watch, "THREAD_TIMES_FILE", str(path))
    return path


@contextmanager
def watching(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[LateWatch, PlannedKernel]]:
    monkeypatch.setattr(late_watch, "PAUSE_NS", 0)
    monkeypatch.setattr(late_watch, "READ_PERIOD_S", 0.02)
    # On a busy machine the test may wait while the watch reads many times.
    monkeypatch.setattr(late_watch, "MAX_READINGS", 1000)
    kernel = PlannedKernel()
    with LateWatch(kernel) as watch:
        until(lambda: watch._readings, 5.0, "the first reading")
        yield watch, kernel
    until(lambda: not watch._thread.is_alive(), 5.0, "the end of the thread")


def period(watch: LateWatch, late_ns: int, missed: int) -> None:
    """Begin a period that was due just now, so that the last reading of the kernel is older."""
    watch.period(clock.mono_ns() + late_ns, late_ns, missed)


def reported(watch: LateWatch) -> Event:
    event: Event
    (event,) = until(watch.take_events, 5.0, "an event")
    return event


def judged(kernel: PlannedKernel, then: int) -> None:
    """Wait until the watch has read the kernel twice and has therefore judged the lateness."""
    until(lambda: kernel.readings >= then + 2, 5.0, "two readings")


def test_a_late_period_is_reported_with_its_cause(monkeypatch: pytest.MonkeyPatch) -> None:
    with watching(monkeypatch) as (watch, kernel):
        period(watch, 100, 0)
        kernel.reading = Reading(asleep_ns=2000 * MS)
        period(watch, 30 * MS, 2)
        event = reported(watch)
        assert "by 0.03 s, because this computer was suspended for 2.00 s" in event.text
        assert kernel.threads == {"lateness"}


def test_times_that_cannot_be_read_stop_no_control_step(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.setattr(
        late_watch, "THREAD_TIMES_FILE", str(tmp_path)
    )  # a directory opens, and no more
    with watching(monkeypatch) as (watch, kernel):
        kernel.reading = Reading(asleep_ns=2000 * MS)
        period(watch, 30 * MS, 2)
        assert "suspended for 2.00 s" in reported(watch).text


def test_neither_a_punctual_period_nor_an_unknown_cause_is_an_event(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with watching(monkeypatch) as (watch, kernel):
        period(watch, 100, 0)
        judged(kernel, kernel.readings)
        period(watch, 30 * MS, 2)
        judged(kernel, kernel.readings)
        assert watch.take_events() == []


def test_only_the_first_report_of_a_cause_is_marked_as_new(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with watching(monkeypatch) as (watch, kernel):
        news = []
        for number in range(3):
            kernel.reading = Reading(asleep_ns=(number + 1) * 1000 * MS)
            period(watch, 30 * MS, 2)
            news.append(reported(watch).news)
        assert news == [True, False, False]


def test_a_lateness_is_compared_with_the_reading_before_it_began(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with watching(monkeypatch) as (watch, kernel):
        began_ns = clock.mono_ns()
        kernel.reading = Reading(asleep_ns=1000 * MS)
        # The watch reads the kernel again while the loop stands still.
        judged(kernel, kernel.readings)
        now_ns = clock.mono_ns()
        watch.period(now_ns, now_ns - began_ns, 9)
        assert "suspended for 1.00 s" in reported(watch).text


def test_a_late_period_that_began_before_the_first_reading_is_not_reported(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    began_ns = clock.mono_ns()
    with watching(monkeypatch) as (watch, kernel):
        kernel.reading = Reading(asleep_ns=1000 * MS)
        now_ns = clock.mono_ns()
        watch.period(now_ns, now_ns - began_ns, 9)
        judged(kernel, kernel.readings)
        assert watch.take_events() == []


def test_the_cause_is_determined_for_the_worst_of_several_late_periods(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    with watching(monkeypatch) as (watch, kernel):
        kernel.reading = Reading(asleep_ns=1000 * MS)
        for late_ms in (20, 50, 30):
            period(watch, late_ms * MS, 1)
        assert reported(watch).text.startswith("by 0.05 s")


def test_the_busiest_program_is_searched_once_in_ten_seconds(
    monkeypatch: pytest.MonkeyPatch, times: Path
) -> None:
    with watching(monkeypatch) as (watch, kernel):
        period(watch, 0, 0)
        for waited_ms in (30, 90):
            times.write_text(f"0 {waited_ms * MS} 2\n")
            period(watch, 30 * MS, 2)
            assert "the program hog (pid 812)" in reported(watch).text
        assert kernel.searches == 1


def test_time_from_before_the_watch_is_no_cause_of_a_late_first_period(
    monkeypatch: pytest.MonkeyPatch, times: Path
) -> None:
    times.write_text(f"0 {900 * MS} 1\n")
    with watching(monkeypatch) as (watch, _):
        times.write_text(f"0 {930 * MS} 2\n")
        period(watch, 30 * MS, 2)
        assert "other programs used the processor for 0.03 s" in reported(watch).text


@pytest.mark.slow
def test_reports_are_a_second_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    with watching(monkeypatch) as (watch, kernel):
        monkeypatch.setattr(late_watch, "PAUSE_NS", 1000 * MS)
        moments = []
        for number in range(2):
            kernel.reading = Reading(asleep_ns=(number + 1) * 1000 * MS)
            period(watch, 30 * MS, 2)
            reported(watch)
            moments.append(time.monotonic())
        assert moments[1] - moments[0] >= 0.9


def test_the_loop_s_scheduler_times_are_the_differences_between_two_periods() -> None:
    late = late_watch.Late(0, 30 * MS, b"1000 200 3\n", b"1500 900 5\n")
    assert late.thread_times == Scheduled(500, 700)


def test_a_kernel_without_schedstat_and_a_process_without_threads_are_no_error(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(late_watch, "THREAD_TIMES_FILE", "/nonexistent/schedstat")

    def refuse(_: threading.Thread) -> None:
        raise RuntimeError("can't start new thread")

    monkeypatch.setattr(threading.Thread, "start", refuse)
    with LateWatch(PlannedKernel()) as watch:
        period(watch, 0, 0)
        period(watch, 30 * MS, 2)
        assert watch.take_events() == []
