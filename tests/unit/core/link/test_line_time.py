"""Drives of 450 m show how delays of the host and lost lines change the pose.

Each pose is compared with the floor, which is the pose if each line had its true time. `pytest -m
soak -s` runs all drives and prints a table with the goal and the result of each drive.
"""

from __future__ import annotations

from itertools import pairwise

import numpy as np
import pytest

from acsard.core.link.line_times import FreeRunning
from acsard.core.values import Instant
from tests.unit.core.link.drives import PERIOD, Case, drive
from tests.unit.core.link.table import print_row

FOUND, FLOOR, ARRIVAL = range(3)

FULL = pytest.param(600.0, 20, marks=[pytest.mark.soak, pytest.mark.timeout(3000)], id="450 m")
SHORT = pytest.param(30.0, 1, id="20 m")
EFFORT = pytest.mark.parametrize(("seconds", "seeds"), [SHORT, FULL])


def errors(name: str, goal: str, case: Case, seconds: float, seeds: int) -> np.ndarray:
    """Return the mean errors, in m and deg, of three poses.

    The poses come from the session, from true times (the floor), and from arrival times.
    """
    means = np.mean([drive(case, seed, seconds).errors() for seed in range(seeds)], axis=0)
    (m, deg), (times, times_deg) = means[FOUND], means[FOUND] / means[FLOOR]
    by, by_deg = means[ARRIVAL]
    print_row(
        name,
        goal,
        f"{m:.3f} m {deg:.3f} deg, {times:.2f} and {times_deg:.2f} x floor; "
        f"arrival {by:.2f} m {by_deg:.2f} deg",
    )
    return np.asarray(means)


def link(prompted: bool) -> str:
    return "prompted" if prompted else "reporting"


@pytest.mark.variations(9)
@EFFORT
@pytest.mark.parametrize("stall", [0.05, 0.09, 0.15, 0.25])
@pytest.mark.parametrize("prompted", [False, True], ids=["reporting", "prompted"])
def test_host_stalls_add_no_pose_error(
    prompted: bool, stall: float, seconds: float, seeds: int
) -> None:
    result = errors(
        f"stalls of {stall} s, {link(prompted)}",
        "1.1 x floor",
        Case(stall=stall, prompted=prompted),
        seconds,
        seeds,
    )
    assert np.all(result[FOUND] <= 1.1 * result[FLOOR] + slack(seeds))


SLACK = np.array([0.02, 0.05])
"""Allowance in m and deg for a single drive that ends near the truth by chance."""


def slack(seeds: int) -> np.ndarray:
    """Return the allowed excess over the goal, which is 0 unless there is only one drive.

    The goals hold for the mean of twenty drives, whose floor is 0.05 to 0.13 m and 0.065 deg.
    """
    return SLACK if seeds == 1 else 0.0 * SLACK


@pytest.mark.slow
@EFFORT
@pytest.mark.parametrize("prompted", [False, True], ids=["reporting", "prompted"])
def test_an_adapter_that_holds_lines_back_adds_no_pose_error(
    prompted: bool, seconds: float, seeds: int
) -> None:
    case = Case("ftdi", prompted, stall=0.15)
    name = f"FTDI 16 ms, 12 stalls a minute, {link(prompted)}"
    result = errors(name, "1.05 x floor", case, seconds, seeds)
    assert np.all(result[FOUND] <= 1.05 * result[FLOOR] + slack(seeds))


@pytest.mark.slow
@EFFORT
@pytest.mark.parametrize("prompted", [False, True], ids=["reporting", "prompted"])
def test_losing_a_fifth_of_the_lines_adds_little_pose_error(
    prompted: bool, seconds: float, seeds: int
) -> None:
    case = Case(prompted=prompted, lost=0.2, stall=0.15, stall_every=60.0)
    name = f"20 % lost, a stall a minute, {link(prompted)}"
    result = errors(name, "0.45 m", case, seconds, seeds)
    assert result[FOUND, 0] <= 0.45


@pytest.mark.slow
@EFFORT
def test_answers_that_take_1_to_5_ms_give_half_the_error_of_arrival_times(
    seconds: float, seeds: int
) -> None:
    """The remaining error comes from the MCU's delay, which the host cannot measure separately.

    The pose from arrival times contains this error too.
    """
    case = Case(prompted=True, thinking=0.004, stall=0.09)
    name = "stalls of 0.09 s, answers 1 to 5 ms late"
    result = errors(name, "half of arrival times'", case, seconds, seeds)
    assert np.all(result[FOUND] <= result[ARRIVAL] / 2)


