"""The doors of the robot: one adapter for each way in which programs reach it.

`contract.py` tries each promise through each door. A door that does not offer a promise says why in
`lacks`. An adapter only sends and receives: the robot itself is judged by `contract.py` with a
plain client on the robot's machine.
"""

from __future__ import annotations

import json
import secrets
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, ExitStack, contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, ClassVar, NamedTuple

import msgspec
import numpy as np
import pytest
import zenoh

from tests.system.builds import BUILD_S
from tests.system.fast_dds import FastDdsNode
from tests.system.harness import (
    Bus,
    Daemon,
    repeated,
    twist,
    until,
)
from tests.system.ros_clients import (
    DIAGNOSTICS,
    EMPTY,
    EMPTY_REQUEST,
    JOINTS,
    PARAMETER_SERVICES,
    REQUESTS,
    STAMPED,
    TWIST,
    WHEELS,
    BridgeHalf,
    Client,
    RmwClient,
    ZenohClient,
    decode,
    encode,
    joints,
    make,
    rmw_key,
    stamped,
)
from tests.system.ros_clients import twist as ros_twist

if TYPE_CHECKING:
    from tests.system.dds import NewDomain

LATE_S = 1.0
"""How late a late command is: four timeouts."""

Send = Callable[[], object]


class Stage(NamedTuple):
    """The robot behind a door, and a client on its machine that sees everything."""

    daemon: Daemon
    bus: Bus
    where: Path
    """A directory for the door's files."""
    request: pytest.FixtureRequest
    endpoint: str
    """Where the door connects to."""
    own: Callable[[str], Path] | None = None
    """The directory of the certificate with this name, if the endpoint is for TLS."""


class Door:
    """What all doors have in common, and the names of what they may offer."""

    name = ""
    stage = "plain"
    """The kind of robot: `plain`, `gateway` (one with TLS) or `router` (behind a fleet's one)."""
    marks: Any = ()
    lacks: ClassVar[dict[str, str]] = {}
    """The rows of the contract that this door does not offer, and why."""
    speeds = (0.2, 0.3)
    """The speeds of `drive`, m/s and rad/s."""
    source = "app"
    zeroes = False
    """Whether the program behind this door sends the first zero by itself."""
    numbers: bool | None = True
    """Whether `clear` names causes: any (True), those of the state (None), or none (False)."""

    def __init__(self, stage: Stage) -> None:
        self.robot, self.bus = stage, stage.bus

    def __enter__(self) -> Door:
        self.stack = ExitStack()
        try:
            self.open()
        except BaseException:
            self.stack.close()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        self.stack.close()

    def open(self) -> None:
        """Open what stays open for all rows."""

    def send(self, linear: float, angular: float = 0.0) -> None:
        """Send one command, and nothing before it."""
        raise NotImplementedError

    def waits(self) -> str:
        """Return the code of what this door's source waits for."""
        waits = {source["name"]: source["wait"] for source in self.bus.state()["sources"]}
        return str(waits.get(self.source, ""))

    def arm(self) -> None:
        """Send zeros until a speed may follow."""

        def armed() -> bool:
            self.send(0.0)
            time.sleep(0.05)
            return self.bus.count("commands") > before and self.waits() not in ("neutral", "zeros")

        before = self.bus.count("commands")
        until(armed, 5.0, f"zeros by {self.name}")

    @contextmanager
    def drive(self) -> Iterator[None]:
        """Drive at `speeds` while the body runs, in the way of this door's users."""

        def send() -> None:
            # A machine that stands still for a second disarms the sender.
            self.send(*(self.speeds if self.waits() != "neutral" else (0.0, 0.0)))

        self.arm()
        with repeated(send) as self._silence:
            yield

    def silence(self) -> None:
        """Let the program behind `drive` send nothing more, as if it hung.

        When this function returns, the program has sent its last command.
        """
        self._silence()

    def stop(self) -> None:
        raise NotImplementedError

    def clear(self, numbers: Sequence[int] | None = None) -> bool:
        """Call `clear`, by default in the way of this door's users. Return its success."""
        raise NotImplementedError

    def late(self) -> tuple[str, Send]:
        """Return the code of a refusal, and a function that sends a speed which is too late."""
        raise NotImplementedError

    def bad(self) -> dict[str, Send]:
        """Return functions that send a bad command, by the code of its refusal."""
        raise NotImplementedError

    def counted(self, code: str) -> int:
        """Return how many commands were refused for this reason so far."""
        return self.bus.count(f"command_{code}")

    def set(self, key: str, value: float) -> bool:
        raise NotImplementedError

    def state(self) -> str:
        """Return the text in which this door's users see mode and reason."""
        raise NotImplementedError

    def for_viewer(self) -> Stage:
        """Return the robot that tells viewers from others."""
        return self.robot

    def viewer(self) -> bool:
        """Try what a viewer may not do, then stop. Return whether the door refused the first."""
        raise NotImplementedError


