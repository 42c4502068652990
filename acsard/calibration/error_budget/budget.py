"""Computes the error budget of a drive: the odometry error that each single cause makes.

For each cause, the error model of the odometry (`core/motion/uncertainty.py`) computes the error of
the pose as if there were no other cause. For the position error, the computation repeats the
measured drive until the robot has driven 100 m. For the heading error, it mirrors all right turns
to left turns, and repeats the drive until the robot has turned by 360 deg.

Four causes are measured with feedback lines: wrong time stamps, quantization, gaps, and wheels that
contradict each other. The error of the track is measured with a gyro. The noise of the gyro is
computed from the variance of the heading that the odometry publishes. All other errors are taken
from the settings in `[odometry]`.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import cycle
from typing import Literal

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from acsard.calibration.error_budget.measured_errors import (
    DriveSteps,
    Driving,
    Line,
    motion,
    rounding,
)
from acsard.core.config.settings import Config, OdometryConfig
from acsard.core.motion.error_model import SPEED_RESOLUTION, ErrorModel, TwistUncertainty, columns
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.path import Path
from acsard.core.motion.uncertainty import PoseUncertainty
from acsard.core.values import REST, PoseCovariance

Cause = Literal["time", "quantization", "gaps", "slip", "parameters", "gyro"]

Basis = Literal["measured", "settings", "unknown"]
"""Basis on which the size of an error is known.

The size is measured, or taken from the settings in `[odometry]`, or unknown.
"""

BUDGET_DISTANCE_M = 100.0
"""Distance of driving after which the budget gives the position error, m."""

LEAST_M, LEAST_RAD = 0.2, 0.2
"""Minimum distance and turn of a drive, m and rad.

A drive that is shorter than `LEAST_M` gives no position errors. A drive that turns less than
`LEAST_RAD` gives no heading errors.
"""

MIN_LINES = 20
"""Minimum number of feedback lines.

If there are fewer lines, the robot is assumed to stand still.
"""

LEAST_SHARE = 0.2
"""Smallest fraction of distance and turns that must remain after motion to and fro has cancelled.

Such motion cancels within each step of the drive. If too little distance remains, the drive gives
no position errors. If too little of the turns remains, the drive gives no heading errors.
"""

STEP_S = 0.1
"""Minimum duration of the steps into which a measured drive is divided, s."""

MAX_STEPS = 20_000
"""Maximum number of steps in 100 m of driving. A slow drive has longer steps than `STEP_S`."""

STRAIGHT = DriveSteps(np.array([[0.05, 0.0] + [0.0] * 7]))
SPIN = DriveSteps(np.array([[0.0, 0.05] + [0.0] * 7]))
"""Steps without errors: 0.05 m straight ahead (`STRAIGHT`), and 0.05 rad in place (`SPIN`).

If the robot stood still, its budget is computed for a drive that repeats these steps.
"""


NOISE = (
    "distance_variance_per_metre", "yaw_variance_per_metre", "yaw_variance_per_radian",
    "wheel_slip_std",
)  # fmt: skip
"""Settings of `[odometry]` that state how large the errors due to skidding are."""

PARAMETERS = (
    "wheel_separation_multiplier_std", "left_wheel_radius_multiplier_std",
    "right_wheel_radius_multiplier_std", "wheel_radius_ratio_std", "distance_scale_std",
)  # fmt: skip
"""Settings of `[odometry]` that state how large the errors of wheel radii and track are."""


class Share(Struct, frozen=True):
    """The odometry errors that one cause alone makes, as standard deviations.

    An error is None if it is unknown.
    """

    cause: Cause
    mm_per_100_m: float | None
    deg_per_turn: float | None
    basis: Basis


class Budget(Struct, frozen=True):
    """The error budget of a drive: the errors of each cause, and facts about the drive."""

    seconds: float
    metres: float
    """Total distance driven, forwards and backwards, m."""
    turned: float
    """Total turning to the left and to the right, deg."""
    lines: int
    missing: int
    unseen: float
    """Total duration of the gaps in the feedback, s."""
    lateness: float
    """RMS error of the time stamps of feedback lines, s."""
    quantum: float
    """Quantization step of the wheel speeds in feedback lines, rad/s."""
    counts: int
    """Encoder counts per wheel turn; 0 if neither feedback lines nor the configuration show them.
    """
    gyro: bool
    """True if the odometry takes the heading from a gyro."""
    still: bool
    """True if the robot hardly moved.

    The budget then contains only two causes: skidding, and the errors of wheel radii and track.
    """
    at_rest: tuple[float, float]
    """Standard deviations of speed, m/s, and turn rate, rad/s, while the robot stands still.

    The cause is the rounding of the wheel speeds in feedback lines.
    """
    shares: tuple[Share, ...]
    multiplier: float = 1.0
    """Configured ratio of effective track to wheel separation."""
    learned: float | None = None
    """Mean ratio of effective track to wheel separation according to the gyro; None if unknown."""
    learned_std: float = 0.0
    learned_used: bool = False
    """True if the odometry uses `learned` as the track while the gyro does not measure the turns.
    """
    coarse: bool = False
    """True if the encoders are coarse and the daemon does not know their counts per wheel turn."""

    def largest(self, *bases: Basis) -> Share | None:
        """Return the share with the largest error. Compare only shares whose `basis` is in `bases`.

        The position errors are compared. If all of them are 0 or unknown, the heading errors are
        compared instead. If these are also 0 or unknown, the result is None.
        """
        known = [share for share in self.shares if share.basis in bases]
        for size in (_millimetres, _degrees):
            candidate = max(known, key=size, default=None)
            if candidate is not None and size(candidate) > 0.0:
                return candidate
        return None

    def total(self) -> tuple[float | None, float | None]:
        """Return the total position error, mm, and the total heading error, deg.

        The position error applies to 100 m of driving, and the heading error to one full turn of
        the robot. The causes are independent, so a total is the square root of the sum of the
        squared errors. A total is None if the error is unknown for all causes.
        """
        return _squares([share.mm_per_100_m for share in self.shares]), _squares(
            [share.deg_per_turn for share in self.shares]
        )


class DriveMessages(Struct, frozen=True):
    """The messages of one drive that this program received from the daemon."""

    lines: list[Line]
    sent: list[float]
    """Times at which the daemon sent lines to the microcontroller, s."""
    complete: bool = True
    """True if `lines` contains nearly every feedback line that the daemon received."""
    counted: bool = False
    """True if feedback lines carry encoder counts and the microcontroller's time."""
    gyro: bool = False
    """True if the odometry takes the heading from a gyro."""
    learned: float | None = None
    """Effective track according to the gyro, divided by the configured track; None if unknown."""
    deviation: float = 0.0
    """Relative standard deviation of `learned`."""
    used: bool = False
    """True if the odometry uses `learned` as the track while the gyro does not measure the turns.
    """
    coarse: bool = False
    """True if the encoders are coarse and the daemon does not know their counts per wheel turn."""


