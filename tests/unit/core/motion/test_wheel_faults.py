"""The wheels of each side check each other.

Odometry excludes a faulty wheel, and the daemon reports slip.
"""

from __future__ import annotations

import math

import numpy as np
import pytest

from acsard.core.codes import Reason
from acsard.core.config.settings import DriveConfig, FeedbackConfig
from acsard.core.link.feedback import Feedback
from acsard.core.motion.gyro import Turn
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.sanity import Sanity
from acsard.core.motion.wheel_faults import WheelFaults
from acsard.core.values import STILL, WHEELS, WheelSpeeds
from tests.each import each, more
from tests.unit.core.motion.liars import (
    AT,
    LIES,
    PERIOD,
    Array,
    Plain,
    Robot,
    apart,
    commands,
    fold,
    lines,
    odometry,
    reported_speeds,
    rolled,
    wishes,
)
from tests.unit.core.motion.test_odometry import Says

TEN = WheelSpeeds(10.0, 10.0, 10.0, 10.0)


def only(wheel: int, speed: float, others: float = 10.0) -> WheelSpeeds:
    return WheelSpeeds(*(speed if i == wheel else others for i in range(4)))


def all_at(speed: float) -> WheelSpeeds:
    return WheelSpeeds(speed, speed, speed, speed)


class Bench:
    """A consistency check that is fed line by line."""

    def __init__(self, counts: int = 3200) -> None:
        kinematics = Kinematics(DriveConfig())
        self.faults = WheelFaults(kinematics, counts, FeedbackConfig())
        self.events: list[str] = []

    def run(
        self,
        speeds: WheelSpeeds,
        command: WheelSpeeds | None = None,
        seconds: float = 1.0,
        turn: float | None = None,
    ) -> float:
        """Feed lines for this time. Return when the check found a faulty wheel, s, or inf.

        `turn` is the gyro's rate, rad/s.
        """
        time_s = math.inf
        for line in range(round(seconds / PERIOD)):
            front_right, front_left, rear_left, rear_right = speeds.as_tuple()
            turned = (
                front_right * PERIOD, front_left * PERIOD, rear_left * PERIOD, rear_right * PERIOD
            )  # fmt: skip
            by_gyro = None if turn is None else turn * PERIOD
            self.faults.watch(command, speeds, PERIOD)
            if self.faults.check_line(turned, speeds, PERIOD, by_gyro):
                time_s = min(time_s, (line + 1) * PERIOD)
            self.events += [event.kind for event in self.faults.events]
        return time_s


def driven(speeds: WheelSpeeds = TEN, counts: int = 3200) -> Bench:
    bench = Bench(counts)
    bench.run(speeds, speeds, seconds=2.0)
    assert bench.faults.status.text == ""
    return bench


# faulty wheels


def test_a_board_that_stopped_during_a_stall_has_no_dead_wheels_afterwards() -> None:
    """Lines of 50 ms each wait during the stall, and the host reads them after it.

    The first command after the stall reaches the board 60 ms late.
    """
    faults = WheelFaults(Kinematics(DriveConfig()), 3200, FeedbackConfig(fault_time=0.1))
    for _ in range(40):
        assert not faults.watch(all_at(6.9), all_at(6.9), 0.05)
    for speed in (6.9, 6.9, 6.8, 4.0, 1.9, 0.9, 0.2, 0.0, 0.0):
        faults.skip(all_at(speed))
    ramp = (2.3, 0.0), (4.6, 0.0), (6.9, 0.4), (6.9, 2.5), (6.9, 5.0), (6.9, 6.5)
    for command, speed in ramp:
        assert not faults.watch(all_at(command), all_at(speed), 0.05)


