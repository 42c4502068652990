"""The covariance of the pose and the variances of the twist.

The error of a pose, e = log(estimate^-1 truth), is the twist that leads from the estimated to the
true pose; its axes are those of odom, at the robot. P is its covariance by noise, J has its error
for one standard deviation of each cause that does not average out (`ErrorModel.effects`), and a
stretch of the path, with the displacement (dx, dy), moves all of it by F:

    P <- F P F' + G Q G'        J <- F J + G_p        P_total = P + J J' + second order

Q is of distance and turn (Siegwart, Nourbakhsh & Scaramuzza, Autonomous Mobile Robots, 5.2.4).
`_bend` has the second order: a wrong heading to either side makes the robot get less far, which is
nearly all of the error along a straight of 60 m. `astray` has what is beyond any order: with a turn
that was missed, or a heading of which nothing is known, the robot may be anywhere within its way.
"""

from __future__ import annotations

import math
from collections.abc import Iterable
from typing import Literal, get_args

from msgspec import Struct, field

from acsard.core.config.settings import FeedbackConfig, LimitsConfig, OdometryConfig
from acsard.core.link.coarse_encoders import LARGEST_JUMP
from acsard.core.link.feedback import MAX_FILLED_GAP_S
from acsard.core.motion.agreement import claims
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.wheels import count_angle
from acsard.core.values import (
    WHEELS,
    Metres,
    Pose,
    PoseCovariance,
    Rad,
    RadPerS,
    Seconds,
    Twist,
    TwistVariances,
)

UPDATE_S = 0.05  # between two updates; lines that need one at once get it
# Rolled, between two updates of the second order. The last term keeps rounding from deciding.
BEND_M = 0.2 + 1e-9

START_VARIANCE = 1e-6  # of x, y (m2) and yaw (rad2) at the start and after the pose was set
MAX_VARIANCE = 1e9  # m2 or rad2, and of the twist: "unknown"
UNKNOWN_POSE = PoseCovariance(MAX_VARIANCE, 0.0, 0.0, MAX_VARIANCE, 0.0, MAX_VARIANCE)
MAX_HEADING_VARIANCE = 1.0  # rad2, of the second order: its series does not converge beyond

ASSUMED_COUNTS = 400  # per revolution; few encoders have fewer
ASSUMED_PERIOD_S = 0.01  # of the lines, before it is known
MIN_PERIOD_S = 1e-3  # no serial line is as short
SPEED_RESOLUTION = 0.01  # rad/s: a line has two decimals
LATERAL_VARIANCE = 1e-3  # m2/s2 sideways, which wheels do not measure, while the robot moves
MIN_TWIST_VARIANCE = 1e-8  # filters that use the published twist treat less as an error
SLIP_FACTOR = 100.0  # on the variances of a step and of the twist while the wheels slip

# Beyond `MAX_FILLED_GAP_S` without a line, the robot rests, and a person may push and turn it.
PUSH_SPEED, PUSH_TURN = 1.0, 0.5  # m/s and rad/s
MOST_AWAY, MOST_TURNED = 10.0, 3.2  # m and rad: then it may be anywhere near, in any direction

Vector = tuple[float, float, float]  # x, y (m) and yaw (rad) of an error

# Error of a step for one standard deviation: of the distance per m and per rad, of the turn per m
# and per rad.
Effect = tuple[float, float, float, float]

ORIGIN: Vector = (0.0, 0.0, 0.0)
NO_EFFECT: Effect = (0.0, 0.0, 0.0, 0.0)

# Causes of an error that do not average out. The motion that the pose may have missed is that of
# gaps, and the differences of gyro and wheels, of the wheels and their commands (`way` and `turn`),
# the same of silences, what the board may have done in one (`range`), and of the wheels of a side.
Missed = Literal[
    "gap", "gyro", "way", "turn", "silent way", "silent turn", "silent range", "left", "right"
]
RATIO, TRACK, SCALE, GYRO = PARAMETERS = range(4)
MISSED: dict[Missed, int] = {cause: len(PARAMETERS) + i for i, cause in enumerate(get_args(Missed))}
CAUSES = len(PARAMETERS) + len(MISSED)


