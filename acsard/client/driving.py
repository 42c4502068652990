"""Drives one robot: `Driver` connects a `Ride` to the bus, and three kinds of steps use it.

The daemon does not answer commands, but says in `state` why the robot does not follow. Then the
steps raise an error with that reason. Each is a generator of the time to wait before it is resumed,
s, so that a script can sleep and an asyncio program can await.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Generator
from contextlib import closing, suppress
from numbers import Real
from typing import Protocol

import zenoh

from acsard.bus.subscription import encoded
from acsard.client.course import Course, Straight, Turn
from acsard.client.follower import FIRST_STATE_TIMEOUT_S, Followed, Watch
from acsard.client.ride import (
    GRACE_S,
    SEND_PERIOD_S,
    Ride,
    can_drive,
    lacks_only_commands,
    objection,
    receives_commands,
    refuses_for_good,
)
from acsard.core.messages.encodings import DecodeError, Decoder
from acsard.core.messages.schema import Odometry
from acsard.core.values import REST, Seconds, Twist
from acsard.host import clock
from acsard.host.errors import NoAnswerError, NotDrivenError, UsageError

# Longest repetition of zeros by a program that ends. The robot usually shows within 0.6 s that it
# has stopped; the rest is for a hiccup of the network or a stall of the daemon.
MAX_END_S = 2.0

COURSE_PERIOD_S = 0.02  # between two looks at the odometry

MAX_ODOM_AGE_S = 0.2  # of a speed on a course

COURSE_TIMEOUT_S = 3.0  # without coming nearer to the end of a course
MAX_MISSES = 5  # of the end of a course, by a robot that rests elsewhere
MAYBE = "is it blocked, or is a speed limit in force?"

# What counts as nearer: this fraction of the rest, or on a long way this many m or rad.
NEARER, MOST_NEARER = 0.01, 0.01

POSES_SET = "poses_set"  # counter in `state`

POSE_SET = "the pose was set during the drive: see where the robot is, and drive the rest anew"

STARTED = "the daemon was started anew during the drive: see where the robot is"

CONNECTION_CLOSED = "the connection to the daemon was closed while the robot was driving"


class UnheardError(NotDrivenError):
    """The daemon receives no commands from this client's command source, so the drive has ended."""

    def __init__(self, text: str, *, lacks_only_commands: bool) -> None:
        super().__init__(text)
        self.lacks_only_commands = lacks_only_commands


class CommandClient(Followed, Protocol):
    """The part of a client that a `Driver` uses."""

    source: str

    @property
    def sender(self) -> str:
        """The public name of this client's sender."""

    def send(self, linear: float, angular: float = 0.0) -> None:
        """Send one command: `linear` m/s, `angular` rad/s (left is +)."""


