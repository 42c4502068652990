"""`acsard foxglove` works with a client of the Foxglove protocol that knows nothing of acsard."""

from __future__ import annotations

import itertools
import json
import signal
import socket
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any

import pytest
import zenoh
from mcap.reader import make_reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore
from websockets.exceptions import InvalidStatus

from acsard.client.commander import RELEASE_TIMEOUT_NS
from acsard.core.config.settings import JointsConfig
from acsard.core.messages.encodings import FORMATS, encode, encoding_name
from acsard.core.messages.schema import Header, JointState, Twist, TwistStamped, Vector3
from acsard.core.values import NS_PER_S
from acsard.foxglove.bridge import STOP_TIMEOUT_S
from tests.system.bystander import lost
from tests.system.harness import (
    ZERO,
    Bus,
    Daemon,
    Program,
    acsard,
    cpu_seconds,
    finish,
    free_endpoint,
    read,
    until,
)
from tests.system.ros_clients import JOINTS, STAMPED, TWIST, BridgeHalf, RmwClient, session_at
from tests.system.viewer import SubscribedTopic, Viewer, opened

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
} | {
    f"/cmd_vel_in/{source}": ("geometry_msgs/msg/TwistStamped", f"cmd/{source}")
    for source in ("teleop", "app", "ros2_control", "dock", "nav")
}
"""The ROS type, and the bus key with the same contents."""

OURS = {"header": "stamp", "sources": "sources", "counters": "counters"}
"""The fields of `state` that have another shape on the bus."""


def free_port() -> int:
    """Return a port of this machine on which no program listens."""
    return int(free_endpoint().rpartition(":")[2])


class Shows(Program):
    """`acsard foxglove` on a port of its own, ready when entered."""

    def __init__(self, daemon: Daemon, *words: str) -> None:
        self.port = free_port()
        where = ("--config", str(daemon.config), "--address", f"127.0.0.1:{self.port}")
        super().__init__(acsard("foxglove", *where, *words or ("--drive",)), daemon.config.parent)

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


def speed(linear: float, angular: float = 0.0) -> bytes:
    """Return a speed in JSON, as the Teleop panels of Foxglove and Lichtblick publish it."""
    axes = {"x": 0, "y": 0, "z": 0}
    return json.dumps({"linear": axes | {"x": linear}, "angular": axes | {"z": angular}}).encode()


CONNECTED_S = RELEASE_TIMEOUT_NS / NS_PER_S + 0.1
"""Time after which a new channel that was silent may drive, s."""


class Panel:
    """A Teleop panel whose button is held while the object is entered: 20 messages a second.

    The panel waits `CONNECTED_S` first, because it may not drive earlier.
    """

    def __init__(self, viewer: Viewer, data: bytes, encoding: str = "json") -> None:
        self._send, self.channel = viewer.publish_on("/cmd_vel", encoding, "geometry_msgs/Twist")
        time.sleep(CONNECTED_S)
        self._data = data
        self._released = threading.Event()
        self._thread = threading.Thread(target=self._hold, daemon=True)

    def __enter__(self) -> Panel:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self.release()

    def release(self) -> None:
        self._released.set()
        self._thread.join()

    def _hold(self) -> None:
        while not self._released.wait(0.05):
            try:
                self._send(self._data)
            except Exception:  # noqa: BLE001 - whatever a cut connection raises
                return


def driving(bus: Bus, faster_than: float = 0.2) -> Any:
    """Wait until the robot drives faster than this speed in m/s, and return the state."""

    def look() -> Any:
        state = bus.state()
        return (
            state if state["mode"] == "driving" and (state["linear"] or 0.0) > faster_than else None
        )

    return until(look, 10.0, f"driving, {bus.state()['reason']}")


def same(message: Any, value: Any) -> bool:
    """Return whether a ROS message, decoded by rosbags, equals a message of the bus."""
    if isinstance(value, Mapping):
        return all(same(getattr(message, key), inner) for key, inner in value.items())
    if isinstance(value, list):
        return len(message) == len(value) and all(map(same, message, value))
    return bool(message == value)