class ErrorModel:
    """What the configuration says about the odometry and its errors."""

    def __init__(
        self,
        odometry: OdometryConfig,
        kinematics: Kinematics,
        counts: int = 0,
        limits: LimitsConfig = LimitsConfig(),  # noqa: B008
        feedback: FeedbackConfig = FeedbackConfig(),  # noqa: B008
        names: tuple[str, ...] = WHEELS,
    ) -> None:
        # `counts` per revolution is 0 if unknown. `names` are those of the driven wheels.
        self.names = names
        self.independent = independent = len(names)  # wheels: of two, the rear is the front
        track, radius = kinematics.track, kinematics.radius
        self.kinematics, self.track = kinematics, track
        self.count: Rad = math.tau / counts if counts else 0.0
        self.wheel_count, self.feedback = count_angle(counts), feedback  # for `wheels.py`
        self.claims = claims(odometry, kinematics, counts) if odometry.gyro else None
        count = radius * math.tau / (counts or ASSUMED_COUNTS)  # m
        # Counts of both sides that arrive at different times turn the heading by this, to and fro.
        self.play: Rad = count / track
        # A wheel at rest rocks between the edges of a count.
        self.unsettled: Rad = 2 * math.tau / (counts or ASSUMED_COUNTS)
        # Where in a count each wheel was at the start, and is now. A turn is the difference of the
        # sides' means, the distance half of their sum.
        xy = count**2 / (6 * independent) if counts else 0.0
        yaw = 4 * xy / track**2
        xy, yaw = START_VARIANCE + xy, START_VARIANCE + yaw
        self.start = PoseCovariance(xy, 0.0, 0.0, xy, 0.0, yaw)

        # If errors of the sides, of variance k |m| each, were the only ones, D =
        # `distance_variance_per_metre` would be k / 2, and Y = `yaw_variance_per_metre` 2 k / L^2.
        # The rest of D or Y is an error of the robot as a whole.
        distance, yaw = odometry.distance_variance_per_metre, odometry.yaw_variance_per_metre
        k = min(2 * distance, yaw * track * track / 2)
        self.along, self.turning = distance - k / 2, yaw - 2 * k / (track * track)
        self.of_sides = k / 4, k / (track * track), k / (2 * track)
        self.skid = odometry.yaw_variance_per_radian

        ratio, gyro = odometry.wheel_radius_ratio_std, odometry.gyro_scale_std
        share = odometry.track_std(independent) / kinematics.multipliers[2]
        scale = (odometry.distance_scale_std, 0.0, 0.0, 0.0)
        # One radius is larger by half of the ratio's error, the other smaller.
        longer, none = ratio * track / 4, NO_EFFECT
        by_wheels = [(0.0, longer, ratio / track, 0.0), (0.0, 0.0, 0.0, -share), scale, none]
        by_gyro = [(0.0, longer, 0.0, 0.0), none, scale, (0.0, 0.0, 0.0, gyro)]
        if not feedback.encoders:  # the lines repeat the commands, and the robot may rest
            by_wheels = [none, (0.0, 0.0, 0.0, 1.0), (1.0, 0.0, 0.0, 0.0), none]
            by_gyro[SCALE] = (1.0, 0.0, 0.0, 0.0)
        missed = [none] * len(MISSED)
        self.effects: tuple[list[Effect], list[Effect]] = by_wheels + missed, by_gyro + missed

        # Independent errors of the speeds; each side is the mean of its wheels.
        self.of_speed = (
            radius**2 / (12 * independent), radius**2 / track**2 / (3 * independent),
        )  # fmt: skip
        self.speed = Twist(limits.linear_speed, limits.angular_speed)
        self.acceleration = Twist(
            max(limits.linear_acceleration, limits.linear_deceleration),
            max(limits.angular_acceleration, limits.angular_deceleration),
        )

    def noise(self, distance: Metres, turn: Rad, turned: Rad) -> Vector:
        """Return var(d), m2, var(turn), rad2, and cov(d, turn), m rad, of a step.

        `turned` is the part of |turn| that is a real turn and not encoder noise, rad.
        """
        half = self.track / 2 * turn
        left, right, path = abs(distance - half), abs(distance + half), abs(distance)
        along, yaw, both = self.of_sides
        return (
            self.along * path + along * (left + right),
            self.turning * path + yaw * (left + right) + self.skid * turned,
            both * (right - left),
        )

    def in_gap(self, seconds: Seconds, period: Seconds, rests: bool) -> tuple[float, float]:
        """Return the variances of the distance, m2, and the turn, rad2, that no line covers.

        Within the limits, a motion between two speeds differs by at most a t^2 / 4 from the
        trapezoid. The rounding of both speeds is alike for both wheels of a side, and none if the
        robot `rests` before and after.
        """
        speed, acceleration, quantum = self.speed, self.acceleration, 0.0
        short = min(seconds, MAX_FILLED_GAP_S)  # then the robot was stopped
        if not rests:
            quantum = 2 * (self.unsettled / 2 / period * short) ** 2
            if self.independent == 2:
                # A count is missed in the gap, too: in one lost line, it is five times the above.
                # With four wheels, the factor of a slip behind a gap covers it.
                count = self.unsettled / 2
                quantum = (count / period * short + count) ** 2 + count**2
        along = min(acceleration.linear * short / 4, speed.linear) * short
        yaw = min(acceleration.angular * short / 4, speed.angular) * short
        return along**2 + self.of_speed[0] * quantum, yaw**2 + self.of_speed[1] * quantum


