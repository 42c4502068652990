"""What makes odometry wrong now, cause by cause: the error budget of a stretch of driving.

Each cause alone goes through the odometry's own model of how errors of a step become errors of the
pose (`drive/uncertainty.py`), over the same driving again and again: until 100 m are driven, for
the place, and until 360 deg are turned, all to one side, for the heading. How large it is in each
step is measured where lines can tell (time, quantisation, gaps, wheels that contradict each other,
what odometry holds a gyro for), and is otherwise what `[odometry]` declares.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from itertools import cycle
from typing import Literal

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from acsard.config.settings import Config, OdometryConfig
from acsard.drive.kinematics import Kinematics
from acsard.drive.noise import columns
from acsard.drive.path import Path
from acsard.drive.twist_uncertainty import DECIMAL, TwistUncertainty
from acsard.drive.uncertainty import GYRO_SCALE, PoseUncertainty
from acsard.error_budget.drive_log import Line, Motion, motion
from acsard.error_budget.rounding import rounding
from acsard.error_budget.steps import Driving, Step, mirrored
from acsard.values import REST

Cause = Literal["time", "quantisation", "gaps", "slip", "parameters", "gyro"]

Basis = Literal["measured", "settings", "unknown"]
"""Seen in the lines, declared in `[odometry]`, or nothing is known of it."""

METRES = 100.0

LEAST_M, LEAST_RAD = 0.2, 0.2
"""What must be driven or turned to tell anything of 100 m or of a turn."""

LEAST_LINES = 20

STEP_S = 0.1
MOST_STEPS = 20_000
"""Of the way to 100 m; who creeps takes longer steps."""

STRAIGHT, SPIN = Step(0.05, 0.0), Step(0.0, 0.05)
"""What is declared is told for, while nothing is driven."""

ZERO = (0.0,) * 6


class Share(Struct, frozen=True):
    """What one cause alone would make of the error; None where this driving does not tell."""

    cause: Cause
    mm_per_100_m: float | None
    """Standard deviation of the place after 100 m, mm."""
    deg_per_turn: float | None
    """Of the heading after 360 deg, deg."""
    basis: Basis


class Budget(Struct, frozen=True):
    """All causes, and what was driven."""

    seconds: float
    metres: float
    turned: float
    """deg, to both sides together."""
    lines: int
    missing: int
    """Lines that did not come."""
    unseen: float
    """s of driving without lines."""
    lateness: float
    """s rms by which lines were taken for later or earlier than they were."""
    quantum: float
    """rad/s: the step between two speeds that lines can tell."""
    counts: int
    """Of the encoders per wheel turn, where lines show them or they are configured; else 0."""
    gyro: bool
    """The heading is a gyro's."""
    still: bool
    """It hardly moved: only what is configured can be told."""
    at_rest: tuple[float, float]
    """m/s and rad/s: what the quantum of two decimals leaves of each report's twist."""
    shares: tuple[Share, ...]
    multiplier: float = 1.0
    """Configured: effective track over wheel separation."""
    learned: float | None = None
    """The same as the gyro implies it, on the way; None is not known."""
    learned_std: float = 0.0
    """Its standard deviation."""
    learned_used: bool = False
    """Where the wheels alone tell the turn, it is by that."""

    def largest(self, *bases: Basis) -> Share | None:
        """Of what is told so, the largest of the place, else of the heading."""
        known = [one for one in self.shares if one.basis in bases]
        for size in (_millimetres, _degrees):
            found = max(known, key=size, default=None)
            if found is not None and size(found) > 0.0:
                return found
        return None

    def total(self) -> tuple[float | None, float | None]:
        """mm and deg of all causes together: independent of each other."""
        return _squares([one.mm_per_100_m for one in self.shares]), _squares(
            [one.deg_per_turn for one in self.shares]
        )


class Heard(Struct, frozen=True):
    """What came from the bus."""

    lines: list[Line]
    sent: list[float]
    """When lines left for the microcontroller, s."""
    whole: bool = True
    """Every line that the daemon got is among them."""
    counted: bool = False
    """Lines carry the encoders' counts and the microcontroller's time."""
    gyro: bool = False
    """The heading is a gyro's."""
    learned: float | None = None
    """The effective track that a gyro implies, as a share of the configured one,"""
    deviation: float = 0.0
    """its standard deviation, as a share of itself,"""
    used: bool = False
    """and whether it is in use where the wheels alone tell the turn."""


