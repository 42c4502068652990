"""Sorts what the bus received since the last wake-up: commands, requests, samples and limits.

A message that cannot be decoded becomes a refusal, which the robot counts by its reason. A query
that needs no decision of the robot is answered at once.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from typing import NamedTuple

from acsard.core.codes import RefusalCode
from acsard.core.config.settings import Config
from acsard.core.incoming.bus_interface import GATEWAY_KEY as GATEWAY
from acsard.core.incoming.bus_interface import (
    NO_INPUT,
    Bus,
    GatewayFollower,
    RouterFollower,
)
from acsard.core.incoming.commands import (
    Arrival,
    Receiver,
    caller_name,
    claimed_identity,
    decode_limit,
    parts,
)
from acsard.core.incoming.imu import GyroFollower
from acsard.core.incoming.queries import Query
from acsard.core.messages.encodings import DecodeError
from acsard.core.messages.keys_and_roles import IMU, SPEED_LIMIT, STOP
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import Announcement, Command, Event, GyroSample, Refusal, Request, SpeedCap

# Queries of a wake-up, beside one slow one (`set`, ROS parameters). More wait, so that a flood
# costs no period.
QUERIES_PER_STEP = 8

BUS_STUCK = Event(
    "bus_stuck",
    "the Zenoh bus accepts no messages from the daemon; the daemon goes on driving the robot",
    "warning",
)

Serve = Callable[[Query, list[Refusal]], Request | None]  # None: answered


class FromBus(NamedTuple):
    """The fields of `Heard` that come from the bus."""

    commands: tuple[Command, ...] = ()
    refusals: tuple[Refusal, ...] = ()
    requests: tuple[Request, ...] = ()
    gyro: tuple[GyroSample, ...] = ()
    speed_cap: SpeedCap | None = None
    announced: tuple[Announcement, ...] = ()


NOTHING = FromBus()


class Intake:
    def __init__(
        self,
        config: Config,
        bus: Bus,
        events: list[Event],
        certificate_ends: dict[str, int],
        run: int,
    ) -> None:
        # `events` collects those of other parts, which the next wake-up logs.
        self.counters: Counter[str] = Counter()  # beside those of the robot
        self.routers = RouterFollower()
        self.events = events
        self._bus, self._certificate_ends = bus, certificate_ends
        self._receiver = Receiver(config.joint_names, Kinematics(config.drive), run)
        self._gateway, self._imu = GatewayFollower(), GyroFollower(config.mcu.simulated)
        self._top_speed = config.limits.linear_speed  # at the start
        self._began = False
        self._batch = NO_INPUT  # of the present wake-up

    def take(self, serve: Serve) -> FromBus:
        # Before the first wake-up the robot knows nothing with which to answer queries. The bus
        # then returns at most one slow query, which only the robot answers.
        batch = self._batch = self._bus.take(QUERIES_PER_STEP if self._began else 0)
        self._began = True
        if batch is NO_INPUT:
            return NOTHING
        commands: list[Command] = []
        refusals: list[Refusal] = []
        requests: list[Request] = []
        gyro: list[GyroSample] = []
        speed_cap: SpeedCap | None = None
        if batch.overrun:
            self.counters["bus_overrun"] += batch.overrun
        for arrival in batch.arrivals:
            try:
                if arrival.key == STOP:
                    requests.append(_stop(arrival))
                elif arrival.key == IMU:
                    sample = self._imu.receive(arrival, self.counters, self.events)
                    gyro += [] if sample is None else [sample]
                elif arrival.key == SPEED_LIMIT:
                    speed_cap = decode_limit(arrival, self._top_speed)
                elif arrival.key == GATEWAY:
                    ends_ns = self._gateway.receive(arrival, self.counters)
                    if ends_ns:
                        self._certificate_ends[""] = ends_ns
                else:
                    commands.append(self._receiver.command(arrival))
            except DecodeError as error:
                refusals.append(_refusal(arrival, error.reason, f"{arrival.key}: {error}"))
        for arrival in batch.displaced:
            source = parts(arrival.key)[1]
            text = f"source {source}: too many commands came at once, and the oldest were dropped"
            refusals.append(_refusal(arrival, "displaced", text))
        for query in batch.queries:
            request = serve(query, refusals)
            if request is not None:
                requests.append(request)
        return FromBus(
            tuple(commands),
            tuple(refusals),
            tuple(requests),
            tuple(gyro),
            speed_cap,
            batch.announced,
        )

    def taken_stops(self) -> list[str]:
        """Return the clients whose stops the present wake-up has taken."""
        # A call of `srv/stop` counts, because the inbox adds a stop for it.
        return [
            caller_name(arrival.via, arrival.attachment, arrival.sender)
            for arrival in self._batch.arrivals
            if arrival.key == STOP and arrival.put
        ]

    def last_stops(self) -> list[str]:
        """Return the clients whose stops came after the last wake-up."""
        self._batch = self._bus.take(0)
        return self.taken_stops()

    def look(self) -> None:
        """Count what the bus has lost, and note its routers; call this ten times a second."""
        health = self._bus.look()
        if health.dropped:
            self.counters["bus_dropped"] += health.dropped
        if health.routers is not None:
            self.routers.receive(health.routers, self.counters, self.events)
        if health.stuck:
            self.counters["bus_stuck"] += 1
            self.events.append(BUS_STUCK)


def _stop(arrival: Arrival) -> Request:
    if not arrival.put:
        raise DecodeError("not_a_put", "send a PUT, not a DELETE")
    by = caller_name(arrival.via, arrival.attachment, arrival.sender)
    return Request("stop", asked_ns=arrival.arrived_ns, by=by)


def _refusal(arrival: Arrival, code: RefusalCode, text: str) -> Refusal:
    if arrival.key in (STOP, SPEED_LIMIT):
        return Refusal(code, text)
    sender = claimed_identity(arrival).sender
    return Refusal(code, text, parts(arrival.key)[1], sender, arrival.arrived_ns)
