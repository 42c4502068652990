"""How far the pose may be from the encoders' own counts after 20 m, for each kind of link.

With a checked link that sends counts, nothing but the counts matters. On a plain link the sample
time matters: it is wrong by the jitter of USB and of this computer, and by what the board's delay
varies. Run it with `pytest -s` for the figures.
"""

from __future__ import annotations

import math

import pytest

from tests.unit.core.link.drives import Adapter, Case, drive
from tests.unit.core.link.table import print_row

ADAPTERS: tuple[Adapter, ...] = ("acm", "ftdi")

STALL = 0.15
"""Length, s, of the stalls of this computer, one a second."""


def off(case: Case, seed: int) -> tuple[float, float]:
    """Return the distance, mm, and the turn, deg, between our pose and that of the counts."""
    host = drive(case, seed, 40.0)
    ours, counter = host.found.pose, host.counter.pose
    yaw = math.degrees(abs(math.remainder(ours.yaw - counter.yaw, math.tau)))
    return 1000 * math.dist((ours.x, ours.y), (counter.x, counter.y)), yaw


def check(name: str, case: Case, mm: float, deg: float) -> None:
    far, turned = off(case, 1)
    print_row(name, f"{mm:g} mm, {deg:g} deg", f"{far:.1f} mm, {turned:.2f} deg")
    assert far <= mm
    assert turned <= deg


@pytest.mark.parametrize("stall", [0.0, STALL])
@pytest.mark.parametrize(
    ("counts", "thinking", "mm", "deg"),
    [(20, 0.0002, 5, 0.1), (20, 0.004, 5, 0.1), (3200, 0.0002, 15, 0.15), (3200, 0.004, 15, 0.2)],
)
def test_a_board_that_answers_within_5_ms_is_where_its_counts_say(
    counts: int, thinking: float, mm: float, deg: float, stall: float
) -> None:
    case = Case(prompted=True, counts=counts, thinking=thinking, stall=stall, stall_every=1.0)
    bound = (25, 0.25) if stall and counts > 400 else (mm, deg)
    check(f"prompted, {counts} counts, stalls of {stall} s", case, *bound)


@pytest.mark.parametrize("stall", [0.0, STALL])
@pytest.mark.parametrize("counts", [20, 96, 3200])
def test_a_free_running_board_is_where_its_counts_say(counts: int, stall: float) -> None:
    check(
        f"free-running, {counts} counts, stalls of {stall} s",
        Case(counts=counts, stall=stall, stall_every=1.0),
        1,
        0.05,
    )


@pytest.mark.parametrize("counts", [20, 96, 3200])
@pytest.mark.parametrize("adapter", ADAPTERS)
def test_a_checked_link_with_counts_loses_nothing(counts: int, adapter: Adapter) -> None:
    case = Case(
        adapter,
        prompted=True,
        counts=counts,
        thinking=0.004,
        checked=True,
        lost=0.2,
        stall=STALL,
        stall_every=1.0,
    )
    # A lost line loses no count, but the shape of the arc in it.
    check(f"checked, {counts} counts, 20 % lost, {adapter}", case, 10 if counts < 400 else 1, 0.01)


@pytest.mark.parametrize("counts", [0, 3200])
def test_an_adapter_of_16_ms_costs_little_with_fine_encoders(counts: int) -> None:
    case = Case("ftdi", prompted=True, counts=counts, thinking=0.004, stall=STALL, stall_every=1.0)
    check(f"prompted, 16 ms, {counts} counts", case, 30, 0.3)


@pytest.mark.parametrize("prompted", [False, True], ids=["reporting", "prompted"])
def test_a_twentieth_of_the_lines_lost_costs_little_with_fine_encoders(prompted: bool) -> None:
    case = Case(prompted=prompted, counts=3200, lost=0.05)
    check(f"5 % lost, prompted: {prompted}", case, 40, 0.4)
