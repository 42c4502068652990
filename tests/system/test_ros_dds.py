"""The real zenoh-bridge-ros2dds, with the file in deploy/ros2, joins ROS nodes on DDS to robots.

`pytest -m bridge` runs these tests, and the tests of `test_ros.py` that need the same bridge. The
first run builds the bridge.
"""

from __future__ import annotations

import re
import shlex
import signal
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple

import pytest

from tests.system import rclpy_stand_in
from tests.system.builds import BUILD_S
from tests.system.harness import ROOT, Bus, Daemon, Program, free_endpoint, until
from tests.system.ros_clients import (
    BRIDGE_FILE,
    ODOMETRY,
    PUBLISHED,
    ROUTE_S,
    SERVICES,
    STAMPED,
    TF,
    TWIST,
    changes,
    decode,
    over_router,
    stamped,
    twist,
    two_robots,
    undisturbed,
)
from tests.system.test_ros_drive import LINE

if TYPE_CHECKING:
    from tests.system.dds import DdsDomain, DdsNode, NewDomain

pytestmark = [pytest.mark.bridge, pytest.mark.timeout(BUILD_S)]


@pytest.fixture
def driven(bus: Bus) -> Iterator[Bus]:
    """Provide `bus`, and stop its robot after the test."""
    yield bus
    bus.at_rest()


def test_a_bridge_that_starts_before_the_robot_joins_it_and_joins_it_again(
    tmp_path: Path, dds: NewDomain
) -> None:
    endpoint = free_endpoint()
    with (
        dds(tmp_path) as domain,
        domain.bridge(endpoint),
        domain.node() as node,
        node.follow("odom", ODOMETRY) as odometry,
        node.follow_late("tf_static", TF) as static,
    ):
        for name in ("first", "second"):
            begun = time.monotonic()
            with Daemon(tmp_path, endpoint=endpoint, name=name):
                for samples in (odometry, static):
                    samples.first(f"of the {name}", lambda s: s.at > begun, 15.0)  # noqa: B023
                called = node.call("acsard/stop")
                # The bridge 1.10 may deliver a call twice after that, and then both are answered.
                assert called._replace(replies=called.replies[:1]).trigger()[0]


def test_announced_topics_have_routes(tmp_path: Path, dds: NewDomain) -> None:
    with (
        Daemon(tmp_path) as daemon,
        dds(tmp_path) as domain,
        domain.bridge(daemon.endpoint) as bridge,
    ):
        for name in PUBLISHED:
            bridge.logs(f"Route Subscriber (Zenoh:{name} -> ROS:/{name}) created")
        for name in ("joint_commands", "speed_limit"):
            bridge.logs(f"Route Publisher (ROS:/{name} -> Zenoh:{name}) created")
        for name in SERVICES:
            bridge.logs("Route Service Client", f"Zenoh:{name}) created")
        assert not [line for line in bridge.log if "WARN" in line or "ERROR" in line]


# two publishers


@contextmanager
def sending(first: DdsNode, speed: float, second: DdsNode, its_speed: float) -> Iterator[None]:
    """Publish a speed from each of two nodes 20 times a second until the context ends.

    The second node publishes 10 ms after the first one.
    """
    ended = threading.Event()

    def send() -> None:
        while not ended.is_set():
            first.put("cmd_vel", TWIST, twist(speed))
            ended.wait(0.01)
            second.put("cmd_vel", TWIST, twist(its_speed))
            ended.wait(0.04)

    thread = threading.Thread(target=send)
    thread.start()
    try:
        yield
    finally:
        ended.set()
        thread.join()


def speeds(bus: Bus) -> list[float]:
    """Wait for 200 control periods, and return the robot's speeds of the last second, m/s."""
    with bus.follow("state") as states:
        sent = bus.count("lines_sent")
        until(lambda: bus.count("lines_sent") >= sent + 200, 10.0, "200 periods")
        last = states.seen[-1].at
        return [sample.value["linear"] for sample in states.seen if sample.at > last - 1.0]


def test_two_publishers_are_one_sender_and_the_robot_follows_the_newest_message(
    driven: Bus, domain: DdsDomain
) -> None:
    with domain.node(name="nav") as nav, domain.node(name="other") as other:
        with sending(nav, 0.0, other, 0.0):
            until(lambda: driven.state()["source"] == "nav", 5.0, "zeros are followed")
            speeds(driven)
        with sending(nav, 0.4, other, 0.1):
            slow = speeds(driven)
        with sending(other, 0.1, nav, 0.4):
            fast = speeds(driven)
        with sending(other, 0.0, nav, 0.4):
            zeros_first = speeds(driven)
        with sending(nav, 0.4, other, 0.0):
            zeros_last = speeds(driven)
        refused = [key for key in driven.state()["counters"] if key.startswith("command_")]
    for name, values in {
        "slow": slow,
        "fast": fast,
        "not held": zeros_first,
        "held": zeros_last,
    }.items():
        print(f"{name}: {min(values):.3f} to {max(values):.3f} m/s")
    assert 0.05 < min(slow) <= max(slow) < 0.2
    # The zeros of one publisher do not hold the robot if the other one's messages come last.
    assert min(*fast, *zeros_first) > 0.3
    assert max(zeros_last) < 0.05
    assert refused == []


