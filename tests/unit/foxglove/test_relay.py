"""The bridge makes one log line of each event, and shows a command as in an exported recording."""

from __future__ import annotations

import os

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config, RosConfig
from acsard.core.incoming.commands import Arrival
from acsard.core.messages.encodings import FORMATS, DecodeError, Format, encode
from acsard.core.messages.keys_and_roles import full_key
from acsard.core.messages.schema import (
    Events,
    Header,
    JointState,
    LogEvent,
    Time,
    Twist,
    TwistStamped,
    Vector3,
)
from acsard.core.ros.attachments import Attachment
from acsard.core.ros.transports import SOURCES, command_keys
from acsard.foxglove.relay import CommandForm, EventDeduplicator, Reader, command_forms
from tests.each import each

KEPT = 20


def events(total: int, of: str = "first") -> Events:
    """Return the daemon's recent events after this many events have happened."""
    numbers = range(max(0, total - KEPT), total)
    log_events = [LogEvent(Time(n), f"mode{n}", "warning", f"{of} {n}", "ann", 1) for n in numbers]
    return Events(Time(total), total, log_events)


def names(deduplicator: EventDeduplicator, report: Events) -> list[str]:
    return [line.name for line in deduplicator.of(report)]


def test_the_first_answer_gives_all_stored_events() -> None:
    lines = EventDeduplicator().of(events(3))
    assert [(line.stamp.sec, line.level, line.name) for line in lines] == [
        (0, 30, "mode0"),
        (1, 30, "mode1"),
        (2, 30, "mode2"),
    ]
    assert lines[0].msg == "first 0 (by ann)"
    assert len(EventDeduplicator().of(events(1000))) == KEPT


@each(("before", "now"), [(3, 4), (3, 3), (0, 5), (19, 23), (40, 60), (40, 55)])
def test_each_event_is_reported_once(before: int, now: int) -> None:
    deduplicator = EventDeduplicator()
    deduplicator.of(events(before))
    assert names(deduplicator, events(now)) == [f"mode{n}" for n in range(before, now)]


def test_events_that_the_daemon_no_longer_stores_are_skipped() -> None:
    deduplicator = EventDeduplicator()
    deduplicator.of(events(10))
    assert names(deduplicator, events(100)) == [f"mode{n}" for n in range(80, 100)]


def test_an_answer_older_than_the_last_message_reports_no_event() -> None:
    deduplicator = EventDeduplicator()
    deduplicator.of(events(10))
    assert names(deduplicator, events(9)) == []
    assert names(deduplicator, events(11)) == ["mode10"]


def test_an_event_that_is_updated_does_not_report_older_events_again() -> None:
    deduplicator, fault = EventDeduplicator(), events(1).events[0]
    missed = LogEvent(Time(5), "periods_missed", "warning", "3 more periods", "", 1)
    deduplicator.of(Events(Time(5), 2, [fault, missed]))
    later = replace(missed, stamp=Time(8), text="9 more periods")
    assert names(deduplicator, Events(Time(8), 4, [fault, later])) == ["periods_missed"]


def test_a_restarted_daemon_s_events_are_reported_from_the_first() -> None:
    deduplicator = EventDeduplicator()
    deduplicator.of(events(10))
    later = replace(events(2, "second"), stamp=Time(11))
    assert names(deduplicator, later) == ["mode0", "mode1"]


@each("total", [3, 4])
def test_a_restarted_daemon_that_has_logged_as_many_events_reports_all_of_them(total: int) -> None:
    deduplicator = EventDeduplicator()
    deduplicator.of(events(3))
    restarted = [replace(event, stamp=Time(10)) for event in events(total, "second").events]
    event_names = names(deduplicator, Events(Time(11), total, restarted))
    assert event_names == [f"mode{n}" for n in range(total)]


TWIST = Twist(Vector3(x=0.3), Vector3(z=-0.2))
STAMPED = TwistStamped(Header(Time(5), "elsewhere"), TWIST)
NAMES = list(Config().joints.as_tuple())


def forms_of(source: str, ros: RosConfig) -> dict[str, CommandForm]:
    return command_forms(lambda key: full_key("robot", key), ros, source)