@each("own", [-4.0, -10.0])
def test_wheels_that_run_backwards_are_found_although_stalls_repeat(own: float) -> None:
    """The wheels drive on in each stall, because the motor driver ignores the board.

    Each stall makes six lines wait.
    """
    faults = WheelFaults(Kinematics(DriveConfig()), 3200, FeedbackConfig())
    fault: Reason | None = None
    for _ in range(6):
        for line in range(60):
            command = min(10.0, 0.4 * line)
            speed = own + 0.1 * (line % 2)
            fault = fault or faults.watch(all_at(command), all_at(speed), 0.01)
        for _ in range(27):
            faults.skip(all_at(own))
    assert fault is not None
    assert fault.code in ("wheel_reversed", "wheel_runaway")


def test_a_runaway_that_never_stops_during_stalls_is_found() -> None:
    faults = WheelFaults(Kinematics(DriveConfig()), 3200, FeedbackConfig(fault_time=0.1))
    fault: Reason | None = None
    for _ in range(10):
        for _ in range(4):
            fault = fault or faults.watch(all_at(2.0), all_at(9.0), 0.05)
        faults.skip(all_at(9.0))
    assert fault is not None
    assert fault.code == "wheel_runaway"


@each("wheel", range(4))
@each("speed", [0.0, -10.0])
def test_a_faulty_wheel_is_left_out_within_fifty_milliseconds_and_named(
    wheel: int, speed: float
) -> None:
    bench = driven()
    assert bench.run(only(wheel, speed), TEN) <= 0.05
    assert bench.faults.status.left_out == (WHEELS[wheel],)
    speeds = only(wheel, speed).as_tuple()
    assert bench.faults.believed(speeds) == pytest.approx((10.0,) * 4, 1e-3)


def test_the_other_wheel_of_the_side_replaces_a_faulty_wheel_and_no_other_speed_changes() -> None:
    bench = driven()
    bench.run(only(1, 0.0), TEN)
    front_right, front_left, *rear = bench.faults.believed((1, 2, 3, 4))
    assert (front_right, rear) == (1, [3, 4])
    assert front_left == pytest.approx(3, rel=1e-3)


def test_one_wheel_of_each_side_can_be_left_out_but_never_both_of_a_side() -> None:
    bench = driven()
    bench.run(WheelSpeeds(0.0, 0.0, 10.0, 10.0), TEN)
    assert bench.faults.status.left_out == ("front_left", "front_right")
    bench.run(STILL, TEN)
    assert bench.faults.status.left_out == ("front_left", "front_right")


def test_a_wheel_that_was_left_out_counts_again_once_it_has_agreed_for_half_a_second() -> None:
    bench = driven()
    bench.run(only(2, 0.0), TEN)
    bench.run(STILL, STILL, seconds=5.0)
    assert bench.faults.status.left_out == ("rear_left",), "a wheel at rest agrees with every other"
    bench.run(TEN, TEN, seconds=2.0)
    assert not bench.faults.status.left_out
    assert bench.events == ["left out", "again"]


@pytest.mark.parametrize(("pair", "fault"), [((10.0, 10.0), True), ((7.0, 8.0), False)])
def test_a_wheel_left_out_as_stuck_is_a_fault_only_while_it_repeats_that_speed(
    pair: tuple[float, float], fault: bool
) -> None:
    bench, five = driven(), WheelSpeeds(5.0, 5.0, 5.0, 5.0)
    bench.run(only(0, 10.0, others=5.0), five, seconds=0.1)
    assert "reports a speed that never changes" in bench.faults.status.text
    found: Reason | None = None
    for line in range(500):
        speeds = only(0, pair[line % 2], others=5.0)
        turned = tuple(speed * PERIOD for speed in speeds.as_tuple())
        found = found or bench.faults.watch(five, speeds, PERIOD)
        bench.faults.check_line(turned, speeds, PERIOD)  # type: ignore[arg-type]
    assert (found is not None and found.code == "wheel_stuck") is fault
    assert bench.faults.status.left_out == ("front_right",)


