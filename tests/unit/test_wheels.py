"""Which wheel to believe: blocked, running away, reversed, slipping, or turned by a hand."""

from __future__ import annotations

import math

import pytest

from acsard.core.config.settings import DriveConfig, FeedbackConfig, WheelMap
from acsard.core.link.feedback import Line
from acsard.core.motion.gyro import Turn
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.sides import CommandRange
from acsard.core.motion.wheels import count_angle, new_wheels
from acsard.core.values import WHEELS, WheelSpeeds
from tests.each import each
from tests.unit.odometer import Odometer
from tests.unit.test_pose import AT, Says
from tests.wheels import FOUR, MAPS

PERIOD = 0.01


def speeds_of(speeds: WheelSpeeds | float) -> WheelSpeeds:
    return speeds if isinstance(speeds, WheelSpeeds) else WheelSpeeds(*[speeds] * 4)


def only(wheel: int, speed: float, others: float = 10.0) -> WheelSpeeds:
    return WheelSpeeds(*(speed if i == wheel else others for i in range(4)))


TEN = speeds_of(10.0)


class Bench:
    """The verdicts on wheels, line by line. A single speed is that of all four wheels."""

    def __init__(self, counts: int = 3200, encoders: bool = True, wheels: WheelMap = FOUR) -> None:
        self.kinematics, self.count = Kinematics(DriveConfig()), count_angle(counts)
        self.feedback = FeedbackConfig(encoders=encoders)
        self.wheels = new_wheels(len(wheels.names))
        self.events: list[str] = []
        self.faults: list[str] = []
        self.pushes = self.gave_up = 0

    def run(
        self,
        speeds: WheelSpeeds | float,
        command: WheelSpeeds | float | None = None,
        seconds: float = PERIOD,
        turn: float | None = None,
        unseen: float = 0.0,
        noise: float = 0.0,
        each: float = PERIOD,
        until_fault: bool = False,
    ) -> float:
        """Feed lines for this time. Return when a wheel was left out, s, or inf.

        `turn` is the gyro's rate, rad/s. In every second line `noise` is added to a turning wheel.
        """
        time_s, wheels = math.inf, self.wheels
        before, wanted = wheels.status.excluded, None if command is None else speeds_of(command)
        for number in range(round(seconds / each)):
            more = noise * (number % 2)
            a, b, c, d = (s + more * (s != 0.0) for s in speeds_of(speeds).as_tuple())
            turned = a * each, b * each, c * each, d * each
            by_gyro = None if turn is None else turn * each
            wheels.commanded, wheels.unseen = wanted, unseen
            reported = WheelSpeeds(a, b, c, d)
            wheels.add(turned, reported, each, by_gyro, self.feedback, self.kinematics, self.count)
            if wheels.status.excluded != before:
                time_s = min(time_s, (number + 1) * each)
            self.events += [event.kind for event in wheels.events]
            self.pushes += bool(wheels.pushed)
            self.gave_up += wheels.gives_up
            if wheels.fault is not None:
                self.faults.append(wheels.fault.code)
                if until_fault:
                    break
        return time_s

    def driven(self, speed: float = 10.0) -> Bench:
        for step in range(101):
            self.run(speed * min(1.0, step / 100), speed * min(1.0, step / 100))
        self.run(speed, speed, 2.0)
        assert self.text == ""
        return self

    def stopped(self, speed: float, keeps: float) -> Bench:
        """Stop with a ramp of 20 rad/s2. The wheels follow until they report `keeps`, for ever."""
        while speed > 0.0:
            speed = max(0.0, speed - 20.0 * PERIOD)
            self.run(max(speed, keeps), speed)
        self.run(keeps, 0.0, 4.0)
        return self

    @property
    def text(self) -> str:
        return self.wheels.status.text


# faults, warnings and reports


@each("wheels", MAPS)
@each("keeps", [0.4, 0.8, 1.6])
def test_wheels_that_keep_their_last_speed_after_a_stop_roll_on(
    keeps: float, wheels: WheelMap
) -> None:
    bench = Bench(wheels=wheels).driven(5.0).stopped(5.0, keeps)
    assert set(bench.faults) == {"wheel_runaway"}


