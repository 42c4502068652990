"""The real zenoh-bridge-ros2dds, with the file in deploy/ros2, joins ROS nodes on DDS to robots.

`pytest -m bridge` runs these tests, and those of `test_ros.py` and `test_contract.py` that need the
same bridge. The first run builds the bridge, and installs rclpy for the nodes on Fast DDS.
"""

from __future__ import annotations

import re
import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.system import fast_dds
from tests.system.builds import BUILD_S
from tests.system.fast_dds import FastDdsNode, ros_environment
from tests.system.harness import PATIENCE_S, ROOT, Bus, Daemon, finish, free_endpoint, until
from tests.system.ros_clients import (
    EMPTY,
    EMPTY_REQUEST,
    ODOMETRY,
    PUBLISHED,
    SERVICES,
    SUBSCRIBED,
    TF,
)

if TYPE_CHECKING:
    from tests.system.dds import NewDomain

PAGES = ROOT / "deploy/manual/pages/howto"

COMMAND = r"ros2 topic pub -r (\d+) -t (\d+) /stop_request std_msgs/msg/Empty"

DROPPED = "received invalid request"
"""What the bridge logs for each request without the header of Cyclone DDS."""

pytestmark = [pytest.mark.bridge, pytest.mark.timeout(BUILD_S)]


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
        for name in SUBSCRIBED:
            bridge.logs(f"Route Publisher (ROS:/{name} -> Zenoh:{name}) created")
        for name in SERVICES:
            bridge.logs("Route Service Client", f"Zenoh:{name}) created")
        assert not [line for line in bridge.log if "WARN" in line or "ERROR" in line]


def test_the_bridge_drops_the_service_calls_of_a_fast_dds_node_and_the_pages_say_so(
    tmp_path: Path, dds: NewDomain, rclpy: str
) -> None:
    with (
        Daemon(tmp_path) as daemon,
        Bus(daemon.endpoint) as bus,
        dds(tmp_path) as domain,
        domain.bridge(daemon.endpoint) as bridge,
        FastDdsNode(rclpy, domain.number, tmp_path) as node,
    ):
        bus.linked()
        for _ in range(3):  # the first request of a new client may be lost on its way to the bridge
            called = node.call("acsard/stop")
            assert (called.replies, bus.state()["mode"]) == ([], "ready"), (
                "the bridge answers now: say so in howto/ros, howto/ros-trouble and the contract"
            )
        bridge.logs(DROPPED)
        # The subscription is reliable, so that DDS sends a lost stop again.
        matched = node.do("put", "/stop_request", EMPTY, "", 2.0, best_effort=True)
        assert (matched, "incompatible QoS" in node.program.stderr) == (False, True)
        node.put("stop_request", EMPTY, EMPTY_REQUEST)
        until(lambda: bus.state()["mode"] == "stopped", PATIENCE_S, "stopped")
    assert DROPPED in (PAGES / "ros-trouble.md").read_text()


def test_drive_py_drives_with_a_real_rclpy(tmp_path: Path, dds: NewDomain, rclpy: str) -> None:
    with (
        Daemon(tmp_path) as daemon,
        Bus(daemon.endpoint) as bus,
        dds(tmp_path) as domain,
        domain.bridge(daemon.endpoint),
    ):
        bus.linked()
        words = [rclpy, str(ROOT / "deploy/ros2/drive.py"), "0.2", "0.0", "3"]
        done = finish(words, tmp_path, env=ros_environment(domain.number, tmp_path))
        assert done.code == 0, done
        assert 0.2 < bus.at_rest()["x"] < 1.0  # a busy machine interrupts or prolongs it


def test_the_command_of_the_pages_stops_the_robot_with_each_new_publisher(
    tmp_path: Path, dds: NewDomain, rclpy: str
) -> None:
    found = {
        page: re.findall(COMMAND, (PAGES / f"{page}.md").read_text())
        for page in ("ros", "ros-tools", "nav2", "stop")
    }
    assert all(found.values())
    ((rate, times),) = {command for commands in found.values() for command in commands}
    with (
        Daemon(tmp_path) as daemon,
        Bus(daemon.endpoint) as bus,
        dds(tmp_path) as domain,
        domain.bridge(daemon.endpoint),
    ):
        bus.linked()
        for _ in range(5):
            with FastDdsNode(rclpy, domain.number, tmp_path) as node:
                node.do("topic_pub", "/stop_request", EMPTY, float(rate), int(times))
            numbers = [cause["number"] for cause in bus.comes_to("stopped")["causes"]]
            assert bus.get("srv/clear", {"numbers": numbers})["success"]


def test_without_the_wheels_of_rclpy_the_tests_fail_and_say_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(fast_dds, "WHEELS", ("/nowhere/rclpy.whl",))
    with pytest.raises(
        pytest.fail.Exception, match=r"nothing was tried with Fast DDS(.|\n)*/nowhere"
    ):
        fast_dds.python_with_rclpy(tmp_path)
