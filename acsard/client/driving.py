"""One drive of `acsard.client`: what is sent when, and what `state` says becomes of it.

The daemon tells nobody that his command does not count: it says so in `state`. Whoever drives
therefore follows `state`, and ends with the daemon's own reason when it does not drive him.
"""

from __future__ import annotations

import math
import time
from collections import deque
from collections.abc import Generator, Iterator
from numbers import Real
from typing import Any, Protocol

import zenoh

from acsard.bus.subscription import Subscription, encoded
from acsard.host.errors import NoAnswerError, NotDrivenError, UsageError
from acsard.messages.encodings import DecodeError, Decoder
from acsard.messages.schema import RobotState

SEND_PERIOD_S = 0.05
"""Commands are repeated at 20 Hz: five times within the default timeout."""

OPENING_S, OPENING_PERIOD_S = 0.4, 0.01
"""Zeros at first: for 0.25 s a daemon that never heard us wants to see that they are not late, and
sees it sooner through the jitter of a busy machine the more there are."""

OPENED_S = 2.0
"""By when zeros that count have counted, and whoever else drove has had time to leave."""

NEVER = ("inactive", "stopped", "fault", "leaving")
"""Modes in which no command counts."""

SETTLED_S = 0.2
"""A state that is older than what we did last has come by then."""

GRACE_S = 0.5
"""A drive that does not count for so long, or for half of its time, is over: a held-up sender is
heard again sooner."""

ASK_S, DEAD_S = 0.3, 2.0
"""Without a state for so long it is asked for, since it may be published seldom; without an answer
nobody is there."""

QUIET_S = 2 * ASK_S
"""A state older than this is none to end by."""

STANDS = 0.01, 0.02
"""m/s and rad/s below which it stands."""

SLOWER, SLOWS_S = 0.97, 1.0
"""It still slows down while within so long its speed falls below this share."""


class UnheardError(NotDrivenError):
    """Not one command of ours arrives."""


class Driven(Protocol):
    """What a drive needs of a client."""

    source: str
    sender: str
    """Our name on each command."""

    def send(self, linear: float, angular: float = 0.0) -> None:
        """One command."""

    def subscribe(self, name: str) -> Subscription:
        """The samples of a key."""

    def ask(self, name: str, take: Any) -> None:
        """Have `take` called with the last sample of a key, if it comes."""


def drive(
    robot: Driven, linear: float, angular: float, seconds: float
) -> Generator[float, None, None]:
    """Drive for `seconds` and until it stands, yielding how long to wait before the next step.

    Raises `NotDrivenError` with the daemon's reason when it does not drive us, `NoAnswerError`
    when it is silent, `UsageError` for what is no number, or no time.
    """
    _require(linear=linear, angular=angular, seconds=seconds)
    if seconds <= 0:
        raise UsageError(f"seconds = {seconds:g}: a drive takes a time above 0; back is linear < 0")
    watch = _Watch(robot)
    try:
        # Each time: the robot may have been stopped and cleared, or started, since the last drive.
        yield from _opening(robot, watch)
        end, grace = time.monotonic() + seconds, min(GRACE_S, seconds / 2)
        while (left := end - time.monotonic()) > 0:
            robot.send(linear, angular)
            yield min(SEND_PERIOD_S, left)
            watch.require(grace)
        yield from _stopping(robot, watch)
    finally:
        # Whatever interrupts the drive, the robot is told to stop.
        robot.send(0.0, 0.0)
        watch.end()


def _require(**numbers: object) -> None:
    for name, value in numbers.items():
        try:
            finite = isinstance(value, Real) and math.isfinite(value)
        except OverflowError:
            raise UsageError(f"{name}: so large a number is no speed and no time") from None
        if not finite:
            raise UsageError(f"{name} = {value!r}: it must be a finite number")


def _opening(robot: Driven, watch: _Watch) -> Iterator[float]:
    """Zeros until the daemon follows them."""
    begun = time.monotonic()
    while (passed := time.monotonic() - begun) < OPENING_S or watch.objection != "":
        robot.send(0.0, 0.0)
        yield OPENING_PERIOD_S
        watch.look()
        if passed >= OPENED_S or (passed >= SETTLED_S and watch.hopeless):
            watch.require(0.0)