def test_the_wheel_angles_are_those_of_the_encoders_even_if_a_wheel_is_left_out() -> None:
    robot = odometry()
    for speeds in [TEN] * 100 + [only(0, 0.0)] * 100:
        estimate, _ = fold(robot, Feedback(AT, speeds, PERIOD), TEN)
    assert estimate.positions == pytest.approx((10.0, 20.0, 20.0, 20.0))
    assert estimate.speeds == only(0, 0.0)


# no healthy wheel is left out


@pytest.mark.parametrize("pushed", [0.5, 3.0, 12.0])
@pytest.mark.parametrize("in_the_air", range(4))
def test_a_push_by_hand_without_a_command_leaves_no_wheel_out(
    pushed: float, in_the_air: int
) -> None:
    """Either three wheels roll and one hangs in the air, or only the wheel in the air turns.

    Odometry excludes no wheel.
    """
    for speeds in (only(in_the_air, 0.0, pushed), only(in_the_air, pushed, 0.0)):
        bench = Bench()
        for line in range(500):
            noisy = WheelSpeeds(*(s + 0.1 * (line % 2) * (s != 0.0) for s in speeds.as_tuple()))
            assert bench.run(noisy, STILL, PERIOD) == math.inf
        assert bench.faults.status.left_out == ()


def test_a_gyro_shows_that_a_pushed_robot_has_a_wheel_in_the_air() -> None:
    bench = Bench()
    assert bench.run(only(3, 0.0, 5.0), STILL, turn=0.0) <= 0.05
    assert bench.faults.status.left_out == ("rear_right",)


def test_a_wheel_that_spins_in_the_air_is_not_left_out_and_is_reported_as_slip() -> None:
    bench = driven()
    assert bench.run(only(0, 12.5), TEN, seconds=10.0) == math.inf
    assert bench.faults.status.slipping == ("right",)


# slip


@pytest.mark.parametrize("wheel", range(4))
def test_slip_is_reported_with_its_side_until_about_half_a_second_after_its_end(wheel: int) -> None:
    bench = driven()
    bench.run(only(wheel, 11.0), TEN, seconds=0.2)
    side = WHEELS[wheel].partition("_")[2]
    assert bench.faults.status.slipping == (side,)
    bench.run(TEN, TEN, seconds=0.4)
    assert bench.faults.slips
    bench.run(TEN, TEN, seconds=0.5)
    assert not bench.faults.slips


def test_slip_makes_every_variance_a_hundred_times_larger() -> None:
    calm, slipping = odometry(3200), odometry(3200)
    for speeds in [TEN] * 200:
        sure, _ = fold(calm, Feedback(AT, speeds, PERIOD), TEN)
        fold(slipping, Feedback(AT, speeds, PERIOD), TEN)
    begun = sure.covariance.yawyaw
    for _ in range(100):
        sure, _ = fold(calm, Feedback(AT, TEN, PERIOD), TEN)
        unsure, _ = fold(slipping, Feedback(AT, only(0, 12.0), PERIOD), TEN)
    assert unsure.twist_variances.linear > 90 * sure.twist_variances.linear
    assert unsure.twist_variances.lateral == pytest.approx(100 * sure.twist_variances.lateral)
    assert unsure.twist_variances.angular > 90 * sure.twist_variances.angular
    assert unsure.covariance.yawyaw - begun > 80 * (sure.covariance.yawyaw - begun)


def test_wheels_that_a_gyro_contradicts_have_a_hundred_times_larger_variances() -> None:
    calm, slipping = odometry(3200), odometry(3200)
    calm.checks.gyro = Says(always=Turn(0.0, 0.0, 0.0, 0.0, slips=False))
    slipping.checks.gyro = Says(always=Turn(0.0, 0.0, 0.0, 0.0, slips=True))
    for _ in range(100):
        line = Feedback(AT, TEN, PERIOD)
        sure = calm.fold(line)
        unsure = slipping.fold(line)
    ratio = unsure.twist_variances.linear / sure.twist_variances.linear
    assert ratio == pytest.approx(100.0)
    assert unsure.covariance.xx > 90 * sure.covariance.xx


