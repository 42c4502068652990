"""Who may do what on which key: the table of SAFETY section 3, once.

`unit/test_access.py` reads it from the rules, and `system/test_access.py` tries it at the robot's
own addresses and at a fleet's router.
"""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from typing import Literal, NamedTuple

from acsard.core.values import Role
from tests import promised
from tests.system import ros_clients as ros

Verb = Literal["put", "delete", "query", "subscribe"]
Who = frozenset[str]
NOBODY: Who = frozenset()
HERE: Who = frozenset({"local"})
KEEPERS: Who = HERE | {"maintainer"}
DRIVERS: Who = KEEPERS | {"operator"}
ANYBODY: Who = DRIVERS | {"viewer"}
LEAST: dict[Role | None, Who] = {"viewer": ANYBODY, "operator": DRIVERS, "maintainer": KEEPERS}
"""Everybody with at least this role. A program on the robot's machine, `local`, has every role."""

SOURCES = ("teleop", "app", "ros2_control", "dock", "nav")
PLAIN = tuple(row.key for row in promised.PUBLISHED if row.always)
VALUES = (*PLAIN, *(f"json/{key}" for key in PLAIN))

ZERO = {"linear": {"x": 0.0}, "angular": {"z": 0.0}}
TWIST = json.dumps(ZERO).encode()
WHEELS = json.dumps({"name": ros.WHEELS, "velocity": [0.0] * 4}).encode()
TOO_SLOW = json.dumps({"speed_limit": -1.0}).encode()
"""A speed limit that the robot refuses and counts."""
PAYLOADS = {
    "set_pose": json.dumps({"x": 0.0, "y": 0.0, "yaw": 0.0}).encode(),
    "set": json.dumps({"settings": {"rates.telemetry": 0.0}}).encode(),
    "list_parameters": b"\0\1\0\0" + bytes(16),
}
NO_NAMES = b"\0\1\0\0" + bytes(4)
FORGED = b"forged"

RMW_TWIST = ros.rmw_key("cmd_vel", ros.TWIST)


class Row(NamedTuple):
    """A verb on a key expression, and the identities whose attempt has an effect."""

    verb: Verb
    key: str
    who: Who
    payload: bytes | Callable[[], bytes] = b""
    how: Literal["plain", "late", "token"] = "plain"
    """How to subscribe: plainly, with history for late joiners, or to liveliness tokens."""
    stirred: bool = False
    """Another client has to send for there to be a sample."""

    @property
    def data(self) -> bytes:
        return self.payload if isinstance(self.payload, bytes) else self.payload()


