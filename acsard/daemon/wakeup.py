"""Runs a control step for each of these events, directly in the event loop's callback.

- period: a control period has ended. Missed periods are counted, but get no separate steps.
- bytes: the serial port has received data or was lost.
- retry: the line with a waiting command may be written now (`pacing.py`).
- command: the bus has a sample that may be a command, and `pacing.py` permits an early line.
  Otherwise the sample waits for the next step.
- stop: the bus has a stop, which gets a step even if `pacing.py` permits no early line. In a flood
  of stops, not every stop gets a separate step.
- signal: the shutdown begins.

The step does not run in a task, because waking a task would cost another round of the event loop.
"""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from typing import Self

from msgspec import Struct

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
        """Process the expiration before `wake` is called."""
        raise NotImplementedError


class Alarm(_Timer):
    """A timer that calls `wake` once, at a time that can be changed."""

    def __init__(self, wake: Callable[[], None]) -> None:
        super().__init__(wake)
        self._at_ns: int | None = None

    def set(self, at_ns: int | None) -> None:
        """Call `wake` once, at the monotonic time `at_ns`, ns.

        A new time replaces the earlier one. None leaves an earlier time in force.
        """
        if at_ns is not None and at_ns != self._at_ns:
            self._timer.set(at_ns)
        self._at_ns = at_ns

    def _expired(self) -> None:
        # The timer may have expired early. Then `set` must accept the same time again.
        self._at_ns = None


class Ticker(_Timer):
    """A timer that calls `wake` at the end of every period.

    After each call of `wake`, `take` must be called. It returns how many periods have ended, and
    sets the timer for the next period.
    """

    def __init__(self, period_ns: int, wake: Callable[[], None]) -> None:
        super().__init__(wake)
        self._period_ns = period_ns
        self._rang = False
        self._due_ns = 0

    def start(self, now_ns: int) -> None:
        """Start the timer. The first period begins at the monotonic time `now_ns`, ns."""
        self._due_ns = now_ns + self._period_ns
        self._timer.set(self._due_ns)

    def take(self, now_ns: int) -> Period:
        """Return how many periods have ended since the last call, and when the first of them ended.

        Also set the timer for the next period. `now_ns` is the present monotonic time, ns. If no
        period has ended, `expired` is 0 in the result.
        """
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
    """Result of a step: the events that may run another step before the present period ends."""

    accepts_early_command: bool
    """Whether the next command gets an extra step immediately. If False, the command waits for a
    step that another event runs, such as the end of the period."""
    retry_ns: int | None
    """Monotonic time at which a step can send the waiting command, ns; None if no command waits."""
    period_ended: bool = True
    """Whether the step ran at the end of a period. If so, the next stop gets an extra step
    immediately."""


class Wakeup:
    """Runs a control step whenever the serial port, a timer, the bus or a signal requires one.

    Calling this object runs a step immediately, in the thread of the event loop. If a step is
    running already, another step runs after it.
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
        """Report that the bus has a sample that may be a command. Any thread may call this method.

        If `accepts_early_command` was True in the result of the last step, the first such sample
        runs a step. Every other sample waits for the next step.
        """
        self._command_arrived = True
        if self._accepts_early_command:
            self._accepts_early_command = False
            self._from_thread()

    def stop(self) -> None:
        """Report that the bus has a stop. Any thread may call this method.

        The first stop runs a step. Further stops wait for the next step, so that a flood of stops
        does not run a flood of steps. A stop runs a step again as soon as a period has ended, or a
        step has returned `accepts_early_command` = True.
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
        """Run `step` for every event, until `step` returns None.

        If `step` raises an exception, this method raises the same exception.
        """
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
