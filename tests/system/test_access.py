"""Every identity may do exactly what `tests/permissions.py` says, at the robot and at a router.

The tests check effects. A put or delete has an effect if a robot obeys it, or if it reaches other
clients as if a robot had sent it. A query has one if an answer arrives, and a subscription if a
sample arrives. To see that nothing happens, a test sends a request after each attempt, and waits
for its answer.
"""

from __future__ import annotations

import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from typing import Any, get_args

import pytest
import zenoh
import zenoh.ext

from tests.permissions import (
    ANYBODY,
    FORGED,
    RMW_TWIST,
    VALUES,
    Row,
    Verb,
    at_router,
    by_ros,
    native,
    with_deletes,
)
from tests.system import ros_clients as ros
from tests.system.fleet_router import ROBOTS, Fleet
from tests.system.harness import ZERO, Bus, until
from tests.system.identities import ADMITTED, Gated, Identity

pytestmark = pytest.mark.network

AT_ROBOT: tuple[str, ...] = get_args(Identity)
AT_ROUTER = ("viewer", "operator", "maintainer", "robot2", "unlisted", "router.local")


class Place:
    """A door with its robots, and a witness of what reaches other clients there."""

    table: tuple[Row, ...] = ()
    robots: list[Bus]
    """Plain clients on the machine of each robot."""
    watches = "local"
    """The identity of the witness."""

    def __init__(self, where: Path) -> None:
        self.where, self.stack = where, ExitStack()
        self._fooled = threading.Event()

    def __enter__(self) -> Place:
        try:
            self.open()
            self.witness = self.stack.enter_context(zenoh.open(self.config(self.watches)))
            keys = {f"{robot.root}/{key}" for robot in self.robots for key in VALUES}
            keys |= {"odom", "tf_static", ros.rmw_key("odom", ros.ODOMETRY)}
            self._watching = [self.witness.declare_subscriber(k, self._judge) for k in keys]
            until(self.reaches_witness, 10.0, "the witness is connected")
        except BaseException:
            self.__exit__()
            raise
        return self

    def __exit__(self, *error: object) -> None:
        self.stack.close()

    def open(self) -> None:
        """Start the robots."""
        raise NotImplementedError

    def config(self, identity: str) -> zenoh.Config:
        """Return the settings of a session with this identity."""
        raise NotImplementedError

    def trees(self, identity: str) -> list[str]:
        """Return the trees of the robots that answer this identity."""
        return [robot.root for robot in self.robots] if identity in ANYBODY else []

    def _judge(self, sample: zenoh.Sample) -> None:
        if sample.payload.to_bytes() == FORGED or sample.kind != zenoh.SampleKind.PUT:
            self._fooled.set()

    def reaches_witness(self) -> bool:
        return bool(list(self.witness.get(f"{self.robots[0].root}/info", timeout=1.0)))

    def fooled(self) -> bool:
        """Return whether the witness has received a forged message since the last call."""
        assert self.reaches_witness()
        was = self._fooled.is_set()
        self._fooled.clear()
        return was

    def comes_true(self, look: Callable[[], bool], steps: int = 5) -> bool:
        """Return whether `look` returns True within `steps` control periods.

        A period is long compared with the delivery of a message on one machine.
        """
        here = self.robots[0]
        begun = here.count("lines_sent")
        while not (result := look()):
            if here.count("lines_sent") >= begun + steps:
                return look()
            time.sleep(0.005)
        return result

    def effects(self) -> list[int]:
        """Return the numbers of admitted commands and of stops, which change with an effect.

        The first commands of a new sender are admitted too, and do not drive the robot yet.
        """
        names = ("commands", "commands_of_new_senders", "command_out_of_range")
        states = [robot.state() for robot in self.robots]
        counts = [state["counters"].get(name, 0) for state in states for name in names]
        return counts + [len(state["causes"]) for state in states]

    def restored(self) -> None:
        """Release all robots and switch them on."""
        for robot in self.robots:
            until(partial(released, robot), 5.0, "cleared and active")

    def tried(self, identity: str, verb: Verb) -> dict[Row, bool]:
        """Try each row of this verb with this identity. Return the results."""
        rows = [row for row in self.table if row.verb == verb]
        try:
            visitor = Visitor(self, identity)
        except zenoh.ZError:
            assert identity not in ADMITTED
            return dict.fromkeys(rows, False)
        with visitor:
            if verb == "query":
                calls = [row for row in rows if row.payload or "/srv/" in row.key]
                outcome = visitor.answered([row for row in rows if row not in calls])
                assert not any(robot.state()["mode"] == "stopped" for robot in self.robots)
                outcome |= visitor.answered(calls)
                self.restored()
                return outcome
            # Try all rows that should have no effect at once, and one by one only if something
            # happened.
            idle = [row for row in rows if identity not in row.who]
            if verb == "subscribe":
                quiet = idle if idle and not any(visitor.followed([idle])) else []
                rest = [row for row in rows if row not in quiet]
                results = visitor.followed([[row] for row in rest])
                return dict.fromkeys(quiet, False) | dict(zip(rest, results, strict=True))
            quiet = idle if idle and not visitor.put(verb, idle) else []
            return {row: row not in quiet and visitor.put(verb, [row]) for row in rows}


