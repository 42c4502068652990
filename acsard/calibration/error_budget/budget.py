"""The error budget of a drive: how much each cause contributes to the present odometry error.

Each cause is propagated alone through the odometry's own error model
(`core/motion/uncertainty.py`). The recorded drive is repeated until 100 m are driven, which gives
the position error, and until 360 deg are turned to one side, which gives the heading error. The
size of a cause in each step is measured if the feedback lines show it. This holds for time,
quantisation, gaps, wheels that contradict each other, and the gyro noise that odometry assumes. All
other sizes come from the declarations in `[odometry]`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import cycle
from typing import Literal

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from acsard.calibration.error_budget.drive_log import Line, Motion, motion
from acsard.calibration.error_budget.step_errors import Driving, Steps, rounding
from acsard.core.config.settings import Config, OdometryConfig
from acsard.core.motion.error_model import DECIMAL, ErrorModel, TwistUncertainty, columns
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.path import Path
from acsard.core.motion.uncertainty import GYRO_SCALE, PoseUncertainty
from acsard.core.values import REST

Cause = Literal["time", "quantisation", "gaps", "slip", "parameters", "gyro"]

Basis = Literal["measured", "settings", "unknown"]
"""Source of a share: visible in the lines, declared in `[odometry]`, or unknown."""

METRES = 100.0

LEAST_M, LEAST_RAD = 0.2, 0.2
"""Minimum distance (m) and minimum turn (rad) of a drive from which errors can be extrapolated."""

LEAST_LINES = 20

STEP_S = 0.1
MOST_STEPS = 20_000
"""Maximum number of steps until 100 m are driven. A slow drive gets longer steps."""

STRAIGHT = Steps(np.array([[0.05, 0.0] + [0.0] * 7]))
SPIN = Steps(np.array([[0.0, 0.05] + [0.0] * 7]))
"""Steps for which the declared errors are computed while the robot does not drive."""

ZERO = (0.0,) * 6


class Share(Struct, frozen=True):
    """Contribution of one cause alone; None if this drive does not show it."""

    cause: Cause
    mm_per_100_m: float | None
    """Standard deviation of the position after 100 m, mm."""
    deg_per_turn: float | None
    """Standard deviation of the heading after a turn of 360 deg, deg."""
    basis: Basis


class Budget(Struct, frozen=True):
    """The contributions of all causes, and facts about the drive."""

    seconds: float
    metres: float
    turned: float
    """Sum of the turns to both sides, deg."""
    lines: int
    missing: int
    """Number of missing lines."""
    unseen: float
    """Driving time without lines, s."""
    lateness: float
    """RMS error of the lines' time stamps, s."""
    quantum: float
    """Quantization step of the wheel speeds in the lines, rad/s."""
    counts: int
    """Encoder counts per wheel turn, from the lines or the configuration; 0 if unknown."""
    gyro: bool
    """True if the heading comes from a gyro."""
    still: bool
    """True if the robot hardly moved, so that only configured errors can be reported."""
    at_rest: tuple[float, float]
    """Standard deviations (m/s, rad/s) of each report's twist due to its two decimals."""
    shares: tuple[Share, ...]
    multiplier: float = 1.0
    """Configured ratio of effective track to wheel separation."""
    learned: float | None = None
    """The same ratio as implied by the gyro, averaged over the drive so far; None if unknown."""
    learned_std: float = 0.0
    """Standard deviation of `learned`."""
    learned_used: bool = False
    """True if odometry uses `learned` when it has only the wheels to measure a turn."""

    def largest(self, *bases: Basis) -> Share | None:
        """Return the share with the largest position error among these bases, or else heading
        error.

        Returns None if no share with one of these bases is greater than 0.
        """
        known = [one for one in self.shares if one.basis in bases]
        for size in (_millimetres, _degrees):
            found = max(known, key=size, default=None)
            if found is not None and size(found) > 0.0:
                return found
        return None

    def total(self) -> tuple[float | None, float | None]:
        """Return the combined error of all causes in mm and deg; the causes are independent."""
        return _squares([one.mm_per_100_m for one in self.shares]), _squares(
            [one.deg_per_turn for one in self.shares]
        )


