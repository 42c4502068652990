"""Computes the covariance of the pose's error, step by step.

The error is log(estimate^-1 truth) in SE(2) (`se2.py`). A step transforms it to the robot's new
place and adds noise (`error_model.py`): P <- F P F' + G Q G'. The errors of the parameters stay the
same all the way, so the effect of each on the pose is summed as a column, J <- F J + G_p, and

    P_total = P + J J' + terms of second order (`second_order.py`)

In nav_msgs/Odometry the covariance is that of x and y along the axes of odom and of yaw. To first
order the position error is that of the twist, so the same numbers are published. Turned by -yaw
they are those of the Lie algebra in base_link. These still hold when the heading is badly known and
an ellipse in x and y cannot be right.

A turn counts only as far as it exceeds encoder noise. A count more on one side and then on the
other is not a turn, but |dyaw| per line would count it as one, 2 to 4 times the yaw's variance on a
straight. Therefore the heading has a play of one count, and only the part beyond it counts.
"""

from __future__ import annotations

import math

from acsard.core.motion.error_model import SLIPPING, Column, ErrorModel
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
"""m2 or rad2. A greater variance carries no information, and the numbers must stay finite for
years."""

COARSE_COUNTS = 400
"""Counts per wheel turn if none are configured. Hardly any encoder has fewer."""

SAME_COUNT = 0.02
"""Relative difference between two angles of a count that rounding to two decimals can cause."""

NOWHERE = PoseCovariance(MAX_VARIANCE, 0.0, 0.0, MAX_VARIANCE, 0.0, MAX_VARIANCE)

GYRO_SCALE = 0.004
"""Relative standard deviation of a gyro's scale. It makes 1.4 degrees after a turn, 29 after twenty
to the same side, and 0 once they are turned back."""

NO_EFFECT: Column = (0.0, 0.0, 0.0, 0.0)

STRETCH = 0.2
"""Way of the wheels between two updates of the second-order terms, m. These change slowly."""