# thousands of random drives


class Fall:
    """One drive with one failure. It has the pose errors with and without the check."""

    def __init__(self, kind: str, seed: int, counts: int) -> None:
        rng = np.random.default_rng(seed)
        speeds = commands(rng, 8.0, stops=0.05)
        true = reported_speeds(rolled(speeds, Robot(counts, tyres=0.005), rng), counts)
        wheel = int(rng.integers(4))
        begun = int(rng.integers(300, 700))
        fast = 300 + np.flatnonzero(abs(speeds[300:700, wheel]) >= 2.0)
        if not fast.size:  # the robot stands during the whole drive
            begun, wheel = (
                int(i) for i in np.unravel_index(np.argmax(abs(speeds[:700])), (700, 4))
            )
        while fast.size and abs(speeds[begun, wheel]) < 2.0:
            begun = int(rng.integers(300, 700))
        lying = LIES[kind](true, wheel, begun)
        healthy, plain, robot = Plain(), Plain(), odometry()
        sanity = Sanity()
        self.out_s = self.wrong = 0.0
        off = out = None
        truth, wishing = lines(true), wishes(speeds)
        for i, line in enumerate(lines(lying, counts)):
            healthy.fold(truth[i])
            if sanity.impossible(line, FeedbackConfig().wheel_speed):
                plain.skip(line)
                robot.skip(line)
                if sanity.doubtful:
                    break
                continue
            plain.fold(line)
            fold(robot, line, wishing[i])
            if off is None and i >= begun and abs(lying[i, wheel] - true[i, wheel]) > 2.0:
                off = i
            if out is None and robot.checks.wheels.status.left_out:
                out = i
                self.wrong += robot.checks.wheels.status.left_out != (WHEELS[wheel],) or i < begun
        self.plain, self.mine = apart(healthy.pose, plain.pose), apart(healthy.pose, robot.pose)
        if off is not None:
            self.out_s = math.inf if out is None else max(0, out - off + 1) * PERIOD


GOAL = 0.1
"""Largest share of the plain mean's error: of the lines before the wheel is left out."""

COARSE = {(20, "reversed"): 0.25}
"""Larger share for the case in which many counts must pass before a failure shows."""

SOAK = [pytest.mark.soak, pytest.mark.timeout(3600)]


@pytest.mark.parametrize(
    ("counts", "count"),
    [
        (3200, 4),
        pytest.param(96, 30, marks=pytest.mark.slow),
        *(more(*one) for one in ((20, 30), (400, 30), (3200, 50))),
        *(pytest.param(counts, 1000, marks=SOAK) for counts in (20, 96, 400, 3200)),
    ],
)
@pytest.mark.parametrize("kind", list(LIES))
def test_the_check_reduces_the_pose_error_of_a_faulty_wheel_to_a_tenth(
    kind: str, counts: int, count: int
) -> None:
    """The drives are random. `COARSE` allows more for coarse encoders."""
    falls = [Fall(kind, seed, counts) for seed in range(count)]
    plain = np.array([fall.plain for fall in falls]).mean(axis=0)
    mine = np.array([fall.mine for fall in falls]).mean(axis=0)
    soon = sum(fall.out_s <= 0.05 + 1e-9 for fall in falls) / count
    print(
        f"\n{kind}, {counts} counts x {count}: plain mean {plain[0]:.3f} m "
        f"{math.degrees(plain[1]):.1f} deg, "
        f"left out {mine[0] / plain[0]:.1%} and {mine[1] / plain[1]:.1%} of that; "
        f"out within 50 ms {soon:.1%}"
    )
    assert not sum(fall.wrong for fall in falls)
    goal = COARSE.get((counts, kind), GOAL)
    assert mine[1] < goal * plain[1]
    assert mine[0] < goal * plain[0]
    assert soon > 0.95 or counts < 3200 or count < 50


