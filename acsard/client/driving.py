"""Sends the commands of one drive of `acsard.client`, and checks that the robot follows them.

The daemon does not answer commands, but says in `state` why the robot does not follow. Then the
drive ends with an error with that reason, and also if this program has sent no command for some
time, because the operator may no longer want the drive.
"""

from __future__ import annotations

import math
from collections.abc import Generator, Iterator
from contextlib import suppress
from numbers import Real
from typing import Protocol

import zenoh

from acsard.client.commander import (
    GRACE_S,
    OPEN_TIMEOUT_S,
    OPENING_PERIOD_S,
    OPENING_S,
    SEND_PERIOD_S,
    lacks_only_commands,
    objection,
    receives_commands,
    refuses_for_good,
)
from acsard.client.final_zeros import MAX_END_S, STANDSTILL, FinalZeros
from acsard.client.follower import MAX_STATE_AGE_S, SETTLED_S, Followed, Watch
from acsard.host import clock
from acsard.host.errors import NoAnswerError, NotDrivenError, UsageError

# After a drive, the speed must fall below `SLOWER` times its lowest value, in each `SLOWS_S`.
SLOWER, SLOWS_S = 0.97, 1.0


CONNECTION_CLOSED = "the connection to the daemon was closed while the robot was driving"


class UnheardError(NotDrivenError):
    """The daemon receives no commands from this client's command source, so the drive has ended."""

    def __init__(self, text: str, *, lacks_only_commands: bool) -> None:
        super().__init__(text)
        self.lacks_only_commands = lacks_only_commands


class CommandClient(Followed, Protocol):
    """The part of a client that `drive` uses."""

    source: str
    sender: str  # public name of this client's sender

    def send(self, linear: float, angular: float = 0.0) -> None:
        """Send one command: `linear` m/s, `angular` rad/s (left is +)."""


def drive(
    robot: CommandClient, linear: float, angular: float, seconds: float
) -> Generator[float, None, None]:
    """Drive for `seconds` at m/s and rad/s (left is +), then send zeros until the robot stands.

    The generator yields the time to wait before resuming it, s. It begins with zeros until the
    daemon accepts the commands.

    Raises:
        NotDrivenError: the robot does not follow, with the daemon's reason; or this program paused
            for more than `GRACE_S` between two commands (not zeros at the end).
        NoAnswerError: the daemon is silent, or the connection was closed.
        UsageError: an argument is not finite, or `seconds` is not above 0.
    """
    _require(linear=linear, angular=angular, seconds=seconds)
    if seconds <= 0:
        raise UsageError(
            f"seconds = {seconds:g}: a drive needs a time above 0; to drive "
            "backwards, use linear < 0"
        )
    checks = _Drive(robot)
    try:
        # Send zeros before each drive, not only before the first one. Since the previous drive, the
        # robot may have been stopped and cleared, or the daemon may have restarted.
        yield from _opening(checks)
        end, grace = clock.steady_s() + seconds, min(GRACE_S, seconds / 2)
        while (left := end - clock.steady_s()) > 0:
            checks.send(linear, angular)
            yield min(SEND_PERIOD_S, left)
            checks.require_no_pause()
            checks.require(grace)
        yield from _stopping(checks)
    finally:
        # Send a zero at the end, even if an exception interrupts the drive. If the connection is
        # closed, this fails, but the exception that ends the drive says so already.
        with suppress(NoAnswerError):
            checks.send(0.0, 0.0)
        checks.watch.end()


def repeat_zeros(robot: CommandClient, idle_s: float = 0.0) -> Generator[float, None, None]:
    """Send zeros until the `state` shows that the robot has stopped, when a drive ends early.

    The generator yields the time to wait, s, and ends after `MAX_END_S` or with the connection.
    `idle_s` after the last command (over `GRACE_S`), the robot may follow another sender: if the
    state shows that, no zero is sent, which would stop it.
    """
    # If the connection is closed, sending raises one of these errors, and subscribing the other.
    with suppress(zenoh.ZError, NoAnswerError):
        if idle_s <= GRACE_S:
            robot.send(0.0, 0.0)
        begun = now = clock.steady_s()
        zeros, watch = FinalZeros(robot.source, robot.sender), Watch(robot, now)
        zeros.drove(now)
        try:
            if idle_s > GRACE_S:
                while watch.state is None and now - begun < GRACE_S:
                    yield SEND_PERIOD_S
                    now = clock.steady_s()
                    list(watch.poll(now))
                state = watch.state
                followed = (robot.source, robot.sender)
                if state is not None and (state.source, state.sender) != followed:
                    return
            while zeros.wanted(now) and now - begun < MAX_END_S:
                yield SEND_PERIOD_S
                robot.send(0.0, 0.0)
                now = clock.steady_s()
                for state in watch.poll(now):
                    zeros.received(state, now)
        finally:
            watch.end()


