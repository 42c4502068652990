"""Tests of how a viewer's commands reach the bus: their stamps, and failures of the bus."""

from __future__ import annotations

from collections.abc import Iterator
from threading import Event
from typing import Any

import pytest
import zenoh

from acsard.client import Client
from acsard.client.commander import BURST_WINDOW_NS, STALE_NS, Wish
from acsard.core import values
from acsard.core.config.settings import DriveConfig, JointsConfig
from acsard.core.incoming.commands import Arrival, Receiver
from acsard.core.messages.encodings import DecodeError, encode
from acsard.core.messages.schema import Header, Message, Time, Twist, TwistStamped, Vector3
from acsard.core.motion.kinematics import Kinematics
from acsard.core.values import NS_PER_S, REST, Command
from acsard.foxglove import drives
from acsard.foxglove.drives import DrivingViewers, Viewer, encoding_of, wish
from acsard.foxglove.notices import Notices
from acsard.host import clock
from tests.each import each
from tests.system.harness import until

RECEIVER = Receiver(JointsConfig(), Kinematics(DriveConfig()))

AHEAD, STILL = Twist(Vector3(x=0.3), Vector3()), Twist(Vector3(), Vector3())

AHEAD_AT = values.Twist(0.3, 0.0)

HOLD_S = 5.0


class Session:
    """A session that records puts as the daemon would receive them.

    It can also block or fail like a broken bus.
    """

    def __init__(self) -> None:
        self.heard: list[Command] = []
        self.locked, self.entered = False, Event()
        self.free = Event()
        self.broken = False

    def zid(self) -> str:
        return "0123456789abcdef"

    def new_timestamp(self) -> None:
        return None

    def put(self, key: str, payload: bytes, *, encoding: str, attachment: bytes, **_: Any) -> None:
        if self.broken:
            raise zenoh.ZError("closed")
        if self.locked:
            self.entered.set()
            assert self.free.wait(HOLD_S)
        key = key.removeprefix("acsard/acsar/")
        arrival = Arrival(key, True, payload, encoding, 0, None, "", attachment=attachment)
        self.heard.append(RECEIVER.command(arrival))


class Viewers:
    """Viewers with one session each."""

    def __init__(self) -> None:
        self.sessions: dict[int, Session] = {1: Session(), 2: Session()}
        self.notices = Notices(lambda text: None, lambda: None)
        self.drives = DrivingViewers(self._robot, "/cmd_vel", self.notices, "")
        for viewer in self.sessions:
            for channel, name in ((1, "Twist"), (2, "TwistStamped")):
                kind = f"geometry_msgs/msg/{name}"
                self.drives.advertised(viewer, channel, "/cmd_vel", "cdr", kind)

    def _robot(self, viewer: int) -> Client:
        fake: Any = self.sessions[viewer]
        return Client(fake, "acsar", "app")

    def publish(self, viewer: int, message: Message) -> None:
        channel = 2 if isinstance(message, TwistStamped) else 1
        self.drives.received(viewer, channel, encode(message, "cdr"))

    def wait_for_commands(self, viewer: int, count: int) -> list[Command]:
        """Wait until the bus has at least `count` commands of this viewer, and return them."""
        commands = self.sessions[viewer].heard
        until(
            lambda: len(commands) >= count, HOLD_S, f"{count} commands of {viewer}, not {commands}"
        )
        return commands


@pytest.fixture
def viewers() -> Iterator[Viewers]:
    """Viewers that connected 2 s ago."""
    ago_ns = clock.steady_ns() - 2 * NS_PER_S
    with pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(clock, "steady_ns", lambda: ago_ns)
        viewers = Viewers()
    yield viewers
    for session in viewers.sessions.values():
        session.free.set()
    viewers.drives.end()


def test_a_viewer_that_leaves_while_its_message_is_decoded_sends_nothing_more(
    viewers: Viewers, monkeypatch: pytest.MonkeyPatch
) -> None:
    viewers.publish(1, AHEAD)
    viewers.wait_for_commands(1, 2)

    def leaves(encoding: str, data: bytes) -> Wish:
        viewers.drives.withdrawn(1, 1)
        viewers.drives.withdrawn(1, 2)
        return wish(encoding, data)

    monkeypatch.setattr(drives, "wish", leaves)
    viewers.publish(1, AHEAD)
    viewers.drives.outbox.flush(HOLD_S)
    assert viewers.wait_for_commands(1, 3)[-1].twist == REST
    assert not viewers.drives.driving()