# the displayed data


@pytest.mark.parametrize(
    ("topic", "count"),
    [
        ("/odom", 4),
        pytest.param("/tf", 4, marks=SLOW),
        pytest.param("/joint_states", 4, marks=SLOW),
        pytest.param("/cmd_vel_out", 4, marks=SLOW),
        pytest.param("/diagnostics", 2, marks=SLOW),
    ],
)
def test_a_topic_shows_what_was_on_the_bus_at_the_time(
    viewer: Viewer, bus: Bus, topic: str, count: int
) -> None:
    type_name, key = TOPICS[topic]
    with bus.follow(key) as on_bus:
        looked = viewer.show(topic)
        assert looked.channel["schemaName"] == type_name
        messages = [looked.read(sample.payload) for sample in looked.first(count, 10.0)]

        def found() -> int:
            values = [sample.value for sample in list(on_bus.seen)]
            return sum(any(same(message, value) for value in values) for message in messages)

        # The bridge queried one, so that the viewer need not wait; that one is in no publication.
        until(lambda: found() >= count - 1, 5.0, f"{messages} on {key}")


def test_the_state_shows_what_was_on_the_bus_at_the_time(viewer: Viewer, bus: Bus) -> None:
    with bus.follow("state") as on_bus:
        looked = viewer.show("/state")
        message = looked.read(looked.first(3)[-1].payload)
        entry = on_bus.find(lambda v: same(message.header.stamp, v["stamp"]), 5.0, "that state")
    fields = {k: v for k, v in entry.value.items() if hasattr(message, k) and v is not None}
    assert set(fields) >= {"mode", "reason", "x", "y", "yaw", "wheels", "link", "source", "gyro"}
    assert all(same(getattr(message, k), v) for k, v in fields.items() if k not in OURS.values())
    assert {item.name: item.count for item in message.counters} == entry.value["counters"]
    assert [item.name for item in message.sources] == [
        item["name"] for item in entry.value["sources"]
    ]


def test_foxglove_shows_the_topics_of_a_recording_and_no_others(viewer: Viewer) -> None:
    until(lambda: set(viewer.channels) >= set(TOPICS), 5.0, "all topics")
    types = {topic: channel["schemaName"] for topic, channel in viewer.channels.items()}
    assert types == {topic: type_name for topic, (type_name, _) in TOPICS.items()}


@SLOW
def test_a_late_viewer_gets_tf_static_and_the_last_diagnostics(
    viewer: Viewer, shows: Shows, bus: Bus
) -> None:
    first = viewer.show("/tf_static").first()[0]
    with bus.follow("tf_static") as published:
        for _ in range(4):
            with Viewer(shows.port) as late:
                assert late.show("/tf_static").first()[0].payload == first.payload
        late_ones = len(published.seen)
    # It is published once in 5 s. No viewer has waited for that.
    assert late_ones < 4
    viewer.show("/diagnostics").first()


def test_a_source_s_command_is_shown_on_its_topic(viewer: Viewer, bus: Bus) -> None:
    looked = viewer.show("/cmd_vel_in/nav")
    # No event shows when a subscription has reached the daemon. A zero moves no robot.

    def put() -> bool:
        bus.put("cmd/nav", ZERO)
        return bool(looked.came)

    until(put, 5.0, "a command")
    message = looked.read(looked.came[0].payload)
    assert (message.twist.linear.x, message.twist.angular.z) == (0.0, 0.0)
    assert message.header.stamp.sec > 0


Sent = tuple[str, float, Callable[[], None]]
"""The source, the speed in m/s, and the function that sends it."""


def moving(name: str, speed: float) -> Any:
    """Return a message of this ROS type that commands this speed in m/s."""
    if name == JOINTS:
        wheels = [speed / 0.05] * 4
        return JointState(name=list(JointsConfig().as_tuple()), velocity=wheels)
    twist = Twist(Vector3(x=speed), Vector3())
    return twist if name == TWIST else TwistStamped(Header(), twist)


