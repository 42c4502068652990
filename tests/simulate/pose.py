"""The promise of odometry: the pose stays within its covariance and never jumps."""

from __future__ import annotations

import math
from collections import deque
from collections.abc import Sequence
from typing import Any

from tests.simulate.gyro_faults import GYRO_BIAS, GyroFaults
from tests.simulate.promises import BrokenError
from tests.simulate.roads import NS
from tests.simulate.spread import RATIO, TRACKS
from tests.simulate.wiring import wheels

LIARS = {
    "bias", "stuck_encoder", "frozen_encoder", "reversed_encoder", "reversed_motor", "dead_motor",
    "swapped_motors", "swapped_encoders", "bit_errors", "noise", "partial_line", "echo", "mute",
    "free_running", "plain_only", "endless", "wrong_baud", "half_duplex",
}  # fmt: skip
"""Board faults with which the encoders lie, or say nothing while the robot may move."""

MOTORS = {"reversed_motor", "dead_motor", "swapped_motors"}
"""Faults behind which a wheel still turns against its command until its motor has followed."""

QUEUED_NS = 2 * NS
"""Time after a wrong baud rate for which lines may come late: they waited while the board sent
slowly."""

GAP_NS = 3 * NS // 10
"""A gap of the estimates of this length and more is judged by itself."""

MOVES = 0.1
"""Speed, m/s, from which on a robot certainly moves before a gap."""

DRIVES, MISCOUNTS_NS = 0.05, 3 * NS // 2
"""Speed, m/s, from which on a robot certainly drives, and the time of driving after which a wrong
number of counts is known."""

STANDS = 0.001
"""Distance, m, and turn, rad, up to which the true pose has stayed the same."""

VAGUE = 0.05
"""Variance, m2 or rad2, from which on a gap may be lost in it. After a gap that is too long to be
filled, the pose stays where it was, but the covariance turns with a heading that is nearly
unknown."""

FRESH_NS = NS // 50
"""Age of a sample up to which the present pose stands for that at the sample. Behind a gap nothing
is known in between."""

SIGMAS = 6.0
COARSE_COUNTS = 6
"""Counts by which encoders of 96 counts may be off if the configuration does not tell the counts:
a line then shows a speed over an inexact time."""

ROOM_M, ROOM_RAD = 0.02, 0.03
"""Allowed beside the covariance: a sample's time is known to a few ms."""

HANG_NS = 8 * NS // 10
"""Time after which the wheels certainly give the turn of a gyro that hangs, also that since the
hang began. The product needs half a second of exact repetition."""

HANG_GAP_NS = 3 * NS // 20
"""If estimates are missing for this time, nothing is known about the turn in it."""

SETTLES_NS = NS // 2
"""Time after a hang from which on the pose is judged again."""

Pose = tuple[float, float, float]


class Hang:
    """A time in which the gyro repeats one rate, with the true headings in it."""

    def __init__(self, at_ns: int, rate: float) -> None:
        self.rate = rate
        """What it reports instead of the true turn rate, rad/s, without its bias."""
        self.sure = True
        """Since it began, nothing else has disturbed the odometry."""
        self.turned = False
        """The true and the estimated heading at its begin, `begun`, are known."""
        self.begun = 0.0, 0.0
        """The true and the estimated heading when the hang began, rad."""
        self.begun_ns = self.seen_ns = at_ns


