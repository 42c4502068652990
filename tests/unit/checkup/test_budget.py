"""The error budget against drives in which one cause alone makes odometry wrong."""

from __future__ import annotations

import math
from collections.abc import Callable
from functools import partial

import pytest

from acsard.checkup.budget import Budget, Cause, Heard, Share, budget
from acsard.config.settings import Config
from tests.unit.checkup import drives
from tests.unit.checkup.drives import Told

CONFIG = Config()

Make = Callable[[int, float], Told]

CASES: dict[str, tuple[Cause, Make]] = {
    "an adapter that holds lines for 16 ms": ("time", partial(drives.late, how="batches")),
    "stalls of the host": ("time", partial(drives.late, how="stalls")),
    "a busy host": ("time", partial(drives.late, how="jitter")),
    "two decimals": ("quantisation", drives.rounded),
    "40 counts a turn": ("quantisation", partial(drives.rounded, counts=40)),
    "400 counts a turn": ("quantisation", partial(drives.rounded, counts=400)),
    "4000 counts a turn": ("quantisation", partial(drives.rounded, counts=4000)),
    "a line of ten lost": ("gaps", partial(drives.lost, share=0.1, longest=1)),
    "up to five lines lost": ("gaps", partial(drives.lost, share=0.1, longest=5)),
    "bursts lost in which the pose stands": (
        "gaps",
        partial(drives.lost, share=0.02, longest=40, stands=True),
    ),
}


def share(found: Budget, cause: Cause) -> Share:
    return next(one for one in found.shares if one.cause == cause)


def as_predicted(case: str, seconds: float, seeds: int) -> float:
    """The rms, over drives, of the error at the end as a share of what the budget says."""
    cause, make = CASES[case]
    ratios = []
    for seed in range(seeds):
        told = make(seed, seconds)
        found = budget(Heard(told.lines, []), CONFIG, metres=told.metres * 0.999)
        millimetres = share(found, cause).mm_per_100_m
        assert millimetres
        ratios.append(1e3 * told.off / millimetres)
    return math.sqrt(sum(ratio**2 for ratio in ratios) / seeds)


@pytest.mark.parametrize("case", ["an adapter that holds lines for 16 ms", "two decimals",
                                  "400 counts a turn", "up to five lines lost"])  # fmt: skip
def test_the_share_of_a_cause_is_about_the_error_it_makes_on_a_short_drive(case: str) -> None:
    assert 1 / 2 < as_predicted(case, 40.0, 10) < 2


@pytest.mark.slow
@pytest.mark.parametrize("case", CASES)
def test_the_share_of_a_cause_is_within_half_of_the_error_it_makes_in_450_m(case: str) -> None:
    ratio = as_predicted(case, 600.0, 20)
    print(f"{case}: error / share {ratio:.2f}")
    assert 1 / 1.5 < ratio < 1.5