def _stopping(robot: Driven, watch: _Watch) -> Iterator[float]:
    """Zeros until it stands, or gets no slower: then something else moves it."""
    begun = since = time.monotonic()
    slowest = math.inf
    while since + SLOWS_S > (now := time.monotonic()) or now - watch.heard > QUIET_S:
        robot.send(0.0, 0.0)
        yield SEND_PERIOD_S
        watch.look()
        if watch.hopeless:
            watch.require(0.0)
        if watch.state is None or watch.heard < begun + SETTLED_S:
            continue
        linear, angular = watch.state.linear, watch.state.angular
        if linear is None or angular is None:
            continue  # without feedback nobody knows whether it stands
        speed = max(abs(linear) / STANDS[0], abs(angular) / STANDS[1])
        if speed < 1.0:
            return
        if speed < SLOWER * slowest:
            slowest, since = speed, now


class _Watch:
    """What `state` says of our commands."""

    def __init__(self, robot: Driven) -> None:
        self._robot = robot
        self._decoder = Decoder(RobotState)
        self._states = robot.subscribe("state")
        self._answers: deque[zenoh.Sample] = deque()
        """What was asked for comes on a thread of Zenoh's, which only leaves it here."""
        self._answered = Answers()
        self.state: RobotState | None = None
        self.heard = self._asked = time.monotonic()
        self.objection: str | None = None
        """Why the last state does not drive us; None without one."""
        self._fine = self.heard
        self._unreadable = False

    @property
    def hopeless(self) -> bool:
        """It does not become better by waiting."""
        state = self.state
        return state is not None and (
            state.mode in NEVER or all(one.name != self._robot.source for one in state.sources)
        )

    def look(self) -> None:
        """Take what has come; raises `NoAnswerError` after a long silence."""
        now = time.monotonic()
        try:
            while self._answers:  # first: what comes by itself is later
                self._take(self._answers.popleft(), asked=True)
            while (sample := self._states.try_recv()) is not None:
                self._take(sample, asked=False)
        except zenoh.ZError:
            raise NoAnswerError("the connection was closed while the robot drove") from None
        if now - max(self.heard, self._asked) > ASK_S:
            self._asked = now
            self._robot.ask("state", self._answers.append)
        if now - self.heard > DEAD_S:
            raise NoAnswerError(
                f"no word from the daemon for {DEAD_S:g} s: does it run, with this robot.id?"
                if not self._unreadable
                else "the daemon's state cannot be read: is it of another version?"
            )

    def require(self, grace: float) -> None:
        """Raises `NotDrivenError` when it has not driven us for longer than `grace` s."""
        self.look()
        if not self.objection:
            return
        if self.hopeless or time.monotonic() - self._fine >= grace:
            heard = self.state is None or _heard(self.state, self._robot.source)
            raise (NotDrivenError if heard else UnheardError)(self.objection)

    def end(self) -> None:
        """No more states."""
        self._states.undeclare()

    def _take(self, sample: zenoh.Sample, asked: bool) -> None:
        try:
            state = self._decoder.decode(*encoded(sample))
        except DecodeError:
            self._unreadable = True
            return
        if asked and not self._answered.news(state, self.state):
            if self.state is None:  # the first may be a storage's: another, at once, tells
                self.state, self._asked = state, self.heard
            return
        self.state, self.heard = state, time.monotonic()
        self.objection = objection(state, self._robot.source, self._robot.sender)
        if not self.objection:
            self._fine = self.heard


class Answers:
    """Which answers show that the daemon lives.

    A storage of a router answers too, for a robot that is dead with the last state there was. What
    comes unasked is no storage's, and may be older: clocks are set back.
    """

    def __init__(self) -> None:
        self._last: RobotState | None = None

    def news(self, answer: RobotState, held: RobotState | None) -> bool:
        """It is newer than the state held so far; or, where the robot's clock was set back since
        that came, than the answer before it. What is held already is no news."""
        before, self._last = (held, self._last), answer
        if held is not None and answer.stamp == held.stamp:
            return False
        return any(one is not None and answer.stamp.to_ns() > one.stamp.to_ns() for one in before)


def objection(state: RobotState, source: str, sender: str) -> str:
    """Why the robot does not follow what `sender` sends as `source`, in words; "" when it does."""
    if state.mode in NEVER:
        return state.reason
    ours = next((one for one in state.sources if one.name == source), None)
    if ours is None:
        names = ", ".join(one.name for one in state.sources)
        return f"{source} is not one of commands.sources: {names}"
    if state.mode == "waiting":
        return state.reason
    if not _heard(state, source):
        return f"the daemon hears no command of source {source}"
    if state.source != source:
        return ours.waits_for or state.reason
    if state.mode != "driving":  # its zeros do not count
        return state.reason
    if state.sender in ("", sender):
        return ""
    return f"another program drives as {source}, {state.sender}: until it is silent"


def _heard(state: RobotState, source: str) -> bool:
    """Something comes from this source, be it only late."""
    return any(one.name == source and one.waits_for != "a command" for one in state.sources)
