"""The real zenoh-bridge-ros2dds, with the file in deploy/ros2, joins ROS nodes on DDS to robots.

`pytest -m bridge` runs these tests, and the tests of `test_ros.py` that need the same bridge. The
first run builds the bridge.
"""

from __future__ import annotations

import time
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from tests.system.builds import BUILD_S
from tests.system.harness import Daemon, free_endpoint
from tests.system.ros_clients import (
    ODOMETRY,
    PUBLISHED,
    SERVICES,
    TF,
)

if TYPE_CHECKING:
    from tests.system.dds import NewDomain

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
        for name in ("joint_commands", "speed_limit"):
            bridge.logs(f"Route Publisher (ROS:/{name} -> Zenoh:{name}) created")
        for name in SERVICES:
            bridge.logs("Route Service Client", f"Zenoh:{name}) created")
        assert not [line for line in bridge.log if "WARN" in line or "ERROR" in line]