def budget(received: DriveMessages, config: Config, metres: float = BUDGET_DISTANCE_M) -> Budget:
    """Return the error budget of a drive.

    `metres` is the distance after which the budget gives the position error, m.
    """
    model, lines = _Model(config, metres), received.lines
    still = _standing(received, config, model)
    if len(lines) < MIN_LINES:
        return still
    moved = motion(
        lines, np.array(received.sent), model.kinematics, received.complete,
        model.odometry.gyro_scale_std,
    )  # fmt: skip
    rolled, turned = float(np.abs(moved.distance).sum()), float(np.abs(moved.turn).sum())
    if rolled < LEAST_M and turned < LEAST_RAD:
        return still
    errors = rounding(np.array([line.speeds for line in lines]), moved.period)
    counts = still.counts or (round(math.tau / errors.count) if errors.count else 0)
    creeping = metres / max(rolled, LEAST_M) * moved.seconds / MAX_STEPS
    driving = Driving(lines, moved, errors, model.kinematics, max(STEP_S, creeping), received.gyro)
    # `_Model` repeats the steps, in which motion to and fro cancels.
    net, net_turn = np.abs(driving.plain().rows[:, :2]).sum(axis=0).tolist()
    model.rolls = net >= max(LEAST_M, LEAST_SHARE * rolled)
    model.turns = net_turn >= max(LEAST_RAD, LEAST_SHARE * turned)
    if not (model.rolls or model.turns):
        return still
    return replace(
        still, metres=rolled, turned=math.degrees(turned), missing=moved.missing,
        unseen=moved.unseen, lateness=moved.lateness, quantum=errors.quantum, counts=counts,
        still=False, shares=tuple(_causes(received, model, driving, counts)),
    )  # fmt: skip


def _standing(received: DriveMessages, config: Config, model: _Model) -> Budget:
    lines, odometry, known = received.lines, config.odometry, model.declares_parameters
    shares = (
        model.share("slip", "settings", STRAIGHT, SPIN, _only(odometry, *NOISE)),
        model.share(
            "parameters", "settings" if known else "unknown", STRAIGHT, SPIN,
            _only(odometry, *PARAMETERS),
        ),
    )  # fmt: skip
    spread = TwistUncertainty(ErrorModel(_only(odometry), model.kinematics), 0).of(REST, 0.0)
    configured = model.kinematics.multipliers[2]
    learned = None if received.learned is None else received.learned * configured
    return Budget(
        lines[-1].at - lines[0].at if lines else 0.0, 0.0, 0.0, len(lines), 0, 0.0, 0.0,
        SPEED_RESOLUTION,
        config.mcu.encoder_counts if received.counted else 0, received.gyro, still=True,
        at_rest=(math.sqrt(spread.linear), math.sqrt(spread.angular)), shares=shares,
        multiplier=configured, learned=learned, learned_std=(learned or 0.0) * received.deviation,
        learned_used=received.used, coarse=received.coarse,
    )  # fmt: skip


