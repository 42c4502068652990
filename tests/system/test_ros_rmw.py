"""ROS 2 over rmw_zenoh works with an independent implementation, and the protocol is exact."""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import NamedTuple

import pytest
import zenoh

from tests.system.harness import Bus, Daemon, client_config, free_endpoint, until
from tests.system.ros_clients import (
    JOINTS,
    ODOMETRY,
    PUBLISHED,
    QUICK,
    SERVICES,
    STAMPED,
    SUBSCRIBED,
    TF,
    TRIGGER,
    TWIST,
    TWISTS,
    WHEELS,
    Attached,
    BridgeHalf,
    RmwClient,
    Samples,
    Sdk,
    ZenohClient,
    gid_of,
    over_router,
    rmw_key,
    two_robots,
    undisturbed,
    unharmed,
)

pytestmark = pytest.mark.network

CONFIG = QUICK

COMMANDS = (
    ("/cmd_vel", TWIST, 0.3),
    ("/cmd_vel_teleop", STAMPED, 0.3),
    ("/joint_commands", JOINTS, 6.0),
)
"""Topic, type and the value in m/s or rad/s; all result in 0.3 m/s."""


class Fleet(NamedTuple):
    """Two robots and a process of the ROS 2 SDK on one router.

    `one` is connected as a Zenoh peer, and `two` as a Zenoh client.
    """

    one: Bus
    two: Bus
    sdk: Sdk


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    where = tmp_path_factory.mktemp("fleet")
    with (
        two_robots(where, "one", "two") as (meeting, daemons),
        Sdk(meeting, where) as sdk,
        over_router(meeting, "one") as first,
        over_router(meeting, "two") as second,
    ):
        yield Fleet(first, second, sdk)
        assert "Traceback" not in sdk.stderr
        for daemon in daemons.values():
            unharmed(daemon)


@pytest.fixture(autouse=True)
def unharmed_after(shared: Daemon) -> Iterator[None]:
    yield
    unharmed(shared)


# an independent implementation


@pytest.mark.parametrize(("robot", "commands"), [("one", COMMANDS), ("two", COMMANDS[:1])])
def test_an_independent_client_drives_the_robot_behind_a_router_as_a_peer_or_a_client(
    fleet: Fleet, robot: str, commands: tuple[tuple[str, str, float], ...]
) -> None:
    bus: Bus = getattr(fleet, robot)
    fleet.sdk.do("follow", f"/{robot}/odom", ODOMETRY)
    for topic, kind, amount in commands:
        before = bus.state()
        top = fleet.sdk.do("drive", f"/{robot}", topic, kind, amount, WHEELS, 0.2)
        assert 0.2 <= top <= 0.31, (topic, kind)
        after = bus.stands()
        assert after["x"] > before["x"] + 0.005, (topic, kind)
        # Commands of a new sender count as first contact until its delays are steady. None is
        # refused.
        assert not [key for key in after["counters"] if key.startswith("command_")]


def test_an_independent_client_stops_and_clears_the_robot(fleet: Fleet) -> None:
    assert fleet.sdk.do("call", "/one/acsard/stop", TRIGGER)["success"] is True
    assert fleet.one.state()["mode"] == "stopped"
    refused = fleet.sdk.do("call", "/one/acsard/clear", TRIGGER)
    assert refused["success"] is False
    assert "type `acsard call clear` again 2 s after that" in refused["message"]
    clear = partial(fleet.sdk.do, "call", "/one/acsard/clear", TRIGGER)
    until(lambda: clear()["success"], 5.0, "a plain clear is obeyed")
    assert fleet.one.state()["mode"] == "ready"


def test_an_independent_client_lists_topics_services_and_the_node(fleet: Fleet) -> None:
    topics = {f"/one/{name}": [kind] for name, (kind, _, _) in PUBLISHED.items()}
    topics |= {f"/one/{name}": [TWIST, STAMPED] for name in TWISTS}
    topics |= {f"/one/{name}": [kind] for name, kind in SUBSCRIBED.items()}
    services = {f"/one/{name}": [kind] for name, kind in SERVICES.items()}

    def lists(what: str, expected: dict[str, list[str]]) -> bool:
        listing = dict(fleet.sdk.do(what))
        return all(listing.get(name) == types for name, types in expected.items())

    until(partial(lists, "topics", topics), 5.0, "all topics")
    until(partial(lists, "services", services), 5.0, "all services")
    nodes = [["/one", "acsard", "::,10:,:,:,,"]]
    until(lambda: fleet.sdk.do("nodes", "/one/odom") == nodes, 5.0, "who publishes odom")