def every_way(session: zenoh.Session) -> Iterator[Sent]:
    """Yield every way to send a command: the source, a different speed for each, and a function."""
    speeds = (number / 100 for number in itertools.count(1))

    def put(key: str, payload: bytes, **named: str) -> Callable[[], None]:
        return lambda: session.put(f"acsard/acsar/{key}", payload, **named)  # type: ignore[arg-type]

    for name, form in itertools.product((TWIST, STAMPED), FORMATS):
        payload = encode(moving(name, speed := next(speeds)), form)
        named = encoding_name(form, name.rpartition("/")[2])
        yield "nav", speed, put("cmd/nav", payload, encoding=named)
        payload = encode(moving(name, speed := next(speeds)), form)
        yield "nav", speed, put("cmd/nav", payload)
    for form in FORMATS:
        payload = encode(moving(JOINTS, speed := next(speeds)), form)
        yield "ros2_control", speed, put("wheel_cmd/ros2_control", payload)
    topics = {
        "cmd_vel": "nav",
        "cmd_vel_dock": "dock",
        "cmd_vel_teleop": "teleop",
        "joint_commands": "ros2_control",
    }
    for client, (topic, source) in itertools.product(
        (RmwClient(session), BridgeHalf(session)), topics.items()
    ):
        for name in (JOINTS,) if topic == "joint_commands" else (TWIST, STAMPED):
            payload = encode(moving(name, speed := next(speeds)), "cdr")
            yield source, speed, partial(client.put, topic, name, payload)


def requested_speeds(messages: list[Any]) -> list[tuple[str, float, float]]:
    """Return the frame and the two speeds of each message."""
    return [(m.header.frame_id, m.twist.linear.x, m.twist.angular.z) for m in messages]


@pytest.mark.nightly
@SLOW
def test_commands_of_every_type_and_transport_are_shown_as_in_an_export(tmp_path: Path) -> None:
    words = ["--record", str(tmp_path / "record")]
    with Daemon(tmp_path, words=words) as daemon, Shows(daemon) as own, Viewer(own.port) as viewer:
        sources = ("teleop", "ros2_control", "dock", "nav")
        looked = {source: viewer.show(f"/cmd_vel_in/{source}") for source in sources}
        read: dict[str, list[Any]] = {source: [] for source in sources}

        def shown(source: str) -> list[tuple[str, float, float]]:
            stream, known = looked[source], read[source]
            known += [stream.read(came.payload) for came in stream.came[len(known) :]]
            return requested_speeds(known)

        with session_at(daemon.endpoint) as session:
            for source, speed, send in every_way(session):

                def came(source: str = source, speed: float = speed, send: Any = send) -> bool:
                    send()
                    return any(linear == pytest.approx(speed) for _, linear, _ in shown(source))

                until(came, 5.0, f"{speed} of {source}")
            session.put("acsard/acsar/cmd/nav", b'{"linear": {"x": 1}}')
            session.delete("acsard/acsar/cmd/nav")
        daemon.process.terminate()
        assert daemon.ended(5.0) == 0
    (path,) = (tmp_path / "record").glob("*.mcap")
    ended = finish(acsard("recording", "export", str(path), str(tmp_path / "new.mcap")), tmp_path)
    assert ended.code == 0, ended
    messages = exported(tmp_path / "new.mcap")
    for source in sources:
        live, written = shown(source), requested_speeds(messages[f"/cmd_vel_in/{source}"])
        # The first message may have come before the subscription.
        assert live == written[-len(live) :]


def exported(path: Path) -> dict[str, list[Any]]:
    """Return the messages of each topic."""
    messages: dict[str, list[Any]] = {}
    store: Any = get_typestore(Stores.EMPTY)
    with path.open("rb") as stream:
        for schema, channel, message in make_reader(stream).iter_messages():
            assert schema is not None
            if schema.name not in store.types:
                store.register(get_types_from_msg(schema.data.decode(), schema.name))
            content = store.deserialize_cdr(message.data, schema.name)
            messages.setdefault(channel.topic, []).append(content)
    return messages


