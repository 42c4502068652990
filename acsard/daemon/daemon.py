"""Runs the daemon from its start to its end.

It opens the simulator (if configured), the bus and the port, in this order, and runs the control
loop. At the first signal the robot ramps to zero, and a second one cuts that short. Then the port
sends STOP (zeros) and closes, and the bus last. If an exception ends a task, there is no ramp, but
STOP.
"""

from __future__ import annotations

import asyncio
import gc
import os
import signal
import sys
from collections.abc import AsyncIterator, Callable, Coroutine, Iterable, Sequence
from contextlib import AsyncExitStack, ExitStack, asynccontextmanager
from secrets import randbits
from typing import Any, Self

from acsard.bus.certificate_watch import watch_certificates
from acsard.bus.tls_files import expiry_times, require_usable
from acsard.bus.zenoh_sessions import log_from_environment
from acsard.core.config.settings import Config
from acsard.core.incoming.queries import offered_services
from acsard.core.link.codec import Codec
from acsard.core.messages.schema import Info
from acsard.core.robot import Robot
from acsard.core.values import NS_PER_S, Event, Instant, Ns, WallNs
from acsard.daemon.bus.bus import ZenohBus
from acsard.daemon.control_loop import ControlLoop
from acsard.daemon.latch_file import Keeper, LatchFile, new_latches
from acsard.daemon.pacing import NO_PERIOD, Period
from acsard.daemon.publication import Publication
from acsard.daemon.pulse import Pulse
from acsard.daemon.serial.port import SerialPort
from acsard.daemon.serial.simulator_pty import Simulated
from acsard.daemon.supervisor import GATEWAY, PAGE, keep_running
from acsard.host import clock, real_time
from acsard.host.child import end_signals
from acsard.host.logs import Log
from acsard.host.systemd import START_EXTENSION_S, Systemd
from acsard.host.version import version
from acsard.recording.recorder import Recorder

# Longest ramp at the end. Then STOP is sent even if the robot still moves.
MAX_EXIT_RAMP_S = 0.6


class Departure:
    """The daemon's shutdown by signals, of which one during the start cancels the start."""

    def __init__(self, log: Log, wake: Callable[[Instant], None], manager: Systemd) -> None:
        self._log, self._wake, self._manager = log, wake, manager
        self._starting = asyncio.current_task()
        self.begun_ns: Ns | None = None
        self.hurried = False

    def __enter__(self) -> Self:
        loop = asyncio.get_running_loop()
        for number in end_signals():
            loop.add_signal_handler(number, self._signal, number)
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> bool:
        # A signal cancels the start, which is no error.
        return kind is asyncio.CancelledError and self.begun_ns is not None

    def started(self) -> None:
        """Record that the start is complete, so that a signal no longer cancels it."""
        self._starting = None

    def _signal(self, number: signal.Signals) -> None:
        self.hurried = self.begun_ns is not None
        if self.begun_ns is None:
            self.begun_ns = clock.now().mono_ns
            self._manager.stopping()
        self._log.info("signal", signal=number.name, hurried=self.hurried)
        if self._starting is not None:
            # A second signal must not cancel the end of the start.
            self._starting.cancel()
            self._starting = None
        self._wake(clock.now())

    def over(self, now_ns: Ns, at_rest: bool) -> bool:
        """Return whether the daemon may end: after a signal, at rest or after the ramp."""
        if self.begun_ns is None:
            return False
        return at_rest or self.hurried or now_ns - self.begun_ns > MAX_EXIT_RAMP_S * NS_PER_S


# Longest hold of the interpreter lock by another thread; the default, 5 ms, is half a period.
SWITCH_INTERVAL_S = 0.0005

# `tf_static` is repeated, as some subscribers cannot query the last sample of a latched topic.
LATCHED_PERIOD_S = 5.0

# Gets the serial device, and why it is not open, once the start is complete.
Announce = Callable[[str, str], None]


async def run(
    config: Config,
    log: Log,
    announce: Announce,
    gateway: Sequence[str] | None = None,
    page: Sequence[str] | None = None,
) -> None:
    """Run the daemon until a signal ends it. Raises a `MendableError` if it cannot start.

    `gateway` (with `bus.outside`) and `page` are the arguments of child processes, if this daemon
    has to start them.
    """
    pulse = Pulse()
    manager = Systemd(os.environ, os.getpid())
    departure = Departure(log, pulse, manager)
    async with AsyncExitStack() as stack:
        stack.callback(manager.close)
        stack.enter_context(departure)
        log_from_environment()
        sys.setswitchinterval(SWITCH_INTERVAL_S)
        # Ask for real-time priority before the first thread starts. Only this thread then has it:
        # the threads of the bus do not inherit it.
        refused = real_time.request() if config.control.real_time else ""
        totals: dict[str, object] = {}
        stack.callback(lambda: log.info("ended", **totals))  # runs after `totals` is filled
        events, start = list[Event](), clock.now()
        recorder = _recorder(config, events.append, start.wall_ns, stack)
        simulated = stack.enter_context(Simulated(config)) if config.mcu.simulated else None
        keeper = Keeper(new_latches()) if config.mcu.simulated else _latch_file(config, stack)
        path = config.mcu.port if simulated is None else simulated.path
        after = stack.enter_context(ExitStack())
        bus, port = ZenohBus(config, pulse), _port(config, path, pulse, events.append)
        ends = _certificates(config, gateway is not None)
        info = _info(config, path)  # takes a while in a clone: before the port is open
        # Open the bus before the port. If another program uses the robot's id or the address, the
        # daemon must end without touching the port.
        async with _patience(config, log, manager):
            await stack.enter_async_context(bus)
        if simulated is not None:
            simulated.publish_on(bus.output)
        between = stack.enter_context(ExitStack())
        await stack.enter_async_context(port)
        # Read the latches after the bus and the port are open. A second daemon for this robot then
        # ends before it touches the latch file.
        if isinstance(keeper, LatchFile):
            await keeper.start(clock.now())
        robot = Robot(config, keeper.latches)
        publication = Publication(
            robot, bus, info, start, log.event, keeper, recorder, events, ends, randbits(48)
        )
        publication.adopted = lambda adopted: log.use(adopted.log)
        if simulated is not None:
            publication.beside = simulated.current
        control = ControlLoop(robot, port, publication, keeper, start, clock.mono_ns, recorder)
        between.callback(lambda: control.finish(clock.now()))
        after.callback(lambda: control.keep_last_stops(clock.now()))
        stack.callback(lambda: totals.update(control.totals(clock.mono_ns())))
        announce(path, port.trouble)
        if refused:
            log.info("real_time", text=refused)
        manager.ready()
        departure.started()
        served = ((gateway if config.bus.outside else None, GATEWAY), (page, PAGE))
        helpers: list[Coroutine[Any, Any, object]] = [
            keep_running(words, events.append, kind) for words, kind in served if words is not None
        ]
        if ends:
            known = publication.report.certificate_ends
            helpers.append(watch_certificates(config.bus, known, events.append))
        async with _beside([port.keep_open(), _repeat_latched(bus, publication), *helpers]):
            await _control(config, control, departure, pulse, manager)


