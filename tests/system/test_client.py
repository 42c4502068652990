"""`acsard.client` against a running daemon."""

from __future__ import annotations

import asyncio
import json
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
import zenoh

from acsard.client import connect, connect_async, connection
from acsard.core.messages import schema
from acsard.core.messages.refusals import BUSY_ENCODING
from acsard.host.errors import (
    NoAnswerError,
    ReplyError,
    UnreachableError,
    UsageError,
)
from tests.each import each
from tests.system.harness import (
    ROOT,
    Bus,
    Daemon,
    finish,
    free_endpoint,
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