@SLOW
@pytest.mark.nightly
def test_the_log_topic_has_each_event_of_the_daemon_once(viewer: Viewer, bus: Bus) -> None:
    looked = viewer.show("/log")
    looked.first()
    assert bus.get("srv/stop")["success"]
    assert bus.get("srv/clear")["success"]
    until(lambda: any("stopped by unnamed" in line for line in lines(looked)), 5.0, "the stop")
    events = bus.get("events")["events"]
    pairs = [(event["name"], event["text"].partition(" (")[0]) for event in events]

    def all_of_them() -> bool:
        messages = [looked.read(entry.payload) for entry in list(looked.came)]
        rows = [(m.name, m.msg.partition(" (")[0]) for m in messages]
        # More events may have happened since, because a busy machine keeps a link waiting.
        return any(rows[at : at + len(pairs)] == pairs for at in range(len(rows)))

    until(all_of_them, 5.0, f"{pairs} in {lines(looked)}")
    payloads = [entry.payload for entry in looked.came]
    assert len(payloads) == len(set(payloads))


def lines(log: SubscribedTopic) -> list[str]:
    return [log.read(message.payload).msg for message in list(log.came)]


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


@SLOW
def test_without_drive_foxglove_accepts_a_stop_and_no_commands(shared: Daemon, bus: Bus) -> None:
    with Shows(shared, "--id", "acsar") as own, Viewer(own.port) as viewer:
        assert viewer.info["capabilities"] == ["services"]
        looked = viewer.show("/odom")
        send, _ = viewer.publish_on("/cmd_vel", "json", "geometry_msgs/Twist")
        before = bus.count("commands")
        send(speed(0.3))
        looked.first(len(looked.came) + 20)
        assert bus.count("commands") == before
        assert set(viewer.services) == {"/acsard/stop"}
        assert viewer.call("/acsard/stop", {})["success"]
        assert bus.state()["mode"] == "stopped"
        assert bus.get("srv/clear")["success"]


@SLOW
def test_an_older_viewer_is_refused_and_the_terminal_says_why(shows: Shows, bus: Bus) -> None:
    with pytest.raises(InvalidStatus):
        Viewer(shows.port, "foxglove.websocket.v1")
    until(lambda: "as Lichtblick before 2026 is" in shows.stderr, 5.0, shows.stderr)


# services and parameters


def test_services_answer_in_the_daemon_s_words(viewer: Viewer, bus: Bus) -> None:
    assert viewer.call("/acsard/stop", {})["message"].startswith("stopped and latched")
    assert bus.state()["mode"] == "stopped"
    assert viewer.call("/acsard/clear", {})["success"]
    assert viewer.call("/acsard/set_pose", {"x": 1.0, "y": 2.0, "yaw": 0.0})["success"]
    assert bus.state()["y"] == 2.0
    refused = viewer.call("/acsard/set_pose", {"x": "here"})
    assert not refused["success"]
    assert 'set_pose needs a payload like {"x": 0, "y": 0, "yaw": 0}' in refused["message"]
    assert viewer.call("/acsard/deactivate", {})["success"]
    assert bus.state()["mode"] == "inactive"
    assert viewer.call("/acsard/activate", {})["success"]
    assert viewer.call("/acsard/reset_odometry", {})["success"]
    assert bus.state()["y"] == 0.0


