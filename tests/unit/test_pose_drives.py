"""How far the pose is from the encoders' own counts or the true path, for each kind of link.

With a checked link that sends counts, nothing but the counts matters. On a plain link the sample
time matters: it is wrong by the jitter of USB and of this computer, and by what the board's delay
varies. `pytest -s` prints the figures.
"""

from __future__ import annotations

import math
from itertools import pairwise

import numpy as np
import pytest

from acsard.core.config.settings import WheelMap
from acsard.core.link.line_times import FreeRunning
from acsard.core.values import Instant
from tests.unit.board_drives import Adapter, Case, drive
from tests.wheels import four_and_two

ADAPTERS: tuple[Adapter, ...] = ("acm", "ftdi")

STALL = 0.15
"""Length, s, of the stalls of this computer, one a second."""


def off(case: Case, seed: int) -> tuple[float, float]:
    """Return the distance, mm, and the turn, deg, between our pose and that of the counts."""
    host = drive(case, seed, 40.0)
    ours, counter = host.found.pose, host.counted
    yaw = math.degrees(abs(math.remainder(ours.yaw - counter.yaw, math.tau)))
    return 1000 * math.dist((ours.x, ours.y), (counter.x, counter.y)), yaw


def check(name: str, case: Case, mm: float, deg: float) -> None:
    far, turned = off(case, 1)
    print(f"\n{name:46} goal {mm:g} mm, {deg:g} deg  found {far:.1f} mm, {turned:.2f} deg", end="")
    assert far <= mm
    assert turned <= deg


@pytest.mark.variations(17)
@pytest.mark.parametrize("stall", [0.0, STALL])
@four_and_two
@pytest.mark.parametrize(
    ("counts", "thinking", "mm", "deg"),
    [(20, 0.0002, 5, 0.1), (20, 0.004, 5, 0.1), (3200, 0.0002, 15, 0.15), (3200, 0.004, 15, 0.2)],
)
def test_a_board_that_answers_within_5_ms_is_where_its_counts_say(
    counts: int, thinking: float, mm: float, deg: float, stall: float, wheels: WheelMap
) -> None:
    case = Case(
        prompted=True, counts=counts, thinking=thinking, stall=stall, stall_every=1.0, wheels=wheels
    )
    bound = (25, 0.25) if stall and counts > 400 else (mm, deg)
    check(f"prompted, {counts} counts, stalls of {stall} s", case, *bound)


@pytest.mark.variations(13)
@pytest.mark.parametrize("stall", [0.0, STALL])
@pytest.mark.parametrize("counts", [20, 96, 3200])
@four_and_two
def test_a_free_running_board_is_where_its_counts_say(
    counts: int, stall: float, wheels: WheelMap
) -> None:
    check(
        f"free-running, {counts} counts, stalls of {stall} s",
        Case(counts=counts, stall=stall, stall_every=1.0, wheels=wheels),
        1,
        0.05,
    )


@pytest.mark.variations(13)
@pytest.mark.parametrize("counts", [20, 96, 3200])
@pytest.mark.parametrize("adapter", ADAPTERS)
@four_and_two
def test_a_checked_link_with_counts_loses_nothing(
    counts: int, adapter: Adapter, wheels: WheelMap
) -> None:
    case = Case(
        adapter,
        prompted=True,
        counts=counts,
        thinking=0.004,
        checked=True,
        lost=0.2,
        stall=STALL,
        stall_every=1.0,
        wheels=wheels,
    )
    # A lost line loses no count, but the shape of the arc in it.
    check(f"checked, {counts} counts, 20 % lost, {adapter}", case, 10 if counts < 400 else 2, 0.01)


@pytest.mark.variations(2)
@pytest.mark.parametrize("counts", [0, 3200])
def test_an_adapter_of_16_ms_costs_little_with_fine_encoders(counts: int) -> None:
    case = Case("ftdi", prompted=True, counts=counts, thinking=0.004, stall=STALL, stall_every=1.0)
    check(f"prompted, 16 ms, {counts} counts", case, 30, 0.3)


@pytest.mark.variations(2)
@pytest.mark.parametrize("prompted", [False, True], ids=["reporting", "prompted"])
def test_a_twentieth_of_the_lines_lost_costs_little_with_fine_encoders(prompted: bool) -> None:
    case = Case(prompted=prompted, counts=3200, lost=0.05)
    check(f"5 % lost, prompted: {prompted}", case, 40, 0.4)


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
        passed += sum(dt_ns for _, dt_ns, _ in placed)
        times.append(placed[-1][0] - passed)
    late = times[len(times) // 2 :]
    assert max(late) - min(late) < period / 10


@pytest.mark.variations(3)
@pytest.mark.parametrize(
    "case",
    [
        Case(stall=0.25, stall_every=2.0),
        Case("ftdi", lost=0.1, stall=0.09),
        Case(prompted=True, stall=0.15, lost=0.1),
        Case(lost=0.3),
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
    for made, feedback in list(zip(host.made, host.heard, strict=True))[1000:]:
        late.append(feedback.at.mono_ns / 1e9 - 1000 - made)
        arrivals.append(feedback.heard_ns / 1e9 - 1000 - made)
    assert np.std(late) < np.std(arrivals) / 8
    assert abs(np.mean(late)) < 0.002
    assert isinstance(host.heard[0].at, Instant)