def test_an_idle_stamped_publisher_blocks_twist_until_both_publishers_have_ended(
    driven: Bus, domain: DdsDomain
) -> None:
    def ignored(node: DdsNode) -> None:
        before, sent = driven.state(), driven.count("lines_sent")

        def two_seconds() -> bool:
            publisher.write(publisher.data_type.deserialize(twist(0.3)))
            return driven.count("lines_sent") >= sent + 200

        until(two_seconds, 10.0, "200 periods")
        assert changes(before, driven.state()) == {}

    with domain.node(name="driver") as driver:
        with domain.node(name="idle") as idle:
            route = idle.publisher("cmd_vel", STAMPED).get_matched_subscriptions
            until(route, ROUTE_S, "the idle one has the route")
            publisher = driver.publisher("cmd_vel", TWIST)
            ignored(driver)
            idle.publish_until_accepted(driven, "cmd_vel", STAMPED, lambda: stamped(0.0))
        ignored(driver)
    with (
        domain.node(name="driver") as driver,
        driven.follow("state") as states,
        driver.driving(driven, "cmd_vel", TWIST, 0.3),
    ):
        states.find(lambda s: (s["linear"] or 0.0) > 0.1, 5.0, "it drives")


# two robots


class Robot(NamedTuple):
    """A robot of the fleet, and a ROS node on DDS that reaches it over a bridge."""

    daemon: Daemon
    bus: Bus
    node: DdsNode


@pytest.fixture(scope="module")
def robots(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[str, dict[str, Daemon]]]:
    """Provide a router's address and two robots behind that router, keyed by name."""
    with two_robots(tmp_path_factory.mktemp("robots"), "robot1", "robot2") as robots:
        yield robots


def one_domain_each(
    stack: ExitStack, dds: NewDomain, where: Path, meeting: str
) -> dict[str, DdsNode]:
    """Start a bridge and a DDS domain for each robot, and return a node in each domain.

    A robot's ROS names have no namespace in its own domain.
    """
    nodes = {}
    for name in ("robot1", "robot2"):
        domain = stack.enter_context(dds(where))
        stack.enter_context(domain.bridge(meeting, "-n", f"/{name}"))
        nodes[name] = stack.enter_context(domain.node())
    return nodes


def one_domain_for_both(
    stack: ExitStack, dds: NewDomain, where: Path, meeting: str
) -> dict[str, DdsNode]:
    """Start one bridge and one DDS domain for both robots, and return a node for each robot.

    The namespace of a ROS name says which robot it belongs to.
    """
    file = where / "both.json5"
    # `allow` with an expression for both robots, as the page says.
    file.write_text(re.sub(r'"/(\w+)', r'"/robot[12]/\1', BRIDGE_FILE.read_text()))
    domain = stack.enter_context(dds(where))
    stack.enter_context(domain.bridge(meeting, file=file))
    return {name: stack.enter_context(domain.node(name)) for name in ("robot1", "robot2")}


WAYS = {"a domain each": one_domain_each, "one domain": one_domain_for_both}


@pytest.fixture(scope="module", params=WAYS)
def fleet(
    request: pytest.FixtureRequest,
    robots: tuple[str, dict[str, Daemon]],
    dds: NewDomain,
    tmp_path_factory: pytest.TempPathFactory,
) -> Iterator[tuple[Robot, Robot]]:
    meeting, daemons = robots
    with ExitStack() as stack:
        nodes = WAYS[request.param](stack, dds, tmp_path_factory.mktemp("fleet"), meeting)
        pair = []
        for name, daemon in daemons.items():
            bus = stack.enter_context(over_router(meeting, name))
            pair.append(Robot(daemon, bus, nodes[name]))
        first, second = pair
        yield first, second


def test_a_command_to_one_robot_drives_only_that_one(fleet: tuple[Robot, Robot]) -> None:
    driven, other = fleet
    with (
        undisturbed(other.bus),
        driven.node.follow("odom", ODOMETRY) as moving,
        other.node.follow("odom", ODOMETRY) as standing,
        driven.node.driving(driven.bus, "cmd_vel", TWIST, 0.3),
    ):
        moving.first("motion", lambda s: decode(ODOMETRY, s.payload).twist.twist.linear.x > 0.2)
        standing.first("odometry of the other")
        assert {decode(ODOMETRY, s.payload).twist.twist.linear.x for s in standing.seen} == {0.0}
    driven.bus.at_rest()


def test_each_robot_has_all_its_topics_and_its_own_static_transforms(
    fleet: tuple[Robot, Robot],
) -> None:
    for robot in fleet:
        for name, (kind, _, late) in PUBLISHED.items():
            follow = robot.node.follow_late if late else robot.node.follow
            with follow(name, kind) as samples:
                decode(kind, samples.first(name).payload)


# the first drive


@pytest.mark.parametrize("number", [None, signal.SIGINT], ids=["to its end", "Ctrl-C"])
def test_the_command_line_of_the_pages_drives_the_robot(
    tmp_path: Path, dds: NewDomain, number: signal.Signals | None
) -> None:
    rclpy_stand_in.write(tmp_path)
    line = [sys.executable, *shlex.split(LINE)[1:]]
    with (
        Daemon(tmp_path) as daemon,
        Bus(daemon.endpoint) as bus,
        dds(tmp_path) as domain,
        domain.bridge(daemon.endpoint),
    ):
        bus.linked()
        variables = {"WAY": "dds", "DOMAIN": str(domain.number)}
        paths = {"PYTHONPATH": f"{tmp_path}:{domain.environment['PYTHONPATH']}"}
        with Program(line, ROOT, domain.environment | variables | paths) as drive:
            if number is not None:
                until(lambda: (bus.state()["linear"] or 0.0) > 0.1, 20.0, "it drives")
                drive.signal(number)
            assert drive.ended(30.0) == (0 if number is None else 128 + number), drive
            assert "Traceback" not in drive.stderr, drive.stderr
        until(lambda: bus.state()["linear"] == 0.0, 3.0, "it stands")
        if number is None:
            assert 0.4 < bus.state()["x"] < 0.7
