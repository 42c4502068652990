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
from acsard.drive.bridging import NOWHERE, Rolled, Rolling, Step, count_of, plus
from acsard.drive.gap_variance import Gaps
from acsard.drive.gyro import Heading, Turn
from acsard.drive.kinematics import Kinematics
from acsard.drive.learned_track import Track
from acsard.drive.lying_wheels.verdict import Witness
from acsard.drive.noise import columns, in_use
from acsard.drive.path import Path
from acsard.drive.twist_uncertainty import TwistUncertainty
from acsard.drive.uncertainty import COARSE_COUNTS, PoseUncertainty
from acsard.mcu.codec import Motors
from acsard.mcu.feedback import Feedback
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

REST_S = 0.2
"""s of four wheels that report 0.00, after which the robot is at rest."""

TAKEN_BACK = 128
"""Lines at most that are taken back of a lie that was believed."""


class Odometry:
    """Integrates feedback; its state is pose, covariance and the wheel angles."""

    def __init__(
        self,
        odometry: OdometryConfig,
        kinematics: Kinematics,
        encoder_counts: int = 0,
        response_time: float = FeedbackConfig().response_time,
        quiet: float = math.inf,
    ) -> None:
        """`encoder_counts` per wheel turn, 0 if unknown; `response_time` s of a slow wheel;
        `quiet` s of silence, after which the wheels are told to stand."""
        self._kinematics, self._declared = kinematics, odometry
        self._track, self._share = in_use(odometry), 1.0
        """The track in use where one is learned; and what it is of the configured one."""
        self._positions = NOWHERE
        self._rolling = Rolling(quiet)
        self._held = NOWHERE
        """rad of counts at rest, whose way is not clear yet."""
        self._steps_seen = NOWHERE
        """Those of the lines of which the counts are known;"""
        self._steps_of, self._coarsest = NOWHERE, 0.0
        """of the last line, and the largest of them that is known, rad/s."""
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

    def use(self, odometry: OdometryConfig) -> None:
        """With these variances from now on."""
        self._uncertainty.use(odometry)
        self._twist_uncertainty.use(odometry)

    def turn_by(self, track: Track) -> None:
        """With this effective track from now on, where the wheels tell the turn."""
        if track != self._track:
            self._track, self._share = track, track.share
            parameters = columns(self._declared, self._kinematics, track)
            apart = self._kinematics.track * track.share
            self._uncertainty.bent_by(parameters, apart)
            self._twist_uncertainty.bent_by(parameters, apart)

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

    def skip(self, feedback: Feedback) -> None:
        """Pass over a line that cannot be true: what it should have told is left to the next one.

        Counts are cumulative: what they made of it then stays true. Else only its time is known.
        """
        self._rolling.skip(feedback)

    def fold(
        self, feedback: Feedback, gyro: Heading | None = None, told: WheelSpeeds | None = None
    ) -> Estimate:
        """Advance by one feedback line: by its counts, else by its speeds times dt.

        After a gap without counts only the uncertainty advances. At rest nothing does: a count to
        and fro is left to the line that tells where it went. Where `gyro` tells the turn since the
        line before, the wheels tell the distance only. `told` is what the wheels are to do, by
        which one that lies is found: then its side's other wheel stands in, and what it made of the
        lines until then is taken back.
        """
        speeds, dt, before = feedback.speeds, feedback.dt, self.twist
        said, witness = speeds.as_tuple(), self._witness
        rolled = self._rolling.take(feedback, self.speeds)
        steps = feedback.steps
        if steps is not self._steps_of or (feedback.counted and steps is not self._steps_seen):
            self._see(feedback)
        turn, by_wheels = None, 0.0
        if gyro is not None:
            by_wheels = self._wheels_turn(rolled)
            still = witness.believed(said) == NOWHERE
            turn = gyro.turn(feedback.at.mono_ns, rolled.known, by_wheels, still)
        by_gyro = None if turn is None else turn.wheels
        if witness.hear(rolled.seen, speeds, rolled.seconds, told, by_gyro):
            self._take_back(gyro)
        slips = witness.slips or (turn is not None and turn.slips)
        believed = witness.believed(said)
        linear, angular = self._kinematics.moved(believed)
        twist = Twist(linear, angular / self._share)
        self._still = self._still + dt if believed == NOWHERE else 0.0
        at_rest = self._still > REST_S
        if rolled.unknown > 0.0:
            self._stand(rolled.unknown, before, twist)
        pieces = self._settled(rolled, at_rest)
        on_trial = gyro is not None and gyro.owes
        turned = self._move(pieces, turn, speeds, on_trial, slips)
        if gyro is not None and on_trial and turned != by_wheels:
            gyro.taken_back(turned - by_wheels)
        self._go_on(rolled.bridged, feedback, before, twist)
        variances = self._twist_variances(twist, feedback, at_rest, turn, slips)
        if turn is not None and dt > 0.0:
            twist = Twist(linear, turn.rate)
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

    def _see(self, line: Feedback) -> None:
        """How coarse its speeds are is the twist's covariance; the counts that it shows are the
        pose's: all four, once every wheel turns."""
        if line.steps is not self._steps_of:
            self._steps_of = line.steps
            self._coarsest = max([step for step in line.steps if step < math.inf], default=0.0)
        if line.counted is None or line.steps is self._steps_seen:
            return
        if all(line.speeds.as_tuple()):
            self._steps_seen = line.steps
        self._uncertainty.show_count(count_of(line))

    def _wheels_turn(self, rolled: Rolled) -> float:
        """rad by which the wheels say the robot turned since the last line that was believed."""
        turned = rolled.turned
        for piece in rolled.pieces:
            turned = plus(turned, piece)
        return self._kinematics.moved(self._witness.believed(turned))[1]

    def _settled(self, rolled: Rolled, at_rest: bool) -> tuple[Motors, ...]:
        """The wheel angles to advance by; at rest counts are held until it is clear where to."""
        turned = rolled.turned
        if self._held != NOWHERE:
            turned = plus(self._held, turned)
        if turned == NOWHERE:
            self._held = NOWHERE  # it has come back
            return rolled.pieces
        if at_rest and max(map(abs, turned)) <= self._unsettled:
            self._held = turned
            return rolled.pieces
        self._held = NOWHERE
        return (turned, *rolled.pieces)

    def _take_back(self, gyro: Heading | None) -> None:
        """Take back what a wheel, found to lie, made of the last lines that it lied in.

        The steps since are gone through anew without it, so that the pose leaps by what was wrong;
        but what a gyro has put right of it, or will, is right.
        """
        lies = list(takewhile(lambda step: self._witness.lied(step.speeds), reversed(self._steps)))
        if not lies:
            return
        self._path.set(lies[-1].pose)
        on_trial = 0.0
        for step in reversed(lies):
            arcs = self._arcs(step.pieces, step.gyro, step.share)
            for distance, angle in arcs:
                self._path.advance(distance, angle)
            if step.on_trial:
                on_trial += math.fsum([angle for _, angle in arcs]) - step.turn
        self._steps.clear()
        if gyro is not None and on_trial:
            self._path.turn(-gyro.taken_back(on_trial))

    def _arcs(
        self, pieces: tuple[Motors, ...], gyro: Turn | None, share: float
    ) -> list[tuple[float, float]]:
        """m and rad for each of so many wheel angles: (4) to (7) are linear.

        A gyro tells one turn for all of them, else a track of this share of the configured one.
        """
        believed, kinematics = self._witness.believed, self._kinematics
        moved = [kinematics.moved(believed(one)) for one in pieces]
        if gyro is not None:
            return [(math.fsum([distance for distance, _ in moved]), gyro.angle)]
        return [(distance, angle / share) for distance, angle in moved]

    def _move(
        self,
        pieces: tuple[Motors, ...],
        turn: Turn | None,
        speeds: WheelSpeeds,
        on_trial: bool,
        slips: bool,
    ) -> float:
        """Advance by wheel angles in rad, an arc for each piece; by how many rad it turned."""
        path, turned = self._path, 0.0
        pose, variance = path.pose, None if turn is None else turn.variance
        for piece in pieces:
            self._positions = plus(self._positions, piece)
        for distance, angle in self._arcs(pieces, turn, self._share):
            turned += angle
            self.travelled += abs(distance)
            dx, dy, heading = path.advance(distance, angle)
            self._uncertainty.advance(distance, angle, dx, dy, heading, variance, slips)
        self._steps.append(Step(pose, pieces, turn, speeds, turned, on_trial, self._share))
        return turned

    def _go_on(self, bridged: float, feedback: Feedback, before: Twist, twist: Twist) -> None:
        """Doubt a way that was bridged; else measure how twists change from line to line."""
        if bridged > 0.0:
            self.bridged += bridged
            self._uncertainty.doubt(*self._gaps.bridge(bridged, before, twist))
        elif feedback.gap:
            self._gaps.interrupt(twist)
        else:
            self._gaps.follow(twist, feedback.dt)

    def _twist_variances(
        self, twist: Twist, feedback: Feedback, at_rest: bool, gyro: Turn | None, slips: bool
    ) -> TwistVariances:
        spread, step = self._twist_uncertainty, self._coarsest
        if at_rest:
            variances = spread.at_rest(self._still, step)
        else:
            variances = spread.of(twist, feedback.dt - feedback.bridged, step)
        if slips:
            variances = spread.slipping(variances)
        if gyro is not None and feedback.dt > 0.0:
            variances = spread.with_gyro(variances, gyro.rate_variance)
        return variances

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
