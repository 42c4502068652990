"""Every identity, verb and key has exactly the permissions in the table of SAFETY section 3.

The tests check effects. A put or delete has an effect if the robot obeys it, or if it reaches other
clients as if the robot had sent it. A query has an effect if an answer arrives, and a subscription
if a sample arrives. To see that nothing happens, a test does not wait for a fixed time. It sends a
request after each attempt, and waits for its answer.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import pytest
import zenoh
import zenoh.ext

from acsard.core.values import Role
from tests import promised
from tests.system import ros_clients as ros
from tests.system.harness import ZERO, Bus, Daemon, free_endpoint, until
from tests.system.identities import ADMITTED, Certificates, Identity, free_tls_endpoint

pytestmark = pytest.mark.network

Verb = Literal["put", "delete", "query", "subscribe"]
IDENTITIES: tuple[Identity, ...] = get_args(Identity)
VERBS: tuple[Verb, ...] = get_args(Verb)

# the table, as SAFETY section 3 has it

Who = frozenset[str]
NOBODY: Who = frozenset()
HERE: Who = frozenset({"local"})
KEEPERS: Who = HERE | {"maintainer"}
DRIVERS: Who = KEEPERS | {"operator"}
ANYBODY: Who = DRIVERS | {"viewer"}
ALLOWED: dict[Role | None, Who] = {"viewer": ANYBODY, "operator": DRIVERS, "maintainer": KEEPERS}

ME, OTHER = "acsard/acsar", "acsard/other"
SOURCES = ("teleop", "app", "ros2_control", "dock", "nav")
PLAIN = tuple(row.key for row in promised.PUBLISHED if row.always and row.key != "battery")
VALUES = (*PLAIN, *(f"json/{key}" for key in PLAIN))

TWIST_JSON = json.dumps(ZERO).encode()
WHEELS_JSON = json.dumps({"name": ros.WHEELS, "velocity": [0.0] * 4}).encode()
POSE_JSON = json.dumps({"x": 0.0, "y": 0.0, "yaw": 0.0}).encode()
SET_JSON = json.dumps({"settings": {"rates.telemetry": 0.0}}).encode()
FORGED = b"forged"
NO_NAMES = b"\x00\x01\x00\x00" + bytes(4)
NO_PREFIXES = b"\x00\x01\x00\x00" + bytes(16)

RMW_ODOM = ros.rmw_key("odom", ros.ODOMETRY)
RMW_CMD = ros.rmw_key("cmd_vel", ros.TWIST)
RMW_STATIC = ros.rmw_key("tf_static", ros.TF)
CDR_TWIST, CDR_STAMPED = ros.twist(0.0), ros.stamped(0.0, age=None)


def _cdr_wheels() -> bytes:
    """Return wheel speeds in CDR with the present time. Build them anew for each use."""
    return ros.joints(0.0)


class Try(NamedTuple):
    """One row of the permission table: a key expression, and the identities that may use it."""

    key: str
    who: Who
    payload: bytes | Callable[[], bytes] = b""
    how: Literal["plain", "late", "token"] = "plain"
    """How to subscribe: plainly, with history for late joiners, or to liveliness tokens."""
    stirred: bool = False
    """Another client has to send for there to be a sample."""

    @property
    def data(self) -> bytes:
        """The payload of the put or the query."""
        return self.payload if isinstance(self.payload, bytes) else self.payload()

    @property
    def label(self) -> str:
        """A name that is unique among the rows of its verb."""
        return self.key + ("" if self.how == "plain" else f" ({self.how})")


def _bad_limit() -> bytes:
    """Return a speed limit that the daemon refuses and counts, in CDR."""
    return ros.encode(
        ros.make(ros.SPEED_LIMIT, header=ros.header(), percentage=False, speed_limit=-1.0)
    )


def _commands() -> Iterator[Try]:
    for source in SOURCES:
        for kind, payload in (("cmd", TWIST_JSON), ("wheel_cmd", WHEELS_JSON)):
            yield Try(f"{ME}/{kind}/{source}", HERE, payload)
            # Over TLS each certificate has keys of its own.
            for name in ("operator", "maintainer"):
                yield Try(f"{ME}/{kind}/{source}/{name}", HERE | {name}, payload)
            yield Try(f"{ME}/{kind}/{source}/viewer", HERE, payload)
    yield Try(f"{ME}/stop", ANYBODY)
    yield Try(f"{ME}/speed_limit", DRIVERS, _bad_limit())
    unlisted = ("cmd/ghost", "cmd/ghost/operator", "cmd/app/operator/more", "cmd", "cmd/*",
                "cmd/**", "cmd/ap$*", "cmd/app/**", "cmd/app/*", "cmd/*/operator")  # fmt: skip
    yield from (Try(f"{ME}/{key}", NOBODY, TWIST_JSON) for key in unlisted)
    yield from (Try(f"{ME}/wheel_cmd/{key}", NOBODY, WHEELS_JSON) for key in ("ghost", "*", "**"))
    yield from (Try(key, NOBODY, TWIST_JSON) for key in (f"{ME}/*/app", "acsard/*/cmd/app"))
    # A PUT of a client on the robot's machine stops the robot if it reaches the key `stop`. Over
    # TLS only exact keys pass.
    own = (f"{ME}/*", f"{ME}/**", f"{ME}/sto$*", f"{ME}/stop/**")
    for key in ("acsard/*/stop", "acsard/**/stop", "acsard/**", "**/stop", "**", *own):
        yield Try(key, HERE, TWIST_JSON)
    others = (f"{OTHER}/cmd/app", f"{OTHER}/stop", f"{OTHER}/**")
    yield from (Try(key, NOBODY, TWIST_JSON) for key in others)
    unwritten = (*VALUES, "alive", "config", "info", "srv/stop", "odo$*")
    yield from (Try(f"{ME}/{key}", NOBODY, FORGED) for key in unwritten)


def _ros_commands() -> Iterator[Try]:
    twists = ("cmd_vel", "cmd_vel_dock", "cmd_vel_teleop")
    for name in twists:
        yield Try(name, DRIVERS, CDR_TWIST)
        yield Try(ros.rmw_key(name, ros.TWIST), DRIVERS, CDR_TWIST)
        yield Try(ros.rmw_key(name, ros.STAMPED), DRIVERS, CDR_STAMPED)
    yield Try("speed_limit", DRIVERS, _bad_limit())
    yield Try(ros.rmw_key("speed_limit", ros.SPEED_LIMIT), DRIVERS, _bad_limit())
    yield Try("joint_commands", DRIVERS, _cdr_wheels)
    yield Try(ros.rmw_key("joint_commands", ros.JOINTS), DRIVERS, _cdr_wheels)
    rmw_type = RMW_CMD.removeprefix("0/cmd_vel/")
    wild = (
        "cmd_vel/**",
        "cmd_v$*",
        "*",
        "0/cmd_vel/**",
        f"0/*/{rmw_type}",
        f"*/cmd_vel/{rmw_type}",
    )
    others = ("other/cmd_vel", f"0/other/cmd_vel/{rmw_type}", f"1/cmd_vel/{rmw_type}", "0/**")
    yield from (Try(key, NOBODY, CDR_TWIST) for key in (*wild, *others))
    yield from (Try(key, NOBODY, FORGED) for key in ("odom", RMW_ODOM, "tf_static", RMW_STATIC))


def _questions() -> Iterator[Try]:
    asked = (*VALUES, "info", "topics", "interfaces", "schema/Twist")
    yield from (Try(f"{ME}/{key}", ANYBODY) for key in asked)
    # Wildcards are allowed only on the robot's machine.
    yield from (Try(f"{key}/@adv/**", HERE) for key in (f"{ME}/tf_static", "tf_static", RMW_STATIC))
    yield Try(f"{ME}/config", KEEPERS)
    for role, identities in (("viewer", ANYBODY), ("operator", DRIVERS), ("maintainer", KEEPERS)):
        yield Try(f"{ME}/whoami/{role}", identities)
    yield from (Try(f"{ME}/whoami/{role}", NOBODY) for role in ("*", "admin"))
    yield from (Try(f"{ME}/{key}", HERE) for key in ("*", "**", "schema/*", "stat$*"))
    services = ("srv/*", "srv/**", "srv/sto$*", "srv/ghost", "cmd/app")
    yield from (Try(f"{ME}/{key}", NOBODY) for key in services)
    # The plain keys answer wildcards, so that no client gets an answer twice.
    yield from (Try(f"{ME}/{key}", NOBODY) for key in ("json/*", "json/**"))
    wilder = ("acsard/*/state", "acsard/*/srv/stop", "acsard/**", "**")
    yield from (Try(key, NOBODY) for key in wilder)
    yield from (Try(f"{OTHER}/{key}", NOBODY) for key in ("state", "srv/stop", "config", "**"))
    rmw_type = ros.rmw_key("", ros.TRIGGER).removeprefix("0//")
    wild = ("acsard/*", "acsard/sto$*", "0/acsard/**", f"0/acsard/*/{rmw_type}", "0/**")
    others = ("other/acsard/stop", f"0/other/acsard/stop/{rmw_type}", f"1/acsard/stop/{rmw_type}")
    yield from (Try(key, NOBODY) for key in (*wild, *others))


def _services() -> Iterator[Try]:
    for verb in promised.TRIGGERS:
        identities = ALLOWED[promised.SERVICES[verb].role]
        yield Try(f"{ME}/srv/{verb}", identities)
        yield Try(f"acsard/{verb}", identities, ros.EMPTY_REQUEST)
        yield Try(ros.rmw_key(f"acsard/{verb}", ros.TRIGGER), identities, ros.EMPTY_REQUEST)
    yield Try(f"{ME}/srv/set_pose", KEEPERS, POSE_JSON)
    yield Try(f"{ME}/srv/set", KEEPERS, SET_JSON)
    for name, kind in ros.PARAMETER_SERVICES.items():
        payload = NO_PREFIXES if name == "list_parameters" else NO_NAMES
        yield Try(f"acsard/{name}", KEEPERS, payload)
        yield Try(ros.rmw_key(f"acsard/{name}", kind), KEEPERS, payload)


def _subscriptions() -> Iterator[Try]:
    often = [value for value in VALUES if not value.endswith("tf_static")]
    yield from (Try(f"{ME}/{key}", ANYBODY) for key in often)
    for name, (kind, _, late) in ros.PUBLISHED.items():
        how: Literal["plain", "late"] = "late" if late else "plain"
        yield Try(name, ANYBODY, how=how)
        yield Try(ros.rmw_key(name, kind), ANYBODY, how=how)
    yield Try(f"{ME}/tf_static", ANYBODY, how="late")
    yield Try(f"{ME}/alive", ANYBODY, how="token")
    tokens = ("acsard/*/alive", "@ros2_lv/**", "@ros2_lv/0/**", "@/*/@ros2_lv/**")
    yield from (Try(key, HERE, how="token") for key in tokens)
    yield from (Try(key, NOBODY, how="token") for key in ("**", f"{OTHER}/alive"))
    # On the robot's machine any wildcard is allowed: published data is no secret there.
    wild = (f"{ME}/*", f"{ME}/**", f"{ME}/json/*", "acsard/*/odom", "acsard/**", "**", "*", "0/**",
            "0/odom/**")  # fmt: skip
    yield from (Try(key, HERE) for key in wild)
    others = (f"{OTHER}/odom", f"{OTHER}/**", "other/odom", "0/other/odom/**", "1/odom/**")
    yield from (Try(key, NOBODY) for key in others)
    commands = (f"{ME}/cmd/app", f"{ME}/cmd/*", f"{ME}/cmd/**", f"{ME}/cmd/app/operator",
                f"{ME}/cmd/*/*", "cmd_vel", RMW_CMD)  # fmt: skip
    yield from (Try(key, HERE, stirred=True) for key in commands)


PUTS = (*_commands(), *_ros_commands())
ROWS: dict[Verb, tuple[Try, ...]] = {
    "put": PUTS,
    "delete": tuple(row._replace(who=NOBODY) for row in PUTS),
    "query": (*_questions(), *_services()),
    "subscribe": tuple(_subscriptions()),
}

Outcome = dict[str, bool]


# the robot and the clients that try to use it


class Robot:
    """A daemon with a plain and a TLS endpoint, a local client, and a second one as witness."""

    def __init__(self, where: Path) -> None:
        self.certificates = Certificates(where)
        self.plain, self.tls = free_endpoint(), free_tls_endpoint()
        bus = {"listen": [self.plain, self.tls], "tls": str(self.certificates.robot)}
        tables: dict[str, dict[str, object]] = {"bus": dict(bus)}
        tables["sim"] = {"faults": ["battery=80:600"]}
        self.daemon = Daemon(where, config=tables, endpoint=self.plain)
        self._fooled = threading.Event()
        self._outcomes: dict[tuple[str, str], Outcome] = {}

    @contextmanager
    def running(self) -> Iterator[Robot]:
        with self.daemon, Bus(self.plain) as self.here, Bus(self.plain) as self.witness:
            self.here.linked()
            keys = (f"{ME}/**", "odom", RMW_ODOM, "tf_static", RMW_STATIC)
            watched = [self.witness.session.declare_subscriber(k, self._judge) for k in keys]
            self.witness.ask("info")
            yield self
            del watched

    def _judge(self, sample: zenoh.Sample) -> None:
        put = sample.kind == zenoh.SampleKind.PUT
        key = str(sample.key_expr).removeprefix(f"{ME}/")
        commands = ("cmd", "wheel_cmd", "stop")
        if sample.payload.to_bytes() == FORGED or not (put or key.partition("/")[0] in commands):
            self._fooled.set()

    def fooled(self) -> bool:
        """Return whether the witness has received a forged message since the last call."""
        self.witness.ask("info")
        was = self._fooled.is_set()
        self._fooled.clear()
        return was

    def config(self, identity: Identity) -> zenoh.Config:
        return self.certificates.config(identity, self.plain, self.tls)

    def comes_true(self, look: Callable[[], bool], steps: int = 5) -> bool:
        """Return whether `look` returns True within `steps` control periods.

        A period is long compared with the delivery of a message on one machine.
        """
        begun = self.here.count("lines_sent")
        while not (result := look()):
            if self.here.count("lines_sent") >= begun + steps:
                return look()
        return result

    def settled(self) -> None:
        """Wait some control periods, so that every earlier message has certainly arrived."""
        self.comes_true(lambda: False)

    def switched(self) -> None:
        """Switch the robot off and on, which produces events."""
        assert self.here.get("srv/deactivate")["success"]
        assert self.here.get("srv/activate")["success"]

    def restored(self) -> None:
        """Release the robot and switch it on."""
        if self.here.state()["mode"] == "stopped":
            assert self.here.get("srv/clear")["success"]
        assert self.here.get("srv/activate")["success"]

    def outcome(self, identity: Identity, verb: Verb) -> Outcome:
        """Try each row of this verb with this identity, once per test run. Return the results."""
        if (identity, verb) not in self._outcomes:
            self._outcomes[identity, verb] = self._tried(identity, verb)
        return self._outcomes[identity, verb]

    def _tried(self, identity: Identity, verb: Verb) -> Outcome:
        rows = ROWS[verb]
        try:
            visitor = Visitor(self, identity)
        except zenoh.ZError:
            assert identity not in ADMITTED
            return dict.fromkeys((row.label for row in rows), False)
        with visitor:
            if verb == "query":
                outcome = visitor.query_outcomes(
                    [r for r in rows if not r.payload and "/srv/" not in r.key]
                )
                assert self.here.state()["mode"] != "stopped"
                outcome |= visitor.query_outcomes([row for row in rows if row.label not in outcome])
                self.restored()
                return outcome
            attempt = visitor.followed if verb == "subscribe" else partial(visitor.has_effect, verb)
            # Try all rows that should have no effect at once, and one by one only if something
            # happened.
            idle = [row for row in rows if identity not in row.who]
            quiet = idle if idle and not attempt(idle) else []
            return {row.label: row not in quiet and attempt([row]) for row in rows}


class Visitor:
    """One Zenoh session with a certain identity, which makes the attempts."""

    def __init__(self, robot: Robot, who: Identity) -> None:
        self._robot, self._who, self._sequence = robot, who, 0
        self._session = zenoh.open(robot.config(who))

    def __enter__(self) -> Visitor:
        return self

    def __exit__(self, *error: object) -> None:
        self._session.close()

    def _attachment(self, key: str) -> bytes | None:
        self._sequence += 1
        if not key.startswith(("0/", "1/")):
            return None
        return ros.Attached(self._sequence, time.time_ns(), bytes(range(16))).pack()

    def _behind(self) -> None:
        """Wait until all messages of this session have arrived.

        The messages of one link stay in order, so the answer to a query shows that.
        """
        if self._who in ADMITTED:
            assert list(self._session.get(f"{ME}/info", timeout=5.0))
        else:
            self._robot.settled()

    def _patience(self, rows: Sequence[Try]) -> int:
        """Return the number of control periods to wait for an effect.

        An effect that is expected gets more time, because the machine may be busy.
        """
        if not all(self._who in row.who for row in rows):
            return 5
        # Last values are sent again every 5 s, for clients that cannot ask for them.
        return 700 if any(row.how == "late" for row in rows) else 200

    def has_effect(self, verb: Verb, rows: Sequence[Try]) -> bool:
        """Return whether any of these puts or deletes had an effect."""
        here = self._robot.here
        before = _accepted_commands(here.state())
        for row in rows:
            attachment = self._attachment(row.key)
            if verb == "put":
                self._session.put(row.key, row.data, attachment=attachment)
            else:
                self._session.delete(row.key, attachment=attachment)
        self._behind()

        def effect() -> bool:
            state = here.state()
            return bool(state["mode"] == "stopped" or _accepted_commands(state) != before)

        done = self._robot.comes_true(effect, self._patience(rows)) or self._robot.fooled()
        if here.state()["mode"] == "stopped":
            self._robot.restored()
        return done

    def query_outcomes(self, rows: Sequence[Try]) -> Outcome:
        """Send these queries. Return for each whether an answer arrived."""
        waiting = {}
        for row in rows:
            answers: zenoh.handlers.FifoChannel[zenoh.Reply] = zenoh.handlers.FifoChannel(64)
            waiting[row.label] = self._session.get(
                row.key,
                handler=answers,
                payload=row.data or None,
                attachment=self._attachment(row.key),
                timeout=5.0,
                accept_replies=zenoh.ReplyKeyExpr.ANY,
            )
        self._behind()
        self._robot.settled()
        outcome: Outcome = {}

        def look(label: str) -> bool:
            try:
                reply = waiting[label].try_recv()
            except zenoh.ZError:
                return True  # all answers have arrived
            outcome[label] = outcome[label] or (reply is not None and reply.ok is not None)
            return outcome[label]

        for row in rows:
            outcome[row.label] = False
            if look(row.label) or self._who not in row.who:
                continue
            self._robot.comes_true(partial(look, row.label), 100)
        return outcome

    def followed(self, rows: Sequence[Try]) -> bool:
        """Return whether any of these subscriptions received a sample."""
        event = threading.Event()

        def on_sample(sample: zenoh.Sample) -> None:
            event.set()

        # Use a session of its own: within one session, every subscription gets the samples that any
        # of them requested.
        with zenoh.open(self._robot.config(self._who)) as session:
            subscribers = [_subscribed(session, row, on_sample) for row in rows]
            if self._who in ADMITTED:
                assert list(session.get(f"{ME}/info", timeout=5.0))
            if any(row.stirred for row in rows):
                here = self._robot.here
                here.put("cmd/app", ZERO)
                here.put("cmd/app/operator", ZERO)
                here.session.put("cmd_vel", CDR_TWIST)
                here.session.put(RMW_CMD, CDR_TWIST, attachment=self._attachment(RMW_CMD))
            if any(row.key.endswith("events") for row in rows):
                self._robot.switched()
            done = self._robot.comes_true(event.is_set, self._patience(rows))
            for subscriber in subscribers:
                subscriber.undeclare()
        return done


def _accepted_commands(state: Any) -> int:
    """Return the number of commands that the daemon has admitted, from its counters.

    This includes the first commands of a new sender, which do not drive the robot yet.
    """
    counters = state["counters"]
    return sum(
        counters.get(name, 0)
        for name in ("commands", "commands_of_new_senders", "command_out_of_range")
    )


def _subscribed(session: zenoh.Session, row: Try, on_sample: Callable[[zenoh.Sample], None]) -> Any:
    if row.how == "token":
        return session.liveliness().declare_subscriber(row.key, on_sample, history=True)
    if row.how == "late":
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
        return zenoh.ext.declare_advanced_subscriber(session, row.key, on_sample, history=history)
    return session.declare_subscriber(row.key, on_sample)


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    with Robot(tmp_path_factory.mktemp("access")).running() as robot:
        yield robot


@pytest.mark.variations(8)
@pytest.mark.parametrize("verb", VERBS)
@pytest.mark.parametrize("identity", IDENTITIES)
def test_each_certificate_may_do_exactly_what_the_access_table_allows(
    robot: Robot, identity: Identity, verb: Verb
) -> None:
    wrong = [
        f"{row.label}: {'let through' if done else 'kept out'}"
        for row, done in zip(ROWS[verb], robot.outcome(identity, verb).values(), strict=True)
        if done != (identity in row.who)
    ]
    assert not wrong


def test_a_put_that_no_certificate_may_send_never_reaches_the_daemon(robot: Robot) -> None:
    before = robot.here.state()["counters"]
    with Visitor(robot, "maintainer") as visitor:
        assert not visitor.has_effect("put", [row for row in ROWS["put"] if not row.who])
        assert not visitor.has_effect("delete", ROWS["delete"])
    after = robot.here.state()["counters"]
    refused = {name for name in after if name.startswith("command_")}
    assert {name: after[name] for name in refused} == {name: before.get(name) for name in refused}


def test_a_link_ends_with_its_certificate(robot: Robot, tmp_path: Path) -> None:
    days = 2.0 / 86400.0
    robot.certificates.issue(tmp_path, "operator", days)
    end = time.monotonic() + 2.0
    with zenoh.open(robot.certificates.client_settings(robot.tls, tmp_path)) as session:
        assert list(session.get(f"{ME}/info", timeout=1.0))
        until(lambda: not list(session.info.routers_zid()), 6.0, "the link ends")
        assert time.monotonic() > end - 1.1  # certificates count whole seconds
