"""The keys on the bus as a plain Zenoh client sees them: values, latch, token, rates, limits."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
import zenoh
import zenoh.ext

from tests.system.bystander import lost
from tests.system.harness import (
    Bus,
    Daemon,
    Following,
    Tables,
    alive_at,
    until,
)


class Late(Following):
    """A client that subscribed to `tf_static` after its first message, and the time when it did."""

    since = 0.0


@pytest.fixture(scope="module")
def shared(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    """A daemon whose board reports its battery, so that each published key has messages."""
    config: Tables = {"sim": {"faults": ["battery=80:600"]}}
    with Daemon(tmp_path_factory.mktemp("shared"), config=config) as daemon:
        with Bus(daemon.endpoint) as bus:
            # The link is up before the board has reported its battery for the first time.
            until(lambda: bus.ask("battery"), 5.0, "the battery")
        yield daemon


@pytest.fixture(scope="module", autouse=True)
def late(shared: Daemon) -> Iterator[Late]:
    """Subscribe to `tf_static` during all other tests, because it is published only every 5 s."""
    with Bus(shared.endpoint) as bus:
        bus.linked()  # the first tf_static, sent at the start, is gone by then
        late = Late()
        late.since = time.monotonic()
        subscriber = bus.session.declare_subscriber("acsard/acsar/tf_static", late.add)
        yield late
        subscriber.undeclare()


@pytest.mark.variations(3)
@pytest.mark.parametrize(
    ("key", "payload"),
    [
        ("acsard/acsar/stop", b"\xff" * 65_000),
        ("acsard/*/stop", b""),
        ("acsard/acsar/sto$*", b""),
        ("**", b""),
    ],
)
def test_a_put_that_reaches_the_stop_key_latches(bus: Bus, key: str, payload: bytes) -> None:
    sent = time.monotonic()
    bus.session.put(key, payload)
    until(lambda: bus.state()["mode"] == "stopped", 2.0, "stopped")
    assert time.monotonic() - sent < 0.2 + lost(sent)
    assert bus.get("srv/clear")["success"]


def test_a_late_advanced_subscriber_gets_tf_static_within_a_second(bus: Bus) -> None:
    following = Following()
    asked = time.monotonic()
    subscriber = zenoh.ext.declare_advanced_subscriber(
        bus.session,
        "acsard/acsar/tf_static",
        following.add,
        history=zenoh.ext.HistoryConfig(detect_late_publishers=True, max_samples=1),
    )
    entry = following.find(lambda _: True, 3.0, "the latched transform")
    subscriber.undeclare()
    # This is well under the 5 s after which it would be sent again anyway.
    assert entry.at - asked < 1.0 + lost(asked, entry.at)
    assert entry.value["transforms"][0]["child_frame_id"] == "lidar_link"


@pytest.mark.variations(2)
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGKILL])
def test_the_alive_token_is_there_while_the_daemon_runs_and_gone_after(
    tmp_path: Path, number: signal.Signals
) -> None:
    with Daemon(tmp_path) as daemon, alive_at(daemon.endpoint, daemon) as alive:
        came = until(alive.try_recv, 5.0, "the alive token")
        assert (came.kind, str(came.key_expr)) == (zenoh.SampleKind.PUT, "acsard/acsar/alive")
        daemon.signal(number)
        daemon.ended(5.0)
        gone = until(alive.try_recv, 5.0, "the token's end")
        assert gone.kind == zenoh.SampleKind.DELETE


def test_queries_beyond_the_limit_are_answered_or_refused_with_ask_again(bus: Bus) -> None:
    handlers = [bus.session.get("acsard/acsar/info", timeout=5.0) for _ in range(400)]
    answered = 0
    for handler in handlers:
        (reply,) = list(handler)
        if reply.ok is not None:
            answered += 1
        else:
            assert reply.err is not None
            assert str(reply.err.encoding) == "text/plain;busy"
    assert answered >= 64
    assert bus.get("info")["id"] == "acsar"


# at the end: the message for which `late` has waited all along


def test_a_late_plain_subscriber_gets_tf_static_within_6_s(late: Late) -> None:
    entry = late.find(lambda _: True, 6.0, "tf_static is sent again")
    assert entry.at - late.since < 6.0
    assert entry.encoding == "application/msgpack;acsard.TFMessage.v1"
    assert entry.value["transforms"][0]["child_frame_id"] == "lidar_link"
