"""Collects inputs, calls `step`, carries the outputs. Decides nothing.

Synchronous on purpose: the daemon calls `wake` from one task, the tests call it in virtual time.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Literal, Protocol

from msgspec import Struct

from acsard.drive.kinematics import Kinematics
from acsard.guard import Guard
from acsard.histogram import Histogram
from acsard.messages.encodings import DecodeError
from acsard.messages.incoming import Arrival, Receiver, voice
from acsard.messages.queries import Queries, Query, Reply
from acsard.messages.report import Report
from acsard.messages.schema import Info, Message
from acsard.robot import Robot
from acsard.settings import Config
from acsard.values import (
    Command,
    Event,
    Inputs,
    Instant,
    Outputs,
    Received,
    Refusal,
    Request,
    Snapshot,
)

Offered = Literal["sent", "superseded", "down"]

QUERIES_PER_STEP = 8
"""Replies built in one step; a crowd of questions waits its turn instead of costing a period."""


class Port(Protocol):
    """The serial port as the loop sees it."""

    is_open: bool
    opened: int
    trouble: str

    def take(self) -> tuple[Received, ...]:
        """What was received since the last call."""

    def offer(self, line: bytes, now: Instant) -> Offered:
        """Send the line now or not at all."""


class BusInput(Struct, frozen=True):
    """What came over the bus since the last call."""

    arrivals: tuple[Arrival, ...] = ()
    queries: tuple[Query, ...] = ()
    overrun: int = 0
    """Samples dropped because they came faster than they could be taken."""


class Bus(Protocol):
    """The bus as the loop sees it."""

    @property
    def wanted(self) -> set[str]:
        """Published keys that somebody listens to."""

    def take(self, queries: int) -> BusInput:
        """What came in since the last call, at most so many queries."""

    def publish(self, key: str, message: Message) -> None:
        """Send a message to its listeners."""

    def reply(self, reply: Reply) -> None:
        """Answer a query; the last reply to its number."""

    def done(self, number: int) -> None:
        """No more replies to this query."""


class ControlLoop:
    """One robot between its port and its bus."""

    def __init__(
        self,
        config: Config,
        info: Info,
        port: Port,
        bus: Bus,
        start: Instant,
        log: Callable[[Event], None],
        certificate_ends_ns: int | None = None,
    ) -> None:
        self.robot = Robot(config)
        self.report = Report(config, start, certificate_ends_ns)
        self.lateness_us = Histogram()
        self.leaving = False
        """Set to begin the way down: the robot ramps to zero and stays there."""
        self.outputs: Outputs | None = None
        self._guard = Guard(
            self.robot.session.codec.stop,
            config.limits.wheel_speed,
            config.commands.sources,
            require_check=config.mcu.link_check == "require",
        )
        self._receiver = Receiver(config.joints, Kinematics(config.drive))
        self._queries = Queries(config, info)
        self._port, self._bus, self._log = port, bus, log
        self._superseded = False
        self._trip = ""

    @property
    def at_rest(self) -> bool:
        """The last line said zero, or there is no link to say it on."""
        outputs = self.outputs
        return outputs is not None and not any(outputs.speeds.as_tuple())

    def wake(self, now: Instant, tick: bool, missed: int = 0, late_ns: int = 0) -> Outputs:
        """One step at `now`; `tick` with the period's lateness and how many were missed."""
        counters = self.robot.counters
        if tick:
            self.lateness_us.add(late_ns / 1000)
            if missed:
                counters["missed_periods"] += missed
        commands, refusals, requests = self._from_bus(now)
        port = self._port
        inputs = Inputs(
            now=now,
            tick=tick,
            port_open=port.is_open,
            opened=port.opened,
            port_trouble=port.trouble,
            received=port.take(),
            commands=commands,
            requests=requests,
            refusals=refusals,
            guard_trip=self._trip,
            superseded=self._superseded,
            leaving=self.leaving,
        )
        self._trip = ""
        outputs = self.outputs = self.robot.step(inputs)
        self._send(outputs, now)
        self._publish(outputs)
        return outputs

    def _from_bus(
        self, now: Instant
    ) -> tuple[tuple[Command, ...], tuple[Refusal, ...], tuple[Request, ...]]:
        # Before the first step there is nothing to answer with.
        got = self._bus.take(QUERIES_PER_STEP if self.outputs else 0)
        commands, refusals, requests = [], [], []
        if got.overrun:
            self.robot.counters["bus_overrun"] += got.overrun
        for arrival in got.arrivals:
            if arrival.key == "stop":
                if arrival.put:
                    requests.append(Request("stop"))
                else:
                    refusals.append(Refusal("not_a_put", "stop: a DELETE is not a stop"))
                continue
            try:
                commands.append(self._receiver.command(arrival))
            except DecodeError as error:
                refusals.append(
                    Refusal(
                        error.reason,
                        f"{arrival.key}: {error}",
                        arrival.key.partition("/")[2],
                        voice(arrival),
                        arrival.arrived_ns,
                    )
                )
        for query in got.queries:
            try:
                served = self._queries.serve(query, self._current, self.outputs)
            except DecodeError as error:
                refusals.append(Refusal(error.reason, f"{query.topic}: {error}"))
                served = []
            if isinstance(served, Request):
                requests.append(served)
                continue
            for reply in served:
                self._bus.reply(reply)
            self._bus.done(query.number)
        return tuple(commands), tuple(refusals), tuple(requests)

    def _send(self, outputs: Outputs, now: Instant) -> None:
        line = self._guard.check(outputs)
        self._trip = self._guard.trip
        if line is None:
            self._superseded = self._superseded and not outputs.tick
            return
        offered = self._port.offer(line, now)
        self._superseded = offered != "sent"
        if offered == "sent":
            self._guard.note_sent()
            self.robot.counters["lines_sent"] += 1
        elif offered == "superseded":
            self.robot.counters["lines_superseded"] += 1

    def _publish(self, outputs: Outputs) -> None:
        bus = self._bus
        for key, message in self.report.due(outputs, bus.wanted, self._look):
            bus.publish(key, message)
        for answer in outputs.answers:
            reply = self._queries.answered(answer, outputs.now.wall_ns)
            if reply is not None:
                bus.reply(reply)
                bus.done(reply.number)
        for event in outputs.events:
            self._log(event)

    def _current(self, key: str) -> Message | None:
        return self.report.current(key, self._look)

    def _look(self) -> Snapshot:
        outputs = self.outputs
        now_ns = 0 if outputs is None else outputs.now.mono_ns
        return self.robot.snapshot(now_ns, self.lateness_us.spread())