def test_a_viewer_that_has_just_connected_sends_no_zero_of_its_own(viewers: Viewers) -> None:
    """The bridge adds no zero, because the viewer's button may already be held.

    A zero would arm the viewer, and the robot would move at once.
    """
    for channel in (1, 2):
        viewers.drives.withdrawn(1, channel)
    viewers.drives.advertised(1, 3, "/cmd_vel", "cdr", "geometry_msgs/msg/Twist")
    viewers.drives.received(1, 3, encode(AHEAD, "cdr"))
    assert viewers.wait_for_commands(1, 1)[0].twist.linear == 0.3


def test_a_stamp_is_passed_on_and_the_added_zeros_use_the_same_clock(viewers: Viewers) -> None:
    long_ago_ns = clock.now().wall_ns - 100 * NS_PER_S
    viewers.publish(1, TwistStamped(Header(Time.from_ns(long_ago_ns)), AHEAD))
    viewers.wait_for_commands(1, 2)
    viewers.drives.withdrawn(1, 2)
    commands = viewers.wait_for_commands(1, 3)
    assert [command.twist.linear for command in commands] == [0.0, 0.3, 0.0]
    assert [command.stamp_ns for command in commands[:2]] == [
        long_ago_ns - BURST_WINDOW_NS,
        long_ago_ns,
    ]
    assert len({command.clock for command in commands}) == 1
    assert commands[2].stamp_ns is not None
    assert 0 <= commands[2].stamp_ns - long_ago_ns < HOLD_S * NS_PER_S


def test_a_plain_twist_has_the_time_of_its_receipt(viewers: Viewers) -> None:
    before_ns = clock.now().wall_ns
    viewers.publish(1, AHEAD)
    for command in viewers.wait_for_commands(1, 2):
        assert command.stamp_ns is not None
        assert abs(command.stamp_ns - before_ns) < HOLD_S * NS_PER_S


def test_a_command_that_waited_for_another_viewer_s_locked_bus_is_dropped(
    viewers: Viewers,
) -> None:
    for viewer in viewers.sessions:
        viewers.publish(viewer, AHEAD)
        viewers.wait_for_commands(viewer, 2)
    first, second = viewers.sessions.values()
    first.locked = True
    # the sender thread waits for this lock, so both commands fall due in one round
    with viewers.drives.outbox._news:
        for viewer in viewers.sessions:
            viewers.publish(viewer, AHEAD)
        given_ns = clock.mono_ns()
    assert first.entered.wait(HOLD_S)
    until(lambda: clock.mono_ns() - given_ns > STALE_NS, HOLD_S, "that it is too old")
    first.free.set()
    viewers.wait_for_commands(1, 3)
    viewers.publish(2, STILL)
    until(lambda: second.heard[-1].twist == REST, HOLD_S, "the zero behind it")
    assert [command.twist.linear for command in second.heard if command.twist != REST] == [0.3]


