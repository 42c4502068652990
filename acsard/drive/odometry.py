"""Wheel speeds over time -> pose, twist and covariance of base_link in odom.

One step of dt, with left and right the mean wheel speeds of a side (kinematics, equation 1):

    (4)  d_left = r_l left dt            (5)  d_right = r_r right dt
    (6)  d = (d_right + d_left) / 2      (7)  dyaw = (d_right - d_left) / L
    (8)  x += d cos(yaw)                 (9)  y += d sin(yaw)
    (10) yaw += dyaw, wrapped            (11) v = d / dt, w = dyaw / dt

Equations (8) and (9) step along a straight line; `path.py` integrates the exact arc instead. They
agree as dyaw -> 0. How far that may be off is `uncertainty.py`'s, for the pose, and
`twist_uncertainty.py`'s.
"""

from __future__ import annotations

import math
from collections import deque
from itertools import takewhile

from acsard.config.settings import FeedbackConfig, OdometryConfig
from acsard.drive.gaps import Gaps
from acsard.drive.gyro import Turn
from acsard.drive.kinematics import Kinematics
from acsard.drive.path import Path
from acsard.drive.twist_uncertainty import TwistUncertainty
from acsard.drive.uncertainty import COARSE_COUNTS, PoseUncertainty
from acsard.drive.witness import Witness
from acsard.mcu.feedback import Feedback
from acsard.mcu.frames import Motors
from acsard.mcu.lattice import on
from acsard.values import (
    REST,
    STILL,
    Estimate,
    Event,
    Pose,
    Twist,
    TwistVariances,
    WheelSpeeds,
    WheelsStatus,
)

MAX_LOST_S = 0.05
"""s of lines that could not be true, up to which the robot is held to have gone on as it did."""

REST_S = 0.2
"""s of four wheels that report 0.00, after which the robot is at rest."""

TAKEN_BACK = 128
"""Lines at most that are taken back of a lie that was believed."""

NOWHERE = (0.0, 0.0, 0.0, 0.0)

Step = tuple[Pose, tuple[Motors, ...], Turn | None, WheelSpeeds]
"""Where it was, how its wheels turned from there, by a gyro too, and the speeds they said."""


