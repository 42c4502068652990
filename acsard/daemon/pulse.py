"""Runs a control step when the kernel, the bus or the serial port requires one.

The event loop watches an interval timer for the periods, an eventfd that Zenoh's threads write, and
a timer for an early line (`pacing.py`). A step runs in its callback, as waking a task would cost
another round. Missed periods only count: they are never made up.
"""

from __future__ import annotations

import asyncio
import os
from collections.abc import Callable

from acsard.core.values import Instant, Ns
from acsard.daemon.pacing import NO_PERIOD, Pace, Period
from acsard.host import clock
from acsard.host.timerfd import TimerFd

# Gets the time and the periods that have ended; returns whether the daemon goes on.
StepFunction = Callable[[Instant, Period], bool]


class Pulse:
    """Wakes the control loop. Calling it with the time runs a step, in the event loop's thread."""

    def __init__(self) -> None:
        # Never closed: a thread of Zenoh may write until the process ends, and a closed descriptor
        # may be another file by then.
        self._bell = os.eventfd(0, os.EFD_NONBLOCK | os.EFD_CLOEXEC)
        self._periods, self._alarm = TimerFd(), TimerFd()
        self._period_ns = self._due_ns = 0  # the latter by the timer's clock
        self._next_ns = 0  # about the same time by the daemon's clock
        self._alarm_ns: Ns | None = None
        self._step: StepFunction | None = None  # None: none may run now
        self._pace: Pace
        self._over: asyncio.Future[None]
        self._early = self._command_waits = self._stop_waits = False

    async def run(self, period_ns: Ns, step: StepFunction, pace: Pace) -> None:
        """Run `step` at the end of each period, and between, until it returns False.

        After each step, `pace` says which events may run another one before the period ends.
        """
        loop = asyncio.get_running_loop()
        self._over, self._step, self._period_ns = loop.create_future(), step, period_ns
        self._pace = pace
        callbacks = {
            self._periods.fileno(): self._period_ended,
            self._bell: self._rung,
            self._alarm.fileno(): self._alarmed,
        }
        for fd, callback in callbacks.items():
            loop.add_reader(fd, callback)
        self._due_ns = self._periods.repeat(period_ns)
        self._next_ns = clock.mono_ns() + period_ns
        try:
            await self._over
        finally:
            self._step = None
            for fd in callbacks:
                loop.remove_reader(fd)
            self._periods.close()
            self._alarm.close()

    def _period_ended(self) -> None:
        now = clock.now()
        period = self._ended(now)
        # A step for another event may have counted the period.
        if period is not NO_PERIOD:
            self(now, period)

    def _ended(self, now: Instant) -> Period:
        expired = self._periods.expirations()
        if not expired:
            return NO_PERIOD
        due_ns = now.mono_ns - (clock.timer_ns() - self._due_ns)
        ended_ns = expired * self._period_ns
        self._due_ns += ended_ns
        self._next_ns = due_ns + ended_ns
        return Period(expired, due_ns)

    def _rung(self) -> None:
        os.eventfd_read(self._bell)
        self(clock.now())

    def _alarmed(self) -> None:
        # A timer that was set again after it had expired reports no expiration.
        if self._alarm.expirations() and self._alarm_ns is not None:
            self._alarm_ns = None
            self(clock.now())

    def __call__(self, now: Instant, period: Period = NO_PERIOD) -> None:
        step = self._step
        if step is None:
            # During a step, such as for a port that it has found lost, before the first one or
            # after the last.
            return
        if period is NO_PERIOD and now.mono_ns >= self._next_ns:
            # After a stall, the periods that have ended meanwhile count before this event.
            period = self._ended(now)
        self._step, self._command_waits = None, False
        try:
            if not step(now, period):
                self._over.set_result(None)
                return
        except BaseException as error:  # noqa: BLE001
            # A bug in a step must end the process: as an error of `run`, which the daemon reports.
            self._over.set_exception(error)
            return
        pace = self._pace
        self._step, retry_ns = step, pace.retry_ns
        if retry_ns != self._alarm_ns:
            self._alarm_ns = retry_ns
            if retry_ns is not None:
                self._alarm.set(retry_ns)
        self._early = early = pace.early
        if early or period is not NO_PERIOD:
            self._stop_waits = False
        if early and self._command_waits:
            self.command()  # it arrived during the step, perhaps too late for it

    # Any thread may call the methods below.

    def command(self) -> None:
        """Report a sample that may be a command. The first runs a step if `Pace.early`."""
        self._command_waits = True
        if self._early:
            self._early = False
            os.eventfd_write(self._bell, 1)

    def stop(self) -> None:
        """Report a stop. The first runs a step, further ones after a period or `Pace.early`."""
        if not self._stop_waits:
            self._stop_waits = True
            os.eventfd_write(self._bell, 1)