def pushed(seconds: Seconds) -> tuple[float, float]:
    """Return the variances of position, m2, and heading, rad2, if nobody watched the robot rest."""
    seconds = max(0.0, seconds)
    away, turned = min(PUSH_SPEED * seconds, MOST_AWAY), min(PUSH_TURN * seconds, MOST_TURNED)
    return away * away, turned * turned


class Path(Struct, frozen=True, gc=False):
    """The motion of base_link since its pose was set; a stretch is the difference of two."""

    way: Metres = 0.0  # forwards minus backwards
    turned: Rad = 0.0  # to the left, not wrapped
    gyro_variance: float = 0.0  # of `turned`, rad2
    lines: int = 0


class Bend(Struct):
    """Second order: the state at its last update, and the sums."""

    p: PoseCovariance
    columns: list[Vector]
    pose: Pose
    rolled: Metres = 0.0  # since then
    # xx, xy and yy of the errors [e, n] / 2, which are independent in each stretch.
    noise: Vector = (0.0, 0.0, 0.0)
    # x and y of the sums of [J_i, W_k] / 2, m, for all causes i and k.
    of_causes: list[tuple[float, float]] = field(
        default_factory=lambda: [(0.0, 0.0)] * (CAUSES * CAUSES)
    )
    added: Vector = (0.0, 0.0, 0.0)  # to xx, xy and yy of the pose


