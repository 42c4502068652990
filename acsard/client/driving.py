"""One drive of `acsard.client`: the commands that are sent, and the check that the robot follows.

The daemon does not answer commands; it reports in `state` why a command does not count. A drive
therefore follows `state`, and ends with the daemon's own reason if the robot does not follow it.
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
"""Pause between two commands, s: 20 Hz, so five commands within the default timeout."""

OPENING_S, OPENING_PERIOD_S = 0.4, 0.01
"""Duration and period of the zeros at the beginning, s. A daemon to which the client is new
checks for 0.25 s that the commands are not late. More zeros let it decide sooner despite the
jitter of a busy machine.
"""

OPENED_S = 2.0
"""Time after which zeros must count, s. It also gives another driver time to leave."""

NEVER = ("inactive", "stopped", "fault", "leaving")
"""Modes in which no command counts."""

SETTLED_S = 0.2
"""Time after an action, s, by which a state from before the action has arrived."""

GRACE_S = 0.5
"""Longest time, s, that a drive may not count before it ends; half of the drive's duration if
that is shorter. A sender that was only delayed counts again sooner.
"""

ASK_S, DEAD_S = 0.3, 2.0
"""Time without a state, s, after which the client queries it, since `state` may be published
seldom; and time without any answer after which the daemon counts as dead.
"""

QUIET_S = 2 * ASK_S
"""Age, s, above which a state is too old to end a drive by."""

STANDS = 0.01, 0.02
"""Speeds, m/s and rad/s, below which the robot counts as standing."""

SLOWER, SLOWS_S = 0.97, 1.0
"""The robot is still slowing down if its speed falls below this share within this time, s."""


class UnheardError(NotDrivenError):
    """No command of this client arrives at the daemon."""


class Driven(Protocol):
    """Interface of a client as a drive uses it."""

    source: str
    sender: str
    """Public name of this client, which each of its commands carries."""

    def send(self, linear: float, angular: float = 0.0) -> None:
        """Send one command."""

    def subscribe(self, name: str) -> Subscription:
        """Subscribe to a key."""

    def ask(self, name: str, take: Any) -> None:
        """Query a key, and call `take` with the reply, if one comes."""


def drive(
    robot: Driven, linear: float, angular: float, seconds: float
) -> Generator[float, None, None]:
    """Drive for `seconds` and then until the robot stands; yield each pause between steps, s.

    Raises:
        NotDrivenError: The robot does not follow; the text is the daemon's reason.
        NoAnswerError: The daemon is silent.
        UsageError: An argument is not a finite number, or `seconds` is not above 0.
    """
    _require(linear=linear, angular=angular, seconds=seconds)
    if seconds <= 0:
        raise UsageError(f"seconds = {seconds:g}: a drive takes a time above 0; back is linear < 0")
    watch = _Watch(robot)
    try:
        # Send the zeros before each drive: since the last one, the robot may have been stopped and
        # cleared, or restarted.
        yield from _opening(robot, watch)
        end, grace = time.monotonic() + seconds, min(GRACE_S, seconds / 2)
        while (left := end - time.monotonic()) > 0:
            robot.send(linear, angular)
            yield min(SEND_PERIOD_S, left)
            watch.require(grace)
        yield from _stopping(robot, watch)
    finally:
        # Send a zero at the end, even if an exception interrupts the drive.
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
    """Send zeros until the daemon follows them."""
    begun = time.monotonic()
    while (passed := time.monotonic() - begun) < OPENING_S or watch.objection != "":
        robot.send(0.0, 0.0)
        yield OPENING_PERIOD_S
        watch.look()
        if passed >= OPENED_S or (passed >= SETTLED_S and watch.hopeless):
            watch.require(0.0)


def _stopping(robot: Driven, watch: _Watch) -> Iterator[float]:
    """Send zeros until the robot stands, or becomes no slower because something else moves it."""
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
            # Without feedback, it is unknown whether the robot stands.
            continue
        speed = max(abs(linear) / STANDS[0], abs(angular) / STANDS[1])
        if speed < 1.0:
            return
        if speed < SLOWER * slowest:
            slowest, since = speed, now


class _Watch:
    """The daemon's `state`, and its verdict on the commands of this client."""

    def __init__(self, robot: Driven) -> None:
        self._robot = robot
        self._decoder = Decoder(RobotState)
        self._states = robot.subscribe("state")
        self._answers: deque[zenoh.Sample] = deque()
        """Replies to queries. A thread of Zenoh appends them here and does nothing else."""
        self._answered = Answers()
        self.state: RobotState | None = None
        self.heard = self._asked = time.monotonic()
        self.objection: str | None = None
        """Why the robot does not follow, by the last state; "" if it does, None without a state."""
        self._fine = self.heard
        self._unreadable = False

    @property
    def hopeless(self) -> bool:
        """True if waiting cannot help."""
        state = self.state
        return state is not None and (
            state.mode in NEVER or all(one.name != self._robot.source for one in state.sources)
        )

    def look(self) -> None:
        """Take the states that have arrived; raise `NoAnswerError` after a long silence."""
        now = time.monotonic()
        try:
            # Replies come first, because a published state is newer.
            while self._answers:
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
        """Raise `NotDrivenError` if the robot has not followed for longer than `grace` s."""
        self.look()
        if not self.objection:
            return
        if self.hopeless or time.monotonic() - self._fine >= grace:
            heard = self.state is None or _heard(self.state, self._robot.source)
            raise (NotDrivenError if heard else UnheardError)(self.objection)

    def end(self) -> None:
        """Unsubscribe from `state`."""
        self._states.undeclare()

    def _take(self, sample: zenoh.Sample, asked: bool) -> None:
        try:
            state = self._decoder.decode(*encoded(sample))
        except DecodeError:
            self._unreadable = True
            return
        if asked and not self._answered.news(state, self.state):
            # The first reply may come from a router's storage. Query again at once to find out.
            if self.state is None:
                self.state, self._asked = state, self.heard
            return
        self.state, self.heard = state, time.monotonic()
        self.objection = objection(state, self._robot.source, self._robot.sender)
        if not self.objection:
            self._fine = self.heard


class Answers:
    """Tells which replies prove that the daemon is alive.

    A router's storage also replies, for a dead robot with its last state. A state that arrives
    unqueried never comes from a storage, but it may be older, because a clock can be set back.
    """

    def __init__(self) -> None:
        self._last: RobotState | None = None

    def news(self, answer: RobotState, held: RobotState | None) -> bool:
        """Return whether the reply is newer than the held state, or than the reply before it.

        The second case covers a robot whose clock was set back since the held state arrived. A
        reply equal to the held state is not news.
        """
        before, self._last = (held, self._last), answer
        if held is not None and answer.stamp == held.stamp:
            return False
        return any(one is not None and answer.stamp.to_ns() > one.stamp.to_ns() for one in before)


def objection(state: RobotState, source: str, sender: str) -> str:
    """Return why the robot does not follow the commands of `sender` as `source`; "" if it does."""
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
    # The robot is `ready`: the zeros of this client arrive, but they do not count.
    if state.mode != "driving":
        return state.reason
    if state.sender in ("", sender):
        return ""
    return f"another program drives as {source}, {state.sender}: until it is silent"


def _heard(state: RobotState, source: str) -> bool:
    """Return whether any command of this source arrives, even if it is late."""
    return any(one.name == source and one.waits_for != "a command" for one in state.sources)
