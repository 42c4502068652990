"""A client and a daemon of two versions work together, in both directions.

The older one is the wheel of this tree. The newer one is the same wheel with a field added to all
that a client receives, to each attachment and to each file, and with a verb, words and a code that
the older one does not know (`versions.py`).
"""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from signal import SIGTERM
from typing import Any, NamedTuple

import pytest
import zstandard

from acsard.core.messages import schema
from acsard.core.messages.keys_and_roles import PUBLISHED, SERVICES
from acsard.core.messages.schema import Message
from tests.system.harness import Bus, Daemon, Finished, Peer, finish, until
from tests.system.versions import (
    CODE,
    LATCH_CODE,
    MODE,
    ONLY_SENT,
    REASON,
    VERB,
    Version,
    built_wheel,
    grow,
    plain_environment,
)
from tests.unit.test_messages_schema import ROS_FIELDS

pytestmark = [pytest.mark.slow, pytest.mark.nightly]  # it builds a wheel and two venvs


class Versions(NamedTuple):
    older: Version
    newer: Version


class Pair(NamedTuple):
    """A running daemon of one version, and the other version, whose clients use it."""

    daemon: Daemon
    version: Version
    client: Version
    where: Path

    @property
    def is_client_older(self) -> bool:
        return self.client.place.name == "older"

    def tool(self, *words: str, within: float = 20.0) -> Finished:
        """Run a tool of the client's version to its end."""
        config = ("--config", str(self.daemon.config))
        return finish(
            [self.client.acsard, *words, *config], self.where, within, plain_environment()
        )


@pytest.fixture(scope="module")
def versions(tmp_path_factory: pytest.TempPathFactory) -> Versions:
    where = tmp_path_factory.mktemp("versions")
    wheel = built_wheel(where)
    with ThreadPoolExecutor(2) as at_once:
        older, newer = at_once.map(lambda name: Version(where / name, wheel), ("older", "newer"))
    grow(newer)
    return Versions(older, newer)


def daemon_of(version: Version, where: Path, name: str = "daemon", **more: Any) -> Daemon:
    """Return the daemon of a version, which records and keeps its latches in files."""
    config = {"record": {"directory": str(where / f"{name}.recordings")}}
    daemon = Daemon(where, config=config, name=name, env=plain_environment(), **more)
    daemon.words[:3] = [version.acsard]
    return daemon


@pytest.fixture(scope="module", params=["old client", "new client"])
def pair(
    request: pytest.FixtureRequest, versions: Versions, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Pair]:
    where = tmp_path_factory.mktemp("pair")
    version, client = versions if request.param == "new client" else versions[::-1]
    with daemon_of(version, where) as daemon, Bus(daemon.endpoint) as bus:
        until(lambda: bus.state()["link"] == "up" or None, 10, "the link is up")
        yield Pair(daemon, version, client, where)


def test_the_newer_version_has_another_field_in_each_message_that_a_client_receives() -> None:
    kinds = {
        kind.__name__
        for kind in vars(schema).values()
        if isinstance(kind, type) and issubclass(kind, Message)
    }
    received = {service.payload for service in SERVICES.values()} | {"GatewayState", "SpeedLimit"}
    ros = {*ROS_FIELDS, "Battery", "Imu", "Odometry", "TFMessage"}
    assert kinds - received - ros - {"Message"} == ONLY_SENT


def test_a_tool_shows_a_mode_and_a_code_and_calls_a_verb_that_it_does_not_know(pair: Pair) -> None:
    shown = pair.tool("fleet", "--once")
    assert shown.code == 0, shown
    ended = pair.tool("call", VERB)
    if pair.is_client_older:
        words = " ".join(shown.out.split())
        assert REASON in words
        assert CODE in words
        assert MODE in words.lower()
        assert (ended.code, ended.out, ended.err) == (0, "dances", "")
    else:
        assert (ended.code, ended.err) == (1, "")
        assert f"'{VERB}' is not a service of this robot" in ended.out


CLIENT = f"""\
import asyncio, json
from acsard.client import connect, connect_async
from acsard.core.messages.keys_and_roles import SERVICES

NAMES = {[topic.key for topic in PUBLISHED if topic.key != "battery"]!r}
FIXED = ["info", "config", "interfaces", "topics"]

def used(robot):
    for name in NAMES + FIXED:
        robot.get(name)
    for name in ("schema/Twist", "whoami/viewer"):
        robot._connection.reply(name)
    for name in NAMES:
        if name not in ("tf_static", "events", "diagnostics"):
            assert next(robot.messages(name, timeout=5), None) is not None, name
    done = {{"role": robot.whoami().role, "events": len(robot.get("events").events)}}
    robot.set({{"limits.linear_speed": 0.8}})
    for verb in ("stop", "clear", "deactivate", "activate", "reset_odometry"):
        reply = robot.call(verb)
        assert reply.success, (verb, reply)
        done[verb] = reply.data.numbers
    robot.drive(0.3, seconds=0.5)
    robot.move(0.02)
    robot.turn(2)
    done["x"] = robot.pose().x
    reply = robot.call("set_pose", x=1.0, y=2.0, yaw=0.5)
    assert reply.success
    done["{VERB}"] = [(reply := robot.call("{VERB}")).success, reply.message]
    refused = robot._connection.request("set_pose", {{"x": 1, "y": 2, "yaw": 0, "zaw": 1}})
    done["strict"] = [refused.success, refused.message]
    return done

async def awaited():
    async with connect_async() as robot:
        await robot.get("state")
        async for _ in robot.messages("odom"):
            break
        await robot.whoami()
        await robot.drive(-0.3, seconds=0.3)
        await robot.pose()
        return (await robot.call("stop")).success and (await robot.call("clear")).success

with connect() as robot:
    done = used(robot)
done["async"] = asyncio.run(awaited())
print(json.dumps(done))
"""