LOCAL = "programs on the robot's machine have every role"
BARE = "a bare program has to send its zero itself"


class Json(Door):
    name = "JSON"
    lacks: ClassVar = {"role": LOCAL, "end": BARE}

    def open(self) -> None:
        self.sender = f"door/{secrets.token_hex(16)}"
        self.root = self.bus.root
        self.session = self.connected("operator")
        self.key = f"{self.root}/cmd/app"

    def connected(self, role: str) -> zenoh.Session:
        """Return the door's session. Over TLS there is one for each role."""
        return self.stack.enter_context(Bus(self.robot.endpoint)).session

    def put(self, payload: bytes, echo: object = None, **more: Any) -> None:
        signature = {"sender": self.sender} | (
            {"echo": echo, "sequence": time.monotonic_ns()} if echo else {}
        )
        self.session.put(self.key, payload, attachment=json.dumps(signature), **more)

    def send(self, linear: float, angular: float = 0.0) -> None:
        self.put(json.dumps(twist(linear, angular)).encode())

    def ask(self, key: str, payload: object = None, role: str = "operator") -> Any:
        """Return the answer of the robot, or None."""
        session = self.session if role == "operator" else self.connected(role)
        data = None if payload is None else json.dumps(payload)
        for reply in session.get(f"{self.root}/{key}", payload=data, timeout=3.0):
            # A router's storage answers with the encoding of the message.
            if reply.ok is not None and str(reply.ok.encoding).startswith("application/json"):
                return json.loads(reply.ok.payload.to_bytes())
        return None

    def stop(self) -> None:
        self.session.put(f"{self.root}/stop", b"")

    def clear(self, numbers: Sequence[int] | None = None) -> bool:
        causes = self.ask("state")["causes"]
        named = [cause["number"] for cause in causes] if numbers is None else numbers
        return bool(self.ask("srv/clear", {"numbers": named})["success"])

    def late(self) -> tuple[str, Send]:
        def put(linear: float, age: float) -> None:
            sec, nanosec = divmod(int((time.time() - age) * 1e9), 10**9)
            header = {"stamp": {"sec": sec, "nanosec": nanosec}}
            self.put(json.dumps({"header": header, "twist": twist(linear)}).encode())

        before = self.bus.count("commands")
        with repeated(lambda: put(0.0, 0.0)):  # by which the daemon learns the sender's clock
            until(lambda: self.bus.count("commands") > before + 2, 5.0, "stamped zeros")
        return "stale", lambda: put(0.5, LATE_S)

    def bad(self) -> dict[str, Send]:
        whole = json.dumps(twist(0.5)).encode()
        few = json.dumps({"name": WHEELS[:3], "velocity": [1.0] * 3}).encode()
        return {
            "malformed": lambda: self.put(whole[:-3]),
            "wrong_shape": lambda: self.put(b'{"linear": {"x": 0.5}}'),
            "unknown_encoding": lambda: self.put(b"forward!"),
            "too_big": lambda: self.put(whole + b" " * 60_000),
            "not_a_put": lambda: self.session.delete(self.key),
            "wildcard": lambda: self.session.put(f"{self.root}/cmd/a$*", whole),
            "unknown_source": lambda: self.session.put(f"{self.root}/cmd/stranger", whole),
            "wrong_wheels": lambda: self.session.put(f"{self.root}/wheel_cmd/app", few),
        }

    def set(self, key: str, value: float) -> bool:
        return bool(self.ask("srv/set", {"settings": {key: value}}, "maintainer")["success"])

    def state(self) -> str:
        state = self.ask("state")
        return f"{state['mode']}: {state['reason']}"


