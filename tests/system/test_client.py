"""`acsard.client` against a running daemon."""

from __future__ import annotations

import asyncio
import json
import math
import re
import signal
import sys
import time
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import zenoh

from acsard.client import connect, connect_async, connection
from acsard.client.connection import Connection
from acsard.client.ride import OPEN_TIMEOUT_S
from acsard.core.messages import schema
from acsard.core.messages.refusals import BUSY_ENCODING
from acsard.host.errors import (
    NoAnswerError,
    NotDrivenError,
    ReplyError,
    UnreachableError,
    UsageError,
)
from tests.each import each
from tests.system.bystander import lost
from tests.system.harness import (
    ROOT,
    Bus,
    Daemon,
    Tables,
    client_config,
    finish,
    free_endpoint,
    until,
)

DEFAULT = "tcp/127.0.0.1:7448"


@pytest.fixture
def fresh(shared: Daemon, bus: Bus) -> Iterator[Bus]:
    """Provide the shared robot at the origin and at rest. Wait for rest at the end, too."""
    bus.at_rest()
    bus.get("srv/reset_odometry")
    yield bus
    bus.at_rest()
    assert "Traceback" not in shared.stderr


def test_typed_messages_of_every_published_key(shared: Daemon, fresh: Bus) -> None:
    with connect(shared.endpoint) as robot:
        reads: list[tuple[Any, type]] = [
            ("odom", schema.Odometry),
            ("tf", schema.TFMessage),
            ("tf_static", schema.TFMessage),
            ("wheel_states", schema.JointState),
            ("cmd_vel_out", schema.TwistStamped),
            ("state", schema.RobotState),
            ("diagnostics", schema.DiagnosticArray),
        ]
        for name, cls in reads:
            assert isinstance(robot.get(name), cls), name
        assert isinstance(next(robot.messages("odom", timeout=2.0)), schema.Odometry)


def test_connect_without_arguments_uses_the_file_that_the_environment_names(
    shared: Daemon, fresh: Bus, monkeypatch: pytest.MonkeyPatch
) -> None:
    async def pid() -> Any:
        async with connect_async() as robot:
            return (await robot.get("info")).pid

    monkeypatch.setenv("ACSARD_CONFIG", str(shared.config))
    with connect() as robot:
        assert robot.get("info").pid == asyncio.run(pid()) == shared.pid


async def test_connecting_without_a_daemon_raises_a_connection_error_with_the_remedy() -> None:
    endpoint = free_endpoint()
    with pytest.raises(UnreachableError, match="acsard run") as error, connect(endpoint):
        pass
    assert isinstance(error.value, ConnectionError)
    assert endpoint in str(error.value)
    with pytest.raises(UnreachableError):
        async with connect_async(endpoint):
            pass


_ONLY_ITS_LIBRARIES = """\
import asyncio, importlib, pkgutil, sys

class Finder:
    others = set()

    def find_spec(self, name, path=None, target=None):
        library = name.partition(".")[0]
        if library not in {"acsard", "msgspec", "xxhash", "zenoh", *sys.stdlib_module_names}:
            self.others.add(library)
            raise ModuleNotFoundError(f"{name} is not for client programs")

sys.meta_path.insert(0, Finder())
import acsard.client

for module in pkgutil.iter_modules(acsard.client.__path__):
    importlib.import_module(f"acsard.client.{module.name}")

async def state(endpoint):
    async with acsard.client.connect_async(endpoint) as robot:
        return await anext(robot.messages("state"))

with acsard.client.connect(sys.argv[1]) as robot:
    robot.drive(0.1, 0.0, seconds=0.1)
    robot.call("stop")
    robot.call("clear")
    print(robot.pose().x > 0.0, asyncio.run(state(sys.argv[1])).link)
# msgspec does not need the first, and `copy` looks for Jython.
print("others:", *Finder.others - {"typing_extensions", "org"})
"""


def test_a_client_program_needs_no_library_but_zenoh_msgspec_and_xxhash(
    shared: Daemon, fresh: Bus
) -> None:
    done = finish([sys.executable, "-c", _ONLY_ITS_LIBRARIES, shared.endpoint], ROOT)
    assert done.code == 0, done.err
    assert done.out.splitlines() == ["True up", "others:"]