class Driver:
    """Sends the commands of a `Ride`, and receives the states of the robot."""

    def __init__(self, robot: CommandClient) -> None:
        self.robot, self.watch = robot, Watch(robot, clock.steady_s())
        # Read the clock again here, because the subscription above may take long.
        self.ride = Ride(robot.source, robot.sender, self.watch, clock.steady_s())

    def step(self, wish: Twist | None) -> None:
        """Pass a wish to the ride, send the command that is due, and process the states."""
        now = clock.steady_s()
        self.ride.wish(wish, now)
        command = self.ride.due(now)
        try:
            if command is not None:
                self.robot.send(command.linear, command.angular)
            self.take()
        except zenoh.ZError:
            raise NoAnswerError(CONNECTION_CLOSED) from None

    def take(self) -> None:
        """Process the states that have arrived. If none has for some time, query it."""
        now = clock.steady_s()
        for state in self.watch.poll(now):
            self.ride.state(state, now)

    @property
    def poses_set(self) -> int:
        """How often the pose was set since the start of the daemon, by the newest state."""
        state = self.watch.state
        return 0 if state is None else state.counters.get(POSES_SET, 0)

    def require_pose(self, poses_set: int | None) -> None:
        """Raise `NotDrivenError` if the pose was set since `poses_set` had this value."""
        if self.poses_set != poses_set:
            raise NotDrivenError(POSE_SET if self.poses_set > (poses_set or 0) else STARTED)

    def require(self) -> None:
        """Raise an error if the ride has ended, or if the daemon is silent.

        It is an `UnheardError` if the daemon receives nothing from this source.
        """
        ride, state, source = self.ride, self.watch.state, self.robot.source
        if silence := self.watch.silence(clock.steady_s()):
            raise NoAnswerError(silence)
        if not ride.ended:
            return
        if state is None or ride.ended != ride.objection or receives_commands(state, source):
            raise NotDrivenError(ride.ended)
        lacks = lacks_only_commands(state, source)
        raise UnheardError(ride.ended, lacks_only_commands=lacks)

    def stop(self) -> Generator[Seconds, None, None]:
        """Send zeros until the robot stands. Raises the errors of `require`."""
        self.step(REST)
        while not self.ride.is_over(clock.steady_s()):
            self.require()
            yield SEND_PERIOD_S
            self.step(None)
        state, source = self.watch.state, self.robot.source
        if state is not None and refuses_for_good(state, source):
            raise NotDrivenError(objection(state, source, self.robot.sender))

    def zeros(self) -> Generator[Seconds, None, None]:
        """Send zeros until the robot stands, for at most `MAX_END_S`, when a drive ends early."""
        begun = clock.steady_s()
        if self.ride.is_over(begun):
            return
        with suppress(NoAnswerError):  # the connection is closed
            self.step(REST)
            while not self.ride.is_over(now := clock.steady_s()) and now - begun < MAX_END_S:
                yield SEND_PERIOD_S
                self.step(None)

    def end(self) -> None:
        """Unsubscribe from the states."""
        self.watch.end()


Steps = Callable[[Driver], Generator[Seconds, None, None]]


def drive(linear: float, angular: float, seconds: float) -> Steps:
    """Return the steps that drive for `seconds` at m/s and rad/s (left is +), and then stop.

    The steps raise:
        NotDrivenError: the robot does not follow, with the daemon's reason; or this program paused
            for more than `GRACE_S` between two commands (not zeros at the end).
        NoAnswerError: the daemon is silent, or the connection was closed.

    Raises `UsageError` if an argument is not finite, or `seconds` is not above 0.
    """
    _require(linear=linear, angular=angular, seconds=seconds)
    if seconds <= 0:
        raise UsageError(
            f"seconds = {seconds:g}: a drive needs a time above 0; to drive "
            "backwards, use linear < 0"
        )

    def steps(driver: Driver) -> Generator[Seconds, None, None]:
        ride = driver.ride
        # A short drive that the robot hardly followed is not a success either.
        ride.grace_s = min(GRACE_S, seconds / 2)
        while True:
            driver.step(Twist(linear, angular))
            driver.require()
            left = seconds
            if ride.begun is not None:
                left += ride.begun - clock.steady_s()
            if left <= 0:
                break
            yield min(ride.period, left)
        yield from driver.stop()

    return steps


def move(distance: float, speed: float) -> Steps:
    """Return the steps that drive `distance` m straight ahead (back if negative), by `odom`."""
    _require_course(distance=distance, speed=speed)
    return _course(lambda odom: Straight(odom, distance, speed))


def turn(degrees: float, speed: float) -> Steps:
    """Return the steps that turn by an angle (left is +), at `speed` rad/s, by `odom`."""
    _require_course(degrees=degrees, speed=speed)
    return _course(lambda odom: Turn(odom, math.radians(degrees), speed))