def released(robot: Bus) -> bool:
    """Clear and activate. Return False if another stop arrived meanwhile."""
    if robot.state()["mode"] == "stopped" and not robot.get("srv/clear")["success"]:
        return False
    return bool(robot.get("srv/activate")["success"])


class AtRobot(Place):
    """The robot's own addresses: a plain one for its own machine, and one with TLS."""

    table = with_deletes(row for rows in (native("acsard/acsar"), by_ros()) for row in rows)

    def open(self) -> None:
        # Its board reports the battery, so that each key has messages.
        self.gated = Gated(self.where, sim={"faults": ["battery=80:600"]})
        self.stack.enter_context(self.gated.daemon)
        self.robots = [self.stack.enter_context(Bus(self.gated.plain))]
        self.robots[0].linked()

    def config(self, identity: str) -> zenoh.Config:
        plain, tls = self.gated.plain, self.gated.tls
        return self.gated.certificates.config(identity, plain, tls)  # type: ignore[arg-type]


class AtRouter(Place):
    """A fleet's router with two robots. `robot2` is also any client with its certificate."""

    table = with_deletes(at_router("acsard/robot1", "acsard/robot2"))
    watches = "maintainer"

    def open(self) -> None:
        self.fleet = self.stack.enter_context(Fleet(self.where))
        self.robots, self._sensed = self.fleet.robots, 0
        for robot, tree in ((name, f"acsard/{name}") for name in ROBOTS):
            itself = self.stack.enter_context(self.fleet.member(robot, robot))
            sensed = itself.session.declare_subscriber(f"{tree}/imu", self._sense)
            self.stack.callback(sensed.undeclare)

    def _sense(self, sample: zenoh.Sample) -> None:
        self._sensed += 1

    def effects(self) -> list[int]:
        return [*super().effects(), self._sensed]

    def config(self, identity: str) -> zenoh.Config:
        return self.fleet.config(identity)

    def trees(self, identity: str) -> list[str]:
        return ["acsard/robot2"] if identity == "robot2" else super().trees(identity)


