"""ROS 2 over rmw_zenoh works with an independent implementation, and the protocol is exact."""

from __future__ import annotations

import queue
import struct
import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import pytest
import zenoh

from tests.system.harness import Bus, Daemon, client_config, free_endpoint, running, until
from tests.system.ros_clients import (
    EMPTY_REQUEST,
    GET,
    JOINTS,
    LIST,
    ODOMETRY,
    PUBLISHED,
    QUICK,
    SERVICES,
    SPEED_LIMIT,
    STAMPED,
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
    behind,
    changes,
    decode,
    encode,
    gid_of,
    make,
    over_router,
    rmw_key,
    twist,
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

WAYS = {
    "peer of a router": COMMANDS,
    "client of a router": COMMANDS[:1],
    "no router": COMMANDS[-1:],
}
"""How the robot and ROS reach each other, and the commands tried in that way.

The keys are the same in all of them.
"""


class Fleet(NamedTuple):
    """Two robots and a process of the ROS 2 SDK on one router.

    `one` is connected as a Zenoh peer, and `two` as a Zenoh client.
    """

    daemons: dict[str, Daemon]
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
        yield Fleet(daemons, first, second, sdk)


class Ground(NamedTuple):
    """A robot and a process of the ROS 2 SDK, connected in one of the ways that are tested."""

    daemon: Daemon
    bus: Bus
    sdk: Sdk
    commands: tuple[tuple[str, str, float], ...]
    prefix: str
    """The prefix of each ROS name."""


@pytest.fixture(scope="module", params=WAYS)
def ground(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Ground]:
    commands = WAYS[request.param]
    if request.param != "no router":
        fleet: Fleet = request.getfixturevalue("fleet")
        name, bus = ("one", fleet.one) if "peer" in request.param else ("two", fleet.two)
        yield Ground(fleet.daemons[name], bus, fleet.sdk, commands, f"/{name}")
        return
    where = tmp_path_factory.mktemp("ground")
    with (
        running(where, config=QUICK) as (daemon, bus),
        Sdk(daemon.endpoint, where) as sdk,
    ):
        yield Ground(daemon, bus, sdk, commands, "")


# an independent implementation


def test_an_independent_client_decodes_the_odometry(ground: Ground) -> None:
    ground.sdk.do("follow", ground.prefix + "/odom", ODOMETRY)
    odometry = ground.sdk.do("newest", ground.prefix + "/odom")
    assert (odometry["header"]["frame_id"], odometry["child_frame_id"]) == ("odom", "base_link")
    assert odometry["pose"]["pose"]["orientation"]["w"] == pytest.approx(1.0, abs=1e-3)
    assert len(odometry["pose"]["covariance"]) == 36
    stamp = odometry["header"]["stamp"]
    assert stamp["sec"] + stamp["nanosec"] / 1e9 == pytest.approx(time.time(), abs=5.0)


def test_an_independent_client_drives_the_robot(ground: Ground) -> None:
    ground.sdk.do("follow", ground.prefix + "/odom", ODOMETRY)
    for topic, kind, amount in ground.commands:
        before = ground.bus.state()
        top = ground.sdk.do("drive", ground.prefix, topic, kind, amount, WHEELS, 0.2)
        assert 0.2 <= top <= 0.31, (topic, kind)
        after = until(lambda: _standing(ground.bus.state()), 5.0, "it stands after a zero")
        assert after["x"] > before["x"] + 0.005, (topic, kind)
        # Commands of a new sender count as first contact until its delays are steady. None is
        # refused.
        assert not [key for key in after["counters"] if key.startswith("command_")]


def _standing(state: Any) -> Any:
    return None if any(state["wheels"]) else state


def test_an_independent_client_that_comes_late_gets_the_static_transforms(ground: Ground) -> None:
    topic = ground.prefix + "/tf_static"
    ground.sdk.do("late", topic, TF)
    message = until(lambda: ground.sdk.do("held", topic), 1.5, "tf_static")
    frames = [(t["header"]["frame_id"], t["child_frame_id"]) for t in message["transforms"]]
    assert frames == [("base_link", "lidar_link")]


def test_an_independent_client_stops_and_clears_the_robot(ground: Ground) -> None:
    stopped = ground.sdk.do("call", ground.prefix + "/acsard/stop", TRIGGER)
    assert stopped["success"] is True
    assert ground.bus.state()["mode"] == "stopped"
    refused = ground.sdk.do("call", ground.prefix + "/acsard/clear", TRIGGER)
    assert refused["success"] is False
    again = "call srv/clear again 2 s after that"
    assert again in refused["message"]
    until(
        lambda: ground.sdk.do("call", ground.prefix + "/acsard/clear", TRIGGER)["success"],
        5.0,
        "a plain clear is obeyed",
    )
    assert ground.bus.state()["mode"] == "ready"


def test_an_independent_client_lists_topics_services_and_the_node(ground: Ground) -> None:
    prefix = ground.prefix
    topics = {f"{prefix}/{name}": [kind] for name, (kind, _, _) in PUBLISHED.items()}
    topics |= {f"{prefix}/{name}": [TWIST, STAMPED] for name in TWISTS}
    topics |= {f"{prefix}/joint_commands": [JOINTS], f"{prefix}/speed_limit": [SPEED_LIMIT]}
    services = {f"{prefix}/{name}": [kind] for name, kind in SERVICES.items()}
    for what, expected in (("topics", topics), ("services", services)):
        until(partial(_lists, ground.sdk, what, expected), 5.0, f"all {what}")
    nodes = [[prefix or "/", "acsard", "::,10:,:,:,,"]]
    until(
        lambda: ground.sdk.do("nodes", ground.prefix + "/odom") == nodes, 5.0, "who publishes odom"
    )


def _lists(sdk: Sdk, what: str, expected: dict[str, list[str]]) -> bool:
    listing = dict(sdk.do(what))
    return all(listing.get(name) == types for name, types in expected.items())


def test_an_independent_client_lists_and_gets_parameters(ground: Ground) -> None:
    reply = ground.sdk.do(
        "call", ground.prefix + "/acsard/list_parameters", LIST, prefixes=[], depth=0
    )
    names = reply["result"]["names"]
    assert {"drive.wheel_radius", "robot.id", "ros.domain"} <= set(names)
    wanted = ["drive.wheel_radius", "robot.id", "ros.domain", "ros.rmw", "no.such"]
    reply = ground.sdk.do("call", ground.prefix + "/acsard/get_parameters", GET, names=wanted)
    prefix_id = ground.prefix.removeprefix("/") or "acsar"
    radius, robot, domain, rmw, nothing = reply["values"]
    assert (radius["type"], radius["double_value"]) == (3, 0.05)
    assert (robot["type"], robot["string_value"]) == (4, prefix_id)
    assert (domain["type"], domain["integer_value"]) == (2, 0)
    assert (rmw["type"], rmw["bool_value"]) == (1, True)
    assert nothing["type"] == 0


def test_no_request_of_the_independent_client_raised_an_exception(ground: Ground) -> None:
    unharmed(ground.daemon)
    assert "Traceback" not in ground.sdk.stderr


# the protocol to the letter


@pytest.fixture
def ros(bus: Bus) -> RmwClient:
    return RmwClient(bus.session)


def test_every_liveliness_token_has_the_form_of_rmw_zenoh(bus: Bus, ros: RmwClient) -> None:
    (zid,) = map(str, bus.session.info.peers_zid())
    rows = [("MP", name, *row) for name, row in PUBLISHED.items()]
    rows += [("SS", name, kind, 10, False) for name, kind in SERVICES.items()]
    rows += [("MS", name, kind, 10, False) for name in TWISTS for kind in (TWIST, STAMPED)]
    rows += [("MS", "joint_commands", JOINTS, 10, False)]
    rows += [("MS", "speed_limit", SPEED_LIMIT, 10, False)]
    head, node = f"@ros2_lv/0/{zid}/0", "%/%/acsard"
    expected = {f"{head}/NUMBER/NN/{node}"}
    for role, name, kind, depth, transient in rows:
        _, *_, dds_type, type_hash = rmw_key(name, kind).split("/")
        mangled = "%" + name.replace("/", "%")
        # Reliable, and keep the last `depth` samples. Fields that equal rmw_zenoh's default are
        # blank.
        qos = f":{'1' if transient else ''}:,{depth}:,:,:,,"
        token = f"{head}/NUMBER/{role}/{node}/{mangled}/{dds_type}/{type_hash}/{qos}"
        assert token.count("/") == 12
        expected.add(token)
    with ros.tokens() as tokens:
        until(lambda: len(tokens) >= len(expected), 5.0, "all tokens")
        parts = [token.split("/") for token in tokens]
    assert {"/".join([*token[:4], "NUMBER", *token[5:]]) for token in parts} == expected
    # The node takes the first number of the session, each endpoint another one.
    assert sorted(int(token[4]) for token in parts) == list(range(len(expected)))
    assert [token[4] for token in parts if token[5] == "NN"] == ["0"]


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


def test_a_reply_names_its_request(bus: Bus, ros: RmwClient) -> None:
    for sequence in (1, 2, 2**40):
        asked = Attached(sequence, time.time_ns(), ros.gid)
        called = ros.call("acsard/reset_odometry", attachment=asked.pack())
        success, message = called.trigger()
        assert success, message
        (reply,) = called.replies
        answered = Attached.read(reply.attachment)
        assert (answered.sequence, answered.gid) == (asked.sequence, asked.gid)
        assert asked.stamp_ns <= answered.stamp_ns <= time.time_ns()
        assert reply.key == rmw_key("acsard/reset_odometry", TRIGGER)
        assert called.seconds < 1.0


# bad attachments, keys and requests are refused and counted, and disturb no other client


GO = twist(0.5)
NOW = Attached(1, time.time_ns(), bytes(16)).pack()


def test_a_command_of_a_sender_whose_clock_is_an_hour_off_is_accepted(
    bus: Bus, ros: RmwClient
) -> None:
    # Only differences of ages count: clocks need not agree.
    for off in (3600.0, -3600.0):
        other = RmwClient(bus.session)
        before = bus.state()
        until(partial(_put, bus, other, off, bus.count("commands") + 3), 3.0, f"zeros {off} s off")
        # A new sender shows its delays first.
        assert changes(before, bus.state()).keys() <= {"commands", "commands_of_new_senders"}


def _put(bus: Bus, other: RmwClient, off: float, enough: int) -> bool:
    key, attached = other.key("cmd_vel", TWIST), other.attachment(off)
    bus.session.put(key, twist(0.0), attachment=attached)
    return bus.count("commands") >= enough


def test_a_put_with_another_type_hash_is_ignored(bus: Bus, ros: RmwClient) -> None:
    ros.zeros(bus)
    before = bus.state()
    key = ros.key("cmd_vel", TWIST)
    for wrong in (key[:-1] + "b", key.replace("Twist_", "Accel_"), key.replace("0/", "1/", 1)):
        assert wrong != key
        bus.session.put(wrong, GO, attachment=ros.attachment())
    behind(bus, lambda: ros.session.put(key, GO), "no_attachment")
    after = bus.state()
    assert changes(before, after).keys() == {"command_no_attachment"}
    assert after["wheels"] == before["wheels"]


@pytest.mark.parametrize(
    ("attachment", "reason"),
    [(b"", "no_attachment"), (bytes(20), "bad_attachment"), (NOW[:-1], "bad_attachment")],
    ids=["none", "short", "cut"],
)
@pytest.mark.parametrize("service", ["acsard/activate", "acsard/get_parameters"])
def test_a_call_with_a_wrong_attachment_is_counted_and_ends_without_an_answer(
    bus: Bus, ros: RmwClient, service: str, attachment: bytes, reason: str
) -> None:
    before = bus.state()
    called = ros.call(service, SERVICES[service], attachment=attachment)
    assert (called.replies, called.errors) == ([], 0)
    assert called.seconds < 1.0
    assert changes(before, bus.state()) == {f"command_{reason}": 1}


def test_a_stop_without_attachment_stops_all_the_same(bus: Bus, ros: RmwClient) -> None:
    before = bus.state()
    try:
        called = ros.call("acsard/stop", attachment=b"")
        assert (called.replies, called.errors) == ([], 0)
        assert bus.state()["mode"] == "stopped"
        assert changes(before, bus.state()) == {"command_no_attachment": 1}
    finally:
        bus.get("srv/clear")


def test_more_names_than_there_are_parameters_are_answered(ros: RmwClient) -> None:
    for count, answered in ((128, 128), (129, 129), (256, 256), (300, 0), (1000, 0)):
        names = ["commands.sources.nav.priority"] * count
        request = encode(make("rcl_interfaces/msg/GetRequest", names=names))
        (reply,) = ros.call("acsard/get_parameters", GET, request).replies
        assert len(decode("rcl_interfaces/msg/GetReply", reply.payload).values) == answered


@pytest.mark.variations(4)
@pytest.mark.parametrize("count", [100, 300])
@pytest.mark.parametrize("service", ["acsard/get_parameters", "acsard/reset_odometry"])
def test_each_of_many_simultaneous_calls_is_answered(
    bus: Bus, ros: RmwClient, service: str, count: int
) -> None:
    names = encode(make("rcl_interfaces/msg/GetRequest", names=["robot.id"]))
    request = names if service.endswith("parameters") else EMPTY_REQUEST
    answers: queue.SimpleQueue[int] = queue.SimpleQueue()
    asked = [ros.attachment() for _ in range(count)]
    for attachment in asked:
        ros.session.get(
            ros.key(service, SERVICES[service]),
            lambda reply: answers.put(reply.ok is not None),
            payload=request,
            attachment=attachment,
            target=zenoh.QueryTarget.ALL_COMPLETE,
            consolidation=zenoh.ConsolidationMode.NONE,
            timeout=20.0,
        )
    assert [answers.get(timeout=20.0) for _ in asked] == [True] * count
    bus.state()


def test_no_ros_client_raised_an_exception_in_the_daemon(bus: Bus, shared: Daemon) -> None:
    unharmed(shared)
    bus.at_rest()


# two robots

TREES: dict[str, type[ZenohClient]] = {"bridge": BridgeHalf, "rmw": RmwClient}


@pytest.mark.parametrize("tree", ["native", "bridge", "rmw"])
def test_a_command_to_one_robot_does_not_reach_the_other(fleet: Fleet, tree: str) -> None:
    driven = fleet.one
    drive: AbstractContextManager[object]
    if tree == "native":
        drive = driven.commanding(0.3)
    else:
        drive = TREES[tree](driven.session, "one").driving(driven, "cmd_vel", TWIST, 0.3)
    with undisturbed(fleet.two), driven.follow("state") as states, drive:
        states.find(lambda s: (s["linear"] or 0.0) > 0.1, 3.0, "it drives")


@pytest.mark.parametrize("tree", ["native", "bridge", "rmw"])
def test_a_stop_of_one_robot_does_not_reach_the_other(fleet: Fleet, tree: str) -> None:
    first, second = fleet.one, fleet.two
    if tree == "native":
        assert first.get("srv/stop")["success"]
    else:
        assert TREES[tree](first.session, "one").call("acsard/stop").trigger()[0]
    assert (first.state()["mode"], second.state()["mode"] != "stopped") == ("stopped", True)
    assert first.get("srv/clear")["success"]


def test_no_key_is_published_by_two_robots(fleet: Fleet) -> None:
    samples, senders = Samples(), dict[str, set[str]]()
    session = fleet.one.session
    keys = {
        key
        for name in ("one", "two")
        for client in (RmwClient(session, name), BridgeHalf(session, name))
        for key in [client.key(topic, kind) for topic, (kind, _, _) in PUBLISHED.items()]
        + [f"acsard/{name}/{topic}" for topic in ("odom", "tf", "state", "cmd_vel_out")]
    }
    subscribers = [session.declare_subscriber(key, samples.add) for key in keys]

    def all_topics() -> bool:
        senders.clear()
        for sample in samples.seen:
            senders.setdefault(sample.key, set()).add(sample.origin)
        # The static transforms come only now and then.
        return len(senders) >= len(keys) - 4

    until(all_topics, 5.0, "all topics of both")
    for subscriber in subscribers:
        subscriber.undeclare()
    assert {len(origins) for origins in senders.values()} == {1}
    by_robot = dict[str, set[str]]()
    for key, origins in senders.items():
        by_robot.setdefault("one" if "one" in key.split("/") else "two", set()).update(origins)
    assert {len(origins) for origins in by_robot.values()} == {1}
    assert by_robot["one"] != by_robot["two"]
