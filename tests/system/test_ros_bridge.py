"""The daemon works with the exact bytes that a zenoh-bridge-ros2dds puts, calls and reads.

These tests emulate the bridge. `test_ros_dds.py` tests the real bridge.
"""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from tests.system.harness import Bus, Daemon, running, until
from tests.system.ros_clients import (
    HASHES,
    PUBLISHED,
    QUICK,
    SERVICES,
    SUBSCRIBED,
    TWIST,
    BridgeHalf,
    RmwClient,
    ZenohClient,
    changes,
    listed,
    session_at,
    stamped,
    twist,
)

pytestmark = pytest.mark.network

CONFIG = QUICK


@pytest.fixture
def ros(bus: Bus) -> BridgeHalf:
    return BridgeHalf(bus.session)


# the bridge's Zenoh half


def test_a_twist_has_52_bytes_and_a_stamped_twist_76(bus: Bus, ros: BridgeHalf) -> None:
    plain = twist(0.0)
    assert (len(plain), len(stamped(0.0))) == (52, 76)
    before = bus.state()
    # Nothing in the envelope distinguishes them, and a bridge may pad either by up to 3 bytes.
    for more in (b"", bytes(3)):
        ros.publish_until_accepted(bus, "cmd_vel", TWIST, plain + more)
        ros.publish_until_accepted(bus, "cmd_vel", TWIST, lambda more=more: stamped(0.0) + more)  # type: ignore[misc]
    assert changes(before, bus.state()).keys() <= {"commands", "commands_of_new_senders"}


# announcements


ALIVE = "acsard/acsar/alive"
"""Declared last: when it has come, all tokens have come."""


def announced(zid: str, namespace: str) -> set[str]:
    """Return the liveliness keys with which a bridge announces everything that it can announce."""
    head = f"@/{zid}/@ros2_lv"
    prefix = f"{namespace}§" if namespace else ""
    keys = {head}
    for name, (kind, depth, late) in PUBLISHED.items():
        qos = f":1:{int(late)}:0,{depth}:typehash=RIHS01_{HASHES[kind]};"
        keys.add(f"{head}/MP/{prefix}{name}/{kind.replace('/', '§')}/{qos}")
    for name, kind in SUBSCRIBED.items():
        qos = f":1:0:0,10:typehash=RIHS01_{HASHES[kind]};"
        keys.add(f"{head}/MS/{prefix}{name}/{kind.replace('/', '§')}/{qos}")
    for name, kind in SERVICES.items():
        keys.add(f"{head}/SS/{prefix}{name.replace('/', '§')}/{kind.replace('/', '§')}")
    return keys


@pytest.mark.parametrize("namespace", ["", "robot1"], ids=["plain", "named"])
def test_the_daemon_announces_the_liveliness_tokens_of_a_bridge(
    tmp_path: Path, namespace: str
) -> None:
    ros = {"namespace": namespace}
    with Daemon(tmp_path, config={"ros": ros}) as daemon, session_at(daemon.endpoint) as session:
        (zid,) = map(str, session.info.peers_zid())
        expected = announced(zid, namespace)
        with listed(session, "@/*/@ros2_lv/**") as tokens:
            until(lambda: len(tokens) >= len(expected), 5.0, "all tokens")
            assert set(tokens) == expected
            assert len(tokens) == len(expected)


def put_for(client: ZenohClient, seconds: float) -> None:
    """Command 0.3 m/s at 20 Hz, as a goal does that never sends a zero."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        client.put("cmd_vel", TWIST, twist(0.3))
        time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["bridge", "rmw"])
def test_silence_arms_nav_only_if_it_is_proved_to_be_the_sender_s(tmp_path: Path, way: str) -> None:
    with Daemon(tmp_path, config=QUICK) as daemon, Bus(daemon.endpoint) as bus:
        bus.linked()
        with session_at(daemon.endpoint) as session:
            if way == "rmw":
                goal = RmwClient(session)
                goal._sequence = 5000  # under way before the network was up
                put_for(goal, 3.0)
                assert bus.stands()["x"] == 0.0
                assert bus.state()["code"] in ("neutral", "no_command", "command")
                goal.put("cmd_vel", TWIST, twist(0.0))  # it ends
                time.sleep(11.0)
                put_for(goal, 1.0)  # another one
                assert bus.state()["x"] > 0.1
                return
            ros, (zid,) = BridgeHalf(session), (str(session.zid()),)
            time.sleep(12.0)
            put_for(ros, 2.0)  # without a token
            assert bus.stands()["x"] == 0.0
            qos = f":1:0:0,10:typehash=RIHS01_{HASHES[TWIST]};"
            key = f"@/{zid}/@ros2_lv/MP/cmd_vel/{TWIST.replace('/', '§')}/{qos}"
            token = session.liveliness().declare_token(key)
            time.sleep(5.0)
            put_for(ros, 2.0)  # sooner than a lost network would have ended the token
            assert bus.stands()["x"] == 0.0
            time.sleep(12.0)
            put_for(ros, 1.0)
            assert bus.state()["x"] > 0.1
            token.undeclare()


def test_a_ros_transport_that_is_switched_off_has_no_keys_and_no_tokens(tmp_path: Path) -> None:
    config = {"ros": {"bridge": False, "rmw": False}}
    with running(tmp_path, config=config) as (_, bus):
        before = bus.state()
        for client in (BridgeHalf(bus.session), RmwClient(bus.session)):
            client.put("cmd_vel", TWIST, b"")
            called = client.call("acsard/stop")
            assert (called.replies, called.errors) == ([], 0)
        with (
            listed(bus.session, "@ros2_lv/**") as rmw,
            listed(bus.session, "@/*/@ros2_lv/**") as bridge,
        ):
            with listed(bus.session, ALIVE) as alive:
                until(lambda: alive, 5.0, "the alive token")
            assert (rmw, bridge) == ([], [])
        after = bus.state()
        assert (after["mode"], changes(before, after)) == ("ready", {})
