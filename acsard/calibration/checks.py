"""Finds why a sensor does not follow the wheels, and says the cause that the log shows.

A log whose fit explains the sensors passes without any of these tests.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from msgspec import Struct

from acsard.calibration.fit import GYRO_DELAY, POSE_DELAY, TRACK, Fit
from acsard.calibration.log import Floats, LogError, Run

MIN_ROLLED = 20.0  # rad, by the wheels of a log
UNEXPLAINED = 0.3  # share of the sensor's motion that the wheels do not explain
TRACK_RANGE = 0.5, 3.6  # credible ratios of effective track and wheel separation
LENGTHS = 0.4, 2.5  # credible ratios of the distances by positions and by wheels
LATE_S, NOTED_LATE_S = 0.9, 0.1  # of the end of the search, and worth a note
CLEAR_TURN, SAME_SIDE = 0.1, 0.5  # rad in a step; mean of the signs
BACKWARDS = 1e-3  # share of the rolled angle, below which wheels never turn backwards
TOO_GOOD = 2e-5  # of the motion; a real sensor differs by more
STEP_S, MIN_CHORD_M = 1.0, 0.05
NAMES = {"gyro": "yaw_rate", "headings": "yaw", "positions": "x, y"}

DRIVE = (
    "stand for 3 s, drive 2 m ahead and back, turn three times to each side, slowly and fast, then "
    "drive curves: 60 s in all"
)


class Compared(Struct, frozen=True):
    """The motion by one sensor and by the wheels, in steps of a second."""

    seen: Floats  # turns, rad
    wheels: Floats  # turns with the configured geometry, rad
    lengths: tuple[float, float]  # sum of the distances by positions and by the wheels, m


def require_motion(runs: Sequence[Run]) -> None:
    """Raise `LogError` if the wheels hardly roll."""
    rolled = sum(float(np.abs(np.diff(side)).sum()) for r in runs for side in (r.left, r.right)) / 2
    if rolled < MIN_ROLLED:
        raise LogError(f"the wheels roll only {rolled:.1f} rad in this log: {DRIVE}")


def require_agreement(fit: Fit, separation: float) -> list[str]:
    """Return notes. Raise `LogError` with the cause if a sensor does not follow the wheels."""
    notes = []
    for sensor, share in fit.unexplained.items():
        if share > UNEXPLAINED:
            raise LogError(_cause(fit, sensor))
        if share < TOO_GOOD:
            notes.append(
                f"{NAMES[sensor]} agrees with the wheels better than a sensor can: was it computed "
                "from them? (The true pose of the simulator agrees, too.)"
            )
    for index, sensor in ((GYRO_DELAY, "yaw_rate"), (POSE_DELAY, "the positions")):
        late = float(fit.p[index])
        if abs(late) > LATE_S:
            raise LogError(
                f"the times of {sensor} are not those of the wheels: record all sensors with times "
                "from the same clock"
            )
        if abs(late) > NOTED_LATE_S:
            notes.append(f"the times of {sensor} are {1000 * late:.0f} ms after the wheels'")
    factor = fit.base.track * math.exp(fit.p[TRACK]) / separation
    if not TRACK_RANGE[0] < factor < TRACK_RANGE[1]:
        raise LogError(_cause(fit, fit.sensors[0]))
    return notes


def _cause(fit: Fit, sensor: str) -> str:
    name, runs = NAMES[sensor], [piece.run for piece in fit.pieces]
    left, right = (
        np.concatenate([np.diff(getattr(run, side)) for run in runs]) for side in ("left", "right")
    )
    if np.allclose(left, right, atol=1e-6):
        return (
            "left and right are the same in every row, although the robot turns: the log has one "
            "side twice. Record the wheels of both sides"
        )
    made = [_compared(fit, run, sensor) for run in runs]
    seen, wheels = (np.concatenate([getattr(m, side) for m in made]) for side in ("seen", "wheels"))
    back = max(float(-np.minimum(v, 0.0).sum() / (np.abs(v).sum() or 1.0)) for v in (left, right))
    if back < BACKWARDS and len(seen) and min(seen.max(), -seen.min()) > 0.2:
        return (
            "the wheels never turn backwards in this log, although the robot turns both ways: "
            "encoders with one channel, or a sign that was lost. Record speeds with their sign"
        )
    if sensor == "positions":
        places, rolled = np.sum([m.lengths for m in made], axis=0)
        if not LENGTHS[0] < places / max(rolled, 1e-9) < LENGTHS[1]:
            return (
                f"the robot drives {places:.3g} m by x and y, but {rolled:.3g} m by its wheels: "
                "are x and y in m, the speeds of the wheels in rad/s, and is "
                "drive.wheel_radius right?"
            )
    turns = np.abs(wheels) > CLEAR_TURN
    ratios = seen[turns] / wheels[turns] if turns.any() else np.ones(1)
    slope, alike = float(np.median(ratios)) or 1e-9, float(np.mean(np.sign(ratios)))
    if alike < -SAME_SIDE:
        sign = "y must point" if sensor == "positions" else f"{name} must grow"
        return (
            f"{name} turns to the other side than the wheels: {sign} to the left, or left and "
            "right are swapped"
        )
    if alike > SAME_SIDE and not TRACK_RANGE[0] < 1 / slope < TRACK_RANGE[1]:
        return _units(name, 1 / slope)
    return (
        f"{name} does not follow the wheels: is it of the same drive, with times from the same "
        "clock, and did the wheels touch the ground? Does yaw_rate turn about the axis that points "
        "up?"
    )


def _units(name: str, factor: float) -> str:
    return (
        f"by the wheels the robot turns {factor:.3g} times as far as by {name}: is yaw_rate in "
        "rad/s and yaw in rad, are the speeds of the wheels in rad/s, and are drive.wheel_radius "
        "and drive.wheel_separation in m?"
    )


def _compared(fit: Fit, run: Run, sensor: str) -> Compared:
    edges = np.linspace(run.t[0], run.t[-1], max(2, round(run.seconds / STEP_S)) + 1)
    rolls = [np.diff(np.interp(edges, run.t, side)) for side in (run.left, run.right)]
    distance, turn = fit.base.motion(np.zeros_like(fit.p), *rolls)
    if sensor == "gyro":
        return Compared(np.diff(np.interp(edges, run.gyro_t, run.turned)), turn, (0.0, 0.0))
    if sensor == "headings":
        return Compared(np.diff(np.interp(edges, run.yaw_t, np.unwrap(run.yaw))), turn, (0.0, 0.0))
    spots = [np.interp(edges, run.place_t, v) for v in (run.place.real, run.place.imag)]
    chords = np.diff(spots[0] + 1j * spots[1])
    far = (np.abs(chords[1:]) > MIN_CHORD_M) & (np.abs(chords[:-1]) > MIN_CHORD_M)
    seen = np.angle(chords[1:] * np.conj(chords[:-1]))[far]
    # Between the middles of two steps. A robot that drives backwards turns the same way.
    wheels = ((turn[1:] + turn[:-1]) / 2)[far]
    lengths = float(np.abs(chords).sum()), float(np.abs(distance).sum())
    return Compared(seen, wheels, lengths)
