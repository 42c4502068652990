"""What the daemon puts on the bus, and the routers to which it is linked."""

from __future__ import annotations

import threading
import time
from types import SimpleNamespace
from typing import Any

import msgspec
import pytest
from msgspec.structs import replace

from acsard.core.config.settings import AccessConfig, BusConfig, Config
from acsard.core.messages.frames import EXAMPLE, FeedbackTopic
from acsard.core.messages.schema import Beat, Twist, Vector3
from acsard.core.values import Estimate
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

WAIT_S = 5.0
ME = threading.get_ident()
WAKER: Any = SimpleNamespace(command=lambda: None, stop=lambda: None)

# The stamp is before 1970, so the message goes the ordinary way.
ODOM = FeedbackTopic(
    "odom", lambda estimate: Twist(Vector3(x=estimate.pose.x), Vector3()), lambda _: (0, 0)
)


def estimate(number: float, heard_ns: int = 0) -> Estimate:
    return replace(EXAMPLE, pose=replace(EXAMPLE.pose, x=float(number)), heard_ns=heard_ns)


class Bus:
    """Outlets, and a session with one publisher, whose put blocks until `free` is set.

    Each put takes `took_ns` by the clock of the outlets, on a busy machine too.
    """

    matching_status = SimpleNamespace(matching=True)

    def __init__(self, *, direct: bool, kind: type[Any] = Twist) -> None:
        self.free, self.entered, self.kind = threading.Event(), threading.Event(), kind
        self.sent: list[tuple[Any, bool]] = []
        """The messages, and whether the control loop has sent them itself."""
        self.took_ns, self._now_ns = 0, 0
        session: Any = self
        self.outlets = Outlets([], direct=direct)
        for topic in ("odom", "cmd_vel_out", "beat"):
            self.outlets.declare(session, topic, topic, "msgpack", "")
        self.outlets.start()

    def declare_publisher(self, key: str, **options: Any) -> Bus:
        return self

    def declare_matching_listener(self, callback: object) -> object:
        return callback

    def put(self, payload: bytes) -> None:
        self.entered.set()
        assert self.free.wait(WAIT_S)
        message = msgspec.msgpack.decode(payload, type=self.kind)
        number = message.linear.x if isinstance(message, Twist) else message
        self.sent.append((number, threading.get_ident() == ME))

    def mono_ns(self) -> int:
        self._now_ns += self.took_ns
        return self._now_ns

    def step(self, *feedback: float, other: float | None = None) -> None:
        """Publish the messages of these feedback lines, as one control step does."""
        for number in feedback:
            self.outlets.publish_feedback(ODOM, estimate(number))
        if other is not None:
            self.outlets.publish("cmd_vel_out", Twist(Vector3(x=other), Vector3()))
        self.outlets.flush()

    def settle(self) -> None:
        """Wait until the thread has sent everything."""
        until_s = time.monotonic() + WAIT_S
        slots = self.outlets._slots.values()
        while self.outlets._began_ns is not None or any(slot.waiting for slot in slots):
            assert time.monotonic() < until_s
            time.sleep(0.0005)

    def numbers(self) -> list[Any]:
        self.free.set()
        self.outlets.stop(WAIT_S)
        return [number for number, _ in self.sent]


@pytest.mark.parametrize("feedback", [False, True])
def test_while_the_bus_blocks_the_newest_messages_wait_and_others_count(
    feedback: bool,
) -> None:
    """If a client can block the bus, the control loop sends nothing itself."""
    bus = Bus(direct=False)
    for number in range(101):
        bus.step(*[number] * feedback, other=None if feedback else number)
        assert bus.entered.wait(WAIT_S)
    lost, _ = bus.outlets.losses(clock.mono_ns())
    assert lost == 100 - SLOT_MESSAGES
    assert bus.numbers() == [0, *range(101 - SLOT_MESSAGES, 101)]
    assert not any(by_loop for _, by_loop in bus.sent)


def test_a_blocked_bus_is_reported_once_for_each_time_that_it_blocks() -> None:
    bus = Bus(direct=False)
    bus.step(other=0)
    assert bus.entered.wait(WAIT_S)
    now_ns = clock.mono_ns()
    late = (0, BLOCKED_AFTER_NS + 1, 2 * BLOCKED_AFTER_NS)
    assert [bus.outlets.losses(now_ns + ns)[1] for ns in late] == [False, True, False]
    bus.numbers()
    assert bus.outlets.losses(now_ns + 3 * BLOCKED_AFTER_NS) == (0, False)


