"""A command shown live equals the message in an export, whichever way it arrived."""

from __future__ import annotations

import os

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config, RosConfig
from acsard.core.incoming.commands import Arrival
from acsard.core.messages.encodings import FORMATS, DecodeError, Format, encode
from acsard.core.messages.schema import Header, JointState, Time, Twist, TwistStamped, Vector3
from acsard.core.messages.topics import full_key
from acsard.core.ros.attachments import Attachment
from acsard.core.ros.transports import command_keys
from acsard.foxglove.command_subscriptions import Reader, Way, ways
from tests.each import each

TWIST = Twist(Vector3(x=0.3), Vector3(z=-0.2))
STAMPED = TwistStamped(Header(Time(5), "elsewhere"), TWIST)
NAMES = list(Config().joints.as_tuple())


def found(source: str, ros: RosConfig) -> dict[str, Way]:
    return ways(lambda key: full_key("robot", key), ros, source)


def arrival(payload: bytes, way: Way, put: bool = True) -> Arrival:
    attached = Attachment(1, 2, os.urandom(16)).pack() if way.via == "rmw" else b""
    return Arrival(way.native, put, payload, way.encoding, 7, None, "", way.via, attached)


def read(payload: bytes, way: Way = Way("cmd/nav"), put: bool = True) -> TwistStamped:  # noqa: B008
    return Reader(Config()).read(arrival(payload, way, put), 9_000_000_001)


def test_a_source_commands_on_its_native_keys_and_those_of_ros() -> None:
    app = {f"acsard/robot/{kind}/app{end}" for kind in ("cmd", "wheel_cmd") for end in ("", "/*")}
    assert set(found("app", RosConfig())) == app
    nav = found("nav", RosConfig())
    assert {way.via for way in nav.values()} == {"native", "bridge", "rmw"}
    native = {way.native for way in nav.values()}
    assert native == {"cmd/nav", "wheel_cmd/nav", "cmd/nav/*", "wheel_cmd/nav/*"}
    assert len(nav) == 4 + 1 + 2  # over rmw, a topic with two types has two keys


def test_all_keys_of_ros_that_command_are_somebody_s() -> None:
    ros = RosConfig()
    heard = {key for source in ("nav", "teleop", "ros2_control") for key in found(source, ros)}
    assert {key for key in command_keys(ros) if "imu" not in key} <= heard


def test_a_namespace_is_before_the_names_of_ros_and_a_tree_that_is_off_has_none() -> None:
    apart = found("nav", RosConfig(namespace="one", rmw=False))
    assert [key for key, way in apart.items() if way.via != "native"] == ["one/cmd_vel"]
    assert len(found("nav", RosConfig(bridge=False, rmw=False))) == 4


@each("form", FORMATS)
@each("message", [TWIST, STAMPED])
def test_a_twist_is_reported_with_the_time_it_came(
    form: Format, message: Twist | TwistStamped
) -> None:
    told = read(encode(message, form))
    assert told == TwistStamped(Header(Time(9, 1), "base_link"), TWIST)


@pytest.mark.parametrize("message", [TWIST, STAMPED], ids=["plain", "stamped"])
def test_a_twist_of_ros_is_told_alike(message: Twist | TwistStamped) -> None:
    name = f"geometry_msgs::msg::dds_::{type(message).__name__}_"
    every = found("nav", RosConfig()).items()
    fit = [way for key, way in every if way.via == "bridge" or f"/{name}/" in key]
    assert [way.via for way in fit] == ["bridge", "rmw"]
    for way in fit:
        assert read(encode(message, "cdr"), way).twist == TWIST


@pytest.mark.parametrize("form", FORMATS)
def test_wheel_speeds_are_told_as_the_twist_they_are(form: Format) -> None:
    wheels = JointState(name=NAMES, velocity=[6.0] * 4)
    told = read(encode(wheels, form), Way("wheel_cmd/ros2_control"))
    assert told.twist.linear.x == pytest.approx(0.3)
    assert told.twist.angular.z == pytest.approx(0.0)


def test_wheels_and_frame_are_those_of_this_robot() -> None:
    mine = replace(
        Config(),
        drive=replace(Config().drive, wheel_radius=0.1),
        odometry=replace(Config().odometry, base_frame="trunk"),
    )
    payload = encode(JointState(name=NAMES, velocity=[6.0] * 4), "json")
    told = Reader(mine).read(arrival(payload, Way("wheel_cmd/nav")), 0)
    assert told.header.frame_id == "trunk"
    assert told.twist.linear.x == pytest.approx(0.6)


@each(
    ("payload", "put"),
    [
        (b'{"linear": {"x": 1}}', True),
        (b'{"linear": {"x": 1}, "angular": {}}' + b" " * 5000, True),
        (b"", True),
        (encode(TWIST, "json"), False),
    ],
)
def test_what_the_daemon_refuses_is_no_command_here(payload: bytes, put: bool) -> None:
    with pytest.raises(DecodeError):
        read(payload, put=put)