@pytest.mark.parametrize(
    ("prompted", "seconds", "seeds"),
    [
        pytest.param(
            False,
            60.0,
            4,
            marks=pytest.mark.slow,
            id="reporting-45 m",
        ),
        # In one minute, the answers lost around a stall decide the result.
        pytest.param(True, 600.0, 3, marks=pytest.mark.soak, id="prompted-450 m thrice"),
        pytest.param(False, *FULL.values, marks=FULL.marks, id="reporting-450 m"),
        pytest.param(True, *FULL.values, marks=FULL.marks, id="prompted-450 m"),
    ],
)
def test_losses_on_a_batched_link_give_no_more_error_than_arrival_times(
    prompted: bool, seconds: float, seeds: int
) -> None:
    case = Case("ftdi", prompted, lost=0.2, stall=0.15, stall_every=60.0)
    name = f"FTDI 16 ms, 20 % lost, {link(prompted)}"
    result = errors(name, "never worse than arrival times", case, seconds, seeds)
    assert np.all(result[FOUND] <= result[ARRIVAL])


@pytest.mark.slow
@pytest.mark.parametrize(("lost", "most"), [(0.01, 0.045), (0.05, 0.035)])
def test_a_free_running_board_on_a_lossy_batched_link_gets_the_times_of_arrival(
    lost: float, most: float
) -> None:
    """Whole periods, of which some are missed, would give 0.049 m and 0.086 m."""
    case = Case("ftdi", lost=lost, stall=0.15, stall_every=60.0)
    assert np.mean([drive(case, seed, 60.0).errors()[FOUND, 0] for seed in range(3)]) < most


def test_the_times_on_a_lossy_link_add_up_to_those_of_arrival() -> None:
    """The board's clock is 0.4 % fast, and an adapter reads every 16 ms."""
    period, batch = 10_000_000, 16_000_000
    lines, chance = FreeRunning(), np.random.default_rng(1)
    came = np.flatnonzero(chance.random(6000) > 0.05) * period * 0.996
    reads = (came // batch + 1).astype(int) * batch
    before, passed, times = 0, 0, []
    for end in np.unique(reads):
        count = int(np.sum(reads == end))
        lines.process_read(int(end), int(end) - before, count, True, period)
        before = int(end)
        placed = [lines.place(behind, period) for behind in reversed(range(count))]
        passed += sum(line.dt_ns for line in placed)
        times.append(placed[-1].due_ns - passed)
    late = times[len(times) // 2 :]
    assert max(late) - min(late) < period / 10


@pytest.mark.slow
def test_a_batched_link_that_loses_one_answer_in_a_hundred_keeps_its_clock() -> None:
    """Without the clock of the answers, the host would spread a stall over earlier lines.

    The error of this drive would then be 0.44 m larger.
    """
    host = drive(Case("ftdi", prompted=True, lost=0.01, stall=0.15), 0, 60.0)
    assert host.errors()[FOUND, 0] <= 0.25


@pytest.mark.slow
@EFFORT
def test_the_gaps_of_bursts_of_lost_lines_are_filled(seconds: float, seeds: int) -> None:
    case = Case(burst_every=30.0)
    result = errors("bursts of 0.1 to 0.5 s, 2 a minute", "7.5 m", case, seconds, seeds)
    assert result[FOUND, 0] <= 7.5


@pytest.mark.slow
def test_every_slot_of_a_drive_is_counted_once() -> None:
    host = drive(Case(stall=0.25, stall_every=2.0), 1, 30.0)
    clocked = [feedback.dt for feedback in host.heard[100:]]
    assert len(host.heard) == len(host.lines)
    assert set(clocked) == {PERIOD}
    assert all(feedback.bridged == feedback.gap == 0.0 for feedback in host.heard)


@pytest.mark.variations(3)
@pytest.mark.parametrize(
    "case",
    [
        Case(stall=0.25, stall_every=2.0),
        Case("ftdi", lost=0.1, stall=0.09),
        Case(prompted=True, stall=0.15, lost=0.1),
        Case(burst_every=5.0, lost=0.3),
    ],
)
def test_line_times_never_go_backwards(case: Case) -> None:
    samples = drive(case, 2, 30.0).heard
    assert all(f.dt >= f.bridged >= 0.0 and f.since >= 0.0 for f in samples)
    assert all(a.at.mono_ns <= b.at.mono_ns for a, b in pairwise(samples))
    assert all(f.at.mono_ns <= f.heard_ns for f in samples)


@pytest.mark.slow
@pytest.mark.parametrize("adapter", ["acm", "ftdi"])
def test_a_stamp_is_the_time_at_which_the_sample_was_made(adapter: str) -> None:
    host = drive(Case("ftdi" if adapter == "ftdi" else "acm", stall=0.15), 3, 40.0)
    late, arrivals = [], []
    for line, feedback in list(zip(host.lines, host.heard, strict=True))[1000:]:
        late.append(feedback.at.mono_ns / 1e9 - 1000 - line.at)
        arrivals.append(feedback.heard_ns / 1e9 - 1000 - line.at)
    assert np.std(late) < np.std(arrivals) / 8
    assert abs(np.mean(late)) < 0.002
    assert isinstance(host.heard[0].at, Instant)