@SLOW
def test_parameters_are_the_live_settings_and_errors_are_reported(viewer: Viewer, bus: Bus) -> None:
    assert viewer.get()["limits.linear_speed"] == 1.0
    viewer.follow("limits.linear_speed")
    viewer.set({"limits.linear_speed": 2})
    until(lambda: viewer.parameters["limits.linear_speed"] == 2.0, 5.0, "the published change")
    assert bus.get("config")["limits"]["linear_speed"] == 2.0
    # The reply has the present value, so that the panel shows that again.
    assert viewer.set({"limits.linear_speed": 99}) == {"limits.linear_speed": 2.0}
    assert "a number from 0 to 10 m/s" in viewer.status("not set: limits.linear_speed")["message"]
    viewer.set({"drive.wheel_radius": 1.0})
    viewer.status("read only when the daemon starts")
    bus.get("srv/set", {"settings": {"limits.linear_speed": 1.0}})
    until(lambda: viewer.get()["limits.linear_speed"] == 1.0, 5.0, "what another has set")


@SLOW
def test_a_change_above_the_size_limit_is_refused_and_delays_no_topic(
    viewer: Viewer, bus: Bus
) -> None:
    looked = viewer.show("/odom")
    looked.first()
    begun, count = time.monotonic(), len(looked.came)
    for _ in range(4):
        viewer.set({"limits.linear_speed": "x" * 70_000})
    refusal = "not set: the payload has over 4096 bytes"
    viewer.status(refusal)
    until(lambda: len(looked.came) > count + 20, 2.0, "odometry meanwhile")
    assert time.monotonic() - begun < 3.0
    assert bus.get("config")["limits"]["linear_speed"] == 1.0


# driving


@SLOW
@pytest.mark.parametrize("encoding", ["json", "cdr"])
def test_a_held_button_drives_and_its_release_stops_the_robot(
    viewer: Viewer, bus: Bus, encoding: str
) -> None:
    twist = Twist(Vector3(x=0.4), Vector3())
    data = speed(0.4) if encoding == "json" else encode(twist, "cdr")
    before = bus.state()["x"]
    with Panel(viewer, data, encoding):
        state = driving(bus)
        assert state["source"] == "app"
        until(lambda: bus.state()["x"] > before + 0.3, 10.0, "0.3 m")
    assert bus.at_rest()["x"] > before + 0.3


@SLOW
def test_a_button_that_is_held_through_a_new_connection_does_not_drive(
    shows: Shows, bus: Bus
) -> None:
    hold = b'{"linear": {"x": 0.4}, "angular": {}}'
    with Viewer(shows.port) as viewer, Panel(viewer, hold) as panel:
        driving(bus, 0.2)
        bus.get("srv/stop")
        panel.release()
    with Viewer(shows.port) as viewer:
        assert bus.get("srv/clear")["success"]
        bus.at_rest()
        send, _ = viewer.publish_on("/cmd_vel", "json", "geometry_msgs/Twist")
        before = bus.state()["x"]
        for _ in range(60):
            send(hold)
            time.sleep(0.05)
        assert bus.state()["x"] == pytest.approx(before, abs=1e-3)
        viewer.status("must send a zero")


@SLOW
def test_each_viewer_is_a_sender_of_its_own(viewer: Viewer, shows: Shows, bus: Bus) -> None:
    with Panel(viewer, speed(0.2)):
        first = driving(bus, 0.1)["sender"]
        with Viewer(shows.port) as other, Panel(other, speed(-0.2)):
            other.status(
                f"your commands do not drive the robot: another program, {first}, drives the "
                "robot as source app"
            )
            assert (bus.state()["linear"] or 0.0) > 0.0
    bus.at_rest()
    with Viewer(shows.port) as other, Panel(other, speed(0.2)):
        assert driving(bus, 0.1)["sender"] != first


@SLOW
def test_a_viewer_whose_commands_do_not_drive_sees_the_reason_until_they_do(
    viewer: Viewer, bus: Bus
) -> None:
    bus.get("srv/stop")
    with Panel(viewer, speed(0.2)):
        status = viewer.status(
            "your commands do not drive the robot: stopped by unnamed (native) at"
        )
        assert bus.get("srv/clear")["success"]
        viewer.status("drive (release the button for two seconds, and press it again)")
    until(lambda: status["id"] in viewer.removed, 5.0, "it is over")