def _course(begin: Callable[[Odometry], Course]) -> Steps:
    # The steps raise the errors of `drive`.
    def steps(driver: Driver) -> Generator[Seconds, None, None]:
        with closing(_Odometer(driver)) as odometer:
            # The odometry behind a new state has all poses that this state counts.
            began, odom, sets = clock.steady_s(), None, None
            while odom is None:
                yield COURSE_PERIOD_S
                driver.take()
                driver.require()
                odom = odometer.newest()
                if sets is None:
                    odom = None
                    sets = driver.poses_set if driver.watch.last_seen > began else None
            course, nearest, nearer, misses = begin(odom), math.inf, odometer.received, 0
            while True:
                if course.is_done:
                    for pause in driver.stop():
                        yield pause
                        odometer.show(course)
                    while not odometer.show(course):  # what came before tells nothing of rest
                        yield COURSE_PERIOD_S
                        driver.take()
                    driver.require_pose(sets)
                    if course.settle():
                        return
                    misses += 1
                    if misses == MAX_MISSES:
                        raise NotDrivenError(
                            f"the robot missed the end {misses} times, and {course.left_text} is "
                            "left: try a lower speed, or limits that the robot can keep"
                        )
                    nearest, nearer = math.inf, clock.steady_s()
                now = clock.steady_s()
                fresh = now - odometer.received < MAX_ODOM_AGE_S
                driver.step(course.twist if fresh else None)
                driver.require()
                driver.require_pose(sets)
                left = abs(course.left)
                if driver.ride.begun is None or left < nearest - min(NEARER * nearest, MOST_NEARER):
                    nearest, nearer = left, now
                elif now - nearer > COURSE_TIMEOUT_S:
                    state = driver.watch.state
                    raise NotDrivenError(
                        f"the robot came no nearer for {COURSE_TIMEOUT_S:g} s, and "
                        f"{course.left_text} is left: {(state and state.wheel_fault) or MAYBE}"
                    )
                yield min(COURSE_PERIOD_S, driver.ride.period)
                odometer.show(course)

    return steps


class _Odometer:
    def __init__(self, driver: Driver) -> None:
        self._driver = driver
        self._samples, self._decoder = driver.robot.subscribe("odom"), Decoder(Odometry)
        self.received = clock.steady_s()
        self.close = self._samples.undeclare

    def newest(self) -> Odometry | None:
        """Return the newest message that has arrived since the last call, or None.

        Raises:
            NotDrivenError: nothing has arrived for some time, because the robot cannot drive.
            NoAnswerError: nothing has arrived, although it can.
        """
        now, odom = clock.steady_s(), None
        while (sample := self._samples.try_recv()) is not None:
            with suppress(DecodeError):
                odom, self.received = self._decoder.decode(*encoded(sample)), now
        if now - self.received > FIRST_STATE_TIMEOUT_S:
            self._driver.require()
            state = self._driver.watch.state
            if state is not None and not can_drive(state):
                raise NotDrivenError(state.why)
            raise NoAnswerError(
                "no odometry arrives, so the way cannot be measured: is rates.odom above 10 Hz?"
            )
        return odom

    def show(self, course: Course) -> bool:
        """Show the newest message to a course, and return whether one has arrived.

        The errors are those of `newest`.
        """
        odom = self.newest()
        if odom is not None:
            course.odom(odom)
        return odom is not None


def repeat_zeros(
    robot: CommandClient, moved_s: Seconds | None = None
) -> Generator[Seconds, None, None]:
    """Send zeros until the `state` shows that the robot has stopped, for at most `MAX_END_S`.

    `moved_s` is the time of the last speed, or None for now. More than `GRACE_S` later, the robot
    may follow another sender: if the state shows that, no zero is sent, which would stop it.
    """
    with suppress(zenoh.ZError, NoAnswerError):  # the connection is closed
        now = clock.steady_s()
        idle_s = 0.0 if moved_s is None else now - moved_s
        driver = Driver(robot)
        driver.ride.moved(now - idle_s)
        try:
            if idle_s > GRACE_S:
                while driver.watch.state is None and clock.steady_s() - now < GRACE_S:
                    yield SEND_PERIOD_S
                    driver.watch.poll(clock.steady_s())
                state = driver.watch.state
                followed = (robot.source, robot.sender)
                if state is not None and (state.source, state.sender) != followed:
                    return
            yield from driver.zeros()
        finally:
            driver.end()


def _require_course(*, speed: float, **way: float) -> None:
    _require(speed=speed, **way)
    if speed <= 0:
        raise UsageError(f"speed = {speed:g}: it must be above 0; the way has the sign")


def _require(**numbers: object) -> None:
    for name, value in numbers.items():
        try:
            finite = isinstance(value, Real) and math.isfinite(value)
        except OverflowError:
            raise UsageError(f"{name}: this number is too large for a speed or a time") from None
        if not finite:
            raise UsageError(f"{name} = {value!r}: it must be a finite number")
