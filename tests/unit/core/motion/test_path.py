"""The computed end of a chain of arcs agrees with exact arithmetic."""

from __future__ import annotations

import math
from collections.abc import Callable

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from acsard.core.motion.path import Path, arc, plus
from acsard.core.values import Pose

Array = NDArray[np.float64]
finite = st.floats(-1e6, 1e6)


@given(a=finite, b=finite)
def test_a_sum_and_its_rounding_error_together_are_exact(a: float, b: float) -> None:
    total, rest = plus(a, b)
    assert math.fsum((a, b, -total, -rest)) == 0.0
    assert total == a + b


def long_double_end(distances: list[float], turns: list[float]) -> tuple[float, float, float]:
    """Return the end of the path, computed with a mantissa of 64 bits and a 2 pi of this precision.

    The yaw is within half a turn.
    """
    two = np.longdouble
    tau = two(math.tau) + two("2.44929359829470635445e-16")
    turn, d = np.array(turns, dtype=two), np.array(distances, dtype=two)
    yaw = np.concatenate([[two(0)], np.cumsum(turn)])
    half = turn / 2
    chord = d * np.where(half == 0, two(1), np.sin(half) / np.where(half == 0, two(1), half))
    heading = np.remainder(yaw[:-1] + half, tau)
    x, y = (chord * np.cos(heading)).sum(), (chord * np.sin(heading)).sum()
    last = yaw[-1] - tau * np.rint(yaw[-1] / tau)
    return x, y, last


Drive = Callable[[np.random.Generator, int], tuple[Array, Array]]

DRIVES: dict[str, Drive] = {
    "cruise": lambda rng, n: (np.full(n, 0.005), np.full(n, 0.0001)),
    "tiny": lambda rng, n: (rng.normal(0.005, 0.002, n), 10.0 ** rng.uniform(-300, -9, n)),
    "huge": lambda rng, n: (rng.normal(0.005, 0.002, n), rng.normal(0.0, 10.0, n)),
    "mixed": lambda rng, n: (
        rng.normal(0.002, 0.01, n),
        rng.choice([-1.0, 1.0], n) * 10.0 ** rng.uniform(-12, 1, n),
    ),
}


@pytest.mark.skipif(np.finfo(np.longdouble).nmant < 63, reason="no long doubles here")
@pytest.mark.parametrize("lines", [50_000, pytest.param(1_000_000, marks=pytest.mark.soak)])
@pytest.mark.parametrize("drive", DRIVES)
def test_a_million_lines_end_within_a_nanometre(drive: str, lines: int) -> None:
    d, turn = (a.tolist() for a in DRIVES[drive](np.random.default_rng(1), lines))
    path = Path()
    for step, by in zip(d, turn, strict=True):
        path.advance(step, by)
    x, y, yaw = long_double_end(d, turn)
    off = (
        abs(path.pose.x - x),
        abs(path.pose.y - y),
        abs(math.remainder(path.pose.yaw - yaw, math.tau)),
    )
    print(f"{drive}, {lines}: {max(off[:2]):.1e} m, {off[2]:.1e} rad")
    assert max(off[:2]) < 1e-9
    assert off[2] < 1e-12


def test_setting_the_pose_discards_the_path_before() -> None:
    path = Path()
    path.advance(0.1, 0.1)
    path.set(Pose(1.0, 2.0, 0.5))
    path.advance(0.0, 0.0)
    assert path.pose == Pose(1.0, 2.0, 0.5)


def test_the_chord_leads_from_pose_to_pose() -> None:
    path = Path()
    path.set(Pose(1.0, 2.0, 0.5))
    dx, dy, heading = path.advance(0.3, 0.4)
    assert path.pose == arc(Pose(1.0, 2.0, 0.5), 0.3, 0.4)
    assert (1.0 + dx, 2.0 + dy) == pytest.approx((path.pose.x, path.pose.y))
    assert heading == pytest.approx(math.atan2(dy, dx)) == pytest.approx(0.7)