# the protocol to the letter


@pytest.fixture
def ros(bus: Bus) -> RmwClient:
    return RmwClient(bus.session)


def test_samples_carry_the_gid_of_their_publisher_s_token_and_count_without_gaps(
    tmp_path: Path,
) -> None:
    with Daemon(tmp_path, config=QUICK) as daemon, Bus(daemon.endpoint) as bus:
        ros = RmwClient(bus.session)
        with ros.tokens() as tokens:
            until(lambda: len(tokens) >= 24, 5.0, "all tokens")
            by_topic = {t.split("/")[9]: t for t in tokens if "/MP/" in t}
        with ExitStack() as stack:
            following = {
                name: stack.enter_context((ros.follow_late if late else ros.follow)(name, kind))
                for name, (kind, _, late) in PUBLISHED.items()
            }
            for name, samples in following.items():
                samples.has(1 if name == "tf_static" else 2)
    for name, samples in following.items():
        attached = [Attached.read(sample.attachment) for sample in samples.seen]
        assert {attachment.gid for attachment in attached} == {gid_of(by_topic[f"%{name}"])}
        assert [attachment.sequence for attachment in attached] == list(
            range(1, len(attached) + 1)
        ), name
        assert abs(attached[-1].stamp_ns / 1e9 - time.time()) < 5.0


def test_no_message_is_made_while_no_ros_client_listens(tmp_path: Path) -> None:
    # Each encoded sample increments the sequence, so samples encoded without a listener would leave
    # a gap.
    with Daemon(tmp_path) as daemon, Bus(daemon.endpoint) as bus:
        ros = RmwClient(bus.session)
        bus.linked()
        with bus.follow("odom") as native:
            until(lambda: len(native.seen) >= 25, 5.0, "25 messages in the native tree")
        with ros.follow("odom", ODOMETRY) as samples:
            samples.has(5)
        first, *_, last = [Attached.read(sample.attachment).sequence for sample in samples.seen]
        assert first == 1
        sent = bus.count("lines_sent")
        until(lambda: bus.count("lines_sent") >= sent + 50, 5.0, "50 periods unheard")
        with ros.follow("odom", ODOMETRY) as samples:
            again = Attached.read(samples.first("odometry again").attachment).sequence
        assert again - last < 10
        print(f"unheard for 50 periods: {again - last - 1} samples made")


def test_the_static_transforms_have_the_heartbeat_for_late_subscribers(
    tmp_path: Path,
) -> None:
    # The transforms are put once, at the start: a subscriber must be there before it.
    meeting, beats = free_endpoint(), Samples()
    key = rmw_key("tf_static", TF)
    with zenoh.open(client_config(meeting, "router")) as router:
        subscriber = router.declare_subscriber(f"{key}/@adv/pub/**", beats.add)
        with Daemon(tmp_path, config={"bus": {"connect": [meeting]}}) as daemon:
            beat = beats.first("a heartbeat", within=2.0)
            unharmed(daemon)
        subscriber.undeclare()
    # The heartbeat holds the number of the last sample. It is not a transform, and is not meant for
    # those subscribers.
    assert beat.payload == struct.pack("<I", 0)
    assert not beat.attachment


# two robots

TREES: dict[str, type[ZenohClient]] = {"bridge": BridgeHalf, "rmw": RmwClient}


@pytest.mark.parametrize("tree", TREES)
def test_a_command_and_a_stop_of_one_robot_do_not_reach_the_other(fleet: Fleet, tree: str) -> None:
    client = TREES[tree](fleet.one.session, "one")
    with (
        undisturbed(fleet.two),
        fleet.one.follow("state") as states,
        client.driving(fleet.one, "cmd_vel", TWIST, 0.3),
    ):
        states.find(lambda s: (s["linear"] or 0.0) > 0.1, 3.0, "it drives")
    assert client.call("acsard/stop").trigger()[0]
    assert fleet.one.state()["mode"] == "stopped"
    assert fleet.two.state()["mode"] != "stopped"
    assert fleet.one.get("srv/clear")["success"]
