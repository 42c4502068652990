"""Runs a control step in the event loop's callback, as waking a task would cost another round.

The causes: a period has ended (missed ones only count); bytes have come or the port was lost; a
line with a waiting command may be written (`pacing.py`); a command may be there, and an early line
too; a stop, even without an early line, but not each stop of a flood; a signal.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Self

from msgspec import Struct

from acsard.core.values import Ns
from acsard.daemon.pacing import NO_PERIOD, Period
from acsard.host.timerfd import TimerFd


class _Timer:
    def __init__(self, wake: Callable[[], None]) -> None:
        self._wake = wake
        self._timer = TimerFd()

    def __enter__(self) -> Self:
        asyncio.get_running_loop().add_reader(self._timer.fileno(), self._expire)
        return self

    def __exit__(self, *_: object) -> None:
        asyncio.get_running_loop().remove_reader(self._timer.fileno())
        self._timer.close()

    def _expire(self) -> None:
        # A timer that was set again after it had expired reports no expiration.
        if self._timer.expirations():
            self._expired()
            self._wake()

    def _expired(self) -> None:
        # Before `wake`.
        raise NotImplementedError


class Alarm(_Timer):
    """A timer that calls `wake` once."""

    def __init__(self, wake: Callable[[], None]) -> None:
        super().__init__(wake)
        self._at_ns: Ns | None = None

    def set(self, at_ns: Ns | None) -> None:
        """Call `wake` at this time instead of an earlier one; None changes nothing."""
        if at_ns is not None and at_ns != self._at_ns:
            self._timer.set(at_ns)
        self._at_ns = at_ns

    def _expired(self) -> None:
        # The timer may have expired early. Then `set` must accept the same time again.
        self._at_ns = None


class Ticker(_Timer):
    """A timer that calls `wake` at the end of every period; then call `take`."""

    def __init__(self, period_ns: Ns, wake: Callable[[], None]) -> None:
        super().__init__(wake)
        self._period_ns = period_ns
        self._rang = False
        self._due_ns = 0

    def start(self, now_ns: Ns) -> None:
        """Start the first period now."""
        self._due_ns = now_ns + self._period_ns
        self._timer.set(self._due_ns)

    def take(self, now_ns: Ns) -> Period:
        """Return the periods that have ended since the last call, and set the next one."""
        if not self._rang and now_ns < self._due_ns:
            return NO_PERIOD
        late_ns = now_ns - self._due_ns
        if late_ns >= 0:
            expired = late_ns // self._period_ns + 1
        else:
            # `now_ns` is from the daemon's clock. NTP may slew the timer's clock, and the timer
            # then expires up to a tenth of a period early.
            expired = int(-late_ns <= self._period_ns // 10)
        due_ns = self._due_ns
        self._due_ns += expired * self._period_ns
        self._timer.set(self._due_ns)
        self._rang = False
        return Period(expired, due_ns)

    def _expired(self) -> None:
        self._rang = True


class Next(Struct, frozen=True):
    """The events that may run another step before the present period ends."""

    accepts_early_command: bool  # the next command does
    retry_ns: Ns | None  # a step can send the waiting command
    period_ended: bool = True  # the next stop does, because this step was a period's


class Wakeup:
    """Runs a control step whenever the serial port, a timer, the bus or a signal requires one.

    Calling this runs a step in the thread of the event loop, or one more after a running one.
    """

    def __init__(self) -> None:
        self._loop = asyncio.get_running_loop()
        self._step: Callable[[], Next | None] | None = None
        self._over: asyncio.Future[None] | None = None
        self._alarm = Alarm(self)
        self._stepping = self._again = False
        self._accepts_early_command = self._command_arrived = self._stop_pending = False

    def __call__(self) -> None:
        step, over = self._step, self._over
        if self._stepping:
            self._again = True
            return
        if step is None or over is None or over.done():
            return
        self._stepping, self._again, self._command_arrived = True, False, False
        try:
            then = step()
            if then is None:
                over.set_result(None)
            else:
                self._arm(then)
        except BaseException as error:  # noqa: BLE001
            # The event loop would only log the exception, but a bug in a step must end the process.
            over.set_exception(error)
        finally:
            self._stepping = False
        if self._again:
            self._loop.call_soon(self)

    def command(self) -> None:
        """Report a sample that may be a command, from any thread.

        The first runs a step if the last one said `accepts_early_command`.
        """
        self._command_arrived = True
        if self._accepts_early_command:
            self._accepts_early_command = False
            self._from_thread()

    def stop(self) -> None:
        """Report a stop, from any thread.

        The first runs a step; further ones do after a period or `accepts_early_command`.
        """
        if not self._stop_pending:
            self._stop_pending = True
            self._from_thread()

    def _from_thread(self) -> None:
        try:
            self._loop.call_soon_threadsafe(self)
        except RuntimeError:
            pass  # the event loop has closed, so nothing is left to wake

    async def run(self, step: Callable[[], Next | None]) -> None:
        """Run `step` for every event until it returns None. Raises its exception."""
        self._over = self._loop.create_future()
        with self._alarm:
            self._step = step
            try:
                await self._over
            finally:
                self._step = None

    def _arm(self, then: Next) -> None:
        self._alarm.set(then.retry_ns)
        self._accepts_early_command = then.accepts_early_command
        if then.accepts_early_command or then.period_ended:
            self._stop_pending = False
        # A command arrived during the step, perhaps too late for this step. So run another step.
        if then.accepts_early_command and self._command_arrived:
            self._accepts_early_command, self._again = False, True