def native(me: str) -> Iterator[Row]:
    """Return the rows of a robot's own tree, for example of acsard/acsar."""
    for source in SOURCES:
        for kind, payload in (("cmd", TWIST), ("wheel_cmd", WHEELS)):
            key = f"{me}/{kind}/{source}"
            # Over TLS each certificate has keys of its own.
            for end, who in (("", HERE), ("/viewer", HERE), ("/operator", HERE | {"operator"}),
                             ("/maintainer", KEEPERS)):  # fmt: skip
                yield Row("put", key + end, who, payload)
    yield Row("put", f"{me}/stop", ANYBODY)
    yield Row("put", f"{me}/speed_limit", DRIVERS, TOO_SLOW)
    unlisted = ("cmd/ghost", "cmd/ghost/operator", "cmd/app/operator/more", "cmd", "cmd/*",
                "cmd/**", "cmd/ap$*", "cmd/app/**", "cmd/app/*", "cmd/*/operator", "*/app",
                "wheel_cmd/ghost", "wheel_cmd/*", "wheel_cmd/**")  # fmt: skip
    yield from (Row("put", f"{me}/{key}", NOBODY, TWIST) for key in unlisted)
    # On the robot's machine a PUT stops if it reaches the key. Over TLS only exact keys pass.
    reaching = (f"{me}/*", f"{me}/**", f"{me}/sto$*", f"{me}/stop/**", "acsard/*/stop",
                "acsard/**/stop", "acsard/**", "**/stop", "**")  # fmt: skip
    yield from (Row("put", key, HERE, TWIST) for key in reaching)
    others = ("acsard/*/cmd/app", "acsard/other/cmd/app", "acsard/other/stop", "acsard/other/**")
    yield from (Row("put", key, NOBODY, TWIST) for key in others)
    unwritten = (*VALUES, "alive", "config", "info", "srv/stop", "odo$*", "tf_static/@adv/x")
    yield from (Row("put", f"{me}/{key}", NOBODY, FORGED) for key in unwritten)

    asked = (*VALUES, "info", "topics", "interfaces", "schema/Twist")
    yield from (Row("query", f"{me}/{key}", ANYBODY) for key in asked)
    yield Row("query", f"{me}/config", KEEPERS)
    for role, who in LEAST.items():
        yield Row("query", f"{me}/whoami/{role}", who)
    for verb, row in promised.SERVICES.items():
        yield Row("query", f"{me}/srv/{verb}", LEAST[row.role], PAYLOADS.get(verb, b""))
    wild = ("*", "**", "schema/*", "stat$*", "tf_static/@adv/**", "srv/ghost")
    yield from (Row("query", f"{me}/{key}", HERE) for key in wild)
    unheard = ("srv/*", "srv/**", "srv/sto$*", "cmd/app", "json/*", "json/**",
               "whoami/*", "whoami/admin")  # fmt: skip
    yield from (Row("query", f"{me}/{key}", NOBODY) for key in unheard)
    beyond = ("acsard/*/state", "acsard/*/srv/stop", "acsard/**", "**", "acsard/other/state",
              "acsard/other/srv/stop", "acsard/other/config", "acsard/other/**")  # fmt: skip
    yield from (Row("query", key, NOBODY) for key in beyond)

    often = (key for key in VALUES if not key.endswith("tf_static"))
    yield from (Row("subscribe", f"{me}/{key}", ANYBODY) for key in often)
    yield Row("subscribe", f"{me}/tf_static", ANYBODY, how="late")
    yield Row("subscribe", f"{me}/alive", ANYBODY, how="token")
    yield Row("subscribe", "acsard/*/alive", HERE, how="token")
    for key in ("**", "acsard/other/alive"):
        yield Row("subscribe", key, NOBODY, how="token")
    wider = (f"{me}/*", f"{me}/**", f"{me}/json/*", "acsard/*/odom", "acsard/**", "**")
    yield from (Row("subscribe", key, HERE) for key in wider)
    yield from (Row("subscribe", f"acsard/other/{key}", NOBODY) for key in ("odom", "**"))
    commands = ("cmd/app", "cmd/*", "cmd/**", "cmd/app/operator", "cmd/*/*")
    yield from (Row("subscribe", f"{me}/{key}", HERE, stirred=True) for key in commands)


def _bad_limit() -> bytes:
    kind = ros.SPEED_LIMIT
    return ros.encode(ros.make(kind, header=ros.header(), percentage=False, speed_limit=-1.0))


