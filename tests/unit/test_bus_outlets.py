"""What the daemon puts on the bus, and the routers to which it is linked."""

from __future__ import annotations

import threading
import time
from collections.abc import Callable
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest
import zenoh
from msgspec.structs import replace

from acsard.core.config.settings import AccessConfig, BusConfig, Config
from acsard.core.messages.frames import EXAMPLE, FeedbackTopic
from acsard.core.messages.schema import Beat, Twist, Vector3
from acsard.core.values import NS_PER_S, Estimate
from acsard.daemon.bus.bus import ZenohBus
from acsard.daemon.bus.outlets import (
    BLOCKED_AFTER_NS,
    MAX_DIRECT,
    SLOT_MESSAGES,
    SLOW_PUT_NS,
    Outlets,
)
from acsard.daemon.bus.router_links import unreached
from acsard.host import clock
from tests.each import each

TOPIC, KEY = "cmd_vel_out", "acsard/acsar/cmd_vel_out"
WAIT_S = 5.0


class Publisher:
    """A publisher with a subscriber, whose put blocks until `free` is set."""

    matching_status = SimpleNamespace(matching=True)

    def __init__(self, error: Exception | None = None) -> None:
        self.free, self.entered, self.error = threading.Event(), threading.Event(), error
        self.sent: list[float] = []
        self.threads, self.thread = set[int](), 0
        """Threads that put, and the last of them."""
        self.takes_s = 0.0

    def declare_matching_listener(self, callback: object) -> object:
        return callback

    def put(self, payload: bytes) -> None:
        self.threads.add(threading.get_ident())
        self.thread = threading.get_ident()
        self.entered.set()
        assert self.free.wait(WAIT_S)
        time.sleep(self.takes_s)
        if self.error:
            raise self.error
        self.sent.append(msgspec.msgpack.decode(payload, type=Twist).linear.x)

    def declare_publisher(self, key: str, **options: Any) -> Publisher:
        """Return this publisher, as a Zenoh session does for its only key."""
        return self


def wait_until(condition: Callable[[], bool]) -> None:
    deadline_s = time.monotonic() + WAIT_S
    while not condition():
        assert time.monotonic() < deadline_s
        time.sleep(0.0005)


WAKER: Any = SimpleNamespace(command=lambda: None, stop=lambda: None)


def started(publisher: Publisher) -> Outlets:
    outlets = Outlets([])
    outlets.declare(cast(zenoh.Session, publisher), TOPIC, KEY, "msgpack", "")
    outlets.start()
    return outlets


def publish(outlets: Outlets, number: float) -> None:
    outlets.publish(TOPIC, Twist(Vector3(x=number), Vector3()))
    outlets.flush()


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
    bus = ZenohBus(Config(), WAKER)
    bus._outlets.declare(cast(zenoh.Session, publisher), TOPIC, KEY, "msgpack", "")
    bus._outlets.start()
    bus.publish(TOPIC, Twist(Vector3(), Vector3()))
    bus.flush()
    bus._outlets.stop(WAIT_S)
    with pytest.raises(ValueError, match="a bug"):
        bus.flush()


def estimate(number: float, heard_ns: int = 0) -> Estimate:
    return replace(EXAMPLE, pose=replace(EXAMPLE.pose, x=float(number)), heard_ns=heard_ns)


# The stamp is before 1970, so the message goes the ordinary way.
ODOM = FeedbackTopic(
    "odom", lambda estimate: Twist(Vector3(x=estimate.pose.x), Vector3()), lambda _: (0, 0)
)


@pytest.mark.parametrize(
    ("config", "direct"),
    [
        (Config(), True),
        (Config(bus=BusConfig(connect=("tls/192.0.2.1:7447",))), False),
        (Config(bus=BusConfig(mode="client", connect=("tcp/127.0.0.1:7447",))), False),
        (Config(bus=BusConfig(insecure=True)), False),
        (Config(access=AccessConfig(wildcards=True)), False),
    ],
)
def test_the_control_loop_sends_feedback_itself_only_if_all_clients_use_exact_keys(
    config: Config, direct: bool
) -> None:
    assert ZenohBus(config, WAKER)._outlets._direct == direct


class Feedback:
    """Outlets for a feedback topic, as the control loop uses them."""

    def __init__(self, publisher: Publisher, *, direct: bool = True) -> None:
        self.publisher, self.outlets = publisher, Outlets([], direct=direct)
        self.outlets.declare(cast(zenoh.Session, publisher), "odom", "odom", "msgpack", "")
        self.outlets.start()

    @property
    def idle(self) -> bool:
        """Whether the thread has sent everything."""
        return self.outlets._began_ns is None and not self.outlets._slots["odom"].waiting

    def heard(self, *numbers: float) -> None:
        """Publish the messages of these feedback lines, as one control step does."""
        for number in numbers:
            self.outlets.publish_feedback(ODOM, estimate(number))
        self.outlets.flush()