class Msgpack(Json):
    name, marks = "msgpack with echo", pytest.mark.slow
    lacks: ClassVar = Json.lacks | dict.fromkeys(("clear", "set"), "requests are in JSON")

    def open(self) -> None:
        super().open()
        self._heard = self.stack.enter_context(self.bus.follow("beat"))
        until(lambda: self._heard.seen, 5.0, "a beat")

    def send(self, linear: float, angular: float = 0.0) -> None:
        self.put(msgspec.msgpack.encode(twist(linear, angular)), self._heard.seen[-1].value)

    def late(self) -> tuple[str, Send]:
        self.arm()
        beat, heard = self._heard.seen[-1].value, time.monotonic()
        until(lambda: time.monotonic() > heard + LATE_S, 2.0, "its age")
        return "too_old", lambda: self.put(msgspec.msgpack.encode(twist(0.5)), beat)

    def bad(self) -> dict[str, Send]:
        pack, beat = msgspec.msgpack.encode, self._heard.seen[-1].value
        of_json = "application/json"
        return {
            "not_finite": lambda: self.put(pack(twist(float("nan"))), beat),
            "malformed": lambda: self.put(pack(twist(0.5)), beat, encoding=of_json),
            "bad_echo": lambda: self.put(pack(twist(0.5)), {"run": "?"}),
        }

    def state(self) -> str:
        with self.bus.follow("state") as states:
            state = states.find(lambda _: True, 2.0, "a state").value
        return f"{state['mode']}: {state['reason']}"


class Gateway(Json):
    """JSON over TLS: each certificate has keys of its own."""

    name, stage = "JSON over the TLS gateway", "gateway"
    marks: Any = pytest.mark.network
    lacks: ClassVar = {"end": BARE}

    def open(self) -> None:
        self._sessions: dict[str, zenoh.Session] = {}
        super().open()
        until(lambda: self.ask("info"), 10.0, f"the robot at {self.robot.endpoint}")
        self.key += "/operator"

    def connected(self, role: str) -> zenoh.Session:
        if role not in self._sessions:
            assert self.robot.own is not None
            own = self.robot.own(role)
            tls = {name: str(own / file) for name, file in TLS_FILES.items()}
            config = zenoh.Config()
            settings: dict[str, object] = {
                "mode": "client",
                "scouting/multicast/enabled": False,
                "connect/endpoints": [self.robot.endpoint],
                "transport/link/tls": tls | {"enable_mtls": True},
            }
            for key, value in settings.items():
                config.insert_json5(key, json.dumps(value))
            self._sessions[role] = self.stack.enter_context(zenoh.open(config))
        return self._sessions[role]

    def bad(self) -> dict[str, Send]:
        admitted = ("malformed", "wrong_shape", "unknown_encoding", "too_big")
        return {code: send for code, send in super().bad().items() if code in admitted}

    def viewer(self) -> bool:
        session = self.connected("viewer")
        until(lambda: self.ask("info", role="viewer"), 10.0, "the viewer is connected")
        for end in ("viewer", "operator"):
            for speed in (0.0, 0.5):
                key = f"{self.root}/cmd/app/{end}"
                session.put(key, json.dumps(twist(speed)), attachment='{"sender": "v/s3cret"}')
        refused = self.ask("srv/deactivate", role="viewer") is None
        session.put(f"{self.root}/stop", b"")
        return refused


TLS_FILES = {
    "root_ca_certificate": "ca.pem",
    "connect_certificate": "certificate.pem",
    "connect_private_key": "key.pem",
}


class Router(Gateway):
    name, stage = "JSON over a fleet's router", "router"
    marks = (pytest.mark.network, pytest.mark.nightly)