@each("wheels", MAPS)
@each("counts", [16, 3200])
@each("speed", [0.8, 1.4, 10.0])
def test_a_robot_faster_than_its_limiter_for_a_second_is_a_fault(
    speed: float, counts: int, wheels: WheelMap
) -> None:
    """It is beyond a fifth more by 0.3 rad and 2.5 counts, too, of the smoothed speed."""
    bench, fast = Bench(counts, wheels=wheels).driven(speed), 1.35 * speed
    beyond_s = max(0.3, 2.5 * count_angle(counts)) / (fast - 1.2 * speed)
    bench.run(fast, speed, 0.9 * max(1.0, beyond_s))
    assert bench.faults == []
    smoothed_s = 0.35 / 0.15 * min(1.0, 3 * count_angle(counts) / fast)
    bench.run(fast, speed, 0.1 * max(1.0, beyond_s) + 0.7 + smoothed_s)
    assert bench.faults[0] == "wheel_too_fast"


@each("wheels", MAPS)
def test_the_blocked_wheels_of_a_side_are_a_warning_until_they_turn(wheels: WheelMap) -> None:
    bench, right = Bench(wheels=wheels), [name for name in wheels.names if "right" in name]
    bench.run(WheelSpeeds(0.0, 10.0, 10.0, 0.0), 10.0, 1.5)
    assert (bench.faults, bench.events) == ([], ["wheel_blocked"] * len(right))
    texts = bench.text.split("; ")
    assert [text.partition(" wheel is blocked, or has no")[0] for text in texts] == right
    bench.run(10.0, 10.0, 2.0)
    assert (bench.text, bench.events[len(texts) :]) == ("", ["again"] * len(texts))


@each("wheels", MAPS)
def test_wheels_of_which_none_begins_are_one_warning_until_one_turns(wheels: WheelMap) -> None:
    bench = Bench(wheels=wheels)
    bench.run(0.0, 1.0, 20.0)  # a speed that the motors may ignore
    assert (bench.faults, bench.events, bench.gave_up) == ([], ["no_wheel_begins"], 0)
    assert bench.text.startswith("no wheel has begun to move for ")
    bench.run(1.0, 1.0, 2.0)
    assert (bench.text, bench.events) == ("", ["no_wheel_begins", "again"])
    bench = Bench(wheels=wheels)
    for number in range(1, 3):
        bench.run(0.0, 2.0, 3.2)
        bench.run(0.0, 0.0, 1.0)
        assert (bench.faults, bench.gave_up) == ([], number)
    bench.run(0.0, 2.0, 3.2)
    assert bench.faults == ["no_wheel_begins"]
    for _ in range(3):  # not three times in a minute
        bench.run(0.0, 0.0, 40.0)
        bench.run(0.0, 2.0, 3.2)
    assert (bench.faults, bench.gave_up) == (["no_wheel_begins"], 5)


@each("wheels", MAPS)
@each("counts", [16, 400, 3200])
def test_a_blocked_wheel_that_springs_back_by_a_count_rolls_on_nowhere(
    counts: int, wheels: WheelMap
) -> None:
    """Its smoothed speed never becomes 0 again."""
    bench = Bench(counts, wheels=wheels)
    bench.run(WheelSpeeds(0.0, 8.0, 8.0, 0.0), 8.0, 1.0)
    back = -count_angle(counts) / PERIOD
    bench.run(WheelSpeeds(back, 8.0, 8.0, back), 8.0, PERIOD)
    bench.run(WheelSpeeds(0.0, 8.0, 8.0, 0.0), 8.0, 10.0)
    assert bench.faults == []


@each("wheels", MAPS)
def test_sides_that_are_swapped_in_a_turn_about_one_of_them_are_found(wheels: WheelMap) -> None:
    """The right side is commanded to stand, and the robot drives: no wheel of it rests."""
    bench = Bench(wheels=wheels)
    bench.run(0.0, 0.0, 2.0)
    told, turned = WheelSpeeds(0.0, 8.0, 8.0, 0.0), WheelSpeeds(8.0, 0.0, 0.0, 8.0)
    bench.run(turned, told, 2.0, until_fault=True)
    assert bench.faults == ["wheels_swapped"]
    assert bench.pushes == 0