def _recorder(
    config: Config, log: Callable[[Event], None], wall_ns: WallNs, stack: AsyncExitStack
) -> Recorder | None:
    if not config.record.directory:
        return None
    recorder = Recorder(config, log, wall_ns)
    stack.push(lambda kind, error, trace: recorder.close(error))
    return recorder


def _latch_file(config: Config, stack: AsyncExitStack) -> LatchFile:
    # The stack closes the latch file later than the serial port. A slow disk then cannot delay the
    # last STOP line to the board.
    keeper = LatchFile(config, os.environ)
    stack.callback(keeper.close)
    return keeper


def _port(config: Config, path: str, pulse: Pulse, tell: Callable[[Event], None]) -> SerialPort:
    mcu = config.mcu
    stop = Codec(mcu.wheels, mcu.trailing_comma).stop
    return SerialPort(path, mcu.baud_rate, stop, config.period_ns, pulse, tell)


@asynccontextmanager
async def _beside(helpers: Iterable[Coroutine[Any, Any, object]]) -> AsyncIterator[None]:
    async with asyncio.TaskGroup() as group:
        tasks = [group.create_task(helper) for helper in helpers]
        yield
        for task in tasks:
            task.cancel()


def _certificates(config: Config, ours: bool) -> dict[str, int]:
    # By the keys of `tls.expiry_times`; {} without TLS, or if another process reads them. Raises
    # `MendableError`. `ours`: this daemon starts the TLS gateway.
    bus = config.bus
    if not bus.tls or (bus.outside and not ours and not bus.tls_routers):
        return {}
    if bus.uses_tls:
        require_usable(bus.tls)
    return expiry_times(bus.tls)


async def _control(
    config: Config,
    control: ControlLoop,
    departure: Departure,
    pulse: Pulse,
    manager: Systemd,
) -> None:
    # Let each of the other tasks run once first. This first round is slow, and must end before the
    # first period.
    await asyncio.sleep(0)
    gc.collect()
    gc.freeze()  # the present objects live to the end, so later collections skip them

    def step(now: Instant, period: Period) -> bool:
        control.shutting_down = departure.begun_ns is not None
        _, news, _, _ = control.step(now, period)
        if period is not NO_PERIOD or news.status_changed:
            robot, changed = control.robot, news.status_changed
            manager.step(now.mono_ns, robot.status, robot.applied, changed=changed)
        return not (control.shutting_down and departure.over(now.mono_ns, control.at_rest))

    try:
        await pulse.run(config.period_ns, step, control.pace)
    except BaseException:
        # No more steps feed systemd's watchdog, and ending the daemon may take longer than the
        # watchdog waits. Its SIGABRT would hide the error. After `stopping`, systemd stops the
        # watchdog, and waits for TimeoutStopSec instead.
        manager.stopping()
        manager.status("ending after an error in the daemon")
        raise


@asynccontextmanager
async def _patience(config: Config, log: Log, manager: Systemd) -> AsyncIterator[None]:
    # Nothing in peer mode.
    if config.bus.mode == "peer":
        yield
        return
    why = f"the daemon waits for the Zenoh router at {', '.join(config.bus.connect)}"
    log.info("connecting", text=why)

    async def repeat() -> None:
        while True:
            manager.waiting(why)
            await asyncio.sleep(START_EXTENSION_S / 3)

    task = asyncio.create_task(repeat())
    try:
        yield
    finally:
        task.cancel()


async def _repeat_latched(bus: ZenohBus, publication: Publication) -> None:
    while True:
        bus.output.publish("tf_static", publication.report.tf_static())
        await asyncio.sleep(LATCHED_PERIOD_S)


def _info(config: Config, path: str) -> Info:
    return Info(
        id=config.robot.id,
        version=version(),
        pid=os.getpid(),
        port=path,
        simulated=config.mcu.simulated,
        rate=config.rate_hz,
        listen=list(config.bus.listening),
        connect=list(config.bus.connect),
        services=offered_services(),
    )