@SLOW
def test_input_that_is_not_a_command_is_reported(viewer: Viewer) -> None:
    send, _ = viewer.publish_on("/cmd_vel", "json", "geometry_msgs/Twist")
    send(b'{"linear": {"x": 1}}')
    viewer.status("refused: the message needs both `linear` and `angular`")
    send, _ = viewer.publish_on("/initialpose", "json", "geometry_msgs/Twist")
    send(speed(1.0))
    viewer.status("no program listens on /initialpose: send commands to /cmd_vel instead")


@SLOW
def test_a_publisher_that_sends_too_seldom_is_reported(viewer: Viewer) -> None:
    send, _ = viewer.publish_on("/cmd_vel", "json", "geometry_msgs/Twist")
    until_told = time.monotonic() + 30.0
    while not viewer.statuses and time.monotonic() < until_told:
        send(speed(0.0))
        time.sleep(0.5)
    viewer.status("publish rate to 10 Hz or more")


@SLOW
def test_a_viewer_that_reads_nothing_or_floods_does_not_delay_other_viewers(
    viewer: Viewer, shows: Shows, bus: Bus
) -> None:
    looked = viewer.show("/odom")
    everything = [channel["id"] for channel in viewer.channels.values()]
    with opened(shows.port) as mute, bus.follow("cmd/app") as commands:
        asked = [{"id": number, "channelId": channel} for number, channel in enumerate(everything)]
        mute.send(json.dumps({"op": "subscribe", "subscriptions": asked}))
        looked.first(len(looked.came) + 50)
        flood = 5000
        send, _ = viewer.publish_on("/cmd_vel", "json", "geometry_msgs/Twist")
        for _ in range(flood):
            send(speed(0.0))
        looked.first(len(looked.came) + 50)
        # The newest command is sent, no faster than the bus accepts; those in between are dropped.
        assert 0 < len(commands.seen) < flood / 5


@contextmanager
def followed(bus: Bus) -> Iterator[tuple[list[Any], list[Any]]]:
    """Collect the commanded and the applied speeds, each with this process's time of arrival."""
    asked: list[Any] = []
    applied: list[Any] = []

    def keep(key: str, points: list[Any]) -> Any:
        def take(sample: Any) -> None:
            points.append((time.monotonic(), read(sample)["twist"]["linear"]["x"]))

        return bus.session.declare_subscriber(f"{bus.root}/{key}", take)

    subscribers = [keep("cmd/app", asked), keep("cmd_vel_out", applied)]
    bus.ask("info")
    try:
        yield asked, applied
    finally:
        for subscriber in subscribers:
            subscriber.undeclare()


TIMEOUT_S, TICKS_S = 0.25, 0.02


@pytest.mark.variations(4)
@SLOW
@pytest.mark.parametrize("how", ["cut", "withdrawn", "killed", "left"])
def test_the_robot_ramps_down_if_the_viewer_or_foxglove_ends_while_it_drives(
    shared: Daemon, bus: Bus, how: str
) -> None:
    with Shows(shared) as own, Viewer(own.port) as viewer, followed(bus) as (asked, applied):
        with Panel(viewer, speed(0.4)) as panel:
            driving(bus, 0.35)
            begun = time.monotonic()
            if how == "cut":
                viewer.cut()
            elif how == "withdrawn":
                panel.release()
                viewer.withdraw(panel.channel)
            elif how == "killed":
                own.signal(signal.SIGKILL)
            else:
                own.signal(signal.SIGINT)
                assert own.ended(1.0) == 0
        bus.at_rest()
        last = max(at for at, linear in asked if linear > 0)
        slower = next(at for at, linear in applied if at > last and linear < 0.39)
        assert slower - last < TIMEOUT_S + TICKS_S + lost(begun)
        zeros = [at for at, linear in asked if at > last and linear == 0]
        # A killed program cannot send a zero; the source's timeout stops the robot.
        assert len(zeros) == (0 if how == "killed" else 1)