class Uncertainty(Struct):
    """The uncertainty of pose and twist. `covariance` and `twist` are what is published."""

    p: PoseCovariance
    covariance: PoseCovariance
    bend: Bend
    columns: list[Vector]  # of J
    pose: Pose  # at the last update
    path: Path = Path()  # then
    # Since then; a sum, because the difference of two long times may be just below `UPDATE_S`.
    seconds: Seconds = 0.0
    twist: TwistVariances = TwistVariances(
        MIN_TWIST_VARIANCE, MIN_TWIST_VARIANCE, MIN_TWIST_VARIANCE
    )
    period: Seconds = ASSUMED_PERIOD_S
    in_play: Rad = 0.0  # heading from the middle of the play, within `ErrorModel.play`
    astray: Metres = 0.0  # standard deviation to all sides
    # Motion that the pose may have missed in an open step, beside `columns`.
    open: tuple[tuple[Missed, Vector], ...] = ()

    @classmethod
    def initial(cls, model: ErrorModel, pose: Pose) -> Uncertainty:
        columns = [ORIGIN] * CAUSES
        return cls(model.start, model.start, Bend(model.start, columns, pose), columns, pose)

    def update(
        self, model: ErrorModel, pose: Pose, path: Path, *, slips: bool, by_gyro: bool
    ) -> None:
        """Add the errors of the stretch since the last update."""
        distance, turn = path.way - self.path.way, path.turned - self.path.turned
        dx, dy = pose.x - self.pose.x, pose.y - self.pose.y
        gyro_variance = path.gyro_variance - self.path.gyro_variance
        if self.seconds:
            self.period = max(MIN_PERIOD_S, self.seconds / (path.lines - self.path.lines))
        self.pose, self.path, self.seconds = pose, path, 0.0
        if not (distance or turn or dx or dy):
            return
        heading = pose.yaw - turn / 2
        c, s = math.cos(heading), math.sin(heading)
        along, turning, both = model.noise(distance, turn, self._beyond_play(model, turn))
        if slips:
            along, turning, both = SLIP_FACTOR * along, SLIP_FACTOR * turning, SLIP_FACTOR * both
        if by_gyro:
            turning, both = gyro_variance, 0.0
        p = carried(self.p, dx, dy, turning / 2)  # half of the noise of the turn comes before
        self.p = added(p, along, turning / 2, both, c, s)
        columns = []
        for column, effect in zip(self.columns, model.effects[by_gyro], strict=True):
            if effect == NO_EFFECT and column == ORIGIN:  # most of them, in most robots
                columns.append(column)
                continue
            x, y, turned = column
            of_distance, of_turn, turn_of_distance, turn_of_turn = effect
            further = of_distance * distance + of_turn * turn
            more = turn_of_distance * distance + turn_of_turn * turn
            lever = turned + more / 2
            columns.append((x + c * further - dy * lever, y + s * further + dx * lever,
                            turned + more))  # fmt: skip
        self.columns, bend = columns, self.bend
        bend.rolled += abs(distance) + model.track / 2 * abs(turn)
        if bend.rolled > BEND_M:
            self._bend()
        self.astray += abs(distance) * self._share_astray()
        self._publish()

    def _share_astray(self) -> float:
        # The root mean square of 1 - cos(e) for a normal error e of the heading; u is its mean.
        variance = self.covariance.yawyaw
        if variance <= MAX_HEADING_VARIANCE:
            variance = sum([yaw * yaw for _, _, yaw in self.columns[len(PARAMETERS) :]])
        if not variance:
            return 0.0
        u = -math.expm1(-variance / 2)
        return u * math.sqrt(3.0 - 2.0 * u + u * u / 2)

    def doubt(self, along: float, yaw: float, aside: float, heading: Rad) -> None:
        """Add variances of distance, m2, turn, rad2, and of the position sideways, m2."""
        c, s = math.cos(heading), math.sin(heading)
        self.p = added(added(self.p, along, yaw, 0.0, c, s), aside, 0.0, 0.0, -s, c)
        self._publish()

    def miss(self, cause: Missed, distance: Metres, turn: Rad, heading: Rad) -> None:
        """Add a motion that the pose may have missed, as standard deviations.

        Those of one cause add up, and those of opposite directions cancel.
        """
        i = MISSED[cause]
        x, y, yaw = self.columns[i]
        c, s = math.cos(heading), math.sin(heading)
        self.columns = [*self.columns]
        self.columns[i] = x + c * distance, y + s * distance, yaw + turn
        self.astray += abs(distance) * self._share_astray()
        self.bend.rolled += 2 * abs(distance)
        if self.bend.rolled > BEND_M:
            self._bend()
        self._publish()

    def set_open(self, missed: Iterable[tuple[Missed, Metres, Rad]], heading: Rad) -> None:
        """Set what the pose may have missed in a step that has not ended: cause, distance, turn."""
        c, s = math.cos(heading), math.sin(heading)
        vectors = [(cause, (c * distance, s * distance, turn)) for cause, distance, turn in missed]
        if vectors or self.open:
            self.open = tuple(vectors)
            self._publish()

    def set_twist(
        self, model: ErrorModel, twist: Twist, step: RadPerS, slips: bool, gyro: float | None
    ) -> None:
        """Set the variances of a moving robot's twist, with those of the gyro's rate, rad2/s2.

        `step` is the change of a speed by one count, if the counts are not declared; inf: unknown.

        A pose that is integrated from twists is as uncertain as that of the odometry. The errors of
        parameters and of the quantization of the speeds come on top.
        """
        linear, angular, period = twist.linear, twist.angular, self.period
        count = model.count / period if model.count else min(step, LARGEST_JUMP / period)
        quantum = max(SPEED_RESOLUTION, count) ** 2
        along, yaw, _ = model.noise(linear, angular, abs(angular))
        along, yaw = along / period, yaw / period
        for of_distance, of_turn, turn_of_distance, turn_of_turn in model.effects[0]:
            along += (of_distance * linear + of_turn * angular) ** 2
            yaw += (turn_of_distance * linear + turn_of_turn * angular) ** 2
        along, yaw = along + model.of_speed[0] * quantum, yaw + model.of_speed[1] * quantum
        self._set_twist(along, LATERAL_VARIANCE, yaw, slips, gyro)

    def set_rest(self, model: ErrorModel, rested: Seconds, slips: bool, gyro: float | None) -> None:
        """Set the variances at rest: of a motion that no encoder shows in `rested` s."""
        quantum = (model.count / rested) ** 2
        linear, angular = model.of_speed
        self._set_twist(linear * quantum, MIN_TWIST_VARIANCE, angular * quantum, slips, gyro)

    def _set_twist(
        self, linear: float, lateral: float, angular: float, slips: bool, gyro: float | None
    ) -> None:
        factor = SLIP_FACTOR if slips else 1.0
        least, most = MIN_TWIST_VARIANCE, MAX_VARIANCE
        self.twist = TwistVariances(
            min(max(factor * linear, least), most),
            min(factor * lateral, most),
            min(max(factor * angular if gyro is None else gyro, least), most),
        )

    def _beyond_play(self, model: ErrorModel, turn: Rad) -> Rad:
        # The sum of |turn| of a straight drive would count the play as turning, and make the
        # variance of yaw 2 to 4 times too large.
        off = self.in_play + turn
        self.in_play = max(-model.play, min(off, model.play))
        return abs(off - self.in_play)

    def _bend(self) -> None:
        # Composes the error e of the path before a stretch with its own w (Baker, Campbell,
        # Hausdorff): log(exp(e) exp(w)) = e + w + [e, w] / 2 + ... The bracket has no yaw. Both
        # have noise, and the effects J and W of the causes, which are the same in each stretch.
        # Compare equation 55 of Barfoot & Furgale, IEEE Transactions on Robotics 30 (2014).
        bend, p, columns = self.bend, self.p, self.columns
        dx, dy = self.pose.x - bend.pose.x, self.pose.y - bend.pose.y
        before = carried(bend.p, dx, dy, 0.0)
        j = [(x - dy * yaw, y + dx * yaw, yaw) for x, y, yaw in bend.columns]
        self.bend = new = Bend(p, columns, self.pose, 0.0, bend.noise, bend.of_causes, bend.added)
        total = _total(before, j)
        bending = [k for k, column in enumerate(columns) if column != ORIGIN]
        if self.covariance.yawyaw > MAX_HEADING_VARIANCE:
            return
        noise_xx, noise_xy, noise_yy = _bracketed(total, _difference(p, before))
        xx, xy, yy = bend.noise
        new.noise = xx, xy, yy = xx + noise_xx / 4, xy + noise_xy / 4, yy + noise_yy / 4
        sums = bend.of_causes
        mean_x = mean_y = 0.0
        for k in bending:
            (ax, ay, ayaw), (bx, by, byaw) = columns[k], j[k]
            wx, wy, wyaw = ax - bx, ay - by, ayaw - byaw
            for i in bending:
                x, y, yaw = j[i]
                sum_x, sum_y = sums[CAUSES * i + k]
                sum_x += (y * wyaw - yaw * wy) / 2
                sum_y += (yaw * wx - x * wyaw) / 2
                sums[CAUSES * i + k] = sum_x, sum_y
        # With A_ik, these sums, and independent unit normals p, E[(p' A p)^2] is the square of the
        # trace, plus the sums of A_ik^2 and of A_ik A_ki.
        for k in bending:
            for i in bending:
                x, y = sums[CAUSES * i + k]
                of_x, of_y = sums[CAUSES * k + i]
                xx, xy, yy = xx + x * (x + of_x), xy + x * (y + of_y), yy + y * (y + of_y)
                if i == k:
                    mean_x, mean_y = mean_x + x, mean_y + y
        new.added = xx + mean_x * mean_x, xy + mean_x * mean_y, yy + mean_y * mean_y

    def _publish(self) -> None:
        columns = [*self.columns] if self.open else self.columns
        for cause, (x, y, yaw) in self.open:
            i = MISSED[cause]
            of_x, of_y, of_yaw = columns[i]
            columns[i] = of_x + x, of_y + y, of_yaw + yaw
        p, (xx, xy, yy) = _total(self.p, columns), self.bend.added
        far = self.astray * self.astray
        p = PoseCovariance(p.xx + xx + far, p.xy + xy, p.xyaw, p.yy + yy + far, p.yyaw, p.yawyaw)
        known = p.xx < MAX_VARIANCE and p.yy < MAX_VARIANCE and p.yawyaw < MAX_VARIANCE
        self.covariance = p if known else UNKNOWN_POSE