class Odometry:
    """Integrates feedback; its state is pose, covariance and the wheel angles."""

    def __init__(
        self,
        odometry: OdometryConfig,
        kinematics: Kinematics,
        encoder_counts: int = 0,
        response_time: float = FeedbackConfig().response_time,
    ) -> None:
        """`encoder_counts` per wheel turn, 0 if unknown; `response_time` s of a slow wheel."""
        self._kinematics = kinematics
        self._positions = NOWHERE
        self._lost_dt, self._lost_turned = 0.0, NOWHERE
        self._path = Path()
        self._uncertainty = PoseUncertainty(odometry, kinematics, encoder_counts)
        self._twist_uncertainty = TwistUncertainty(odometry, kinematics, encoder_counts)
        self._gaps = Gaps()
        self._witness = Witness(kinematics, encoder_counts, response_time)
        self._steps: deque[Step] = deque(maxlen=TAKEN_BACK)
        """Of the last lines."""
        self._unsettled = 2 * math.tau / (encoder_counts or COARSE_COUNTS)
        """rad that no wheel turns between the edges of one count."""
        self._still = 0.0
        """s without a wheel speed."""
        self.twist = REST
        """Twist of the last feedback."""
        self.speeds = STILL
        """Wheel speeds of the last feedback."""
        self.gaps, self.unseen, self.bridged = 0, 0.0, 0.0
        """Gaps in which it drove and the pose stood, s of them, and s that were bridged."""
        self.travelled = 0.0
        """m since the start, forwards and backwards."""

    def set_pose(self, pose: Pose) -> None:
        """Put base_link at `pose` in odom, as certain as at the start; wheel angles go on."""
        self._path.set(pose)
        self._steps.clear()
        self._uncertainty.set(pose.yaw)

    @property
    def pose(self) -> Pose:
        """Pose of base_link in odom now."""
        return self._path.pose

    def missed(self) -> dict[str, int]:
        """What no line told, as counters: those that are 0 are left out."""
        ms = {"gap_ms": round(1e3 * self.unseen), "bridged_ms": round(1e3 * self.bridged)}
        return {name: count for name, count in ({"gaps": self.gaps} | ms).items() if count}

    @property
    def doubt(self) -> WheelsStatus:
        """Which wheels the pose goes without, and which slip."""
        return self._witness.status

    @property
    def events(self) -> list[Event]:
        """What the last line had to tell of wheels that are doubted."""
        return self._witness.events

    def believed(self, wheels: WheelSpeeds) -> WheelSpeeds:
        """What four wheels say, rad or rad/s, with others in place of those that are left out."""
        return self._witness.believed(wheels)

    def skip(self, feedback: Feedback) -> None:
        """Pass over a line that cannot be true: what it should have told is left to the next one.

        Counts are cumulative: what they made of it then stays true. Else only its time is known.
        """
        if feedback.turned is None:
            self._lost_dt += feedback.dt
        else:
            self._lost_turned = _sum(self._lost_turned, feedback.turned)

    def fold(
        self, feedback: Feedback, gyro: Turn | None = None, told: WheelSpeeds | None = None
    ) -> Estimate:
        """Advance by one feedback line: by its counts, else by its speeds times dt.

        After a gap without counts only the uncertainty advances. At rest nothing does: a count to
        and fro is left to the line that tells where it went. Where a gyro tells the turn since the
        line before, the wheels tell the distance only. `told` is what the wheels are to do, by
        which one that lies is found: then its side's other wheel stands in, and what it made of the
        lines until then is taken back.
        """
        speeds, dt, before = feedback.speeds, feedback.dt, self.twist
        lost_dt, self._lost_dt = self._lost_dt, 0.0
        # Of lost lines without counts: it went on at about this speed, or too long to guess.
        moved_dt, unknown = (lost_dt, 0.0) if lost_dt <= MAX_LOST_S else (0.0, lost_dt)
        turned, bridged, passed = self._lost_turned, 0.0, moved_dt + dt
        between = counted = NOWHERE
        if feedback.turned is None:
            unknown, bridged = unknown + feedback.gap, feedback.bridged
            if bridged:
                between = _between(self.speeds, speeds, bridged)
            if feedback.counted is None:
                moved_dt += dt - bridged
            else:
                counted = feedback.counted
                self._uncertainty.show_count(_count(feedback))
        else:
            turned = _sum(turned, feedback.turned)
        said = _times(speeds.as_tuple(), moved_dt)
        # Counts may hold what rounding cost one wheel until they were known: nothing it did now.
        now = feedback.turned or _sum(between, _times(speeds.as_tuple(), passed - bridged))
        self._watch(now, speeds, dt if feedback.turned else passed, told, gyro)
        believed = self._witness.believed(speeds)
        twist = self._kinematics.twist(believed)
        self._still = self._still + dt if believed == STILL else 0.0
        at_rest = self._still > REST_S
        if unknown > 0.0:
            self._stand(unknown, before, twist)
        rolled = NOWHERE
        if not at_rest or max(map(abs, turned)) > self._unsettled:
            rolled, turned = turned, NOWHERE
        self._lost_turned = turned
        self._move((rolled, between, counted, said), gyro, speeds)
        if bridged > 0.0:
            self.bridged += bridged
            self._uncertainty.doubt(*self._gaps.bridge(bridged, before, twist))
        elif feedback.gap:
            self._gaps.interrupt(twist)
        else:
            self._gaps.follow(twist, dt)
        variances = self._twist_variances(twist, feedback, at_rest, gyro)
        if gyro is not None and dt > 0.0:
            twist = Twist(twist.linear, gyro.rate)
        self.twist, self.speeds = twist, speeds
        return Estimate(
            feedback.at,
            self._path.pose,
            twist,
            self._uncertainty.covariance,
            variances,
            self._positions,
            speeds,
            feedback.asked_ns,
            feedback.heard_ns,
        )

    def _watch(
        self, turned: Motors, speeds: WheelSpeeds, dt: float, told: WheelSpeeds | None,
        gyro: Turn | None,
    ) -> None:  # fmt: skip
        """Let front and rear judge a line; take back what a wheel made of the last ones that lied.

        The steps since are gone through anew without it, so that the pose leaps by what was wrong.
        """
        turn = None if gyro is None else gyro.wheels
        if not self._witness.hear(turned, speeds, dt, told, turn):
            return
        lies = list(takewhile(lambda step: self._witness.lied(step[3]), reversed(self._steps)))
        if not lies:
            return
        self._path.set(lies[-1][0])
        for step in reversed(lies):
            for distance, angle in self._arcs(step[1], step[2]):
                self._path.advance(distance, angle)
        self._steps.clear()

    def _arcs(self, pieces: tuple[Motors, ...], gyro: Turn | None) -> list[tuple[float, float]]:
        """m and rad for each of so many wheel angles: (4) to (7) are linear.

        A gyro tells one turn for all of them.
        """
        rolled = [self._witness.believed(WheelSpeeds(*one)) for one in pieces if one != NOWHERE]
        moved = [self._kinematics.twist(one) for one in rolled]
        if gyro is not None:
            return [(sum(one.linear for one in moved), gyro.angle)]
        return [(one.linear, one.angular) for one in moved]

    def _move(self, pieces: tuple[Motors, ...], gyro: Turn | None, speeds: WheelSpeeds) -> None:
        """Advance by wheel angles in rad, an arc for each piece, of a line with these speeds."""
        self._steps.append((self._path.pose, pieces, gyro, speeds))
        for piece in pieces:
            if piece != NOWHERE:
                self._positions = _sum(self._positions, piece)
        for distance, turn in self._arcs(pieces, gyro):
            self._advance(distance, turn, gyro)

    def _slips(self, gyro: Turn | None) -> bool:
        """Front and rear of a side contradict each other, or the gyro all of them."""
        return self._witness.slips or (gyro is not None and gyro.slips)

    def _twist_variances(
        self, twist: Twist, feedback: Feedback, at_rest: bool, gyro: Turn | None
    ) -> TwistVariances:
        spread, step = self._twist_uncertainty, 0.0
        if feedback.counted is not None:
            step = max([one for one in feedback.steps if one < math.inf], default=0.0)
        variances = spread.at_rest(self._still) if at_rest else spread.of(twist, feedback.dt, step)
        if self._slips(gyro):
            variances = spread.slipping(variances)
        if gyro is not None and feedback.dt > 0.0:
            variances = spread.with_gyro(variances, gyro.rate_variance)
        return variances

    def _advance(self, distance: float, turn: float, gyro: Turn | None) -> None:
        self.travelled += abs(distance)
        dx, dy, heading = self._path.advance(distance, turn)
        variance = None if gyro is None else gyro.variance
        self._uncertainty.advance(distance, turn, dx, dy, heading, variance, self._slips(gyro))

    def _stand(self, seconds: float, before: Twist, after: Twist) -> None:
        """What the robot did in so many seconds between two twists is unknown: it has not moved."""
        if before != REST or after != REST:
            self.gaps += 1
            self.unseen += seconds
        self._uncertainty.stand(
            seconds * (before.linear + after.linear) / 2,
            seconds * (before.angular + after.angular) / 2,
            *self._gaps.unseen(seconds, before, after),
        )


def _count(line: Feedback) -> float:
    """rad of the coarsest encoder's count, of a line that shows whole ones; 0 if none does."""
    rows = zip(line.counted or NOWHERE, line.speeds.as_tuple(), line.steps, strict=True)
    return max([
        step * turned / speed for turned, speed, step in rows
        if speed and 0.0 < step < math.inf and on(speed, step)
    ], default=0.0)  # fmt: skip


def _sum(a: Motors, b: Motors) -> Motors:
    return a[0] + b[0], a[1] + b[1], a[2] + b[2], a[3] + b[3]


def _times(a: Motors, dt: float) -> Motors:
    return a[0] * dt, a[1] * dt, a[2] * dt, a[3] * dt


def _between(before: WheelSpeeds, after: WheelSpeeds, dt: float) -> Motors:
    """Wheel angles over a time that no line reported: linear from one report to the next."""
    return _times(_sum(before.as_tuple(), after.as_tuple()), dt / 2)