@SLOW
def test_commands_that_a_suspended_foxglove_process_held_back_move_no_robot(
    shared: Daemon, bus: Bus
) -> None:
    with Shows(shared) as own, Viewer(own.port) as viewer, followed(bus) as (asked, _):
        with Panel(viewer, speed(0.4)):
            driving(bus, 0.3)
            own.signal(signal.SIGSTOP)
            bus.at_rest()
        stood = len(asked)
        own.signal(signal.SIGCONT)
        viewer.show("/odom").first()
        assert [linear for _, linear in asked[stood:] if linear] == []


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
            viewer.status("the daemon of robot acsar is back", 10.0)
            until(lambda: status["id"] in viewer.removed, 5.0, "it is not gone any more")
            count = len(looked.came)
            until(lambda: len(looked.came) > count + 10, 10.0, "odometry again")
            assert viewer.call("/acsard/stop", {})["success"]


@SLOW
def test_foxglove_ends_while_a_connection_never_sends_its_request(shared: Daemon) -> None:
    with Shows(shared) as own, socket.create_connection(("127.0.0.1", own.port)):
        with Viewer(own.port):  # the server has accepted the silent connection, too
            pass
        own.signal(signal.SIGTERM)
        assert own.ended(STOP_TIMEOUT_S) == 0


@SLOW
def test_a_port_that_is_in_use_ends_with_75_and_the_remedy(shared: Daemon, tmp_path: Path) -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        address = f"127.0.0.1:{listener.getsockname()[1]}"
        words = ("foxglove", "--config", str(shared.config), "--address", address)
        ended = finish(acsard(*words), tmp_path)
    assert ended.code == 75
    assert f"cannot listen on {address}: " in ended.err
    assert "Address already in use" in ended.err
    assert "--address 127.0.0.1:" in ended.err
    assert "Traceback" not in ended.err


@SLOW
@pytest.mark.nightly
def test_foxglove_without_shown_topics_costs_little_processor_time(
    shows: Shows, viewer: Viewer, bus: Bus
) -> None:
    def cost() -> float:
        """Return the processor time while the daemon publishes 300 odometry messages, s."""
        with bus.follow("odom") as odom:
            before = cpu_seconds(shows.pid)
            until(lambda: len(odom.seen) >= 300, 20.0, "three seconds of odometry")
            return cpu_seconds(shows.pid) - before

    alone = cost()
    looked = [viewer.show(topic) for topic in ("/odom", "/tf", "/joint_states")]
    for view in looked:
        view.first()
    assert alone < cost() / 2


@SLOW
def test_commands_with_old_stamps_move_no_robot(viewer: Viewer, bus: Bus) -> None:
    name = "geometry_msgs/msg/TwistStamped"
    send, _ = viewer.publish_on("/cmd_vel", "json", name)
    twist = json.loads(speed(0.4))

    def stamped(ns: int) -> None:
        sec, nanosec = divmod(ns, NS_PER_S)
        header = {"stamp": {"sec": sec, "nanosec": nanosec}, "frame_id": ""}
        send(json.dumps({"header": header, "twist": twist}).encode())
        time.sleep(0.05)

    time.sleep(CONNECTED_S)
    began, until_driven = time.time_ns(), time.monotonic() + 20.0
    while (bus.state()["linear"] or 0.0) < 0.2 or time.time_ns() - began < NS_PER_S:
        assert time.monotonic() < until_driven, bus.state()["reason"]
        stamped(time.time_ns())
    with followed(bus) as (asked, applied):
        # A tunnel that was interrupted delivers, one by one, messages that entered it more than 1 s
        # ago.
        bus.at_rest()
        stood = len(applied)
        for number in range(40):
            stamped(began + number * 50_000_000)
        assert len(asked) >= 40
        until(lambda: len(applied) > stood, 5.0, "what is applied")
    assert {linear for _, linear in applied[stood:]} == {0.0}