def steady(counts: int, speed: float, rng: np.random.Generator) -> tuple[Array, Array]:
    """Return commanded speeds in rad/s and wheel angles in rad of a straight drive."""
    steps = np.concatenate([np.linspace(0.0, 1.0, 150), np.ones(450)])
    speeds = np.round(steps[:, None] * speed * np.ones(4), 2)
    return speeds, rolled(speeds, Robot(counts, tyres=0.005), rng)


def out_after(kind: str, counts: int, speed: float, seed: int) -> float:
    """Return the time until odometry excludes the faulty wheel on a straight drive, s.

    The test fails if it excludes another wheel.
    """
    rng = np.random.default_rng(seed)
    speeds, angles = steady(counts, speed, rng)
    wheel, begun = int(rng.integers(4)), int(rng.integers(300, 400))
    lying = LIES[kind](reported_speeds(angles, counts), wheel, begun)
    robot = odometry()
    for i, (line, wish) in enumerate(zip(lines(lying, counts), wishes(speeds), strict=True)):
        fold(robot, line, wish)
        if robot.checks.wheels.status.left_out:
            assert robot.checks.wheels.status.left_out == (WHEELS[wheel],)
            assert i >= begun
            return (i - begun + 1) * PERIOD
    return math.inf


@pytest.mark.parametrize(
    ("kind", "counts", "speed", "within"),
    [
        ("dead", 400, 20.0, 0.03), ("dead", 400, 4.0, 0.05),
        ("dead", 96, 20.0, 0.05), ("dead", 96, 10.0, 0.06), ("dead", 96, 4.0, 0.13),
        ("dead", 20, 20.0, 0.1), ("dead", 20, 10.0, 0.2), ("dead", 20, 4.0, 0.7),
        ("reversed", 400, 4.0, 0.04), ("reversed", 96, 4.0, 0.1), ("reversed", 20, 20.0, 0.08),
    ],
)  # fmt: skip
def test_the_time_to_find_a_wrong_wheel_depends_on_counts_and_speed(
    kind: str, counts: int, speed: float, within: float
) -> None:
    """The speeds are wheel speeds in rad/s: 20 rad/s are 1 m/s."""
    time_s = max(out_after(kind, counts, speed, seed) for seed in range(3))
    print(f"\n{kind}, {counts} counts, {speed:g} rad/s: {time_s:.2f} s")
    assert time_s <= within + 1e-9


def healthy(
    seed: int, seconds: float, counts: int, before: tuple[WheelSpeeds, ...] = ()
) -> tuple[int, bool]:
    """Return how often slip is reported on a clean drive, and whether the pose is exact.

    It is exact if it equals the pose from the plain mean of the wheels bit for bit. The lines of
    `before` come before the drive.
    """
    rng = np.random.default_rng(10_000 + seed)
    targets = commands(rng, seconds)
    robot, plain, alarms, slips = odometry(), Plain(), 0, False
    speeds = reported_speeds(rolled(targets, Robot(counts, load=0.02), rng), counts)
    for entry in before:
        robot.fold(Feedback(AT, entry, PERIOD))
        plain.fold(Feedback(AT, entry, PERIOD))
    for line, wish in zip(lines(speeds), wishes(targets), strict=True):
        fold(robot, line, wish)
        plain.fold(line)
        if line.speeds != STILL:
            was, slips = slips, bool(robot.checks.wheels.status.slipping)
            alarms += slips and not was
    return alarms, robot.pose == plain.pose


@pytest.mark.parametrize("seed", range(4))
def test_a_digit_that_flips_at_rest_does_not_make_an_encoder_count_as_fine(seed: int) -> None:
    flipped = only(1, 0.01, 0.0)
    assert healthy(seed, 20.0, 96, (STILL, flipped, STILL, STILL, flipped, STILL)) == (0, True)