def test_each_method_of_the_python_client_works_with_the_other_version(pair: Pair) -> None:
    env = plain_environment(ACSARD_CONFIG=str(pair.daemon.config))
    ended = finish([pair.client.python, "-c", CLIENT], pair.where, 40, env)
    assert (ended.code, ended.err) == (0, ""), ended
    done = json.loads(ended.out)
    assert done["role"] == "maintainer"
    assert done["stop"] == done["clear"] != []
    assert done["x"] > 0.05
    assert done["async"] is True
    success, text = done[VERB]
    assert success is pair.is_client_older
    assert text == "dances" or "is not a service of this robot" in text
    success, text = done["strict"]
    assert success is False
    assert "unknown field `zaw`" in text


INVITE = """\
from acsard.web.tokens import Vault, place
Vault(place(), "acsar").invite("viewer", "tv", 30)
"""


def test_the_older_version_reads_the_latches_the_tokens_and_the_recording_of_the_newer_one(
    versions: Versions, tmp_path: Path, peer: Peer
) -> None:
    older, newer = versions
    with daemon_of(newer, tmp_path, port=peer.path) as daemon, Bus(daemon.endpoint) as bus:
        until(lambda: bus.state()["link"] == "up" or None, 10, "the link is up")
        config = ("--config", str(daemon.config))
        env = plain_environment(XDG_STATE_HOME=str(tmp_path))
        for words in (("call", "deactivate"), ("call", VERB), ("call", "stop")):
            assert finish([newer.acsard, *words, *config], tmp_path, env=env).code == 0
        invited = finish([newer.python, "-c", INVITE], tmp_path, env=env)
        assert (invited.code, invited.err) == (0, "")
        kept = list(tmp_path.glob("daemon.states/*.latches.json"))
        daemon.signal(SIGTERM)
        assert daemon.ended(5) == 0
    text = kept[0].read_text()
    assert LATCH_CODE in text
    assert "later" in text
    tokens = tmp_path / "acsard-web/tokens.json"
    content = json.loads(tokens.read_text())
    rows = content["tokens"]
    assert rows[0]["later"] == 1
    rows.append(rows[0] | {"name": "pilot", "role": "pilot"})
    tokens.write_text(json.dumps(content))

    (recording,) = tmp_path.glob("daemon.recordings/*.rec.zst")
    with zstandard.open(recording) as file:
        assert b"later" in file.read()
    with ThreadPoolExecutor(3) as at_once:
        out = tmp_path / "out"
        acts = {
            "list": ("recording", "--directory", str(recording.parent)),
            "show": ("recording", "show", str(recording)),
            "report": ("recording", "report", str(recording), str(out.with_suffix(".html"))),
            "export": ("recording", "export", str(recording), str(out.with_suffix(".mcap"))),
            "replay": ("recording", "replay", str(recording)),
            "tokens": ("web", "tokens", *config),
        }
        runs = {
            name: at_once.submit(finish, [older.acsard, *words], tmp_path, 40, env)
            for name, words in acts.items()
        }
    ended = {name: run.result() for name, run in runs.items()}
    replay = ended.pop("replay")
    assert {name: end for name, end in ended.items() if end.code} == {}
    # The older version has no such service, so its replay lacks that one event and nothing else.
    assert (replay.code, replay.err) == (1, "")
    compared = replay.out.partition("\n")[0].replace(" ", "")  # "1 122 of 1 122 modes"
    same = re.findall(r"(\d+)of(\d+)([a-z]+)", compared)
    missing = {what: int(of) - int(count) for count, of, what in same if count != of}
    assert missing == {"events": 1}, replay
    assert f"event {VERB}: dances" in replay.out
    assert "stopped by" in ended["show"].out
    assert f"{VERB}: dances" in ended["show"].out
    assert ended["show"].err == ""
    assert recording.name in ended["list"].out
    assert "tv" in ended["tokens"].out

    with daemon_of(older, tmp_path, port=peer.path) as daemon, Bus(daemon.endpoint) as bus:
        state = bus.state()
        assert state["mode"] == "stopped"
        assert "stopped by" in state["reason"]
        assert LATCH_CODE in state["reason"]
        assert "cannot be read" not in state["reason"]
        ended_call = finish([older.acsard, "call", "clear", *config], tmp_path, env=env)
        assert ended_call.code == 0, ended_call
        assert bus.state()["mode"] == "inactive"