def budget(heard: Heard, config: Config, metres: float = METRES) -> Budget:
    """Of a daemon with this configuration; `metres` stands for the 100."""
    kinematics = Kinematics(config.drive)
    if len(heard.lines) >= LEAST_LINES:
        moved = motion(heard.lines, np.array(heard.sent), kinematics, heard.whole)
        of = _Driven(heard, config, kinematics, moved, metres)
        if of.rolled >= LEAST_M or of.turned >= LEAST_RAD:
            return of.budget()
    return _standing(heard, config, kinematics, metres)


def _standing(heard: Heard, config: Config, kinematics: Kinematics, metres: float) -> Budget:
    """What the settings tell."""
    lines, shares = heard.lines, []
    for cause, kind in _declared(config.odometry, kinematics):
        place = _driven(kind, kinematics, 0, [STRAIGHT], metres)
        turn = _driven(kind, kinematics, 0, [SPIN], math.inf, math.tau)
        shares.append(Share(cause, _mm(place), _deg(turn), "settings"))
    if not columns(config.odometry, kinematics):
        shares.append(Share("parameters", None, None, "unknown"))
    spread = TwistUncertainty(_only(config.odometry), kinematics, 0).of(REST, 0.0)
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
    """The shares of what was driven."""

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
        """Time, quantisation and gaps."""
        heard, none = self._heard, _only(self._config.odometry)
        if heard.counted:
            # Counts are cumulative: when a line came, or whether, does not matter to them.
            yield self._share("time", "measured", none, [])
            yield self._share("quantisation", "measured", none, driving.plain(), counts)
            yield self._share("gaps", "measured", none, [])
            return
        told: Basis = "measured" if heard.whole else "unknown"
        yield self._share("time", told, none, driving.late())
        yield self._share("quantisation", told, none, driving.rounded(), counts)
        yield self._share("gaps", told, none, driving.missed())

    def _of_base(self, driving: Driving) -> Iterator[Share]:
        """Slip, parameters and the gyro."""
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
            known = odometry.covariance == "model" and driving.tells_gyro
            told: Basis = "measured" if known else "unknown"
            steps = driving.turned_by_gyro()
            yield self._share("gyro", told, _only(odometry), steps, scale=GYRO_SCALE)

    def _share(
        self, cause: Cause, basis: Basis, odometry: OdometryConfig, steps: Sequence[Step],
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
            left = [mirrored(step) for step in steps]
            driven = _driven(odometry, self._kinematics, counts, left, math.inf, math.tau, scale)
            degrees = _deg(driven)
        return Share(cause, millimetres, degrees, basis)


def _declared(
    odometry: OdometryConfig, kinematics: Kinematics
) -> Iterator[tuple[Cause, OdometryConfig]]:
    yield "slip", _only(odometry, noise=True)
    if columns(odometry, kinematics):
        yield "parameters", _only(odometry, parameters=True)


def _driven(
    odometry: OdometryConfig, kinematics: Kinematics, counts: int, steps: Sequence[Step],
    metres: float, turns: float = math.inf, scale: float = 0.0,
) -> PoseUncertainty | None:  # fmt: skip
    """The error after so many m or rad of these steps, again and again; None without steps.

    `scale` is what a gyro's is off by.
    """
    if not steps:
        return None
    pose, path = PoseUncertainty(odometry, kinematics, counts), Path()
    rolled = turned = 0.0
    for step in cycle(steps):
        dx, dy, heading = path.advance(step.distance, step.turn)
        pose.advance(step.distance, step.turn, dx, dy, heading, step.by_gyro, scale=scale)
        if step.along or step.yaw:
            pose.doubt(step.along, step.yaw)
        if step.stood is not None:
            lost = step.stood
            pose.stand(lost.distance, lost.turn, lost.along, lost.yaw)
        rolled, turned = rolled + abs(step.distance), turned + abs(step.turn)
        if rolled >= metres or turned >= turns:
            break
    return pose


def _only(
    odometry: OdometryConfig, *, noise: bool = False, parameters: bool = False
) -> OdometryConfig:
    """The odometry's model with one kind of error and no other."""
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


def _mm(driven: PoseUncertainty | None) -> float:
    if driven is None:
        return 0.0
    return 1e3 * math.sqrt(driven.covariance.xx + driven.covariance.yy)


def _deg(driven: PoseUncertainty | None) -> float:
    return 0.0 if driven is None else math.degrees(math.sqrt(driven.covariance.yawyaw))


def _millimetres(share: Share) -> float:
    return share.mm_per_100_m or 0.0


def _degrees(share: Share) -> float:
    return share.deg_per_turn or 0.0


def _squares(values: Sequence[float | None]) -> float | None:
    known = [value for value in values if value is not None]
    return math.hypot(*known) if known else None