def test_a_viewer_does_not_drive_after_a_suspend(
    viewers: Viewers, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The bridge must include the suspend, in which the monotonic clock stands still."""
    viewers.publish(1, AHEAD)
    assert list(viewers.drives.driving()) == [1]
    monkeypatch.setattr(clock, "asleep_ns", lambda: 10**15)
    assert not viewers.drives.driving()


def test_a_bus_that_fails_for_one_viewer_is_reported_and_serves_the_others(
    viewers: Viewers,
) -> None:
    viewers.sessions[1].broken = True
    viewers.publish(1, AHEAD)
    until(lambda: waiting_texts(viewers.notices), HOLD_S, "that the bus takes nothing")
    assert "the bus accepts no commands" in waiting_texts(viewers.notices)[0]
    viewers.publish(2, AHEAD)
    assert [command.twist.linear for command in viewers.wait_for_commands(2, 2)] == [0.0, 0.3]
    viewers.sessions[1].broken = False
    viewers.publish(1, AHEAD)
    viewers.wait_for_commands(1, 1)


@each(("rate", "slow"), [(1.0, True), (2.0, True), (5.0, False), (20.0, False)])
def test_a_panel_that_publishes_too_seldom_is_detected(rate: float, slow: bool) -> None:
    assert is_called_slow(NS_PER_S / rate) is slow


def test_single_presses_are_not_reported_as_a_slow_panel() -> None:
    assert not is_called_slow(4.0 * NS_PER_S)


def test_a_command_on_a_channel_beyond_the_limit_is_reported(viewers: Viewers) -> None:
    for channel in range(100):
        viewers.drives.advertised(1, channel, "/cmd_vel", "cdr", "geometry_msgs/msg/Twist")
    viewers.drives.received(1, 63, encode(AHEAD, "cdr"))
    assert not waiting_texts(viewers.notices)
    viewers.drives.received(1, 64, encode(AHEAD, "cdr"))
    assert ["64 topics at most" in text for text in waiting_texts(viewers.notices)] == [True]


def is_called_slow(every_ns: float) -> bool:
    """Return whether the bridge warns a panel that publishes at this interval to be too slow."""
    robot: Any = None
    viewer = Viewer(robot)
    times = [round(n * every_ns) for n in range(6)]
    return [viewer.is_slow(viewer.commander.take(Wish(AHEAD_AT), at)) for at in times][-1]


def waiting_texts(notices: Notices) -> list[str]:
    return [notice.text for notice in notices._waiting.waiting]


# the messages of a panel: accepted whole, or refused with the reason

MESSAGE = Twist(Vector3(x=0.3), Vector3(z=-0.2))
STAMPED = TwistStamped(Header(Time(5)), MESSAGE)


@pytest.mark.parametrize("name", ["geometry_msgs/Twist", "geometry_msgs/msg/Twist"])
@pytest.mark.parametrize("form", ["json", "cdr"])
def test_a_panel_s_twist_is_decoded(name: str, form: str) -> None:
    encoding = encoding_of(form, name)
    result = wish(encoding, encode(MESSAGE, "json" if form == "json" else "cdr"))
    assert result == Wish(values.Twist(0.3, -0.2))


@pytest.mark.parametrize("form", ["json", "cdr"])
def test_a_panel_s_stamped_twist_is_decoded_with_its_stamp(form: str) -> None:
    encoding = encoding_of(form, "geometry_msgs/msg/TwistStamped")
    result = wish(encoding, encode(STAMPED, "json" if form == "json" else "cdr"))
    assert result == Wish(values.Twist(0.3, -0.2), 5 * NS_PER_S)


@each(
    ("form", "name"),
    [
        ("json", "std_msgs/msg/String"),
        ("json", "Twist"),
        ("json", ""),
        ("ros1", "geometry_msgs/Twist"),
        ("", "geometry_msgs/Twist"),
    ],
)
def test_a_topic_type_that_cannot_drive_is_refused_when_it_is_advertised(
    form: str, name: str
) -> None:
    with pytest.raises(DecodeError, match=r"use geometry_msgs/msg/Twist|use json or cdr"):
        encoding_of(form, name)


@each(
    "payload",
    [
        b"",
        b"{}",
        b'{"linear": {"x": 1}}',
        b'{"linear": {"x": "fast"}, "angular": {}}',
        b'{"linear": {"x": NaN}, "angular": {}}',
        b'{"linear": {"x": 1}, "angular": {}, "more": 1}',
        b"\xff" * 60,
        b'{"linear": {"x": 1}, "angular": {}}' + b" " * 5000,
    ],
)
def test_a_payload_that_is_not_a_twist_is_refused(payload: bytes) -> None:
    with pytest.raises(DecodeError):
        wish(encoding_of("json", "geometry_msgs/Twist"), payload)


@each("cut", range(0, 52, 4))
def test_cdr_cut_anywhere_is_refused(cut: int) -> None:
    with pytest.raises(DecodeError):
        wish(encoding_of("cdr", "geometry_msgs/Twist"), encode(MESSAGE, "cdr")[:cut])