def test_a_call_that_is_not_answered_in_time_raises_no_answer(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(connection, "REPLY_TIMEOUT_S", 0.3)
    endpoint = free_endpoint()
    unanswered: list[zenoh.Query] = []
    settings = zenoh.Config()
    settings.insert_json5("listen/endpoints", json.dumps([endpoint]))
    settings.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(settings) as stuck:
        stuck.declare_queryable("acsard/acsar/srv/*", unanswered.append)
        with connect(endpoint) as robot, pytest.raises(NoAnswerError, match=r"within 0.3 s"):
            robot.call("deactivate")
        assert unanswered
        unanswered.clear()


@pytest.mark.parametrize(
    ("endpoint", "robot_id", "why"),
    [
        *((endpoint, "acsar", "write it like") for endpoint in ("127.0.0.1:7448", "", "tcp/[::1]")),
        *((DEFAULT, robot_id, "is not a robot's id") for robot_id in ("a/b*", "")),
    ],
)
def test_an_invalid_address_raises_a_value_error(endpoint: str, robot_id: str, why: str) -> None:
    with pytest.raises(UsageError, match=why) as error, connect(endpoint, robot_id=robot_id):
        pass
    assert isinstance(error.value, ValueError)


@pytest.mark.slow
def test_a_drive_of_a_stopped_robot_raises_the_daemon_s_reason(shared: Daemon, fresh: Bus) -> None:
    with connect(shared.endpoint) as robot:
        robot.call("stop")
        with pytest.raises(NotDrivenError, match=f"stopped by {robot.name}"):
            robot.drive(0.5, seconds=0.2)
        numbers = [cause.number for cause in robot.get("state").causes]
        robot.call("stop")
        assert not robot.call("clear", numbers=numbers).success
        assert robot.call("clear").success
        robot.call("deactivate")
        with pytest.raises(NotDrivenError, match="acsard call activate"):
            robot.drive(0.5, seconds=0.2)
        robot.call("activate")
        robot.drive(0.5, seconds=0.2)
        assert robot.pose().x > 0.02


def test_a_drive_that_is_stopped_on_its_way_raises_and_does_not_go_on(
    shared: Daemon, fresh: Bus
) -> None:
    with connect(shared.endpoint) as robot:

        def stop() -> None:
            until(lambda: (fresh.state()["linear"] or 0.0) > 0.1, 5.0, "driving")
            fresh.session.put("acsard/acsar/stop", b"")

        with ThreadPoolExecutor(1) as other:
            stopping = other.submit(stop)
            with pytest.raises(NotDrivenError, match="stopped"):
                robot.drive(0.3, seconds=30.0)
            stopping.result()
        assert robot.call("clear").success


@pytest.mark.slow
def test_move_and_turn_end_within_five_millimetres_and_half_a_degree(
    shared: Daemon, fresh: Bus
) -> None:
    with connect(shared.endpoint) as robot:
        begun = time.monotonic()
        robot.move(0.2)
        robot.turn(-90)
        robot.move(-0.1)
        robot.turn(90)
        late = lost(begun)
        pose = robot.pose()
    # A late message lets the robot go on, at 0.02 m/s and 3 degrees a second near the end.
    assert pose.x == pytest.approx(0.2, abs=0.005 + 0.02 * late)
    assert pose.y == pytest.approx(0.1, abs=0.005 + 0.02 * late)
    assert math.degrees(pose.yaw) == pytest.approx(0.0, abs=1.0 + 3.0 * late)


@pytest.mark.slow
def test_a_drive_raises_and_names_the_sender_while_another_commander_drives(
    shared: Daemon, fresh: Bus
) -> None:
    with (
        connect(shared.endpoint) as first,
        connect(shared.endpoint) as robot,
        ThreadPoolExecutor(1) as other,
    ):
        # The second would drive if the first ended within this time.
        driving = other.submit(lambda: first.drive(0.1, seconds=OPEN_TIMEOUT_S + 3.0))
        until(lambda: (fresh.state()["linear"] or 0.0) > 0.05, 5.0, "the first drives")
        with pytest.raises(NotDrivenError, match=re.escape(first._connection.sender)):
            robot.drive(0.5, seconds=0.2)
        driving.result()


@pytest.mark.slow
def test_a_drive_of_a_robot_that_dies_behind_a_router_with_storages_raises(tmp_path: Path) -> None:
    endpoint, last = free_endpoint(), list[zenoh.Sample]()

    def answer(query: zenoh.Query) -> None:
        answered.append(True)
        for item in last[-1:]:
            query.reply(
                item.key_expr, item.payload, encoding=item.encoding, timestamp=item.timestamp
            )

    answered: list[bool] = []
    with ExitStack() as stack:
        router = stack.enter_context(zenoh.open(client_config(endpoint, "router")))
        handles: list[Any] = [
            router.declare_subscriber("acsard/acsar/state", last.append),
            router.declare_queryable("acsard/acsar/state", answer),
        ]
        listen: Tables = {"bus": {"listen": [free_endpoint()], "connect": [endpoint]}}
        daemon = stack.enter_context(Daemon(tmp_path, config=listen))
        until(lambda: bool(last), 10.0, "connected")
        robot, bus = stack.enter_context(connect(endpoint)), stack.enter_context(Bus(endpoint))

        def kill() -> None:
            until(lambda: (bus.state()["linear"] or 0.0) > 0.1, 10.0, "driving")
            daemon.signal(signal.SIGKILL)

        killing = stack.enter_context(ThreadPoolExecutor(1)).submit(kill)
        with pytest.raises(NoAnswerError, match="nothing received from the daemon"):
            robot.drive(0.3, seconds=4.0)
        killing.result()
        assert answered
        for item in handles:
            item.undeclare()


async def test_a_zero_sent_right_after_a_command_is_not_lost(shared: Daemon, fresh: Bus) -> None:
    # A drive may be cancelled just after it sent a command. The bus drops commands of one key that
    # come faster than 1000 Hz, also because the receiver was busy and handles them in a row. Then
    # the robot would drive on for its timeout, so the zero is repeated.
    sent: list[float] = []
    original = Connection._put

    def put(self: Connection, linear: float, angular: float, echo: schema.Beat) -> None:
        original(self, linear, angular, echo)
        sent.append(linear)

    with pytest.MonkeyPatch.context() as patch, fresh.follow("cmd/app") as commands:
        patch.setattr(Connection, "_put", put)
        async with connect_async(shared.endpoint) as robot:
            driving = asyncio.create_task(robot.drive(0.2, seconds=60.0))
            # Send the opening zero, the pause, and the first command, in one step of the loop.
            await asyncio.sleep(0)
            while 0.2 not in sent:
                await asyncio.sleep(0)
            driving.cancel()
            with pytest.raises(asyncio.CancelledError):
                await driving
            zeros = sent[::-1].index(0.2)
            assert zeros >= 2
            await robot.get("info")
        fresh.get("info")  # after everything that was sent: the command itself may be dropped
        until(lambda: commands.seen[-1].value["linear"]["x"] == 0.0, 1.0, "a last zero")


def test_the_client_repeats_a_query_to_a_busy_daemon_and_never_a_service_call() -> None:
    endpoint, asked = free_endpoint(), list[str]()

    def answer(query: zenoh.Query) -> None:
        asked.append(str(query.key_expr))
        if len(asked) < 4:
            query.reply_err("another text", encoding=BUSY_ENCODING)
        else:
            query.reply(query.key_expr, "{}")

    config = zenoh.Config()
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as busy:
        queryables = [
            busy.declare_queryable(f"acsard/acsar/{key}", answer) for key in ("config", "srv/*")
        ]
        with connect(endpoint) as robot:
            assert robot._connection.reply("config")[1] == b"{}"
            assert asked == ["acsard/acsar/config"] * 4
            asked.clear()
            # Another client may have pressed stop since.
            with pytest.raises(ReplyError, match="another text"):
                robot.call("deactivate")
            assert asked == ["acsard/acsar/srv/deactivate"]
        assert queryables


@pytest.mark.slow
@each("use", ["robot.messages('odom')", "robot.send(0.3)"])
def test_a_program_that_never_closes_its_connection_ends(
    shared: Daemon, tmp_path: Path, use: str
) -> None:
    script = f"""
from acsard.client import connect
opened = connect({shared.endpoint!r})
robot = opened.__enter__()
kept = {use}
if hasattr(kept, "__next__"): next(kept)
"""
    assert finish([sys.executable, "-c", script], tmp_path, 10.0).code == 0
