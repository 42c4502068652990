"""Tests of the units behind the names of columns."""

from __future__ import annotations

import math

import pytest

from acsard.calibration.units import factor, parted


@pytest.mark.parametrize(
    ("cell", "name", "unit"),
    [
        ("t", "t", ""),
        (" T [ms] ", "t", "ms"),
        ("Yaw Rate (deg / s)", "yaw_rate", "deg/s"),
        ("yaw-rate", "yaw_rate", ""),
        ("left(rpm", "left", "rpm"),
        ("", "", ""),
    ],
)
def test_a_unit_stands_in_brackets(cell: str, name: str, unit: str) -> None:
    assert parted(cell) == (name, unit)


@pytest.mark.parametrize(
    ("name", "unit", "times"),
    [
        ("t", "", 1.0),
        ("t", "ns", 1e-9),
        ("x", "cm", 0.01),
        ("yaw", "deg", math.pi / 180),
        ("yaw_rate", "degrees/sec", math.pi / 180),
        ("left", "rpm", math.tau / 60),
        ("left", "rad/s", 1.0),
        ("left", "m/s", None),
        ("t", "rad", None),
    ],
)
def test_a_unit_is_worth_so_much(name: str, unit: str, times: float | None) -> None:
    assert factor(name, unit) == (None if times is None else pytest.approx(times))
