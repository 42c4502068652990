"""The rows of a heading sensor as evidence."""

from __future__ import annotations

import numpy as np

from acsard.calibration.evidence import (
    COUNT,
    DRIFT,
    LEFT,
    RATE,
    RIGHT,
    STRETCH,
    TURN,
    Base,
    Evidence,
    huber,
    of_rows,
)  # fmt: skip
from acsard.calibration.heading import Rows
from acsard.calibration.table import Floats

NOISE = 0.01
"""Residuals that are usual when outliers are sought.

They are `NOISE` rad per second and the fraction `SHARE` of the turn, added as squares.
"""
SHARE = 0.03


def turned(rows: Rows, base: Base, parameters: Floats) -> Floats:
    """Return the turn of each row by the wheels for these parameters, rad."""
    left, right, turn, slope = parameters[[LEFT, RIGHT, TURN, RATE]]
    straight = base.gain * turn * (right * rows.right - left * rows.left)
    return np.asarray(straight + slope * _slower(rows, base, parameters))


def _slower(rows: Rows, base: Base, parameters: Floats) -> Floats:
    """Return the reduction of each row's turn per unit of `RATE`, rad."""
    left, right, turn = parameters[[LEFT, RIGHT, TURN]]
    rate = base.gain * turn * (left + right) / 2
    return np.asarray(-rate * abs(rate) * rows.fast)


def evidence(rows: Rows, base: Base, parameters: Floats, blocks: int) -> Evidence:
    """Return the evidence at these parameters."""
    turn = parameters[TURN]
    by_wheels = turned(rows, base, parameters)
    jacobian = np.zeros((len(rows.turned), COUNT))
    jacobian[:, LEFT] = -base.gain * turn * rows.left
    jacobian[:, RIGHT] = base.gain * turn * rows.right
    jacobian[:, RATE] = _slower(rows, base, parameters)
    jacobian[:, TURN] = (by_wheels + jacobian[:, RATE] * parameters[RATE]) / turn
    jacobian[:, DRIFT] = rows.seconds
    jacobian[:, STRETCH] = by_wheels
    gyro = by_wheels * (1 + parameters[STRETCH]) + parameters[DRIFT] * rows.seconds
    residual = rows.turned - gyro
    usual = np.hypot(NOISE * rows.seconds, SHARE * by_wheels)
    return of_rows(jacobian, residual, huber(residual / usual, 1.0), rows.block, blocks)


def bias(rows: Rows, by_wheels: Floats) -> float:
    """Return the rate by which the sensor exceeds the wheels, rad/s, by robust least squares."""
    seconds, found = rows.seconds, 0.0
    for _ in range(10):
        off = rows.turned - by_wheels
        usual = np.hypot(NOISE * seconds, SHARE * by_wheels)
        weight = huber((off - found * seconds) / usual, 1.0)
        found = float((weight * seconds) @ off / ((weight * seconds) @ seconds))
    return found


def first(rows: Rows, base: Base) -> Floats:
    """Return g_l and g_r, of any sign, by least squares.

    They are relative to the gain of parameters that are all 1.
    """
    columns = base.gain * np.column_stack((-rows.left, rows.right))
    weight = np.ones(len(rows.turned))
    found: Floats = np.zeros(2)
    for _ in range(10):
        root = np.sqrt(weight)[:, None]
        found = np.asarray(np.linalg.lstsq(columns * root, rows.turned * root[:, 0], rcond=None)[0])
        by_wheels = columns @ found
        usual = np.hypot(NOISE * rows.seconds, SHARE * by_wheels)
        weight = huber((rows.turned - by_wheels) / usual, 1.0)
    return found


def by_sides(rows: Rows, base: Base, sides: Floats) -> Floats:
    """Return the turn of each row by the wheels for the result of `first`, rad."""
    return np.asarray(base.gain * (sides[1] * rows.right - sides[0] * rows.left))