def _causes(
    received: DriveMessages, model: _Model, driving: Driving, counts: int
) -> Iterator[Share]:
    """Yield the errors of each cause. `counts` is encoder counts per wheel turn; 0 if unknown."""
    odometry, plain = model.odometry, driving.plain()

    def share(
        cause: Cause, basis: Basis, steps: DriveSteps, only: OdometryConfig | None = None,
        counts: int = 0, scale: float = 0.0,
    ) -> Share:  # fmt: skip
        left, only = steps.to_the_left(), only or _only(odometry)
        return model.share(cause, basis, steps, left, only, counts, scale)

    # Encoder counts are cumulative, so late and lost feedback lines cause no error.
    counted = received.counted
    basis: Basis = "measured" if counted or received.complete else "unknown"
    yield share("time", basis, plain if counted else driving.late())
    yield share("quantization", basis, plain if counted else driving.rounded(), counts=counts)
    yield share("gaps", basis, plain if counted else driving.missed())

    declared = share("slip", "settings", plain, _only(odometry, *NOISE))
    slip = share("slip", "measured", driving.contradicted())
    yield max(declared, slip, key=lambda candidate: (_millimetres(candidate), _degrees(candidate)))

    kind = _only(odometry, *PARAMETERS)
    basis = "settings" if model.declares_parameters else "unknown"
    if received.learned is not None:
        off = received.deviation if received.used else abs(received.learned - 1.0)
        off *= model.kinematics.multipliers[2]
        kind, basis = replace(kind, wheel_separation_multiplier_std=off), "measured"
    yield share("parameters", basis, plain, kind)

    if received.gyro:
        known = odometry.covariance == "model" and driving.tells_gyro
        basis = "measured" if known else "unknown"
        yield share("gyro", basis, driving.turned_by_gyro(), scale=odometry.gyro_scale_std)


class _Model:
    def __init__(self, config: Config, metres: float) -> None:
        self.odometry, self.kinematics = config.odometry, Kinematics(config.drive)
        self.rolls = self.turns = True
        """Whether the drive is long enough to extrapolate the position error (`rolls`) and the
        heading error (`turns`)."""
        self._metres = metres

    @property
    def declares_parameters(self) -> bool:
        return bool(columns(_only(self.odometry, *PARAMETERS), self.kinematics))

    def share(
        self, cause: Cause, basis: Basis, ahead: DriveSteps, left: DriveSteps, only: OdometryConfig,
        counts: int = 0, scale: float = 0.0,
    ) -> Share:  # fmt: skip
        """Return the errors that one cause makes. They are None if `basis` is "unknown".

        Args:
            cause: the cause of the errors.
            basis: the basis on which the size of the errors is known.
            ahead: the steps that are repeated for the position error.
            left: the steps that are repeated for the heading error. All turns are to the left.
            only: the settings of `[odometry]`, with zeros for the errors of all other causes.
            counts: encoder counts per wheel turn if the cause is quantization, otherwise 0. They
                are also 0 if they are unknown.
            scale: relative standard deviation of the gyro's scale if the cause is the gyro,
                otherwise 0.
        """
        if basis == "unknown":
            return Share(cause, None, None, basis)
        millimetres = degrees = None
        if self.rolls:
            error = self._error(ahead, only, counts, scale, self._metres, math.inf)
            millimetres = 1e3 * math.sqrt(error.xx + error.yy)
        if self.turns:
            error = self._error(left, only, counts, scale, math.inf, math.tau)
            degrees = math.degrees(math.sqrt(error.yawyaw))
        return Share(cause, millimetres, degrees, basis)

    def _error(
        self, steps: DriveSteps, only: OdometryConfig, counts: int, scale: float, metres: float,
        angle: float,
    ) -> PoseCovariance:  # fmt: skip
        """Return the covariance of the pose after a drive that repeats `steps`.

        The drive ends when `metres` m are driven, or when the turns add up to `angle` rad.
        """
        pose, path = PoseUncertainty(ErrorModel(only, self.kinematics), counts), Path()
        rolled = turned = 0.0
        for distance, turn, along, yaw, *missed, by_gyro in cycle(steps.rows.tolist()):
            dx, dy, heading = path.advance(distance, turn)
            variance = by_gyro if steps.by_gyro else None
            pose.advance(distance, turn, dx, dy, heading, variance, scale=scale)
            if along or yaw:
                pose.doubt(along, yaw)
            if any(missed):
                pose.add_gap(*missed)
            rolled, turned = rolled + abs(distance), turned + abs(turn)
            if rolled >= metres or turned >= angle:
                break
        return pose.covariance


def _only(odometry: OdometryConfig, *names: str) -> OdometryConfig:
    zeros = {name: 0.0 for name in (*NOISE, *PARAMETERS) if name not in names}
    return replace(odometry, pose_covariance_diagonal=(0.0,) * 6, **zeros)


def _millimetres(share: Share) -> float:
    return share.mm_per_100_m or 0.0


def _degrees(share: Share) -> float:
    return share.deg_per_turn or 0.0


def _squares(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return math.hypot(*known) if known else None
