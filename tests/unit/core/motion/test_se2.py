"""Tests of errors as motions in SE(2), compared with 3x3 matrices."""

from __future__ import annotations

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st
from numpy.typing import NDArray

from acsard.core.motion.se2 import (
    Vector,
    added,
    bracket,
    bracket_covariance,
    brackets,
    carried,
    difference,
    plus,
    seen_from,
    total,
    twice_bracketed,
)
from acsard.core.values import PoseCovariance

Array = NDArray[np.float64]
number = st.floats(-3.0, 3.0)
vectors = st.tuples(number, number, number)
roots = st.lists(number, min_size=9, max_size=9)


def packed(m: Array) -> PoseCovariance:
    return PoseCovariance(
        *(float(m[i, k]) for i, k in ((0, 0), (0, 1), (0, 2), (1, 1), (1, 2), (2, 2)))
    )


def matrix(p: PoseCovariance) -> Array:
    return np.array(
        [[p.xx, p.xy, p.xyaw], [p.xy, p.yy, p.yyaw], [p.xyaw, p.yyaw, p.yawyaw]], dtype=np.float64
    )


def covariance(root: list[float]) -> PoseCovariance:
    m = np.array(root).reshape(3, 3)
    return packed(m @ m.T)


def ad(v: Vector) -> Array:
    """Return the matrix of the Lie bracket with v, [v, .]."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [0.0, 0.0, 0.0]])


def hat(v: Vector) -> Array:
    return np.array([[0.0, -v[2], v[0]], [v[2], 0.0, v[1]], [0.0, 0.0, 0.0]])


@given(a=vectors, b=vectors)
def test_the_bracket_is_the_commutator(a: Vector, b: Vector) -> None:
    c = hat(a) @ hat(b) - hat(b) @ hat(a)
    assert bracket(a, b) == pytest.approx((c[0, 2], c[1, 2]))
    assert c[1, 0] == pytest.approx(0.0)


@given(error=vectors, dx=number, dy=number)
def test_an_error_that_is_seen_from_a_further_point_is_the_same_motion(
    error: Vector, dx: float, dy: float
) -> None:
    moved = np.array([[1.0, 0.0, dx], [0.0, 1.0, dy], [0.0, 0.0, 1.0]])
    result = np.linalg.inv(moved) @ hat(error) @ moved
    assert seen_from(error, dx, dy) == pytest.approx((result[0, 2], result[1, 2], result[1, 0]))


@given(root=roots, dx=number, dy=number)
def test_a_covariance_is_carried_like_its_errors(root: list[float], dx: float, dy: float) -> None:
    f = np.array([[1.0, 0.0, -dy], [0.0, 1.0, dx], [0.0, 0.0, 1.0]])
    p = covariance(root)
    assert matrix(carried(p, dx, dy)) == pytest.approx(f @ matrix(p) @ f.T, abs=1e-9)


@given(a=vectors, root=roots, times=number)
def test_the_correlation_of_brackets_with_their_errors_is_that_of_the_matrices(
    a: Vector, root: list[float], times: float
) -> None:
    p = covariance(root)
    assert np.array(brackets(a, p, times)) == pytest.approx(
        times * (ad(a) @ matrix(p))[:2], abs=1e-9
    )


@given(p_root=roots, q_root=roots)
def test_the_covariance_of_a_bracket_is_that_of_all_its_directions(
    p_root: list[float], q_root: list[float]
) -> None:
    # The errors lie along the columns of the roots, each at +-1 deviation, in all pairs.
    p, q = np.array(p_root).reshape(3, 3), np.array(q_root).reshape(3, 3)
    every = [ad(tuple(a)) @ b for a in p.T for b in q.T]
    expected = np.sum([np.outer(vector, vector) for vector in every], axis=0)
    xx, xy, yy = bracket_covariance(covariance(p_root), covariance(q_root))
    assert (xx, xy, yy) == pytest.approx((expected[0, 0], expected[0, 1], expected[1, 1]), abs=1e-6)


@given(p_root=roots, q_root=roots)
def test_the_third_terms_are_those_of_barfoot_and_furgale(
    p_root: list[float], q_root: list[float]
) -> None:
    q, root = matrix(covariance(q_root)), np.array(p_root).reshape(3, 3)
    twice = np.sum([ad(tuple(e)) @ ad(tuple(e)) for e in root.T], axis=0)
    p = covariance(p_root)
    result = twice_bracketed(packed(q), (p.xyaw, p.yyaw, p.yawyaw))
    assert matrix(result) == pytest.approx(twice @ q + q @ twice.T, abs=1e-6)


@given(p_root=roots, q_root=roots, c=number, s=number)
def test_sums_of_covariances_are_taken_cell_by_cell(
    p_root: list[float], q_root: list[float], c: float, s: float
) -> None:
    p, q = covariance(p_root), covariance(q_root)
    assert matrix(total(p, q)) == pytest.approx(matrix(p) + matrix(q))
    assert matrix(difference(p, q)) == pytest.approx(matrix(p) - matrix(q))
    g = np.array([[c, 0.0], [s, 0.0], [0.0, 1.0]])
    noise = g @ np.array([[2.0, 0.5], [0.5, 3.0]]) @ g.T
    assert matrix(added(p, 2.0, 3.0, 0.5, c, s)) == pytest.approx(matrix(p) + noise, abs=1e-9)
    assert plus((1.0, 2.0, 3.0), (c, s, 0.5)) == (1.0 + c, 2.0 + s, 3.5)