@each("wheels", MAPS)
@each("press_s", [0.05, 0.2])
@each("dead_s", [0.2, 0.4, 0.6])
def test_a_short_press_of_the_emergency_stop_makes_no_runaway_of_a_dead_time(
    dead_s: float, press_s: float, wheels: WheelMap
) -> None:
    """The motors keep their power, and do not see the zeros yet."""
    bench, dead, wished = Bench(wheels=wheels).driven(), [10.0] * round(dead_s / PERIOD), 10.0
    for step in range(300):
        pressed = step < round(press_s / PERIOD)
        wished = 0.0 if pressed else max(0.0, wished - 0.2)
        dead.append(wished)
        bench.run(dead.pop(0), None if pressed else wished)
    assert bench.faults == []


@each("wheels", MAPS)
@each("counts", [16, 24, 48, 96])
def test_a_count_that_is_crossed_to_and_fro_is_no_motion(counts: int, wheels: WheelMap) -> None:
    bench, count = Bench(counts, wheels=wheels), count_angle(counts) / PERIOD
    for _ in range(40):
        for sign in (1.0, -1.0):
            bench.run(sign * count, sign * 0.3, PERIOD)
            bench.run(0.0, sign * 0.3, 0.19)
    assert bench.faults == []


@each("wheels", MAPS)
def test_wheels_that_rested_and_are_then_turned_are_reported_and_never_a_fault(
    wheels: WheelMap,
) -> None:
    bench = Bench(wheels=wheels)
    bench.run(0.0, 0.0, 1.0)
    bench.run(2.0, 0.0, 3.0, noise=0.1)
    assert (bench.faults, bench.pushes >= 2) == ([], True)
    bench = Bench(wheels=wheels).driven()  # also after a press, in which nothing proves a fault
    bench.run(5.0, None, 1.0)
    bench.run(0.0, None, 1.0)
    bench.run(3.0, 0.0, 2.0, noise=0.1)
    assert (bench.faults, bench.pushes >= 1) == ([], True)


@each("wheels", MAPS)
@each(
    ("speeds", "commands", "rests", "code", "words"),
    [
        ((10.0, -10.0), (10.0, 10.0), False, "wheel_reversed", "left wheel"),
        ((10.0, 10.0), (0.0, 10.0), False, "wheel_runaway", "right wheel"),
        ((-10.0, 10.0), (10.0, -10.0), True, "wheels_swapped", "right and left wheels"),
    ],
)
def test_a_fault_names_its_wheels_and_is_found_once(
    speeds: tuple[float, float], commands: tuple[float, float], rests: bool, code: str, words: str,
    wheels: WheelMap,
) -> None:  # fmt: skip
    """Both wheels of a side do the same, so that neither outvotes the other."""
    bench, (right, left), (of_right, of_left) = Bench(wheels=wheels).driven(), speeds, commands
    told = WheelSpeeds(of_right, of_left, of_left, of_right)
    if rests:
        bench.run(0.0, 0.0, 2.0)
    bench.run(WheelSpeeds(right, left, left, right), told, 3.0, until_fault=True)
    fault = bench.wheels.fault
    assert fault is not None
    assert (fault.code, bench.faults) == (code, [code])
    assert fault.text.replace("front_", "").replace("rear_", "").startswith(words)
    assert ("front" in fault.text or "rear" in fault.text) is (wheels is FOUR)
    assert fault.part in (*wheels.names, " and ".join(wheels.names[:2]), "rear_right and rear_left")


