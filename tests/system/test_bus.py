"""The keys on the bus as a plain Zenoh client sees them: values, latch, token, rates, limits."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

import msgspec
import pytest
import zenoh
import zenoh.ext

from acsard.core.messages import schema
from tests import promised
from tests.each import each
from tests.system.bystander import lost
from tests.system.harness import (
    Bus,
    Daemon,
    Following,
    Tables,
    alive_at,
    kept_waiting,
    seconds,
    until,
)

PUBLISHED = {row.key: row.type for row in promised.PUBLISHED}
"""The type of each key that a simulated robot publishes without a URDF file."""


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


@each("form", ["json", "msgpack"])
def test_a_get_on_a_published_key_answers_with_its_last_value(shared: Daemon, form: str) -> None:
    with Bus(shared.endpoint) as bus:
        for key, name in PUBLISHED.items():
            (answer,) = bus.ask(key if form == "json" else f"{key}?fmt=msgpack")
            assert (answer.ok, answer.key) == (True, key)
            assert answer.encoding == f"application/{form};acsard.{name}.v1"
            fields = getattr(schema, name).__struct_fields__
            assert set(getattr(msgspec, form).decode(answer.payload)) == set(fields)


def test_info_has_the_identity_of_the_daemon(bus: Bus, shared: Daemon) -> None:
    info = bus.get("info")
    assert (info["id"], info["pid"]) == ("acsar", shared.pid)
    assert (info["simulated"], info["rate"]) == (True, 100.0)
    assert (info["listen"], info["connect"]) == ([shared.endpoint], [])
    assert info["port"].startswith("/dev/pts/")


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


@pytest.mark.slow
def test_odometry_comes_a_hundred_times_a_second_and_state_ten_times(bus: Bus) -> None:
    begun, pid = time.monotonic(), bus.get("info")["pid"]
    waited = kept_waiting(pid)
    with bus.follow("odom") as odoms, bus.follow("state") as states:
        until(lambda: len(states.seen) > 12, 5.0, "a dozen states")
        stamps = [seconds(entry.value["header"]["stamp"]) for entry in list(odoms.seen)]
        reports = [entry.value for entry in list(states.seen)]
        machine_s = lost(begun) + kept_waiting(pid) - waited
    slow = [seconds(state["stamp"]) for state in reports]
    what = [[state[name] for name in ("mode", "reason", "link", "source")] for state in reports]
    changes = sum(now != before for before, now in pairwise(what))
    assert stamps == sorted(set(stamps))
    # The daemon publishes a state at once when it has changed. On a machine that stands still the
    # link may change.
    if any(state["link"] != "up" for state in reports):
        return  # the kernel's thread that carries bytes through the simulator's pty had no core
    for times, more, rate, near in ((stamps, 0, 100.0, 0.03), (slow, changes, 10.0, 0.1)):
        count, span = len(times) - 1, times[-1] - times[0]
        # Messages that the machine delayed at the beginning have a late stamp, so the span is
        # short.
        assert ((1 - near) * span - machine_s) * rate <= count
        assert count <= (1 + near) * (span + machine_s) * rate + more


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


@each(
    ("asked", "types"),
    [("schema/Odo$*", {"Odometry"}), ("*/Odometry", {"Odometry"}), ("schema/*/Odometry", set())],
)
def test_a_wildcard_gets_the_schemas_that_it_includes(
    asked: str, types: set[str], shared: Daemon
) -> None:
    with Bus(shared.endpoint) as bus:
        replies = [reply.ok for reply in bus.session.get(f"{bus.root}/{asked}", timeout=5.0)]
    assert {str(reply.key_expr).rpartition("/")[2] for reply in replies if reply} == types