class Ros(Door):
    """A ROS node. Its commands are on `cmd_vel`, and those with a stamp on `cmd_vel_teleop`."""

    lacks: ClassVar = {
        "role": "ROS has no roles: a router or a bridge has one certificate",
        "end": BARE,
    }
    source, numbers = "nav", False
    pause_s = 0.0
    """The time after a zero in which no speed may follow, because several nodes are one sender."""
    ros: Client

    def arm(self) -> None:
        super().arm()
        time.sleep(self.pause_s)

    def send(self, linear: float, angular: float = 0.0) -> None:
        self.ros.put("cmd_vel", TWIST, ros_twist(linear, angular))

    def stop(self) -> None:
        assert self.ros.call("acsard/stop").trigger()[0]

    def clear(self, numbers: Sequence[int] | None = None) -> bool:
        return self.ros.call("acsard/clear").trigger()[0]

    def late(self) -> tuple[str, Send]:
        name, before = "cmd_vel_teleop", self.bus.count("commands")
        with repeated(lambda: self.ros.put(name, STAMPED, stamped(0.0))):
            until(lambda: self.bus.count("commands") > before + 2, 5.0, "stamped zeros")
        return "stale", lambda: self.ros.put(name, STAMPED, stamped(0.5, age=LATE_S))

    def bad(self) -> dict[str, Send]:
        put, few = self.ros.put, joints(6.0, WHEELS[:3])
        return {
            "not_finite": lambda: put("cmd_vel", TWIST, ros_twist(float("nan"))),
            "wrong_wheels": lambda: put("joint_commands", JOINTS, few),
        }

    def set(self, key: str, value: float) -> bool:
        kind = PARAMETER_SERVICES["set_parameters"]
        none: dict[str, Any] = {"bool_value": False, "integer_value": 0, "string_value": ""}
        lists = ("byte_array", "bool_array", "integer_array", "double_array", "string_array")
        none |= {f"{name}_value": np.array([]) for name in lists}
        wish = make("rcl_interfaces/msg/ParameterValue", type=3, double_value=value, **none)
        wishes = [make("rcl_interfaces/msg/Parameter", name=key, value=wish)]
        question, answer = REQUESTS[kind]
        request = encode(make(question, parameters=wishes))
        (reply,) = self.ros.call("acsard/set_parameters", kind, request).replies
        return bool(decode(answer, reply.payload).results[0].successful)

    def state(self) -> str:
        with self.ros.follow("diagnostics", DIAGNOSTICS) as samples:
            message = decode(DIAGNOSTICS, samples.first("diagnostics").payload)
        (mode,) = (status for status in message.status if status.name == "acsard: mode")
        values = {value.key: value.value for value in mode.values}
        return f"{values['mode']}: {mode.message}"


class OverZenoh(Ros):
    """A ROS node that can also put malformed bytes."""

    marks: Any = pytest.mark.network
    ros: ZenohClient

    def bad(self) -> dict[str, Send]:
        ros, whole, key = self.ros, ros_twist(0.5), self.ros.key("cmd_vel", TWIST)
        return super().bad() | {
            "malformed": lambda: ros.put("cmd_vel", TWIST, whole[:-1]),
            "too_big": lambda: ros.put("cmd_vel", TWIST, whole + bytes(5000)),
            "not_a_put": lambda: ros.session.delete(key, attachment=ros.attachment()),
        }


class Rmw(OverZenoh):
    name = "rmw_zenoh"

    def open(self) -> None:
        self.ros = RmwClient(self.bus.session)

    def bad(self) -> dict[str, Send]:
        put, key = self.bus.session.put, rmw_key("cmd_vel", TWIST)
        return super().bad() | {
            "no_attachment": lambda: put(key, ros_twist(0.5)),
            "bad_attachment": lambda: put(key, ros_twist(0.5), attachment=b"rqh" + bytes(17)),
        }


class EmulatedBridge(OverZenoh):
    name, pause_s = "ros2dds bridge, emulated", 1.1

    def open(self) -> None:
        self.ros = BridgeHalf(self.bus.session)

    def bad(self) -> dict[str, Send]:
        between = ros_twist(0.5) + bytes(8)  # neither a Twist nor a TwistStamped
        put = self.bus.session.put
        return super().bad() | {"wrong_shape": lambda: put("cmd_vel", between)}


class CycloneDds(Ros):
    name, pause_s = "bridge with Cyclone DDS", 1.1
    marks: Any = (pytest.mark.bridge, pytest.mark.timeout(BUILD_S))

    def open(self) -> None:
        domains: NewDomain = self.robot.request.getfixturevalue("dds")
        domain = self.stack.enter_context(domains(self.robot.where))
        self.stack.enter_context(domain.bridge(self.robot.endpoint))
        self.ros = self.stack.enter_context(self.node(domain.number))

    def node(self, domain: int) -> AbstractContextManager[Client]:
        from tests.system.dds import DdsNode

        return DdsNode(domain)


class FastDds(CycloneDds):
    name = "bridge with Fast DDS"
    lacks: ClassVar = CycloneDds.lacks | dict.fromkeys(
        ("clear", "set"), "the bridge drops the service calls of a Fast DDS node"
    )

    def node(self, domain: int) -> AbstractContextManager[Client]:
        return FastDdsNode(self.robot.request.getfixturevalue("rclpy"), domain, self.robot.where)

    def stop(self) -> None:
        self.ros.put("stop_request", EMPTY, EMPTY_REQUEST)