def test_what_sound_robots_do_is_no_fault() -> None:
    # A slow motor that has come to rest: the smoothed speed of a coarse encoder falls for longer.
    slow = Bench(counts=0).driven(18.0)
    for step in range(300):
        slow.run(18.0 * math.exp(-step * PERIOD / 0.342), 0.0)
    # A limit that is lowered in motion.
    lowered, speed, command = Bench().driven(15.0), 15.0, 15.0
    for _ in range(600):
        command = max(3.0, command - 0.2)
        speed += (command - speed) * PERIOD / 0.6
        lowered.run(speed, command)
    # A board that stopped its motors in a stall: the lines of that time wait.
    again = Bench().driven()
    again.run(0.0, 10.0, 0.5, unseen=PERIOD)
    for step in range(100):
        again.run(0.09 * step, 0.1 * step)
    blind = Bench(encoders=False)
    blind.run(-10.0, 10.0, 5.0)
    assert slow.faults == lowered.faults == again.faults == blind.faults == []
    assert again.events == blind.events == []


@each("wheels", MAPS)
@each("counts", [0, 20])
@each("silence", [1.1, 8.0])
@each("before", [-17.0, 17.0])
@each("after", [0.0, -3.0, 12.0])
def test_the_speed_before_a_long_silence_is_no_motion_behind_it(
    after: float, before: float, silence: float, counts: int, wheels: WheelMap
) -> None:
    """A hand turned the wheels, for too short a time for a fault."""
    bench = Bench(counts, wheels=wheels).driven(1.0)
    bench.run(before, 0.0, 0.2)
    bench.wheels.add_command(speeds_of(after), silence)
    bench.wheels.commanded, bench.wheels.unseen = speeds_of(after), silence
    bench.wheels.add(
        (0.0,) * 4, speeds_of(after), 0.0, None, bench.feedback, bench.kinematics, bench.count
    )  # the first line behind a long silence has no time of its own
    bench.run(after, after, 1.0)
    assert bench.faults == []


# what a silence may hide


@pytest.mark.parametrize(
    ("commands", "seconds", "least", "most"),
    [
        ([(4.0, 0.01)] * 10, 0.1, 0.4, 0.4),  # constant, and no line is late
        ([(4.0, 0.2), (0.0, 0.1)], 0.3, 0.8, 1.2),  # it came to rest, or went on
        ([(0.0, 0.1), (4.0, 0.1), (0.0, 0.1)], 0.3, 0.0, 0.8),  # it came and went
        ([(4.0, 0.1), (-4.0, 0.2)], 0.3, -0.4, 1.2),  # it changed its sign
        ([(-4.0, 0.6)], 0.6, -2.4, -1.2),  # a stall: the board stops after 0.3 s
        ([(4.0, 0.1)], 0.6, 1.6, 2.4),  # the last line is not the end
        ([(4.0, 0.1)] + [(0.0, 0.1)] * 600, 60.0, 0.4, 4.0),  # a second of it
        ([(0.0, 30.0), (4.0, 30.0)], 60.0, 0.0, 0.0),
    ],
)
def test_a_silence_may_hide_what_any_of_its_commands_turn_the_wheels(
    commands: list[tuple[float, float]], seconds: float, least: float, most: float
) -> None:
    found = CommandRange(commands[0][0], commands[0][0])
    for speed, s in commands:
        found = found.extended(speed, s)
    found = found.until(seconds)
    assert (found.least, found.most) == pytest.approx((least, most))
    assert abs(found.margin) == pytest.approx((most - least) / 2)


# wheels that the pose leaves out


@each("wheel", range(4))
@each("speed", [0.0, -10.0])
def test_a_faulty_wheel_is_left_out_within_60_ms_and_named(wheel: int, speed: float) -> None:
    bench = Bench().driven()
    assert bench.run(only(wheel, speed), 10.0, 1.0) <= 0.06
    assert bench.wheels.status.excluded == (WHEELS[wheel],)
    # The other wheel of the side replaces it, and no other speed changes.
    believed = bench.wheels.believed((1, 2, 3, 4))
    expected = [1.0, 2.0, 3.0, 4.0]
    expected[wheel] = expected[3 - wheel]
    assert believed == pytest.approx(expected, rel=1e-3)


def test_one_wheel_of_each_side_can_be_left_out_but_never_both_of_a_side() -> None:
    bench = Bench().driven()
    for speeds in (WheelSpeeds(0.0, 0.0, 10.0, 10.0), 0.0):
        bench.run(speeds, 10.0, 1.0)
        assert bench.wheels.status.excluded == ("front_left", "front_right")


