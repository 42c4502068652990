"""Computes the covariance of the pose's error e = log(estimate^-1 truth) (`se2.py`), step by step.

Noise is independent from step to step, with the covariance P. The error of a parameter is the same
in every step: J has for each parameter the error of the pose at one standard deviation. The sum is
published: to first order it is that of nav_msgs/Odometry, for x and y in the axes of odom. Rotated
by -yaw it is right even if the possible positions form an arc and not an ellipse.
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
from acsard.core.values import PoseCovariance, Rad

MAX_VARIANCE = 1e9  # m2 or rad2: "unknown"

ASSUMED_COUNTS = 400  # per revolution; few encoders have fewer

START_VARIANCE = 1e-6  # of x, y (m2) and yaw (rad2) at the start and after the pose was set

UNKNOWN_POSE = PoseCovariance(MAX_VARIANCE, 0.0, 0.0, MAX_VARIANCE, 0.0, MAX_VARIANCE)

# Cause of a motion that the pose may have missed: a gap, or doubtful wheels of a side.
Missed = Literal["gap", "left", "right"]

NO_EFFECT: Column = (0.0, 0.0, 0.0, 0.0)

UPDATE_DISTANCE = 0.2  # m rolled, between two updates of the second-order terms


class PoseUncertainty:
    """Computes the covariance of the pose, in plain floats, because updates come at 100 Hz.

        P <- F P F' + G Q G'
        J <- F J + G_p
        P_total = P + J J' + terms of second order (`second_order.py`)

    F moves an error from the position before the step to that after it (`se2.seen_from`), Q is the
    noise of distance and turn (`error_model.Noise`), G makes an error of the pose of it, along the
    chord, and G_p has that of each parameter in this step (`error_model.columns`).
    """

    def __init__(self, model: ErrorModel, counts: int) -> None:
        self._model = model
        self._parameters = self._effects = model.columns
        self._counted = counts > 0
        count, track = model.radius * math.tau / (counts or ASSUMED_COUNTS), model.track
        self._play = count / track
        self._phase = (count**2 / 24 / 2, count**2 / 24 * 2 / track**2, 0.0)
        # Displacement in odom and rolled since the last update of second order, m.
        self._dx = self._dy = self._rolled = 0.0
        self.set(0.0)

    def set(self, yaw: Rad) -> None:
        """Reset the covariance to that of an initial pose with this heading."""
        self._p = PoseCovariance(START_VARIANCE, 0.0, 0.0, START_VARIANCE, 0.0, START_VARIANCE)
        self._cos, self._sin = math.cos(yaw), math.sin(yaw)
        if self._counted:
            self._p = added(self._p, *self._phase, self._cos, self._sin)
        self._effects = self._parameters
        # Of J; those of the gyro's scale and of missed motions come when needed.
        self._columns: list[Vector] = [ORIGIN for _ in self._effects]
        self._of_gyro = -1  # index of the gyro's scale, or -1
        self._of_missed: dict[Missed, int] = {}  # indices of missed motions
        self._columns_before = self._columns
        self._turned = self._middle = 0.0
        self._second = SecondOrder(len(self._effects))
        self._begin_stretch()
        self._lost = False
        self.covariance = self._p  # published, of x, y and yaw in odom
        self._publish()

    def advance(
        self, distance: float, turn: float, dx: float, dy: float, heading: float,
        variance: float | None = None, slips: bool = False,
    ) -> None:  # fmt: skip
        """Update the covariance after an arc of `distance` m through `turn` rad.

        `dx` and `dy` are its displacement, m, and `heading` the direction of its chord in odom,
        rad. A gyro gives `variance` of the turn, rad2, and the parameters then affect only the
        distance. Wheels that slip have `SLIP_FACTOR` times the noise.
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
        scale = None if variance is None else self._model.settings.gyro_scale_std
        self._p = stepped(self._p, dx, dy, along, yaw, both, c, s)
        if scale and self._of_gyro < 0:
            self._of_gyro = self._widen()
        if self._effects:
            self._bend(distance, turn, dx, dy, scale)
        self._dx += dx
        self._dy += dy
        self._rolled += abs(distance) + self._model.track / 2 * abs(turn)
        if self._rolled > UPDATE_DISTANCE:
            self._end_stretch()
        self._publish()

    def doubt(self, along: float, yaw: float) -> None:
        """Add variances of distance, m2, and turn, rad2: the last step filled a gap."""
        if not self._lost:
            self._p = added(self._p, along, yaw, 0.0, self._cos, self._sin)
            self._publish()

    def miss(self, cause: Missed, distance: float, turn: float) -> None:
        """Add a motion that the pose may have missed in the last step, as standard deviations.

        Those of the same cause add up and do not average out, like the error of a parameter.
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
        """Add a gap in which the pose was not updated: probable motion, and its variances."""
        if self._lost:
            self._mark_unknown(distance, turn)
            return
        self.miss("gap", distance, turn)
        c, s = self._cos, self._sin
        # The motion may be an arc to either side, so the position is uncertain sideways too.
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
        # Without a motion, nothing changes. The position or the heading is already unknown.
        if distance or turn:
            self.covariance = UNKNOWN_POSE

    def _beyond_play(self, turn: float) -> float:
        # On a straight drive, the counts of both sides arrive at different times, and the heading
        # turns back and forth by one count. The sum of |dyaw| would count this as turning, and make
        # the variance of yaw 2 to 4 times too large. Only turns beyond one count add to the noise.
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
        # J <- F J + G_p; `scale` is None without a gyro.
        c, s, more = self._cos, self._sin, 0.0
        columns: list[Vector] = []
        # Unpacking into names is faster than indexing tuples.
        for (x, y, yaw), effect in zip(self._columns, self._effects, strict=True):
            of_distance, of_turn, turn_of_distance, turn_of_turn = effect
            along = of_distance * distance + of_turn * turn
            if scale is None:
                more = turn_of_distance * distance + turn_of_turn * turn
            else:
                more = scale * turn if len(columns) == self._of_gyro else 0.0
            # The direction of the chord is the old heading plus half of the turn.
            lever = yaw + more / 2
            columns.append((x + c * along - dy * lever, y + s * along + dx * lever, yaw + more))
        self._columns = columns

    def _begin_stretch(self) -> None:
        self._before = self._p
        self._columns_before = self._columns
        self._dx = self._dy = self._rolled = 0.0

    def _end_stretch(self) -> None:
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
