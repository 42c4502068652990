"""`acsard foxglove` works with a client of the Foxglove protocol that knows nothing of acsard."""

from __future__ import annotations

import json
import signal
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any

import pytest

from tests.system.harness import (
    Bus,
    Daemon,
    Program,
    acsard,
    free_endpoint,
    until,
)
from tests.system.viewer import Viewer, opened

SLOW = pytest.mark.slow

TOPICS = {
    "/odom": ("nav_msgs/msg/Odometry", "odom"),
    "/tf": ("tf2_msgs/msg/TFMessage", "tf"),
    "/tf_static": ("tf2_msgs/msg/TFMessage", "tf_static"),
    "/joint_states": ("sensor_msgs/msg/JointState", "wheel_states"),
    "/cmd_vel_out": ("geometry_msgs/msg/TwistStamped", "cmd_vel_out"),
    "/diagnostics": ("diagnostic_msgs/msg/DiagnosticArray", "diagnostics"),
    "/battery_state": ("sensor_msgs/msg/BatteryState", "battery"),
    "/state": ("acsard/msg/RobotState", "state"),
    "/log": ("rcl_interfaces/msg/Log", "events"),
}
"""The ROS type, and the bus key with the same contents."""


def free_port() -> int:
    """Return a port of this machine on which no program listens."""
    return int(free_endpoint().rpartition(":")[2])


class Shows(Program):
    """`acsard foxglove` on a port of its own, ready when entered."""

    def __init__(self, daemon: Daemon, *words: str) -> None:
        self.port = free_port()
        where = ("--config", str(daemon.config), "--address", f"127.0.0.1:{self.port}")
        super().__init__(acsard("foxglove", *where, *words), daemon.config.parent)

    def __enter__(self) -> Shows:
        super().__enter__()
        try:
            self.says("ws://")
        except BaseException:
            self.__exit__()
            raise
        return self


@pytest.fixture(scope="module")
def shows(shared: Daemon) -> Iterator[Shows]:
    with Shows(shared) as program:
        yield program


@pytest.fixture
def viewer(shows: Shows, bus: Bus) -> Iterator[Viewer]:
    with Viewer(shows.port) as viewer:
        yield viewer
    bus.at_rest()


def same(message: Any, value: Any) -> bool:
    """Return whether a ROS message, decoded by rosbags, equals a message of the bus."""
    if isinstance(value, Mapping):
        return all(same(getattr(message, key), inner) for key, inner in value.items())
    if isinstance(value, list):
        return len(message) == len(value) and all(map(same, message, value))
    return bool(message == value)


# the displayed data


def test_foxglove_shows_the_topics_of_a_recording_as_they_are_on_the_bus(
    viewer: Viewer, bus: Bus
) -> None:
    types = {topic: channel["schemaName"] for topic, channel in viewer.channels.items()}
    assert types == {topic: type_name for topic, (type_name, _) in TOPICS.items()}
    with bus.follow("odom") as on_bus:
        looked = viewer.show("/odom")
        messages = [looked.read(sample.payload) for sample in looked.first(4, 10.0)]

        def found() -> int:
            values = [sample.value for sample in list(on_bus.seen)]
            return sum(any(same(message, value) for value in values) for message in messages)

        # The bridge queried one, so that the viewer need not wait; that one is in no publication.
        until(lambda: found() >= 3, 5.0, f"{messages} on the bus")


def test_a_key_is_subscribed_only_while_a_viewer_shows_it(viewer: Viewer, bus: Bus) -> None:
    # Zenoh tells a publisher of a key whether any subscriber listens.
    publisher: Any = bus.session.declare_publisher(f"{bus.root}/tf")

    def listened() -> bool:
        return bool(publisher.matching_status.matching)

    until(lambda: not listened(), 5.0, "no program listens at first")
    looked = viewer.show("/tf")
    until(listened, 5.0, "a subscriber listens")
    looked.hide()
    until(lambda: not listened(), 5.0, "no subscriber listens any more")
    publisher.undeclare()


def test_a_viewer_has_no_service_but_stop_and_publishes_nothing(viewer: Viewer, bus: Bus) -> None:
    assert viewer.info["capabilities"] == ["services"]
    assert set(viewer.services) == {"/acsard/stop"}
    looked = viewer.show("/odom")
    send = viewer.publish_on("/cmd_vel", "geometry_msgs/Twist")
    before = bus.count("commands")
    send(json.dumps({"linear": {"x": 0.3}, "angular": {}}).encode())
    looked.first(len(looked.came) + 20)
    assert bus.count("commands") == before


@SLOW
def test_a_viewer_that_reads_nothing_does_not_delay_other_viewers(
    viewer: Viewer, shows: Shows, bus: Bus
) -> None:
    looked = viewer.show("/odom")
    everything = [channel["id"] for channel in viewer.channels.values()]
    with opened(shows.port) as mute:
        asked = [{"id": number, "channelId": channel} for number, channel in enumerate(everything)]
        mute.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
        looked.first(len(looked.came) + 50)


# the daemon, the port, the end


@SLOW
def test_a_daemon_that_is_gone_is_reported_and_waited_for(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    daemon = Daemon(tmp_path, endpoint=endpoint)
    with daemon, Shows(daemon) as own, Viewer(own.port) as viewer:
        looked = viewer.show("/odom")
        looked.first()
        daemon.signal(signal.SIGKILL)
        status = viewer.status("the daemon of robot acsar is gone; `acsard foxglove` waits for it")
        with Viewer(own.port) as late:
            late.show("/odom")
            late.status("is gone")
        assert not viewer.call("/acsard/stop", {})["success"]
        with Daemon(tmp_path, endpoint=endpoint, name="again"):
            until(lambda: status["id"] in viewer.removed, 10.0, "it is not gone any more")
            count = len(looked.came)
            until(lambda: len(looked.came) > count + 10, 10.0, "odometry again")
            assert viewer.call("/acsard/stop", {})["success"]
