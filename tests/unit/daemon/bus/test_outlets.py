"""Tests of the outlets, through which the control loop publishes on the bus.

The loop never waits, and an outlet sends only the newest value.
"""

from __future__ import annotations

import threading
import time
from collections import deque
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest
import zenoh

from acsard.core.config.settings import Config
from acsard.core.messages.schema import Twist, Vector3
from acsard.daemon.bus.bus import ZenohBus
from acsard.daemon.bus.outlets import BLOCKED_AFTER_NS, SLOT_MESSAGES, Outlets
from acsard.host import clock
from tests.scenarios.world import MemoryBus, World

TOPIC, KEY = "cmd_vel_out", "acsard/acsar/cmd_vel_out"
WAIT_S = 5.0


class Publisher:
    """A publisher with a subscriber, whose put blocks until `free` is set."""

    matching_status = SimpleNamespace(matching=True)

    def __init__(self, error: Exception | None = None) -> None:
        self.free, self.entered, self.error = threading.Event(), threading.Event(), error
        self.sent: list[float] = []

    def declare_matching_listener(self, callback: object) -> object:
        return callback

    def put(self, payload: bytes) -> None:
        self.entered.set()
        assert self.free.wait(WAIT_S)
        if self.error:
            raise self.error
        self.sent.append(msgspec.msgpack.decode(payload, type=Twist).linear.x)

    def declare_publisher(self, key: str, **options: Any) -> Publisher:
        """Return this publisher, as a Zenoh session does for its only key."""
        return self


class Waker:
    """A control loop that nothing wakes."""

    def command(self) -> None:
        """Ignore the command."""

    def stop(self) -> None:
        """Ignore the stop."""


def started(publisher: Publisher) -> Outlets:
    outlets = Outlets([])
    outlets.declare(cast(zenoh.Session, publisher), TOPIC, KEY, "msgpack", "")
    outlets.start()
    return outlets


def publish(outlets: Outlets, number: float) -> None:
    outlets.publish(TOPIC, Twist(Vector3(x=number), Vector3()))
    outlets.flush()


def test_messages_are_sent_in_order_while_the_bus_accepts_them() -> None:
    publisher = Publisher()
    publisher.free.set()
    outlets = started(publisher)
    for number in range(SLOT_MESSAGES):
        publish(outlets, number)
    outlets.stop(WAIT_S)
    assert publisher.sent == list(range(SLOT_MESSAGES))
    assert outlets.losses(clock.mono_ns()) == (0, False)


def test_while_the_bus_blocks_the_newest_messages_wait_and_the_others_are_counted() -> None:
    publisher = Publisher()
    outlets = started(publisher)
    publish(outlets, 0)
    assert publisher.entered.wait(WAIT_S)
    for number in range(1, 101):
        publish(outlets, number)
    assert outlets.losses(clock.mono_ns())[0] == 100 - SLOT_MESSAGES
    publisher.free.set()
    outlets.stop(WAIT_S)
    assert publisher.sent == [0, *range(101 - SLOT_MESSAGES, 101)]


def test_a_blocked_bus_is_reported_once_for_each_time_that_it_blocks() -> None:
    publisher = Publisher()
    outlets = started(publisher)
    publish(outlets, 0)
    assert publisher.entered.wait(WAIT_S)
    now_ns = clock.mono_ns()
    reports = [
        outlets.losses(now_ns + late_ns)[1]
        for late_ns in (0, BLOCKED_AFTER_NS + 1, 2 * BLOCKED_AFTER_NS)
    ]
    assert reports == [False, True, False]
    publisher.free.set()
    outlets.stop(WAIT_S)
    assert outlets.losses(now_ns + 3 * BLOCKED_AFTER_NS) == (0, False)


def test_an_error_of_the_thread_ends_the_control_loop() -> None:
    publisher = Publisher(ValueError("a bug"))
    publisher.free.set()
    bus = ZenohBus(Config(), Waker())
    bus._outlets.declare(cast(zenoh.Session, publisher), TOPIC, KEY, "msgpack", "")
    bus._outlets.start()
    bus.publish(TOPIC, Twist(Vector3(), Vector3()))
    bus.flush()
    bus._outlets.stop(WAIT_S)
    with pytest.raises(ValueError, match="a bug"):
        bus.flush()


class SlowPublisher(Publisher):
    """A publisher whose put takes 20 ms of the clock `now_ns`."""

    now_ns = 0

    def put(self, payload: bytes) -> None:
        self.now_ns += 20_000_000


class OutletBus(MemoryBus):
    """A bus in memory that sends `odom` through real outlets, and waits until it is sent."""

    def __init__(self, publisher: Publisher) -> None:
        super().__init__({"odom"})
        self.errors: list[BaseException] = []
        self.outlets = Outlets(self.errors)
        self.outlets.declare(cast(zenoh.Session, publisher), "odom", "odom", "msgpack", "")
        self.outlets.start()

    @property
    def feedback_delays(self) -> deque[tuple[int, int]]:
        return self.outlets.feedback_delays

    @feedback_delays.setter
    def feedback_delays(self, value: object) -> None: ...

    def publish(self, *arguments: Any) -> None:
        self.outlets.publish(*arguments)
        self.outlets.flush()
        deadline_s = time.monotonic() + WAIT_S
        while self.outlets._slots["odom"].waiting or self.outlets._began_ns is not None:
            assert time.monotonic() < deadline_s, self.errors
            time.sleep(0.0005)


def test_the_delay_of_feedback_includes_sending_it(monkeypatch: pytest.MonkeyPatch) -> None:
    publisher, world = SlowPublisher(), World()
    monkeypatch.setattr(clock, "mono_ns", lambda: world.now_ns + publisher.now_ns)
    world.bus = world.loop._bus = bus = OutletBus(publisher)
    world.run(0.2)
    bus.outlets.stop(WAIT_S)
    bus.wanted_keys.clear()
    world.run(0.02)
    delay = world.loop._stopwatch.measured(world.now_ns)["feedback_to_bus"].since_start
    assert delay.count >= 15
    assert delay.p50 >= 20_000