class Puts:
    """The clock of the outlets, by which each put takes `took_ns`, on a busy machine too."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.took_ns, self._now_ns = 0, 0
        monkeypatch.setattr("acsard.daemon.bus.outlets.clock", self)

    def mono_ns(self) -> int:
        self._now_ns += self.took_ns
        return self._now_ns


def test_after_a_slow_put_the_thread_sends_feedback_until_it_is_fast_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    puts, feedback = Puts(monkeypatch), Feedback(publisher := Publisher())
    publisher.free.set()
    puts.took_ns = 2 * SLOW_PUT_NS
    feedback.heard(1)
    assert publisher.threads == {threading.get_ident()}
    for number in (2, 3):
        feedback.heard(number)
        wait_until(lambda: feedback.idle)
        assert publisher.thread != threading.get_ident()
    puts.took_ns = 0
    feedback.heard(4)
    wait_until(lambda: feedback.idle)
    feedback.heard(5)
    assert publisher.thread == threading.get_ident()
    feedback.outlets.stop(WAIT_S)
    assert publisher.sent == [1, 2, 3, 4, 5]


def test_the_lines_that_waited_during_a_stall_are_left_to_the_thread_and_not_overtaken() -> None:
    feedback = Feedback(publisher := Publisher())
    feedback.heard(*range(MAX_DIRECT + 1))
    assert publisher.entered.wait(WAIT_S)
    feedback.heard(100)
    publisher.free.set()
    feedback.outlets.stop(WAIT_S)
    assert publisher.sent == [*range(MAX_DIRECT + 1), 100]
    assert threading.get_ident() not in publisher.threads


@pytest.mark.parametrize("direct", [True, False])
def test_the_delay_of_feedback_includes_sending_it(direct: bool) -> None:
    feedback, delays = Feedback(publisher := Publisher(), direct=direct), list[int]()
    publisher.free.set()
    publisher.takes_s = 0.02
    feedback.outlets.feedback_sent = delays.append
    feedback.outlets.publish_feedback(ODOM, estimate(1, clock.mono_ns()))
    feedback.outlets.flush()
    feedback.outlets.stop(WAIT_S)
    assert len(delays) == 1
    assert 0.02 * NS_PER_S <= delays[0] < 1.0 * NS_PER_S


def test_a_beat_is_sent_by_the_control_loop_itself_unless_a_put_was_slow(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    puts, publisher, sent = Puts(monkeypatch), Publisher(), list[tuple[Beat, bool]]()
    outlets = Outlets([], direct=True)

    def put(payload: bytes) -> None:
        beat = msgspec.msgpack.decode(payload, type=Beat)
        sent.append((beat, threading.current_thread() is threading.main_thread()))

    monkeypatch.setattr(publisher, "put", put)
    outlets.declare(cast(zenoh.Session, publisher), "beat", "beat", "msgpack", "Beat")
    outlets.start()
    for number, took_ns in enumerate((0, 2 * SLOW_PUT_NS, 0, 0)):
        puts.took_ns = took_ns
        outlets.publish_beat(Beat(7, number))
        outlets.flush()
        wait_until(lambda: len(sent) == number + 1)  # noqa: B023
        wait_until(lambda: outlets._began_ns is None)
    outlets.stop(WAIT_S)
    assert sent == [(Beat(7, 0), True), (Beat(7, 1), True), (Beat(7, 2), False), (Beat(7, 3), True)]


A, B = "tcp/127.0.0.1:7447", "tcp/127.0.0.1:7450"


@each(
    ("mode", "endpoints", "ends", "missing"),
    [
        ("peer", (A,), {A}, ()),
        ("peer", (A,), set(), (A,)),
        # the TLS gateway or a ROS node connected to this process
        ("peer", (A,), {"tcp/127.0.0.1:50123"}, (A,)),
        ("peer", (A, B), {A}, (B,)),
        ("peer", (A, B), {A, B}, ()),
        ("peer", ("tcp/localhost:7447",), {A}, ()),
        ("peer", ("tcp/localhost:7447", B), {B}, ("tcp/localhost:7447",)),
        ("peer", ("tcp/nobody.invalid:7447",), set(), ("tcp/nobody.invalid:7447",)),
        # the name was resolved before
        ("peer", ("tcp/nobody.invalid:7447",), {"tcp/10.0.0.7:7447"}, ()),
        ("peer", ("tls/nobody.invalid:7447",), {A}, ("tls/nobody.invalid:7447",)),
        ("peer", ("tls/127.0.0.1:7447",), {A}, ("tls/127.0.0.1:7447",)),
        ("peer", ("tcp/127.0.0.1:7447?rel=0",), {A}, ()),
        ("peer", ("tcp/[::1]:7447",), {"tcp/[::1]:7447"}, ()),
        ("peer", ("unixsock-stream//run/zenoh",), set(), ("unixsock-stream//run/zenoh",)),
        ("client", (A, B), {B}, ()),
        ("client", (A, B), set(), (A, B)),
    ],
)
def test_an_endpoint_without_a_link_to_it_is_missing(
    mode: str, endpoints: tuple[str, ...], ends: set[str], missing: tuple[str, ...]
) -> None:
    assert unreached(mode, endpoints, ends) == missing