def test_a_wheel_that_was_left_out_counts_again_once_it_has_agreed_for_two_seconds() -> None:
    bench = Bench().driven()
    bench.run(only(2, 0.0), 10.0, 1.0)
    for speed, seconds, out in ((0.0, 5.0, True), (10.0, 1.5, True), (10.0, 1.0, False)):
        bench.run(speed, speed, seconds)  # at rest it agrees with every other
        assert bench.wheels.status.excluded == ("rear_left",) * out
    assert [kind for kind in bench.events if kind != "wheel_blocked"][:2] == ["left out", "again"]


def test_the_wheel_angles_are_those_of_the_encoders_even_if_a_wheel_is_left_out() -> None:
    robot = Odometer()
    for speeds in [TEN] * 100 + [only(0, 0.0)] * 100:
        estimate = robot.fold(Line(AT, speeds, PERIOD), TEN)
    assert estimate.positions == pytest.approx((10.0, 20.0, 20.0, 20.0))
    assert estimate.speeds == only(0, 0.0)


@each("pushed", [0.5, 3.0, 12.0])
@each("wheel", range(4))
def test_a_push_leaves_no_wheel_out_unless_a_gyro_shows_one(pushed: float, wheel: int) -> None:
    """Three wheels roll and one hangs in the air, or only the wheel in the air turns."""
    for speeds in (only(wheel, 0.0, pushed), only(wheel, pushed, 0.0)):
        bench = Bench()
        assert bench.run(speeds, 0.0, 5.0, noise=0.1) == math.inf
        assert bench.wheels.status.excluded == ()
    bench = Bench()
    assert bench.run(only(wheel, 0.0, 5.0), 0.0, 1.0, turn=0.0) <= 0.06
    assert bench.wheels.status.excluded == (WHEELS[wheel],)


# slip


@each("wheel", range(4))
def test_slip_is_reported_with_its_side_until_about_half_a_second_after_its_end(wheel: int) -> None:
    bench, side = Bench().driven(), WHEELS[wheel].partition("_")[2]
    bench.run(only(wheel, 11.0), 10.0, 0.2)
    assert bench.wheels.status.slipping == (side,)
    bench.run(10.0, 10.0, 0.4)
    assert bench.wheels.slips
    bench.run(10.0, 10.0, 0.5)
    assert not bench.wheels.slips
    # A wheel that spins in the air is not left out.
    assert bench.run(only(wheel, 12.5), 10.0, 10.0) == math.inf
    assert bench.wheels.status.slipping == (side,)


def test_slip_makes_every_variance_a_hundred_times_larger() -> None:
    calm, slipping = Odometer(counts=3200), Odometer(counts=3200)
    for _ in range(200):
        sure = calm.fold(Line(AT, TEN, PERIOD), TEN)
        slipping.fold(Line(AT, TEN, PERIOD), TEN)
    begun = sure.covariance.yawyaw
    for _ in range(100):
        sure = calm.fold(Line(AT, TEN, PERIOD), TEN)
        unsure = slipping.fold(Line(AT, only(0, 12.0), PERIOD), TEN)
    assert unsure.twist_variances.linear > 90 * sure.twist_variances.linear
    assert unsure.twist_variances.lateral == pytest.approx(100 * sure.twist_variances.lateral)
    assert unsure.twist_variances.angular > 90 * sure.twist_variances.angular
    assert unsure.covariance.yawyaw - begun > 80 * (sure.covariance.yawyaw - begun)
    estimates = []
    for slips in (False, True):  # a gyro that contradicts the wheels does so too
        robot = Odometer(counts=3200)
        robot.use(Says(always=Turn(0.0, 0.0, 0.0, 0.0, slips=slips)))
        for _ in range(100):
            estimate = robot.fold(Line(AT, TEN, PERIOD))
        estimates.append(estimate)
    sure, unsure = estimates
    assert unsure.twist_variances.linear / sure.twist_variances.linear == pytest.approx(100.0)
    assert unsure.covariance.xx > 90 * sure.covariance.xx