class Visitor:
    """A session with a certain identity, which makes the attempts."""

    def __init__(self, place: Place, who: str) -> None:
        self._place, self._who, self._sequence = place, who, 0
        self._session = zenoh.open(place.config(who))

    def __enter__(self) -> Visitor:
        return self

    def __exit__(self, *error: object) -> None:
        self._session.close()

    def _attachment(self, key: str) -> bytes | None:
        self._sequence += 1
        if not key.startswith(("0/", "1/")):
            return None
        return ros.Attached(self._sequence, time.time_ns(), bytes(range(16))).pack()

    def _behind(self, session: zenoh.Session) -> None:
        """Wait until all messages of this session have arrived.

        The messages of one route stay in order, so the answer to a query shows that.
        """
        trees = self._place.trees(self._who)
        for tree in trees:
            assert list(session.get(f"{tree}/info", timeout=5.0))
        if len(trees) < len(self._place.robots):
            self._place.comes_true(lambda: False)

    def _patience(self, rows: Sequence[Row]) -> int:
        """Return the number of control periods to wait for an effect, more for an expected one."""
        if not any(self._who in row.who for row in rows):
            return 5
        # Last values are sent again every 5 s, for clients that cannot ask for them.
        return 700 if any(row.how == "late" for row in rows) else 400

    def put(self, verb: Verb, rows: Sequence[Row]) -> bool:
        """Return whether any of these puts or deletes had an effect."""
        place = self._place
        before = place.effects()
        for row in rows:
            attachment = self._attachment(row.key)
            if verb == "put":
                self._session.put(row.key, row.data, attachment=attachment)
            else:
                self._session.delete(row.key, attachment=attachment)
        self._behind(self._session)
        done = place.comes_true(lambda: place.effects() != before, self._patience(rows))
        if done:
            place.restored()
        return place.fooled() or done

    def answered(self, rows: Sequence[Row]) -> dict[Row, bool]:
        """Send these queries. Return for each whether an answer arrived."""
        outcome, waiting = dict.fromkeys(rows, False), {}
        for row in rows:
            answers: zenoh.handlers.FifoChannel[zenoh.Reply] = zenoh.handlers.FifoChannel(64)
            waiting[row] = self._session.get(
                row.key,
                handler=answers,
                payload=row.data or None,
                attachment=self._attachment(row.key),
                timeout=5.0,
                accept_replies=zenoh.ReplyKeyExpr.ANY,
            )
        self._behind(self._session)
        self._place.comes_true(lambda: False)

        def look(row: Row) -> bool:
            try:
                reply = waiting[row].try_recv()
            except zenoh.ZError:
                return True  # all answers have arrived
            outcome[row] = outcome[row] or (reply is not None and reply.ok is not None)
            return outcome[row]

        for row in rows:
            if not look(row) and self._who in row.who:
                self._place.comes_true(partial(look, row), 100)
        return outcome

    def followed(self, groups: Sequence[Sequence[Row]]) -> list[bool]:
        """Return for each group of subscriptions whether any of them received a sample.

        Each group has a session of its own: within one session, every subscription gets the samples
        that any of them requested.
        """
        place, rows = self._place, [row for group in groups for row in group]
        events = [threading.Event() for _ in groups]
        with ExitStack() as stack:
            for group, event in zip(groups, events, strict=True):
                session = stack.enter_context(zenoh.open(place.config(self._who)))
                for row in group:
                    subscriber = subscribed(session, row, partial(heard, event))
                    stack.callback(subscriber.undeclare)
                self._behind(session)
            here = place.robots[0]
            if any(row.stirred for row in rows):
                for key in ("cmd/app", "cmd/app/operator"):
                    here.put(key, ZERO)
                here.session.put("cmd_vel", ros.twist(0.0))
                attachment = self._attachment(RMW_TWIST)
                here.session.put(RMW_TWIST, ros.twist(0.0), attachment=attachment)
            if any(row.key.endswith(("events", "battery")) for row in rows):
                # These calls are events, and with a new mode the battery is published at once.
                for robot in place.robots:
                    for verb in ("deactivate", "activate"):
                        assert robot.get(f"srv/{verb}")["success"]
            for group, event in zip(groups, events, strict=True):
                place.comes_true(event.is_set, self._patience(group))
        return [event.is_set() for event in events]


def heard(event: threading.Event, sample: zenoh.Sample) -> None:
    event.set()


def subscribed(session: zenoh.Session, row: Row, take: Callable[[zenoh.Sample], None]) -> Any:
    if row.how == "token":
        return session.liveliness().declare_subscriber(row.key, take, history=True)
    if row.how == "late":
        history = zenoh.ext.HistoryConfig(detect_late_publishers=True)
        return zenoh.ext.declare_advanced_subscriber(session, row.key, take, history=history)
    return session.declare_subscriber(row.key, take)


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[AtRobot]:
    with AtRobot(tmp_path_factory.mktemp("robot")) as place:
        assert isinstance(place, AtRobot)
        yield place


@pytest.fixture(scope="module")
def router(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Place]:
    with AtRouter(tmp_path_factory.mktemp("router")) as place:
        yield place


@pytest.mark.variations(8)
@pytest.mark.parametrize("verb", get_args(Verb))
@pytest.mark.parametrize("identity", AT_ROBOT)
def test_the_robot_lets_each_identity_do_exactly_what_the_table_says(
    robot: Place, identity: str, verb: Verb
) -> None:
    judge(robot, identity, verb)


@pytest.mark.nightly
@pytest.mark.parametrize("verb", get_args(Verb))
@pytest.mark.parametrize("identity", AT_ROUTER)
def test_the_router_lets_each_identity_do_exactly_what_the_table_says(
    router: Place, identity: str, verb: Verb
) -> None:
    judge(router, identity, verb)


def judge(place: Place, identity: str, verb: Verb) -> None:
    wrong = [
        f"{row.key} ({row.how}): {'let through' if done else 'kept out'}"
        for row, done in place.tried(identity, verb).items()
        if done != (identity in row.who)
    ]
    assert not wrong


def test_a_link_ends_with_its_certificate(robot: AtRobot, tmp_path: Path) -> None:
    certificates = robot.gated.certificates
    certificates.issue(tmp_path, "operator", 2.0 / 86400.0)
    end = time.monotonic() + 2.0
    with zenoh.open(certificates.client_settings(robot.gated.tls, tmp_path)) as session:
        assert list(session.get("acsard/acsar/info", timeout=1.0))
        until(lambda: not list(session.info.routers_zid()), 6.0, "the link ends")
        assert time.monotonic() > end - 1.1  # certificates count whole seconds