class Heard(Struct, frozen=True):
    """The data that was received from the bus."""

    lines: list[Line]
    sent: list[float]
    """Times at which lines were sent to the microcontroller, s."""
    whole: bool = True
    """True if every line that the daemon received is included."""
    counted: bool = False
    """True if the lines carry encoder counts and the microcontroller's time."""
    gyro: bool = False
    """True if the heading comes from a gyro."""
    learned: float | None = None
    """Effective track that the gyro implies, relative to the configured one; None if unknown."""
    deviation: float = 0.0
    """Relative standard deviation of `learned`."""
    used: bool = False
    """True if odometry uses `learned` when it has only the wheels to measure a turn."""


def budget(heard: Heard, config: Config, metres: float = METRES) -> Budget:
    """Return the error budget of a daemon with this configuration; `metres` replaces the 100 m."""
    kinematics = Kinematics(config.drive)
    if len(heard.lines) >= LEAST_LINES:
        moved = motion(heard.lines, np.array(heard.sent), kinematics, heard.whole)
        of = _Driven(heard, config, kinematics, moved, metres)
        if of.rolled >= LEAST_M or of.turned >= LEAST_RAD:
            return of.budget()
    return _standing(heard, config, kinematics, metres)


def _standing(heard: Heard, config: Config, kinematics: Kinematics, metres: float) -> Budget:
    """Return the budget of a robot that stands, from the settings alone."""
    lines, shares = heard.lines, []
    for cause, kind in _declared(config.odometry, kinematics):
        place = _driven(kind, kinematics, 0, STRAIGHT, metres)
        turn = _driven(kind, kinematics, 0, SPIN, math.inf, math.tau)
        shares.append(Share(cause, _mm(place), _deg(turn), "settings"))
    if not columns(config.odometry, kinematics):
        shares.append(Share("parameters", None, None, "unknown"))
    spread = TwistUncertainty(ErrorModel(_only(config.odometry), kinematics), 0).of(REST, 0.0)
    counts = config.mcu.encoder_counts if heard.counted else 0
    return Budget(
        lines[-1].at - lines[0].at if lines else 0.0, 0.0, 0.0, len(lines), 0, 0.0, 0.0, DECIMAL,
        counts, heard.gyro, still=True,
        at_rest=(math.sqrt(spread.linear), math.sqrt(spread.angular)), shares=tuple(shares),
        multiplier=(configured := kinematics.multipliers[2]),
        learned=(learned := None if heard.learned is None else heard.learned * configured),
        learned_std=(learned or 0.0) * heard.deviation, learned_used=heard.used,
    )  # fmt: skip


class _Driven:
    """Computes the shares of a drive."""

    def __init__(
        self, heard: Heard, config: Config, kinematics: Kinematics, moved: Motion, metres: float
    ) -> None:
        self._heard, self._config, self._kinematics = heard, config, kinematics
        self._motion, self._metres = moved, metres
        self.rolled = float(np.abs(moved.distance).sum())
        self.turned = float(np.abs(moved.turn).sum())

    def budget(self) -> Budget:
        heard, moved = self._heard, self._motion
        found = rounding(np.array([one.speeds for one in heard.lines]), moved.period)
        creeping = self._metres / max(self.rolled, LEAST_M) * moved.seconds / MOST_STEPS
        driving = Driving(
            heard.lines, moved, found, self._kinematics, max(STEP_S, creeping), heard.gyro
        )
        counts = self._config.mcu.encoder_counts if heard.counted else 0
        if not counts and found.count:
            counts = round(math.tau / found.count)
        shares = [*self._of_lines(driving, counts), *self._of_base(driving)]
        return replace(
            _standing(heard, self._config, self._kinematics, self._metres),
            metres=self.rolled, turned=math.degrees(self.turned), missing=moved.missing,
            unseen=moved.unseen, lateness=moved.lateness, quantum=found.quantum, counts=counts,
            still=False, shares=tuple(shares),
        )  # fmt: skip

    def _of_lines(self, driving: Driving, counts: int) -> Iterator[Share]:
        """Yield the shares of time, quantisation and gaps."""
        heard, none = self._heard, _only(self._config.odometry)
        if heard.counted:
            # Counts are cumulative, so late and missing lines cause no error.
            yield self._share("time", "measured", none, driving.plain())
            yield self._share("quantisation", "measured", none, driving.plain(), counts)
            yield self._share("gaps", "measured", none, driving.plain())
            return
        told: Basis = "measured" if heard.whole else "unknown"
        yield self._share("time", told, none, driving.late())
        yield self._share("quantisation", told, none, driving.rounded(), counts)
        yield self._share("gaps", told, none, driving.missed())

    def _of_base(self, driving: Driving) -> Iterator[Share]:
        """Yield the shares of slip, parameters and the gyro."""
        heard, odometry = self._heard, self._config.odometry
        declared = self._share("slip", "settings", _only(odometry, noise=True), driving.plain())
        seen = self._share("slip", "measured", _only(odometry), driving.contradicted())
        yield max(declared, seen, key=_millimetres)
        known = bool(columns(odometry, self._kinematics))
        basis: Basis = "settings" if known else "unknown"
        kind = _only(odometry, parameters=True)
        if heard.learned is not None:
            share = heard.deviation if heard.used else abs(heard.learned - 1.0)
            off = share * self._kinematics.multipliers[2]
            kind, basis = replace(kind, wheel_separation_multiplier_std=off), "measured"
        yield self._share("parameters", basis, kind, driving.plain())
        if heard.gyro:
            known = odometry.covariance == "model" and self._motion.yaw_variance is not None
            told: Basis = "measured" if known else "unknown"
            steps = driving.turned_by_gyro()
            yield self._share("gyro", told, _only(odometry), steps, scale=GYRO_SCALE)

    def _share(
        self, cause: Cause, basis: Basis, odometry: OdometryConfig, steps: Steps,
        counts: int = 0, scale: float = 0.0,
    ) -> Share:  # fmt: skip
        if basis == "unknown":
            return Share(cause, None, None, basis)
        millimetres = degrees = None
        if self.rolled >= LEAST_M:
            millimetres = _mm(
                _driven(odometry, self._kinematics, counts, steps, self._metres, scale=scale)
            )
        if self.turned >= LEAST_RAD:
            left = steps.to_the_left()
            degrees = _deg(
                _driven(odometry, self._kinematics, counts, left, math.inf, math.tau, scale)
            )
        return Share(cause, millimetres, degrees, basis)


