"""The export of a recording contains the messages that other clients received meanwhile."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from functools import partial
from pathlib import Path
from typing import Any, NamedTuple

import msgspec
import pytest
from rosbags.rosbag2 import Reader
from rosbags.typesys import Stores, get_types_from_msg, get_typestore

from tests.scenarios.taped import ADDED
from tests.system.harness import ROOT, Bus, Daemon, acsard, finish, until

ROS = ("odom", "tf", "joint_states", "cmd_vel_out")

RECORDED = ROOT / "tests" / "recordings" / "quiet.rec.zst"


class ExportedFile(NamedTuple):
    """The contents of an exported file: the bytes of each topic, and a function to decode them."""

    data: dict[str, list[bytes]]
    times: dict[str, list[int]]
    decode: Callable[[str, bytes], Any]


def bag(path: Path) -> ExportedFile:
    store: Any = get_typestore(Stores.EMPTY)
    data: dict[str, list[bytes]] = {}
    times: dict[str, list[int]] = {}
    with Reader(path) as reader:
        types = {channel.topic: channel.msgtype for channel in reader.connections}
        for channel in reader.connections:
            store.register(get_types_from_msg(channel.msgdef.data, channel.msgtype))
        for connection, time_ns, raw in reader.messages():
            data.setdefault(connection.topic, []).append(raw)
            times.setdefault(connection.topic, []).append(time_ns)
    return ExportedFile(data, times, lambda topic, raw: store.deserialize_cdr(raw, types[topic]))


class LiveMessages:
    """The messages that arrived while the recording was made."""

    def __init__(self) -> None:
        self.data: dict[str, list[bytes]] = {}
        """The messages of each topic, on the keys of the ROS tree or of our own."""
        self.numbered: dict[str, list[tuple[int, bytes]]] = {}
        """The messages of each topic for nodes with rmw_zenoh, whose publisher numbers them."""
        self.displaced = 0
        """Number of messages of all topics that the daemon never sent, because newer ones came."""


def _take(payloads: list[bytes], sample: Any) -> None:
    payloads.append(sample.payload.to_bytes())


def _take_numbered(items: list[tuple[int, bytes]], sample: Any) -> None:
    number = int.from_bytes(sample.attachment.to_bytes()[:8], "little")
    items.append((number, sample.payload.to_bytes()))


@contextmanager
def collect_messages(bus: Bus) -> Iterator[LiveMessages]:
    """Collect all messages for ROS nodes (rmw_zenoh and bridge), and `state` and `events`."""
    live = LiveMessages()
    with ExitStack() as stack:
        for key in (*ROS, f"{bus.root}/state", f"{bus.root}/events"):
            payloads = live.data.setdefault(key.rpartition("/")[2], [])
            subscriber = bus.session.declare_subscriber(key, partial(_take, payloads))
            stack.callback(subscriber.undeclare)
        for topic in ROS:
            numbered = live.numbered.setdefault(topic, [])
            subscriber = bus.session.declare_subscriber(
                f"0/{topic}/**", partial(_take_numbered, numbered)
            )
            stack.callback(subscriber.undeclare)
        bus.ask("info")  # after the subscriptions
        yield live


def places(live: Sequence[Any], entries: Sequence[Any], topic: str) -> list[int]:
    """Return the index of each live message in the file.

    Fails if one is missing or in the wrong order.
    """
    at = iter(enumerate(entries))
    indexes = [next((n for n, other in at if other == message), None) for message in live]
    if None in indexes:
        missing = live[indexes.index(None)]
        stamped = [
            message
            for message in entries
            if not isinstance(message, bytes) and message[0] == missing[0]
        ]
        pytest.fail(
            f"{topic}: {indexes.index(None)} of {len(indexes)}: {missing}, written: {stamped}"
        )
    return [n for n in indexes if n is not None]


def assert_published(
    numbered: Sequence[tuple[int, Any]], entries: Sequence[Any], displaced: int, topic: str
) -> None:
    """Check the number of messages in the file against the publisher's sequence numbers.

    A busy machine may lose live messages, but the numbers of the others show how many were
    published.
    """
    assert len(numbered) > 50, topic
    indexes = places([message for _, message in numbered], entries, topic)
    published = numbered[-1][0] - numbered[0][0]
    assert published <= indexes[-1] - indexes[0] <= published + displaced, topic


pytestmark = pytest.mark.slow  # tests/scenarios/test_export.py has it in virtual time


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> Any:
    """The live messages, the static transforms as a query returned them, and the bag."""
    where = tmp_path_factory.mktemp("export")
    words = ["--record", str(where / "record")]
    with (
        Daemon(where, words=words) as daemon,
        Bus(daemon.endpoint) as bus,
        collect_messages(bus) as live,
    ):
        bus.linked()
        with bus.commanding(0.3, 0.2):
            before = len(live.data["odom"])
            until(lambda: len(live.data["odom"]) > before + 150, 5.0, "odometry")
        bus.get("srv/stop")
        until(lambda: any(b"stop" in payload for payload in live.data["events"]), 5.0, "the stop")
        static = bus.get("tf_static")
        daemon.process.terminate()
        assert daemon.ended(5.0) == 0
    live.displaced = max(
        msgspec.msgpack.decode(raw)["counters"].get("bus_dropped", 0) for raw in live.data["state"]
    )
    (path,) = (where / "record").glob("*.rec.zst")
    ended = finish(acsard("recording", "export", str(path), str(where / "bag"), "--rosbag2"), where)
    assert ended.code == 0, ended
    return live, static, bag(where / "bag")


@pytest.mark.parametrize("topic", ROS)
def test_every_exported_message_has_the_bytes_that_a_ros_node_received(
    topic: str, both: Any
) -> None:
    live, _, export = both
    assert len(live.data[topic]) > 50
    assert places(live.data[topic], export.data[f"/{topic}"], topic)
    assert_published(live.numbered[topic], export.data[f"/{topic}"], live.displaced, topic)


def test_the_exported_static_transforms_are_those_that_were_published(both: Any) -> None:
    _, static, export = both
    (raw,) = export.data["/tf_static"]
    message = export.decode("/tf_static", raw)
    for transform, other in zip(static["transforms"], message.transforms, strict=True):
        stamp = other.header.stamp
        assert transform["header"]["stamp"] == {"sec": stamp.sec, "nanosec": stamp.nanosec}
        assert transform["child_frame_id"] == other.child_frame_id
        assert transform["transform"]["translation"]["x"] == other.transform.translation.x


def test_every_published_event_is_in_the_exported_log(both: Any) -> None:
    live, _, export = both
    lines = [export.decode("/log", raw) for raw in export.data["/log"]]
    lines = [entry for entry in lines if entry.name not in ADDED]
    written = [(entry.stamp.sec, entry.stamp.nanosec, entry.name) for entry in lines]
    last = msgspec.msgpack.decode(live.data["events"][-1])
    live_events = [(*entry["stamp"].values(), entry["name"]) for entry in last["events"]]
    assert "stop" in {name for *_, name in live_events}
    indexes = places(live_events, written, "log")
    # Events of the same name that follow each other share a row in `events`.
    others = [
        entry
        for n, entry in enumerate(written)
        if indexes[0] < n < indexes[-1] and n not in indexes
    ]
    assert {name for *_, name in others} <= {"missed_periods"}


def test_the_export_has_each_command_under_its_source(both: Any) -> None:
    _, _, export = both
    sent = [export.decode("/cmd_vel_in/app", raw) for raw in export.data["/cmd_vel_in/app"]]
    speeds = {(command.twist.linear.x, command.twist.angular.z) for command in sent}
    assert speeds >= {(0.3, 0.2)}


def test_message_times_in_the_export_are_the_publication_stamps(both: Any) -> None:
    _, _, export = both
    for raw, time_ns in zip(export.data["/cmd_vel_out"], export.times["/cmd_vel_out"], strict=True):
        stamp = export.decode("/cmd_vel_out", raw).header.stamp
        assert stamp.sec * 10**9 + stamp.nanosec == time_ns


def test_an_export_to_a_full_disk_ends_with_one_sentence_and_leaves_no_file(tmp_path: Path) -> None:
    words = acsard("recording", "export", str(RECORDED), "new.mcap")
    full = ["sh", "-c", 'ulimit -f 16; exec "$@"', "sh", *words]  # blocks of 512 bytes per file
    ended = finish(full, tmp_path)
    assert (ended.code, ended.err) == (1, "acsard: cannot write new.mcap: File too large")
    assert not [*tmp_path.iterdir()]