class PoseWitness:
    """Compares the estimated poses with the true ones.

    The comparison starts at an anchor, a sample at which both poses count as equal. The covariance
    is that of the pose since the daemon's start, so that of the anchor counts, too: a way back
    makes the pose more certain, and less certain what it was at the anchor.
    """

    def __init__(self, config: dict[str, Any]) -> None:
        drive = config.get("drive", {})
        fastest = config.get("feedback", {}).get("wheel_speed", 80.0)
        self.fastest: float = fastest * drive.get("wheel_radius", 0.05)
        multiplier = drive.get("wheel_separation_multiplier", 1.0)
        self.track: float = drive.get("wheel_separation", 0.3) * multiplier
        self._follows_ns = int(
            (4.0 * config.get("sim", {}).get("motor_time_constant", 0.1) + 0.1) * NS
        )
        """Time that a motor needs to follow its command again."""
        counts = config.get("sim", {}).get("encoder_counts")
        mcu_counts = config.get("mcu", {}).get("encoder_counts")
        self._miscounted = bool(mcu_counts) and mcu_counts != (counts or 3200)
        turn = COARSE_COUNTS * math.tau / 96 if counts == 96 and not mcu_counts else 0.0
        self._unsure_m: float = turn * drive.get("wheel_radius", 0.05)
        """Distance that such encoders may be off, m."""
        rate = config.get("control", {}).get("rate", 100.0)
        # No second wheel of its side halves or contradicts a damaged speed of two wheels.
        independent = len(wheels(config))
        of_side = independent // 2
        self._track_share: float = TRACKS[independent] / multiplier + RATIO / 2
        """Deviation of a turn, as a share of it, of a robot that nobody has calibrated."""
        self._per_flip_m = self.fastest / of_side / (100.0 if rate == "auto" else rate)
        """Distance by which one damaged speed of one line may move the pose, m."""
        self._known_ns = 0
        """From when on the lines show the motion again."""
        checked = config.get("mcu", {}).get("link_check") == "on"
        self._miscounts = checked and mcu_counts is not None and mcu_counts != (counts or 3200)
        """The configuration has a wrong number of counts, which the lines contradict."""
        self._driven_ns = self._seen_ns = 0
        """Time for which this daemon has seen the robot drive, and the last estimate."""
        rate = config.get("control", {}).get("rate")
        self._seldom = rate == 10.0
        """Whether lines come so seldom that two of them say little of a longer gap between."""
        rates = config.get("odometry", {})
        sure = rates.get("yaw_variance_per_metre", 1.0) < 1e-4
        sure |= rates.get("yaw_variance_per_radian", 1.0) < 1e-2
        # Nobody knows the heading as well as these rates say at ten lines a second.
        self._drifts = sure and self._seldom
        self._true: deque[tuple[int, Pose]] = deque(maxlen=400)
        self._anchor: tuple[Pose, Pose] | None = None
        self._anchor_m = self._anchor_rad = 0.0
        """Deviations of the position and of the heading at the anchor."""
        self._gyro = bool(rates.get("gyro"))
        self._hang: Hang | None = None
        """The present hang of the gyro."""
        self._settles_ns = 0
        """The pose is judged again from this time on."""
        self._spoiled = self._spoiled_before = 0.0
        """Turn that wrong samples of the gyro may have added up to now, and up to the anchor,
        rad."""
        self._placed = False
        self._asked: Pose | None = None
        """The pose that a call of this step has set, if its time is known."""
        self._expected: tuple[Pose, Pose] | None = None
        """The true pose at the last sample before a call, and the pose that the call has set."""
        self._asked_ns = 0
        """The time of that sample."""
        self._room = self._speed = 0.0
        self._last: tuple[int, Pose] | None = None
        self.latest: Pose | None = None
        """The pose of the last estimate, None if it was set since."""
        self._before: tuple[int, Pose, Pose, float, tuple[float, ...]] | None = None
        """Time, pose, true pose, true speed and covariance at the last estimate before a
        silence."""

    def doubt(self, mute: bool = False) -> None:
        """Restart the comparison at the next estimate, because the encoders missed some motion.

        The pose must not jump even then. If the board was only `mute`, there is a gap in the
        feedback, which `_gap` judges.
        """
        self._anchor = self._expected = None
        if self._hang is not None:
            self._hang.sure = False
        if not mute:
            self._before = None

    def flip(self) -> None:
        """Note a damaged line on a plain link, which may report a wrong but plausible speed."""
        self._unsure_m += self._per_flip_m

    def gyro(self, now_ns: int, faults: GyroFaults) -> None:
        """Note whether the gyro hangs and at which rate, and the effect of its wrong samples."""
        self._spoiled = faults.spoiled
        if faults.hung is not None and self._hang is None:
            self.doubt()
            self._hang = Hang(now_ns, faults.hung - GYRO_BIAS)
        elif faults.hung is None and self._hang is not None:
            self._settles_ns = now_ns + SETTLES_NS
            self._hang = None
            self.doubt()

    def mended(self, fault: str, at_ns: int) -> None:
        """Note that a fault of the board ended."""
        if fault in MOTORS:
            self.unknown_until(at_ns + self._follows_ns)
        if fault == "wrong_baud":
            self.unknown_until(at_ns + QUEUED_NS)

    def unknown_until(self, at_ns: int) -> None:
        """Note that the lines do not show the true motion until this time."""
        self._known_ns = max(self._known_ns, at_ns)

    def new_life(self) -> None:
        """Note that a daemon starts."""
        self._driven_ns = 0
        self.begin()

    def begin(self) -> None:
        """Forget all earlier estimates, because a daemon starts or the pose is set."""
        self.doubt()
        self._last = None

    def placed(self, asked: Pose | None = None) -> None:
        """Note that a call sets the pose. The estimates of this step still have the old pose.

        `asked` is the new pose, or None if the call may take effect in another step.
        """
        self._placed, self._asked = True, asked

    def see(
        self,
        now_ns: int,
        estimates: Sequence[Any],
        truth: tuple[int, float, float, float, float],
        offset_ns: int,
        faults: set[str],
    ) -> None:
        """Judge the estimates of one step."""
        at_ns, x, y, yaw, _ = truth
        self._true.append((at_ns + offset_ns, (x, y, yaw)))
        self._speed = self._present_speed()
        if self._speed > DRIVES:
            self._driven_ns += now_ns - self._seen_ns
        self._seen_ns = now_ns
        lies = not LIARS.isdisjoint(faults) or now_ns < self._known_ns
        counted = not self._miscounts or self._driven_ns >= MISCOUNTS_NS
        silent_only = faults & LIARS == {"mute"} if lies else counted
        if lies:
            self.doubt(silent_only)
        if self._spoils_pose(now_ns):
            self._before = None
        before = self._before
        if before is not None and silent_only:
            self._gap(now_ns, before, estimates[0], offset_ns, at_ns, (x, y, yaw))
        for sampled_ns, ex, ey, eyaw, covariance, _ in estimates:
            # A sum is finite only if each of its numbers is.
            if not math.isfinite(ex + ey + eyaw + sum(covariance)):
                raise BrokenError("the pose is finite", now_ns, f"{ex} {ey} {eyaw} {covariance}")
            at_pose = (ex, ey, eyaw)
            self._judge_pose(now_ns, sampled_ns + offset_ns, at_pose, covariance, lies, counted)
        sampled_ns, ex, ey, eyaw, covariance, _ = estimates[-1]
        self.latest = ex, ey, eyaw
        if silent_only:
            last_ns = sampled_ns + offset_ns
            # After a stall, the sample may be much older than this step.
            true = self._true_at(last_ns)
            self._before = true and (last_ns, self.latest, true, self._speed, covariance)

    def end_step(self) -> bool:
        """Forget the pose if it was set in this step, and return whether it was."""
        placed = self._placed
        if placed:
            last, asked = self._last, self._asked
            self._placed, self._asked, self.latest = False, None, None
            self.begin()
            true = None if last is None else self._true_at(last[0])
            if last is not None and true is not None and asked is not None:
                self._expected, self._asked_ns = (true, asked), last[0]
        return placed

    def _judge_pose(
        self, now_ns: int, at_ns: int, pose: Pose, covariance: tuple[float, ...], lies: bool,
        counted: bool,
    ) -> None:  # fmt: skip
        last, self._last = self._last, (at_ns, pose)
        # Wrong counts look like a fast robot until they are compared with the speeds.
        if last is not None and not lies and not self._miscounted:
            way = math.hypot(pose[0] - last[1][0], pose[1] - last[1][1])
            seconds = max(0.0, (at_ns - last[0]) / NS)
            if way > self.fastest * 1.1 * seconds + 0.05:
                raise BrokenError(
                    "the pose never jumps", now_ns, f"{last[1]} to {pose} in {seconds:.3f} s"
                )
        if lies or self._drifts:
            return
        if self._spoils_pose(now_ns):
            self._anchor = self._expected = None
            if self._hang is not None and self._hang.sure:
                self._hung(now_ns, at_ns, pose, covariance, self._hang)
            return
        # A robot that stood before a gap may have been pushed in it.
        stood = self._before is not None and self._before[3] < MOVES
        if last is not None and at_ns - last[0] >= GAP_NS and (self._seldom or stood):
            self.doubt(mute=True)
        true = self._true_at(at_ns)
        if true is None:
            return
        by_time = 0.1 * self._speed
        if self._expected is not None:
            if at_ns - self._asked_ns < NS // 5:  # behind a silence nobody knows the way since
                self._put(now_ns, self._expected, true, pose, by_time)
            self._expected = None
        xx, _, _, yy, _, yawyaw = covariance
        sigma, sigma_yaw = math.sqrt(xx + yy), math.sqrt(yawyaw)
        if self._anchor is None:
            self._anchor, self._anchor_m, self._anchor_rad = (true, pose), sigma, sigma_yaw
            self._room, self._spoiled_before = by_time, self._spoiled
            return
        if not counted:
            return
        expected = _through(self._anchor, true)
        dx, dy = pose[0] - expected[0], pose[1] - expected[1]
        dyaw = math.remainder(pose[2] - expected[2], math.tau)
        far = math.hypot(true[0] - self._anchor[0][0], true[1] - self._anchor[0][1])
        by_time += self._unsure_m
        room = ROOM_M + self._room + by_time
        room_yaw = ROOM_RAD + self._room / self.track + by_time / self.track
        room_yaw += self._spoiled - self._spoiled_before
        room_yaw += SIGMAS * self._anchor_rad
        allowed = SIGMAS * (sigma + self._anchor_m) + room + far * room_yaw
        off = math.hypot(dx, dy)
        if off > allowed:
            raise BrokenError(
                "the pose stays within its covariance", now_ns,
                f"{off:.3f} m off, allowed {allowed:.3f} m",
            )  # fmt: skip
        if abs(dyaw) > SIGMAS * sigma_yaw + room_yaw:
            raise BrokenError(
                "the pose stays within its covariance", now_ns,
                f"{dyaw:.3f} rad off, allowed {SIGMAS * sigma_yaw + room_yaw:.4f}",
            )  # fmt: skip

    def _spoils_pose(self, now_ns: int) -> bool:
        """Return whether the gyro hangs, or has hung too recently to judge the pose."""
        return self._hang is not None or now_ns < self._settles_ns

    def _hung(
        self, now_ns: int, at_ns: int, pose: Pose, covariance: tuple[float, ...], hang: Hang
    ) -> None:
        """Judge the heading while the gyro hangs.

        The position is not judged. It stays wrong even after the product has corrected the heading.
        """
        true, yaw = self._true_at(at_ns), pose[2]
        passed_ns, hang.seen_ns = at_ns - hang.seen_ns, at_ns
        if true is None or passed_ns > HANG_GAP_NS:
            hang.sure = False
            return
        if not hang.turned:
            hang.turned, hang.begun = True, (true[2], yaw)
        if at_ns - hang.begun_ns < HANG_NS:
            return
        off = math.remainder(yaw - hang.begun[1] - (true[2] - hang.begun[0]), math.tau)
        sigma, room = math.sqrt(covariance[5]), ROOM_RAD + 0.1 * self._speed / self.track
        if abs(off) > SIGMAS * sigma + room:
            raise BrokenError(
                "the wheels give the turn of a gyro that hangs", now_ns,
                f"{off:.3f} rad off, sigma {sigma:.4f}, the gyro repeats {hang.rate:.3f} rad/s",
            )  # fmt: skip

    def _gap(
        self,
        now_ns: int,
        before: tuple[int, Pose, Pose, float, tuple[float, ...]],
        estimate: Any,
        offset_ns: int,
        true_ns: int,
        true: Pose,
    ) -> None:
        """Check that the covariance of the first estimate after a gap includes the gap's motion."""
        then_ns, pose, true_then, speed, covariance = before
        sampled_ns, ex, ey, eyaw, (xx, _, _, yy, _, yawyaw), _ = estimate
        # A robot that stood may have been pushed in the gap, unless it stands where it stood.
        stood = speed < MOVES
        if sampled_ns + offset_ns - then_ns < (GAP_NS // 2 if stood else GAP_NS):
            return
        if stood and math.dist(true, true_then) > STANDS:
            return
        # A step that stands still reads older samples than its own time.
        if true_ns - sampled_ns > FRESH_NS:
            at_sample = self._true_at(sampled_ns + offset_ns)
            if at_sample is None:
                return
            true = at_sample
        # The error of the heading before the gap moves the pose during the gap. If the robot drives
        # back, this makes the covariance of the place smaller.
        old_xx, _, x_yaw, old_yy, y_yaw, yaw_variance = covariance
        dx, dy = ex - pose[0], ey - pose[1]
        variance = old_xx - 2 * dy * x_yaw + dy * dy * yaw_variance
        variance += old_yy + 2 * dx * y_yaw + dx * dx * yaw_variance
        if old_xx + old_yy > VAGUE:
            variance = 0.0
        x, y, _ = _through((true_then, pose), true)
        off, sigma = math.hypot(ex - x, ey - y), math.sqrt(max(0.0, xx + yy - variance))
        if off > SIGMAS * sigma + ROOM_M + 0.1 * speed:
            text = f"{off:.3f} m off after {(sampled_ns + offset_ns - then_ns) / NS:.3f} s"
            raise BrokenError(
                "a gap while moving is in the covariance",
                now_ns,
                f"{text}, sigma grew {sigma:.3f} m",
            )
        if not stood or self._drifts:
            return
        turned = abs(math.remainder(eyaw - pose[2], math.tau))
        # A turn back takes away what the track may have falsified of the turns before it.
        old_sigma = max(0.0, math.sqrt(yaw_variance) - self._track_share * turned)
        sigma = math.sqrt(max(0.0, yawyaw - old_sigma**2))
        if turned > SIGMAS * sigma + ROOM_RAD:
            text = f"{turned:.3f} rad in {(sampled_ns + offset_ns - then_ns) / NS:.3f} s"
            raise BrokenError(
                "a robot that stands keeps its heading", now_ns, f"{text}, sigma {sigma:.3f}"
            )

    def _put(
        self, now_ns: int, expected: tuple[Pose, Pose], true: Pose, pose: Pose, room: float
    ) -> None:
        """Check that the first estimate after a call has the requested pose plus later motion."""
        x, y, yaw = _through(expected, true)
        off, turned = math.hypot(pose[0] - x, pose[1] - y), math.remainder(pose[2] - yaw, math.tau)
        if off > ROOM_M + room or abs(turned) > ROOM_RAD + room / self.track:
            text = f"{expected[1]} was asked for, and {pose} is {off:.3f} m, {turned:.3f} rad off"
            raise BrokenError("the pose is put where a call asks for it", now_ns, text)

    def _present_speed(self) -> float:
        """Return the true speed of the robot in m/s, plus the speed of its wheels in a turn."""
        if len(self._true) < 2:
            return 0.0
        (t0, a), (t1, b) = self._true[-2], self._true[-1]
        seconds = max(0.005, (t1 - t0) / NS)
        turn = math.remainder(b[2] - a[2], math.tau) * self.track
        return float((math.hypot(b[0] - a[0], b[1] - a[1]) + abs(turn)) / seconds)

    def _true_at(self, at_ns: int) -> Pose | None:
        """Return the interpolated true pose at a time, or None without samples close to it."""
        after = None
        for then_ns, pose in reversed(self._true):
            if then_ns <= at_ns:
                if after is None:
                    return pose if at_ns - then_ns < 20_000_000 else None
                span = after[0] - then_ns
                if span > 60_000_000:
                    return None
                share = (at_ns - then_ns) / span if span else 0.0
                turn = math.remainder(after[1][2] - pose[2], math.tau)
                return (
                    pose[0] + share * (after[1][0] - pose[0]),
                    pose[1] + share * (after[1][1] - pose[1]),
                    pose[2] + share * turn,
                )
            after = then_ns, pose
        return None


def _through(anchor: tuple[Pose, Pose], true: Pose) -> Pose:
    """Return the pose that exact odometry has when the true pose is `true`.

    The anchor is a pair of the true pose and the pose of the odometry at the same time.
    """
    (tx, ty, tyaw), (ox, oy, oyaw) = anchor
    turn = oyaw - tyaw
    dx, dy = true[0] - tx, true[1] - ty
    c, s = math.cos(turn), math.sin(turn)
    return ox + c * dx - s * dy, oy + s * dx + c * dy, true[2] + turn