def _require(**numbers: object) -> None:
    for name, value in numbers.items():
        try:
            finite = isinstance(value, Real) and math.isfinite(value)
        except OverflowError:
            raise UsageError(f"{name}: this number is too large for a speed or a time") from None
        if not finite:
            raise UsageError(f"{name} = {value!r}: it must be a finite number")


def _opening(checks: _Drive) -> Iterator[float]:
    begun = clock.steady_s()
    while (passed := clock.steady_s() - begun) < OPENING_S or checks.objection != "":
        checks.send(0.0, 0.0)
        yield OPENING_PERIOD_S
        checks.require_no_pause()
        checks.process_states()
        if passed >= OPEN_TIMEOUT_S or (passed >= SETTLED_S and checks.refuses_for_good):
            checks.require(0.0)


def _stopping(checks: _Drive) -> Iterator[float]:
    # Also ends after `SLOWS_S` without slowing down: something else moves the robot, or there is no
    # feedback. Raises `NotDrivenError` and `NoAnswerError`.
    begun = since = clock.steady_s()
    watch, slowest = checks.watch, math.inf
    while since + SLOWS_S > (now := clock.steady_s()) or watch.age(now) > MAX_STATE_AGE_S:
        checks.send(0.0, 0.0)
        yield SEND_PERIOD_S
        checks.process_states()
        if checks.refuses_for_good:
            checks.require(0.0)
        if watch.state is None or watch.last_seen < begun + SETTLED_S:
            continue
        linear, angular = watch.state.linear, watch.state.angular
        if linear is None or angular is None:
            # Without feedback from the board, it is unknown whether the robot stands.
            continue
        speed = max(abs(linear) / STANDSTILL[0], abs(angular) / STANDSTILL[1])
        if speed < 1.0:
            return
        if speed < SLOWER * slowest:
            slowest, since = speed, now


class _Drive:
    # Checks, from `state`, whether the robot follows the commands of this client.
    def __init__(self, robot: CommandClient) -> None:
        self._robot = robot
        self.watch = Watch(robot, clock.steady_s())
        # Read the clock again here, because the subscription above may take long.
        self._followed_s = self._last_command_s = clock.steady_s()
        # Why it does not; "" if it does, None before the first state.
        self.objection: str | None = None

    @property
    def refuses_for_good(self) -> bool:
        state = self.watch.state
        return state is not None and refuses_for_good(state, self._robot.source)

    def send(self, linear: float, angular: float) -> None:
        try:
            self._robot.send(linear, angular)
        except zenoh.ZError:
            raise NoAnswerError(CONNECTION_CLOSED) from None

    def require_no_pause(self) -> None:
        # The process may have been stopped, its computer may have been suspended, or the bus may
        # not have accepted the command. The received states cannot reveal such a pause, because old
        # states that waited in the queue seem to arrive now.
        now = clock.steady_s()
        paused, self._last_command_s = now - self._last_command_s, now
        if paused > GRACE_S:
            raise NotDrivenError(
                f"this program sent no command for {paused:.1f} s, so the robot was stopped and "
                "the drive was not finished: was the computer suspended, did something keep the "
                "program from running, or did the network to the daemon fail?"
            )

    def process_states(self) -> None:
        now, watch = clock.steady_s(), self.watch
        try:
            states = watch.poll(now)
        except zenoh.ZError:
            raise NoAnswerError(CONNECTION_CLOSED) from None
        for state in states:
            self.objection = objection(state, self._robot.source, self._robot.sender)
            if not self.objection:
                self._followed_s = now
        if watch.silent(now):
            raise NoAnswerError(
                "the daemon's state cannot be read: does the daemon run another version of acsard "
                "than this program? Use the same version for both"
                if watch.unreadable
                else f"nothing received from the daemon for {watch.silence_timeout_s:g} s: does "
                "the daemon run, and does it have the robot.id that this program uses? `acsard "
                "fleet` lists the robots"
            )

    def require(self, grace: float) -> None:
        """Raise `NotDrivenError` if the robot has not followed for `grace` s, or never will.

        It is an `UnheardError` if the daemon receives nothing from this source.
        """
        self.process_states()
        if not self.objection:
            return
        if self.refuses_for_good or clock.steady_s() - self._followed_s >= grace:
            state = self.watch.state
            source = self._robot.source
            if state is None or receives_commands(state, source):
                raise NotDrivenError(self.objection)
            lacks = lacks_only_commands(state, source)
            raise UnheardError(self.objection, lacks_only_commands=lacks)
