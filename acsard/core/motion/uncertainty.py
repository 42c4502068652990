"""Computes the covariance of the pose's error, step by step.

The error is e = log(estimate^-1 truth) in SE(2) (`se2.py`), with the components x, y and yaw. It
has two parts. Noise is independent from step to step, and its covariance is P (3x3). The error of a
parameter, such as a wheel radius, is the same in every step, so its effects add up. The matrix J
has a column for each parameter: the error of the pose if this parameter is off by one standard
deviation. Each step updates both parts, and their sum is published (' means transposed):

    P <- F P F' + G Q G'
    J <- F J + G_p
    P_total = P + J J' + terms of second order (`second_order.py`)

- F (3x3) transforms an error at the robot's position before the step to its position after the step
  (`se2.seen_from`).
- Q (2x2) is the covariance of the noise in the distance and the turn of the step
  (`error_model.Noise`).
- G (3x2) transforms errors of distance and turn to an error of the pose. The distance is along the
  chord of the step.
- G_p has a column for each parameter: the error of the pose that it causes in this step
  (`error_model.columns`).

The covariance in nav_msgs/Odometry is defined for x and y in the axes of odom, and for yaw. To
first order it equals the covariance of e in these axes, so P_total is published. Rotated by -yaw,
P_total is the covariance of e in the axes of base_link. This rotated covariance is right even if
the heading is so uncertain that the possible positions form an arc and not an ellipse.
"""

from __future__ import annotations

import math
from typing import Literal

from acsard.core.motion.error_model import SLIP_FACTOR, Column, ErrorModel
from acsard.core.motion.se2 import (
    ORIGIN,
    Vector,
    added,
    carried,
    difference,
    plus,
    seen_from,
    stepped,
    total,
)
from acsard.core.motion.second_order import SecondOrder
from acsard.core.values import PoseCovariance

MAX_VARIANCE = 1e9
"""Largest variance of the pose, m2 or rad2. It means "unknown"."""

ASSUMED_COUNTS = 400
"""Number of encoder counts per revolution of a wheel that is assumed if this number is not
configured. Few encoders have fewer counts."""

UNKNOWN_POSE = PoseCovariance(MAX_VARIANCE, 0.0, 0.0, MAX_VARIANCE, 0.0, MAX_VARIANCE)

Missed = Literal["gap", "left", "right"]
"""Cause of a motion that the pose may have missed: a gap in the feedback, or wheels of one side
whose reports may be wrong or were ignored."""

NO_EFFECT: Column = (0.0, 0.0, 0.0, 0.0)

UPDATE_DISTANCE = 0.2
"""Distance that the wheels roll between two updates of the second-order terms, m."""