def carried(p: PoseCovariance, dx: Metres, dy: Metres, turning: float) -> PoseCovariance:
    """Return `p`, with `turning` more variance of yaw, when the robot has moved by `dx`, `dy`."""
    xyaw, yyaw, yawyaw = p.xyaw, p.yyaw, p.yawyaw + turning
    return PoseCovariance(
        p.xx - 2 * dy * xyaw + dy * dy * yawyaw,
        p.xy + dx * xyaw - dy * yyaw - dx * dy * yawyaw,
        xyaw - dy * yawyaw,
        p.yy + 2 * dx * yyaw + dx * dx * yawyaw,
        yyaw + dx * yawyaw,
        yawyaw,
    )


def added(
    p: PoseCovariance, along: float, yaw: float, both: float, c: float, s: float
) -> PoseCovariance:
    """Return `p` plus noise of distance and turn, in the direction of cosine `c` and sine `s`."""
    cc, cs = along * c, along * s
    return PoseCovariance(
        p.xx + cc * c, p.xy + cc * s, p.xyaw + both * c,
        p.yy + cs * s, p.yyaw + both * s, p.yawyaw + yaw,
    )  # fmt: skip


def _difference(p: PoseCovariance, q: PoseCovariance) -> PoseCovariance:
    return PoseCovariance(
        p.xx - q.xx, p.xy - q.xy, p.xyaw - q.xyaw,
        p.yy - q.yy, p.yyaw - q.yyaw, p.yawyaw - q.yawyaw,
    )  # fmt: skip


def _total(p: PoseCovariance, columns: list[Vector]) -> PoseCovariance:
    xx, xy, xyaw, yy, yyaw, yawyaw = p.xx, p.xy, p.xyaw, p.yy, p.yyaw, p.yawyaw
    for x, y, yaw in columns:
        if x == 0.0 == yaw and y == 0.0:
            continue
        xx, xy, yy = xx + x * x, xy + x * y, yy + y * y
        xyaw, yyaw, yawyaw = xyaw + x * yaw, yyaw + y * yaw, yawyaw + yaw * yaw
    return PoseCovariance(xx, xy, xyaw, yy, yyaw, yawyaw)


def _bracketed(p: PoseCovariance, q: PoseCovariance) -> Vector:
    # The covariance xx, xy, yy of [a, b], of independent a and b with the covariances p and q.
    return (
        p.yy * q.yawyaw - 2 * p.yyaw * q.yyaw + p.yawyaw * q.yy,
        p.yyaw * q.xyaw - p.xy * q.yawyaw - p.yawyaw * q.xy + p.xyaw * q.yyaw,
        p.yawyaw * q.xx - 2 * p.xyaw * q.xyaw + p.xx * q.yawyaw,
    )