def test_an_error_of_the_thread_ends_the_control_loop() -> None:
    def fails(payload: bytes) -> None:
        raise ValueError("a bug")

    bus, publisher = ZenohBus(Config(), WAKER), Bus(direct=False)
    publisher.put = fails  # type: ignore[method-assign]
    session: Any = publisher
    bus.output.declare(session, "cmd_vel_out", "cmd_vel_out", "msgpack", "")
    bus.output.start()
    bus.output.publish("cmd_vel_out", Twist(Vector3(), Vector3()))
    bus.output.flush()
    bus.output.stop(WAIT_S)
    publisher.outlets.stop(WAIT_S)
    with pytest.raises(ValueError, match="a bug"):
        bus.output.flush()


# feedback, which the control loop sends itself

NETWORK = BusConfig(connect=("tls/192.0.2.1:7447",))


@each(
    ("config", "direct"),
    [
        (Config(), True), (Config(bus=NETWORK), False),
        (Config(bus=BusConfig(mode="client", connect=("tcp/127.0.0.1:7447",))), False),
        (Config(bus=BusConfig(insecure=True)), False),
        (Config(access=AccessConfig(wildcards=True)), False),
    ],
)  # fmt: skip
def test_the_control_loop_sends_feedback_itself_only_if_all_clients_use_exact_keys(
    config: Config, direct: bool
) -> None:
    assert ZenohBus(config, WAKER).output._direct == direct


def test_after_a_slow_put_the_thread_sends_feedback_until_it_is_fast_again(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bus = Bus(direct=True)
    monkeypatch.setattr("acsard.daemon.bus.outlets.clock", bus)
    bus.free.set()
    for number, took_ns in ((1, 2 * SLOW_PUT_NS), (2, 2 * SLOW_PUT_NS), (3, 0), (4, 0)):
        bus.took_ns = took_ns
        bus.step(number)
        bus.settle()
    assert bus.numbers() == [1, 2, 3, 4]
    assert [by_loop for _, by_loop in bus.sent] == [True, False, False, True]


def test_most_lines_that_waited_during_a_stall_are_left_to_the_thread_and_not_overtaken() -> None:
    bus = Bus(direct=True)
    bus.free.set()
    bus.step(*range(MAX_DIRECT + 4))
    bus.step(100)
    assert bus.numbers() == [*range(MAX_DIRECT + 4), 100]
    by_loop = [by_loop for _, by_loop in bus.sent]
    assert by_loop[:-1] == [True] * MAX_DIRECT + [False] * 4


def test_a_beat_is_sent_by_the_control_loop_itself_unless_a_put_was_slow(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    bus = Bus(direct=True, kind=Beat)
    monkeypatch.setattr("acsard.daemon.bus.outlets.clock", bus)
    bus.free.set()
    for number, took_ns in enumerate((0, 2 * SLOW_PUT_NS, 0, 0)):
        bus.took_ns = took_ns
        bus.outlets.publish_beat(Beat(7, number))
        bus.outlets.flush()
        bus.settle()
    assert bus.numbers() == [Beat(7, number) for number in range(4)]
    assert [by_loop for _, by_loop in bus.sent] == [True, True, False, True]


# routers

A, B = "tcp/127.0.0.1:7447", "tcp/127.0.0.1:7450"


@each(
    ("mode", "endpoints", "ends", "missing"),
    [
        ("peer", (A,), {A}, ()), ("peer", (A,), set(), (A,)),
        # the TLS gateway or a ROS node connected to this process
        ("peer", (A,), {"tcp/127.0.0.1:50123"}, (A,)),
        ("peer", (A, B), {A}, (B,)), ("peer", (A, B), {A, B}, ()),
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
        ("client", (A, B), {B}, ()), ("client", (A, B), set(), (A, B)),
    ],
)  # fmt: skip
def test_an_endpoint_without_a_link_to_it_is_missing(
    mode: str, endpoints: tuple[str, ...], ends: set[str], missing: tuple[str, ...]
) -> None:
    assert unreached(mode, endpoints, ends) == missing
