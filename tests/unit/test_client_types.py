"""Both clients: the same names, their answers, and a type for each key of the table."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import AsyncIterator, Callable
from functools import partial
from inspect import signature
from pathlib import Path
from types import SimpleNamespace
from typing import Any, get_args, get_overloads, get_type_hints

import msgspec
import pytest

from acsard.client import AsyncClient, Client
from acsard.client.reads import FOLLOWED_KEYS, QUERIED_KEYS, AsyncReads, Reads
from acsard.core.messages.keys_and_roles import by_key
from acsard.core.messages.schema import MESSAGES, Beat, ServiceReply
from acsard.core.values import Pose
from acsard.host.errors import ReplyError, UsageError
from tests.each import each
from tests.system.harness import ROOT
from tests.unit.screens import sample_of


def types(method: Callable[..., object]) -> dict[str, object]:
    """Return the type that each overload gives, by key."""
    found: dict[str, object] = {}
    for overload in get_overloads(method):
        hints = get_type_hints(overload)
        # The type of a message is also the argument of the iterator over it.
        kind = next(iter(get_args(hints["return"])), hints["return"])
        found |= dict.fromkeys(get_args(hints["name"]), kind)
    return found


@each(
    ("method", "keys"),
    [
        (Reads.get, QUERIED_KEYS),
        (AsyncReads.get, QUERIED_KEYS),
        (Reads.messages, FOLLOWED_KEYS),
        (AsyncReads.messages, FOLLOWED_KEYS),
    ],
)
def test_each_key_has_its_own_type(method: Callable[..., object], keys: set[str]) -> None:
    def wanted(key: str) -> object:
        topic = by_key(key)
        assert topic is not None
        return MESSAGES.get(topic.type, str)  # a dictionary with keys that are strings

    assert types(method) == {key: wanted(key) for key in keys}


def test_both_clients_show_the_same_few_names() -> None:
    for client in (Client, AsyncClient):
        assert {name for name in dir(client) if not name.startswith("_")} == {
            "call", "clear", "drive", "get", "messages", "move", "name", "pose", "send", "set",
            "stop", "turn", "whoami",
        }, client  # fmt: skip


@each("name", ["call", "clear", "drive", "move", "pose", "send", "set", "stop", "turn", "whoami"])
def test_both_clients_have_the_same_parameters_and_defaults(name: str) -> None:
    one, other = (signature(getattr(client, name)) for client in (Client, AsyncClient))
    assert one.parameters == other.parameters


class Asked:
    """A connection that returns what it was asked, and refuses `clear`."""

    name = "me"

    def call(self, service: str, **fields: object) -> ServiceReply:
        return ServiceReply(service != "clear", f"{service} {fields}")

    def set(self, settings: object) -> ServiceReply:
        return ServiceReply(True, f"set {settings}")

    def whoami(self) -> str:
        return "whoami"

    def pose(self) -> Pose:
        return Pose(1.0, 2.0, 3.0)

    def send(self, *speeds: float) -> None:
        self.sent = speeds

    def reply(self, name: str) -> tuple[str, bytes]:
        return "application/json", msgspec.json.encode({"asked": name})

    def subscribe(self, name: str) -> Any:
        samples = [sample_of(beat) for beat in BEATS]

        async def arriving() -> AsyncIterator[Any]:
            for sample in samples:
                yield sample

        return SimpleNamespace(until_silence=lambda timeout: iter(samples), arriving=arriving)

    _reply, _subscribe = reply, subscribe


BEATS = [Beat(7, 1), Beat(7, 2)]


@pytest.mark.parametrize("kind", [Client, AsyncClient])
async def test_both_clients_ask_the_connection_and_return_its_answer(
    kind: type[Client] | type[AsyncClient],
) -> None:
    connection: Any = Asked()
    robot: Any = kind(connection)

    async def result(answer: Any) -> Any:
        return await answer if kind is AsyncClient else answer

    assert (await result(robot.stop())).message == "stop {}"
    assert (await result(robot.call("set_pose", x=1.0))).message == "set_pose {'x': 1.0}"
    assert (await result(robot.set({"rates.odom": 5.0}))).message == "set {'rates.odom': 5.0}"
    assert await result(robot.whoami()) == "whoami"
    assert await result(robot.pose()) == Pose(1.0, 2.0, 3.0)
    assert await result(robot.get("config")) == {"asked": "config"}
    robot.send(0.5, 0.2)
    assert connection.sent == (0.5, 0.2)
    assert robot.name == "me"
    robot.name = "you"
    assert connection.name == "you"
    for asks in (robot.clear, partial(robot.call, "clear")):
        with pytest.raises(ReplyError, match="clear"):
            await result(asks())
    found = robot.messages("beat")
    beats = [beat async for beat in found] if kind is AsyncClient else list(found)
    assert beats == BEATS
    for name, words in (("config", r"use get\('config'\)"), ("odmo", "did you mean odom")):
        with pytest.raises(UsageError, match=words):
            robot.messages(name)
    with pytest.raises(UsageError, match="did you mean odom"):
        await result(robot.get("odmo"))


STUDENT = """\
import asyncio

from acsard.client import connect, connect_async

with connect() as robot:
    for odom in robot.messages("odom", timeout=1.0):
        print(odom.time, odom.yaw, odom.pose.pose.position.x)
        print(odom.speed)
        break
    robot.get("odmo")
    robot.move(robot.get("state").mode)
    robot.turn(90)
    robot.stop().success


async def main() -> None:
    async with connect_async() as robot:
        async for state in robot.messages("state"):
            print(state.mod)
        await robot.get("odmo")
        await robot.drive("fast", seconds=1.0)


asyncio.run(main())
"""


@pytest.mark.slow
def test_mypy_names_the_mistakes_of_a_program(tmp_path: Path) -> None:
    """A wrong field, a wrong key and a wrong type, in a script and in an asyncio program."""
    program = tmp_path / "student.py"
    program.write_text(STUDENT)
    done: Any = subprocess.run(
        [sys.executable, "-m", "mypy", "--strict", "--no-error-summary", str(program)],
        cwd=ROOT, capture_output=True, text=True, timeout=110, check=False,
    )  # fmt: skip
    errors = [line for line in done.stdout.splitlines() if ": error: " in line]
    lines = [int(line.split(":")[1]) for line in errors]
    text = STUDENT.splitlines()
    assert [text[number - 1].strip() for number in lines] == [
        "print(odom.speed)",
        'robot.get("odmo")',
        'robot.move(robot.get("state").mode)',
        "print(state.mod)",
        'await robot.get("odmo")',
        'await robot.drive("fast", seconds=1.0)',
    ], done.stdout + done.stderr
    assert '"Odometry" has no attribute "speed"' in errors[0]