def by_ros() -> Iterator[Row]:
    """Return the rows of the ROS trees, which only the robot itself offers."""
    zero, stamped = ros.twist(0.0), ros.stamped(0.0, age=None)
    for name in ros.TWISTS:
        yield Row("put", name, DRIVERS, zero)
        yield Row("put", ros.rmw_key(name, ros.TWIST), DRIVERS, zero)
        yield Row("put", ros.rmw_key(name, ros.STAMPED), DRIVERS, stamped)
    for key in ("speed_limit", ros.rmw_key("speed_limit", ros.SPEED_LIMIT)):
        yield Row("put", key, DRIVERS, _bad_limit)
    for key in ("stop_request", ros.rmw_key("stop_request", ros.EMPTY)):
        yield Row("put", key, ANYBODY, ros.EMPTY_REQUEST)
    for key in ("joint_commands", ros.rmw_key("joint_commands", ros.JOINTS)):
        yield Row("put", key, DRIVERS, lambda: ros.joints(0.0))
    end = RMW_TWIST.removeprefix("0/cmd_vel/")
    wild = ("cmd_vel/**", "cmd_v$*", "0/cmd_vel/**", f"0/*/{end}", f"*/cmd_vel/{end}",
            "other/cmd_vel", f"0/other/cmd_vel/{end}", f"1/cmd_vel/{end}")  # fmt: skip
    yield from (Row("put", key, NOBODY, zero) for key in wild)
    # A PUT that reaches `stop_request` stops, by any key expression.
    reaching = ("*", "stop_re$*", "0/**", "0/stop_request/**")
    yield from (Row("put", key, HERE, zero) for key in reaching)
    written = [key for name, kind in (("odom", ros.ODOMETRY), ("tf_static", ros.TF))
               for key in (name, ros.rmw_key(name, kind))]  # fmt: skip
    yield from (Row("put", key, NOBODY, FORGED) for key in written)

    services = {f"acsard/{verb}": LEAST[promised.SERVICES[verb].role] for verb in promised.TRIGGERS}
    services |= {f"acsard/{name}": KEEPERS for name in ros.PARAMETER_SERVICES}
    for name, who in services.items():
        verb = name.removeprefix("acsard/")
        request = ros.EMPTY_REQUEST if verb in promised.TRIGGERS else PAYLOADS.get(verb, NO_NAMES)
        for key in (name, ros.rmw_key(name, ros.SERVICES[name])):
            yield Row("query", key, who, request)
    yield from (Row("query", f"{key}/@adv/**", HERE) for key in written[2:])
    end = ros.rmw_key("", ros.TRIGGER).removeprefix("0//")
    asked = ("acsard/*", "acsard/sto$*", "0/acsard/**", f"0/acsard/*/{end}", "0/**",
            "other/acsard/stop", f"0/other/acsard/stop/{end}", f"1/acsard/stop/{end}")  # fmt: skip
    yield from (Row("query", key, NOBODY) for key in asked)

    for name, (kind, _, late) in ros.PUBLISHED.items():
        for key in (name, ros.rmw_key(name, kind)):
            yield Row("subscribe", key, ANYBODY, how="late" if late else "plain")
    for key in ("@ros2_lv/**", "@ros2_lv/0/**", "@/*/@ros2_lv/**"):
        yield Row("subscribe", key, HERE, how="token")
    yield from (Row("subscribe", key, HERE) for key in ("*", "0/**", "0/odom/**"))
    others = ("other/odom", "0/other/odom/**", "1/odom/**")
    yield from (Row("subscribe", key, NOBODY) for key in others)
    yield from (Row("subscribe", key, HERE, stirred=True) for key in ("cmd_vel", RMW_TWIST))


def at_router(me: str, itself: str) -> Iterator[Row]:
    """Return the rows of two robots at a fleet's router, which admits no local programs.

    `me` is the tree of one robot, and `itself` that of the robot whose certificate is an identity
    too: it may do everything there.
    """
    name = itself.rpartition("/")[2]
    for row in native(me):
        yield row._replace(who=row.who - HERE)
    yield Row("put", f"{me}/imu", frozenset({"maintainer"}), b'{"angular_velocity": {"z": 0.1}}')
    yield Row("put", f"{me}/cmd/app/{name}", NOBODY, TWIST)
    outside = (f"{name}/cmd_vel", "cmd_vel", "acsard/robot3/state", "@/*/router/config/mode")
    yield from (Row("put", key, NOBODY, FORGED) for key in outside)
    yield Row("query", "@/*/router/**", NOBODY)
    yield from (Row("subscribe", key, NOBODY) for key in ("@/**", "acsard/robot3/**"))
    own = {f"cmd/app/{name}", "cmd/app/operator", "stop", "speed_limit", "info", "config",
           "whoami/operator", "srv/stop", "odom", "alive"}  # fmt: skip
    for row in native(itself):
        if row.key.removeprefix(f"{itself}/") in own and row.payload != FORGED and not row.stirred:
            yield row._replace(who=row.who - HERE | {name})
    yield Row("put", f"{itself}/cmd/app/{name}", frozenset({name}), TWIST)


def with_deletes(rows: Iterator[Row]) -> tuple[Row, ...]:
    """Return the rows, and for each PUT a DELETE, which nobody may send."""
    table = tuple(rows)
    deletes = (row._replace(verb="delete", who=NOBODY) for row in table if row.verb == "put")
    return (*table, *deletes)