class PoseUncertainty:
    """Computes the covariance of the pose. It uses plain floats, because updates come at 100 Hz."""

    def __init__(self, model: ErrorModel, counts: int) -> None:
        """Start at the origin.

        `counts` is the number of encoder counts per revolution of a wheel; 0 if it is unknown.
        """
        self._model = model
        self._parameters = self._effects = model.columns
        self._counted = counts > 0
        self._count = 0.0
        self._set_count_angle(math.tau / (counts or ASSUMED_COUNTS))
        self._dx = self._dy = self._rolled = 0.0
        """Motion since the last update of the second-order terms, m. `_dx` and `_dy` are the
        displacement in odom, and `_rolled` is the distance that the wheels rolled."""
        self.set(0.0)

    def update_track(self) -> None:
        """Read the effective track and the columns of the error model again.

        Call this when they have changed. The error model must have as many columns as before.
        """
        beside = self._effects[len(self._parameters) :]
        self._parameters = self._model.columns
        self._effects = (*self._parameters, *beside)
        self._set_count_angle(self._count)

    def _set_count_angle(self, angle: float) -> None:
        """Set the angle of an encoder count, rad, within which a wheel's position is unknown."""
        self._count, count, track = angle, self._model.radius * angle, self._model.track
        self._play = count / track
        self._phase = (count**2 / 24 / 2, count**2 / 24 * 2 / track**2, 0.0)

    def set(self, yaw: float) -> None:
        """Reset the covariance to that of an initial pose with the heading `yaw`, rad."""
        xx, yy, _, _, _, yawyaw = self._model.settings.pose_covariance_diagonal
        self._p = PoseCovariance(xx, 0.0, 0.0, yy, 0.0, yawyaw)
        self._cos, self._sin = math.cos(yaw), math.sin(yaw)
        if self._counted:
            self._p = added(self._p, *self._phase, self._cos, self._sin)
        self._effects = self._parameters
        self._columns: list[Vector] = [ORIGIN for _ in self._effects]
        """The columns of the matrix J (see the module). The columns for the gyro's scale and for
        missed motions are added when needed."""
        self._of_gyro = -1
        """The index in `_columns` of the column for the gyro's scale; -1 before it is added."""
        self._of_missed: dict[Missed, int] = {}
        """The indices in `_columns` of the columns for motions that the pose missed."""
        self._columns_before = self._columns
        self._turned = self._middle = 0.0
        self._second = SecondOrder(len(self._effects))
        self._begin_stretch()
        self._lost = False
        self.covariance = self._p
        """The published covariance of x, y and yaw in odom."""
        self._publish()

    def advance(
        self, distance: float, turn: float, dx: float, dy: float, heading: float,
        variance: float | None = None, slips: bool = False, scale: float | None = None,
    ) -> None:  # fmt: skip
        """Update the covariance after a step, which is an arc of `distance` m through `turn` rad.

        Args:
            distance: the length of the arc, m.
            turn: the turn of the step, rad.
            dx: the displacement along the x axis of odom, m.
            dy: the displacement along the y axis of odom, m.
            heading: the direction of the chord of the arc in odom, rad.
            variance: the variance of the turn, rad2, if a gyro measured the turn; None if the
                wheels measured it. With a gyro, the errors of the parameters affect only the
                distance.
            slips: whether the wheels slip. The noise of the wheels is then larger by the factor
                `SLIP_FACTOR`.
            scale: the relative standard deviation of the gyro's scale; None for the configured one,
                `odometry.gyro_scale_std`.
        """
        if self._lost:
            self._mark_unknown(distance, turn)
            return
        c, s = self._cos, self._sin = math.cos(heading), math.sin(heading)
        along, yaw, both = self._model.noise.of(distance, turn, self._beyond_play(turn))
        if slips:
            along, yaw, both = SLIP_FACTOR * along, SLIP_FACTOR * yaw, SLIP_FACTOR * both
        if variance is not None:
            yaw, both = variance, 0.0
            scale = self._model.settings.gyro_scale_std if scale is None else scale
        self._p = stepped(self._p, dx, dy, along, yaw, both, c, s)
        if variance is not None and scale and self._of_gyro < 0:
            self._of_gyro = self._widen()
        if self._effects:
            self._bend(distance, turn, dx, dy, None if variance is None else scale)
        self._dx += dx
        self._dy += dy
        self._rolled += abs(distance) + self._model.track / 2 * abs(turn)
        if self._rolled > UPDATE_DISTANCE:
            self._end_stretch()
        self._publish()

    def doubt(self, along: float, yaw: float) -> None:
        """Increase the uncertainty of the last step, because it filled a gap in the feedback.

        `along` is the additional variance of the step's distance, m2, and `yaw` that of the step's
        turn, rad2.
        """
        if not self._lost:
            self._p = added(self._p, along, yaw, 0.0, self._cos, self._sin)
            self._publish()

    def miss(self, cause: Missed, distance: float, turn: float) -> None:
        """Add the uncertainty of a motion that the pose may have missed in the last step.

        Motions that the pose misses for the same cause add up and do not average out. Therefore
        they are treated like the error of a parameter. `distance`, m, and `turn`, rad, are the
        standard deviations, with the signs of the motion.
        """
        if self._lost:
            return
        if cause not in self._of_missed:
            self._of_missed[cause] = self._widen()
        index, c, s = self._of_missed[cause], self._cos, self._sin
        self._columns = [*self._columns]
        self._columns[index] = plus(self._columns[index], (c * distance, s * distance, turn))
        self._publish()

    def add_gap(self, distance: float, turn: float, along: float, yaw: float) -> None:
        """Add the uncertainty of a gap in the feedback during which the pose was not updated.

        Args:
            distance: the probable distance driven in the gap, m.
            turn: the probable turn in the gap, rad.
            along: the variance of the distance, m2.
            yaw: the variance of the turn, rad2.
        """
        if self._lost:
            self._mark_unknown(distance, turn)
            return
        self.miss("gap", distance, turn)
        c, s = self._cos, self._sin
        # The unknown motion may be an arc to the left or to the right, so the position also becomes
        # uncertain sideways.
        aside = (distance**2 + along) * min(1.0, (turn**2 + yaw) / 4)
        way_along, way_yaw, both = self._model.noise.of(distance, turn, abs(turn))
        p = added(self._p, along + way_along, yaw + way_yaw, both, c, s)
        self._p = added(p, aside, 0.0, 0.0, -s, c)
        self._publish()

    def _widen(self) -> int:
        self._effects = (*self._effects, NO_EFFECT)
        self._columns = [*self._columns, ORIGIN]
        self._columns_before = [*self._columns_before, ORIGIN]
        self._second.add_parameter()
        return len(self._columns) - 1

    def _mark_unknown(self, distance: float, turn: float) -> None:
        """Set all variances to "unknown" after a motion of `distance` m and `turn` rad.

        Without a motion, nothing changes. Call this only if the position or the heading is already
        unknown.
        """
        if distance or turn:
            self.covariance = UNKNOWN_POSE

    def _beyond_play(self, turn: float) -> float:
        # On a straight drive, the encoder counts of both sides arrive at different times, so the
        # heading turns back and forth by one count. The sum of |dyaw| over all feedback lines would
        # count this as turning, and make the variance of yaw 2 to 4 times too large. The heading
        # therefore has a dead band of one count, like the backlash of a gear: only turns beyond it
        # add to the noise.
        self._turned += turn
        off = self._turned - self._middle
        if abs(off) <= self._play:
            return 0.0
        beyond = abs(off) - self._play
        self._middle += math.copysign(beyond, off)
        return beyond

    def _bend(
        self, distance: float, turn: float, dx: float, dy: float, scale: float | None
    ) -> None:
        """Update the matrix J of the parameters' effects after an arc: J <- F J + G_p.

        `scale` is the relative standard deviation of the gyro's scale, or None without a gyro.
        """
        c, s, more = self._cos, self._sin, 0.0
        columns: list[Vector] = []
        # With four columns at 100 Hz, unpacking into names is faster than indexing tuples.
        for (x, y, yaw), effect in zip(self._columns, self._effects, strict=True):
            of_distance, of_turn, turn_of_distance, turn_of_turn = effect
            along = of_distance * distance + of_turn * turn
            if scale is None:
                more = turn_of_distance * distance + turn_of_turn * turn
            else:
                more = scale * turn if len(columns) == self._of_gyro else 0.0
            # Half of the heading error of the step acts on its displacement, because the direction
            # of the chord is the old heading plus half of the turn.
            lever = yaw + more / 2
            columns.append((x + c * along - dy * lever, y + s * along + dx * lever, yaw + more))
        self._columns = columns

    def _begin_stretch(self) -> None:
        self._before = self._p
        self._columns_before = self._columns
        self._dx = self._dy = self._rolled = 0.0

    def _end_stretch(self) -> None:
        """Add the second-order terms (`second_order.py`) for the path since the last update."""
        dx, dy, p = self._dx, self._dy, self._p
        before = carried(self._before, dx, dy)
        columns_before = [seen_from(column, dx, dy) for column in self._columns_before]
        new = [
            (a[0] - b[0], a[1] - b[1], a[2] - b[2])
            for a, b in zip(self._columns, columns_before, strict=True)
        ]
        self._second.carry(dx, dy)
        self._p = total(p, self._second.compose(before, difference(p, before), columns_before, new))
        self._begin_stretch()

    def _publish(self) -> None:
        p, second = self._p, self._second
        xx, xy, yy = p.xx + second.xx, p.xy + second.xy, p.yy + second.yy
        xyaw, yyaw, yawyaw = p.xyaw, p.yyaw, p.yawyaw
        for x, y, yaw in self._columns:
            xx += x * x
            xy += x * y
            xyaw += x * yaw
            yy += y * y
            yyaw += y * yaw
            yawyaw += yaw * yaw
        published = PoseCovariance(xx, xy, xyaw, yy, yyaw, yawyaw)
        if self._counted:
            along, turning, both = self._phase
            published = added(published, along, turning, both, self._cos, self._sin)
        if xx >= MAX_VARIANCE or yy >= MAX_VARIANCE or yawyaw >= MAX_VARIANCE:
            self._lost = True
            published = _capped(published)
        self.covariance = published


def _capped(p: PoseCovariance) -> PoseCovariance:
    """Limit the variances to `MAX_VARIANCE`. The correlations do not change."""
    x, y, yaw = (
        min(1.0, math.sqrt(MAX_VARIANCE / max(v, MAX_VARIANCE))) for v in (p.xx, p.yy, p.yawyaw)
    )
    return PoseCovariance(
        min(p.xx, MAX_VARIANCE),
        p.xy * x * y,
        p.xyaw * x * yaw,
        min(p.yy, MAX_VARIANCE),
        p.yyaw * y * yaw,
        min(p.yawyaw, MAX_VARIANCE),
    )