def _declared(
    odometry: OdometryConfig, kinematics: Kinematics
) -> Iterator[tuple[Cause, OdometryConfig]]:
    yield "slip", _only(odometry, noise=True)
    if columns(odometry, kinematics):
        yield "parameters", _only(odometry, parameters=True)


def _driven(
    odometry: OdometryConfig, kinematics: Kinematics, counts: int, steps: Steps, metres: float,
    turns: float = math.inf, scale: float = 0.0,
) -> PoseUncertainty:  # fmt: skip
    """Return the error after `metres` m or `turns` rad of these steps, repeated.

    `scale` is the relative standard deviation of the gyro's scale.
    """
    pose, path = PoseUncertainty(ErrorModel(odometry, kinematics), counts), Path()
    rolled = turned = 0.0
    for distance, turn, along, yaw, *missed, by_gyro in cycle(steps.rows.tolist()):
        dx, dy, heading = path.advance(distance, turn)
        variance = by_gyro if steps.by_gyro else None
        pose.advance(distance, turn, dx, dy, heading, variance, scale=scale)
        if along or yaw:
            pose.doubt(along, yaw)
        if any(missed):
            pose.stand(*missed)
        rolled, turned = rolled + abs(distance), turned + abs(turn)
        if rolled >= metres or turned >= turns:
            break
    return pose


def _only(
    odometry: OdometryConfig, *, noise: bool = False, parameters: bool = False
) -> OdometryConfig:
    """Return the odometry's model with a single kind of error."""
    made = replace(odometry, pose_covariance_diagonal=ZERO)
    if not noise:
        made = replace(
            made, distance_variance_per_metre=0.0, yaw_variance_per_metre=0.0,
            yaw_variance_per_radian=0.0,
        )  # fmt: skip
    if not parameters:
        made = replace(
            made, wheel_separation_multiplier_std=0.0, left_wheel_radius_multiplier_std=0.0,
            right_wheel_radius_multiplier_std=0.0, distance_scale_std=0.0,
        )  # fmt: skip
    return made


def _mm(driven: PoseUncertainty) -> float:
    return 1e3 * math.sqrt(driven.covariance.xx + driven.covariance.yy)


def _deg(driven: PoseUncertainty) -> float:
    return math.degrees(math.sqrt(driven.covariance.yawyaw))


def _millimetres(share: Share) -> float:
    return share.mm_per_100_m or 0.0


def _degrees(share: Share) -> float:
    return share.deg_per_turn or 0.0


def _squares(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return math.hypot(*known) if known else None