@pytest.mark.parametrize(
    "seconds",
    [
        20,
        pytest.param(120, marks=pytest.mark.slow),
        pytest.param(3600, marks=[pytest.mark.soak, pytest.mark.timeout(3600)]),
    ],
)
@pytest.mark.parametrize("counts", [96, 400, 3200])
def test_an_hour_of_clean_driving_raises_one_false_alarm_at_most(counts: int, seconds: int) -> None:
    """The robots differ in motors, tyres and loads. Each drives for at most five minutes."""
    each = min(seconds, 300)
    results = [healthy(seed, each, counts) for seed in range(seconds // each)]
    alarms = sum(alarm for alarm, _ in results)
    print(f"\n{counts} counts, {seconds} s: {alarms} false alarms")
    assert alarms <= 1
    assert all(same for _, same in results)


def slipping(rng: np.random.Generator, counts: int, speed: float = 0.0) -> float:
    """Return the time until the check reports a wheel whose speed is wrong by 10 %, s.

    The drive is steady. Its speed is random if `speed` is 0.
    """
    speed = rng.choice((-1, 1)) * (speed or rng.uniform(6.0, 18.0))
    steps = np.concatenate([np.linspace(0.0, 1.0, 90), np.ones(410)])
    speeds = np.round(steps[:, None] * speed * np.ones(4), 2)
    angles: Array = rolled(speeds, Robot(counts, tyres=0.01), rng)
    wheel, begun = int(rng.integers(4)), int(rng.integers(350, 450))
    angles[begun:, wheel] += 0.1 * rng.choice((-1, 1)) * (
        angles[begun:, wheel] - angles[begun - 1, wheel]
    )  # fmt: skip
    robot = odometry()
    for i, (line, wish) in enumerate(
        zip(lines(reported_speeds(angles, counts)), wishes(speeds), strict=True)
    ):
        fold(robot, line, wish)
        if i >= begun and robot.checks.wheels.status.slipping:
            return (i - begun + 1) * PERIOD
    return math.inf


@pytest.mark.slow
@pytest.mark.parametrize(
    "count", [10, pytest.param(300, marks=[pytest.mark.soak, pytest.mark.timeout(1800)])]
)
@pytest.mark.parametrize(("counts", "share"), [(3200, 0.95), (400, 0.7)])
def test_slip_of_a_tenth_is_reported_within_a_fifth_of_a_second(
    counts: int, share: float, count: int
) -> None:
    rng = np.random.default_rng(5)
    times = sorted(slipping(rng, counts) for _ in range(count))
    soon = sum(time_s <= 0.2 + 1e-9 for time_s in times) / count
    print(f"\n{counts} counts: median {times[count // 2]:.2f} s, {soon:.0%} in 0.2 s")
    assert soon >= share


@pytest.mark.parametrize(
    ("counts", "speed", "within"),
    [
        (3200, 20.0, 0.2), (3200, 4.0, 0.3), (400, 20.0, 0.25), (400, 10.0, 0.4),
        pytest.param(400, 4.0, 1.5, marks=pytest.mark.slow),
    ],
)  # fmt: skip
def test_the_time_to_report_slip_depends_on_counts_and_speed(
    counts: int, speed: float, within: float
) -> None:
    """The speeds are wheel speeds in rad/s."""
    rng = np.random.default_rng(7)
    times = sorted(slipping(rng, counts, speed) for _ in range(5))
    print(f"\n{counts} counts, {speed:g} rad/s: median {times[2]:.2f} s, at most {times[-1]:.2f}")
    assert times[-1] <= within + 1e-9


def test_slip_of_a_tenth_is_not_found_with_twenty_counts_a_turn() -> None:
    assert slipping(np.random.default_rng(7), 20, 20.0) == math.inf
