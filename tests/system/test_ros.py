"""ROS 2 drives the robot in the same way over both transports, rmw_zenoh and the bridge.

These tests run with an emulated bridge, which has only the Zenoh half, and with the real bridge and
ROS nodes on Cyclone DDS and on Fast DDS. The build of the real bridge takes long, so its tests have
the mark `bridge` instead of `network`.

`test_ros_rmw.py` and `test_ros_bridge.py` test the protocol of each transport.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from statistics import median
from typing import TYPE_CHECKING, Any

import numpy as np
import pytest

from tests.system.builds import BUILD_S
from tests.system.bystander import lost
from tests.system.fast_dds import FastDdsNode
from tests.system.harness import PATIENCE_S, Bus, Daemon, kept_waiting, until
from tests.system.ros_clients import (
    EMPTY,
    EMPTY_REQUEST,
    JOINTS,
    ODOMETRY,
    PARAMETER_SERVICES,
    PUBLISHED,
    QUICK,
    REQUESTS,
    STAMPED,
    TWIST,
    WHEELS,
    BridgeHalf,
    Client,
    RmwClient,
    ZenohClient,
    behind,
    changes,
    decode,
    encode,
    make,
    twist,
    unharmed,
)

if TYPE_CHECKING:
    from tests.system.dds import DdsDomain

CONFIG = QUICK

EMULATED: dict[str, type[ZenohClient]] = {"rmw": RmwClient, "bridge": BridgeHalf}

NETWORK = [pytest.param(name, marks=pytest.mark.network) for name in EMULATED]
ON_DDS = [pytest.mark.bridge, pytest.mark.timeout(BUILD_S)]
CYCLONE, FAST = (pytest.param(name, marks=ON_DDS) for name in ("Cyclone DDS", "Fast DDS"))


@contextmanager
def client(request: pytest.FixtureRequest, bus: Bus, where: Path) -> Iterator[Client]:
    if request.param in EMULATED:
        yield EMULATED[request.param](bus.session)
        return
    domain: DdsDomain = request.getfixturevalue("domain")
    node: AbstractContextManager[Client] = domain.node()
    if request.param == "Fast DDS":
        node = FastDdsNode(request.getfixturevalue("rclpy"), domain.number, where)
    with node as entered:
        yield entered


@pytest.fixture(params=[*NETWORK, CYCLONE, FAST])
def ros(request: pytest.FixtureRequest, bus: Bus, tmp_path: Path) -> Iterator[Client]:
    """Provide a ROS node for each transport: emulated nodes, and real ones on the real bridge."""
    with client(request, bus, tmp_path) as node:
        yield node


@pytest.fixture(params=[*NETWORK, CYCLONE])
def caller(request: pytest.FixtureRequest, bus: Bus, tmp_path: Path) -> Iterator[Client]:
    """Provide each of these nodes whose service calls are answered."""
    with client(request, bus, tmp_path) as node:
        yield node


@pytest.fixture(params=NETWORK)
def zenoh_ros(request: pytest.FixtureRequest, bus: Bus) -> ZenohClient:
    """Provide an emulated ROS node that can also publish malformed bytes on any key."""
    return EMULATED[request.param](bus.session)


@pytest.fixture(autouse=True)
def restored(bus: Bus, shared: Daemon) -> Iterator[None]:
    """After the test, release the latches of the shared robot, stop it and reset its odometry."""
    yield
    for verb in ("clear", "activate"):
        bus.get(f"srv/{verb}")
    bus.at_rest()
    bus.get("srv/reset_odometry")
    unharmed(shared)


def test_every_topic_arrives(ros: Client) -> None:
    with ExitStack() as stack:
        following = {
            name: stack.enter_context((ros.follow_late if late else ros.follow)(name, kind))
            for name, (kind, _, late) in PUBLISHED.items()
        }
        for name, samples in following.items():
            decode(PUBLISHED[name][0], samples.first(name).payload)


# commands

COMMANDS = {
    "Twist": ("cmd_vel", TWIST, 0.3, "nav"),
    "TwistStamped": ("cmd_vel_teleop", STAMPED, 0.3, "teleop"),
    "JointState": ("joint_commands", JOINTS, 6.0, "ros2_control"),
}


@pytest.mark.parametrize("name", COMMANDS)
def test_a_command_of_each_type_drives_the_robot(bus: Bus, ros: Client, name: str) -> None:
    topic, kind, amount, source = COMMANDS[name]
    with ros.follow("odom", ODOMETRY) as odometry, ros.follow("joint_states", JOINTS) as wheels:
        with ros.driving(bus, topic, kind, amount):
            odometry.first("motion", lambda s: _speed(s.payload) > 0.2)
            assert bus.state()["source"] == source
        turning = decode(JOINTS, wheels.seen[-1].payload)
    assert sorted(turning.name) == sorted(WHEELS)
    assert all(speed > 3.0 for speed in turning.velocity)


def _speed(payload: bytes) -> float:
    return float(decode(ODOMETRY, payload).twist.twist.linear.x)


GO = twist(0.5)

WILDCARDS = {
    RmwClient: ("0/cmd_vel/**", "*/cmd_vel/*/*", "0/**", "**"),
    BridgeHalf: ("cmd_vel$*", "*", "**"),
}


def test_a_command_by_wildcard_drives_nothing(bus: Bus, zenoh_ros: ZenohClient) -> None:
    for key in WILDCARDS[type(zenoh_ros)]:
        zenoh_ros.zeros(bus)
        before = bus.state()
        bus.session.put(key, GO, attachment=zenoh_ros.attachment())
        bus.session.delete(key, attachment=zenoh_ros.attachment())
        behind(bus, lambda: zenoh_ros.put("cmd_vel", TWIST, b""), "malformed")
        after = bus.state()
        # Either the access rules keep it out, or the daemon's code refuses it.
        mine = {
            "command_malformed", "command_wildcard", "command_no_attachment", "command_not_a_put",
        }  # fmt: skip
        assert changes(before, after).keys() <= mine, key
        assert (after["x"], after["wheels"]) == (before["x"], before["wheels"]), key
        if after["mode"] == "stopped":  # "**" includes `stop`
            bus.get("srv/clear")


# stops

STOP_S = 0.05
"""The longest time from a message on `stop_request` to the published state `stopped`."""


def test_each_of_100_messages_on_stop_request_stops_the_robot_at_once(
    bus: Bus, shared: Daemon, ros: Client
) -> None:
    took = []
    with bus.follow("state") as states:
        for number in range(101):
            asked, waited = time.monotonic(), kept_waiting(shared.pid)
            ros.put("stop_request", EMPTY, EMPTY_REQUEST)
            state = states.find(lambda s: s["mode"] == "stopped", 5.0, "stopped", after=asked)
            late = lost(asked, state.at) + kept_waiting(shared.pid) - waited
            if number:  # the first message waits for its route
                took.append(state.at - asked - late)
            numbers = [cause["number"] for cause in state.value["causes"]]
            assert bus.get("srv/clear", {"numbers": numbers})["success"]
            bus.comes_to("ready")
    print(f"stop_request: median {1e3 * median(took):.1f} ms, longest {1e3 * max(took):.1f} ms")
    assert max(took) < STOP_S


@pytest.mark.parametrize("payload", [b"", b"?", bytes(60_000)], ids=["empty", "odd", "large"])
def test_any_message_on_stop_request_stops(
    bus: Bus, zenoh_ros: ZenohClient, payload: bytes
) -> None:
    key = zenoh_ros.key("stop_request", EMPTY)
    bus.session.put(key, payload)  # without the attachment of rmw_zenoh
    (cause,) = until(lambda: bus.state()["causes"], PATIENCE_S, "stopped")
    assert cause["by"] == f"unnamed ({'rmw' if isinstance(zenoh_ros, RmwClient) else 'bridge'})"


# services


def call_parameters(caller: Client, service: str, **request: Any) -> Any:
    """Call one of the parameter services of ROS and return its only reply."""
    kind = PARAMETER_SERVICES[service]
    question, answer = REQUESTS[kind]
    called = caller.call(f"acsard/{service}", kind, encode(make(question, **request)))
    assert (len(called.replies), called.errors) == (1, 0), called
    return decode(answer, called.replies[0].payload)


def test_the_parameters_are_listed_described_and_read(bus: Bus, caller: Client) -> None:
    names = call_parameters(caller, "list_parameters", prefixes=[], depth=0).result.names
    assert len(names) > 90
    assert "limits.linear_speed" in names
    described = call_parameters(caller, "describe_parameters", names=names).descriptors
    types = call_parameters(caller, "get_parameter_types", names=names).types
    values = call_parameters(caller, "get_parameters", names=names).values
    assert [entry.name for entry in described] == names
    assert [entry.type for entry in described] == list(types) == [entry.type for entry in values]
    (limit,) = (entry for entry in described if entry.name == "limits.linear_speed")
    assert (limit.floating_point_range[0].from_value, limit.read_only) == (0.0, False)
    value = values[names.index("limits.linear_speed")].double_value
    assert value == bus.get("config")["limits"]["linear_speed"]
    atomically = call_parameters(
        caller, "set_parameters_atomically", parameters=[_limit(value)]
    ).result
    assert atomically.successful, atomically.reason


def _limit(value: float) -> Any:
    """Return the ROS parameter `limits.linear_speed` with this value."""
    none: dict[str, Any] = {"bool_value": False, "integer_value": 0, "string_value": ""}
    lists = ("byte_array", "bool_array", "integer_array", "double_array", "string_array")
    none |= {f"{kind}_value": np.array([]) for kind in lists}
    double = make("rcl_interfaces/msg/ParameterValue", type=3, double_value=value, **none)
    return make("rcl_interfaces/msg/Parameter", name="limits.linear_speed", value=double)