def arrival(payload: bytes, form: CommandForm, put: bool = True) -> Arrival:
    attached = Attachment(1, 2, os.urandom(16)).pack() if form.via == "rmw" else b""
    return Arrival(form.native, put, payload, form.encoding, 7, None, "", form.via, attached)


NAV = CommandForm("cmd/nav")


def read(payload: bytes, form: CommandForm = NAV, put: bool = True) -> TwistStamped:
    return Reader(Config()).read(arrival(payload, form, put), 9_000_000_001)


def test_a_source_commands_on_its_native_keys_and_those_of_ros() -> None:
    app = {f"acsard/robot/{kind}/app{end}" for kind in ("cmd", "wheel_cmd") for end in ("", "/*")}
    assert set(forms_of("app", RosConfig())) == app
    nav = forms_of("nav", RosConfig())
    assert {form.via for form in nav.values()} == {"native", "bridge", "rmw"}
    native = {form.native for form in nav.values()}
    assert native == {"cmd/nav", "wheel_cmd/nav", "cmd/nav/*", "wheel_cmd/nav/*"}
    assert len(nav) == 4 + 1 + 2  # over rmw, a topic with two types has two keys


def test_every_ros_command_key_belongs_to_a_source() -> None:
    ros = RosConfig()
    source_keys = {key for source in SOURCES.values() for key in forms_of(source, ros)}
    others = ("imu", "speed_limit")
    assert {key for key in command_keys(ros) if not any(o in key for o in others)} <= source_keys


def test_a_namespace_is_before_the_names_of_ros_and_a_tree_that_is_off_has_none() -> None:
    apart = forms_of("nav", RosConfig(namespace="one", rmw=False))
    assert [key for key, form in apart.items() if form.via != "native"] == ["one/cmd_vel"]
    assert len(forms_of("nav", RosConfig(bridge=False, rmw=False))) == 4


@each("form", FORMATS)
@each("message", [TWIST, STAMPED])
def test_a_twist_is_reported_with_the_time_it_came(
    form: Format, message: Twist | TwistStamped
) -> None:
    command = read(encode(message, form))
    assert command == TwistStamped(Header(Time(9, 1), "base_link"), TWIST)


@pytest.mark.parametrize("message", [TWIST, STAMPED], ids=["plain", "stamped"])
def test_a_twist_over_ros_is_decoded_the_same_way(message: Twist | TwistStamped) -> None:
    name = f"geometry_msgs::msg::dds_::{type(message).__name__}_"
    every = forms_of("nav", RosConfig()).items()
    fit = [form for key, form in every if form.via == "bridge" or f"/{name}/" in key]
    assert [form.via for form in fit] == ["bridge", "rmw"]
    for form in fit:
        assert read(encode(message, "cdr"), form).twist == TWIST


@pytest.mark.parametrize("form", FORMATS)
def test_wheel_speeds_are_shown_as_the_equivalent_twist(form: Format) -> None:
    wheels = JointState(name=NAMES, velocity=[6.0] * 4)
    command = read(encode(wheels, form), CommandForm("wheel_cmd/ros2_control"))
    assert command.twist.linear.x == pytest.approx(0.3)
    assert command.twist.angular.z == pytest.approx(0.0)


def test_wheels_and_frame_are_those_of_this_robot() -> None:
    mine = replace(
        Config(),
        drive=replace(Config().drive, wheel_radius=0.1),
        odometry=replace(Config().odometry, base_frame="trunk"),
    )
    payload = encode(JointState(name=NAMES, velocity=[6.0] * 4), "json")
    command = Reader(mine).read(arrival(payload, CommandForm("wheel_cmd/nav")), 0)
    assert command.header.frame_id == "trunk"
    assert command.twist.linear.x == pytest.approx(0.6)


@each(
    ("payload", "put"),
    [
        (b'{"linear": {"x": 1}}', True),
        (b'{"linear": {"x": 1}, "angular": {}}' + b" " * 5000, True),
        (b"", True),
        (encode(TWIST, "json"), False),
    ],
)
def test_a_payload_that_the_daemon_refuses_is_not_shown_as_a_command(
    payload: bytes, put: bool
) -> None:
    with pytest.raises(DecodeError):
        read(payload, put=put)