class PoseUncertainty:
    """The covariance of the pose, in plain floats because it is updated at 100 Hz."""

    def __init__(self, model: ErrorModel, counts: int) -> None:
        """Start; `counts` are the encoders' counts per wheel turn, 0 if unknown."""
        self._model = model
        self._parameters = self._effects = model.columns
        self._configured = self._counted = counts > 0
        self._count = 0.0
        self._stand_within(math.tau / (counts or COARSE_COUNTS))
        self._dx = self._dy = self._rolled = 0.0
        """Motion in odom, and way of the wheels, since the last update of the second-order terms,
        m."""
        self.set(0.0)

    def bend(self) -> None:
        """Use the model's columns, as many as before, and its track from now on.

        Their effects until now stay.
        """
        beside = self._effects[len(self._parameters) :]
        self._parameters = self._model.columns
        self._effects = (*self._parameters, *beside)
        self._stand_within(self._count)

    def _stand_within(self, angle: float) -> None:
        """Set the angle of a count.

        Each side is the mean of two wheels, which may stand anywhere in it.
        """
        self._count, count, track = angle, self._model.radius * angle, self._model.track
        self._play = count / track
        self._phase = (count**2 / 24 / 2, count**2 / 24 * 2 / track**2, 0.0)

    def set(self, yaw: float) -> None:
        """Reset the covariance to that of the start, with the heading `yaw`."""
        xx, yy, _, _, _, yawyaw = self._model.settings.pose_covariance_diagonal
        self._p = PoseCovariance(xx, 0.0, 0.0, yy, 0.0, yawyaw)
        self._cos, self._sin = math.cos(yaw), math.sin(yaw)
        if self._counted:
            self._p = added(self._p, *self._phase, self._cos, self._sin)
        self._effects = self._parameters
        self._columns: list[Vector] = [ORIGIN for _ in self._effects]
        """J, column by column. Behind the parameters' columns come those that are added when they
        first err."""
        self._of_gyro = self._of_gaps = -1
        """Index of the column for turns by a gyro, and of that for motion in gaps; -1 without
        one."""
        self._columns_before = self._columns
        self._turned = self._middle = 0.0
        self._second = SecondOrder(len(self._effects))
        self._begin_stretch()
        self._lost = False
        self.covariance = self._p
        """The published covariance of x, y and yaw in odom."""
        self._publish()

    def show_count(self, angle: float) -> None:
        """Take the angle of an encoder count that the lines show, rad, unless one is configured.

        From now on the pose consists of whole counts, and the start position within a count is
        unknown too.
        """
        if self._configured or angle <= 0.0:
            return
        if self._counted and abs(angle - self._count) < SAME_COUNT * self._count:
            return
        self._stand_within(angle)
        if not self._counted:
            self._counted = True
            self._p = added(self._p, *self._phase, self._cos, self._sin)

    def advance(
        self, distance: float, turn: float, dx: float, dy: float, heading: float,
        variance: float | None = None, slips: bool = False, scale: float = GYRO_SCALE,
    ) -> None:  # fmt: skip
        """Add an arc of `distance` m through `turn` rad; in odom it leads by `dx`, `dy` m.

        `heading` is the direction of the chord. `variance` is that of the turn, rad2, if a gyro
        measured it instead of the wheels. Then the wheels' parameters affect only the distance, and
        the gyro's relative `scale` error affects the turn. `slips` means that the wheels slip.
        """
        if self._lost:
            self._forget_where(distance, turn)
            return
        c, s = self._cos, self._sin = math.cos(heading), math.sin(heading)
        along, yaw, both = self._model.noise.of(distance, turn, self._beyond_play(turn))
        if slips:
            along, yaw, both = SLIPPING * along, SLIPPING * yaw, SLIPPING * both
        if variance is not None:
            yaw, both = variance, 0.0
        self._p = stepped(self._p, dx, dy, along, yaw, both, c, s)
        if variance is not None and scale and self._of_gyro < 0:
            self._of_gyro = self._widen()
        if self._effects:
            self._bend(distance, turn, dx, dy, None if variance is None else scale)
        self._dx += dx
        self._dy += dy
        self._rolled += abs(distance) + self._model.track / 2 * abs(turn)
        if self._rolled > STRETCH:
            self._end_stretch()
        self._publish()

    def doubt(self, along: float, yaw: float) -> None:
        """Add variances to the last way: `along` m2 in its direction, `yaw` rad2 of heading."""
        if not self._lost:
            self._p = added(self._p, along, yaw, 0.0, self._cos, self._sin)
            self._publish()

    def stand(self, distance: float, turn: float, along: float, yaw: float) -> None:
        """Account for a gap in which the robot may have moved on by `distance` and `turn`, unseen.

        The pose stands still in a gap. Such errors all have one direction and do not average out,
        so they form a column like a parameter. `along` m2 and `yaw` rad2 are the variances of the
        unseen motion.
        """
        if self._lost:
            self._forget_where(distance, turn)
            return
        c, s = self._cos, self._sin
        if self._of_gaps < 0:
            self._of_gaps = self._widen()
        self._columns = [*self._columns]
        gone_on = plus(self._columns[self._of_gaps], (c * distance, s * distance, turn))
        self._columns[self._of_gaps] = gone_on
        # An unknown arc may lead to either side.
        aside = (distance**2 + along) * min(1.0, (turn**2 + yaw) / 4)
        way_along, way_yaw, both = self._model.noise.of(distance, turn, abs(turn))
        p = added(self._p, along + way_along, yaw + way_yaw, both, c, s)
        self._p = added(p, aside, 0.0, 0.0, -s, c)
        self._publish()

    def _widen(self) -> int:
        """Add a column without effect so far; return its index."""
        self._effects = (*self._effects, NO_EFFECT)
        self._columns = [*self._columns, ORIGIN]
        self._columns_before = [*self._columns_before, ORIGIN]
        self._second.widen()
        return len(self._columns) - 1

    def _forget_where(self, distance: float, turn: float) -> None:
        """Give up the position.

        A robot that moves without a known heading or position knows neither.
        """
        if distance or turn:
            self.covariance = NOWHERE

    def _beyond_play(self, turn: float) -> float:
        """Return the part of `turn` that is not encoder noise, rad."""
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
        """Apply F J + G_p. One half of the step's own heading error acts on its lever arm.

        `scale` is that of the gyro that measured the turn, None if the wheels did.
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
            lever = yaw + more / 2
            columns.append((x + c * along - dy * lever, y + s * along + dx * lever, yaw + more))
        self._columns = columns

    def _begin_stretch(self) -> None:
        self._before = self._p
        self._columns_before = self._columns
        self._dx = self._dy = self._rolled = 0.0

    def _end_stretch(self) -> None:
        """Add the second-order terms of the way since the last update."""
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
    """Return the covariance with capped variances and the same correlations."""
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
