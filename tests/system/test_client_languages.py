"""The examples in deploy/clients work, and types generated from the schemas fit the messages.

`pytest -m 'languages and not soak'` runs Rust and the types in TypeScript and Python: two minutes.
`pytest -m languages` also runs TypeScript, whose bridge takes ten minutes to build. pytest's cache
stores the builds.
"""

from __future__ import annotations

import asyncio
import json
import re
import shutil
import socket
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

import pytest
from aiohttp import web
from aiohttp.test_utils import TestServer

from tests.pages import blocks
from tests.system.builds import CLIENTS, copied, node_program, program, run
from tests.system.harness import (
    Bus,
    Daemon,
    Program,
    environment,
    free_endpoint,
    until,
)

BRIDGE = "zenoh-bridge-remote-api"


# the examples

LINE = re.compile(r"x (-?\d+\.\d{3}) m, y (-?\d+\.\d{3}) m, (-?\d+\.\d{3}) m/s")


def followed(words: Sequence[str], where: Path, bus: Bus) -> None:
    """Run an example that follows the robot. Check the positions that it prints during a drive."""
    with Program(words, where) as follower:
        follower.says(" m/s", 30.0)
        begun = bus.state()["x"]
        with bus.commanding(0.3):

            def moved() -> bool:
                lines = [LINE.fullmatch(line) for line in list(follower.out)]
                matches = [match for match in lines if match]
                return (
                    bool(matches)
                    and float(matches[-1][1]) > begun + 0.1
                    and float(matches[-1][3]) > 0.2
                )

            until(moved, 20.0, f"the robot moves\n{follower}")
    bus.at_rest()


@pytest.mark.slow
def test_the_python_example_follows_the_robot(shared: Daemon, bus: Bus, tmp_path: Path) -> None:
    words = [sys.executable, str(CLIENTS / "python/follow.py"), shared.endpoint]
    followed(words, tmp_path, bus)


@pytest.mark.slow
async def test_the_node_program_says_why_the_page_closed_its_connection(tmp_path: Path) -> None:
    async def closes(request: web.Request) -> web.WebSocketResponse:
        opened = web.WebSocketResponse()
        await opened.prepare(request)
        await opened.receive()
        await opened.close(code=1008, message=b"the token has expired")
        return opened

    stand_in = web.Application()
    stand_in.router.add_get("/ws", closes)
    words = node_program(tmp_path)
    async with TestServer(stand_in) as server:
        address = f"http://{server.host}:{server.port}"
        node = await asyncio.create_subprocess_exec(
            *words, address, stdout=subprocess.PIPE, stderr=subprocess.PIPE
        )
        out, err = await node.communicate()
    assert node.returncode == 1, (out, err)
    assert f"no connection to {address}: the token has expired\n" in err.decode()


@pytest.mark.parametrize("verb", ["state", "stop"])
def test_the_program_for_curl_fails_if_no_robot_answers(verb: str) -> None:
    program("curl", "the program calls it")
    missing = called(verb, {"ADDRESS": f"http://{free_endpoint().partition('/')[2]}"})
    assert missing.returncode != 0, missing
    assert missing.stderr.startswith("curl: ")


def called(verb: str, robot: dict[str, str]) -> subprocess.CompletedProcess[str]:
    """Run the program for curl."""
    words = ["sh", str(CLIENTS / "curl/robot.sh"), verb]
    return subprocess.run(
        words, env=environment(**robot), capture_output=True, text=True, timeout=30, check=False
    )


@pytest.fixture(scope="module")
def cargo() -> str:
    return program("cargo", "it builds the example in Rust and the bridge")


@pytest.fixture(scope="module")
def npm() -> str:
    program("node", "it runs what is made of TypeScript")
    return program("npm", "it fetches zenoh-ts, quicktype and tsc")


@pytest.fixture(scope="module")
def bridge(kept: Path) -> str:
    """Return the path of the installed bridge, or build it with the command on the page."""
    words = next(line for line in commands() if line.startswith(f"cargo install {BRIDGE}"))
    if (path := shutil.which(BRIDGE)) is None:
        program("cargo", "it builds the bridge")
        run(
            [*words.split(), "--quiet", "--root", str(kept)],
            kept,
            CARGO_TARGET_DIR=str(kept / "bridge"),
        )
        path = str(kept / "bin" / BRIDGE)
    return path


def commands() -> list[str]:
    """Return the commands that the pages ask the reader to type."""
    page = "deploy/manual/pages/howto/languages.md"
    return [line for block in blocks("sh") if block.page == page for line in block.commands()]


@pytest.mark.languages
@pytest.mark.timeout(1800)
def test_the_rust_example_follows_the_robot(
    shared: Daemon, bus: Bus, kept: Path, cargo: str
) -> None:
    here = copied("rust", kept)
    run([cargo, "build", "--quiet"], here)
    followed([str(here / "target/debug/follow"), shared.endpoint], here, bus)


@pytest.mark.languages
@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_the_typescript_example_follows_the_robot_through_the_bridge(
    shared: Daemon, bus: Bus, kept: Path, npm: str, bridge: str
) -> None:
    here = copied("typescript", kept)
    run([npm, "install", "--no-package-lock"], here)
    run([npm, "run", "build"], here)
    where = free_endpoint().removeprefix("tcp/")
    quiet = ["-m", "client", "-e", shared.endpoint, "--no-multicast-scouting", "--ws-port", where]
    with Program([bridge, *quiet], kept) as between:
        host, port = where.split(":")
        until(lambda: listens(host, int(port)), 20.0, f"the bridge listens\n{between}")
        followed([npm, "start", "--silent", "--", f"ws/{where}"], here, bus)


def listens(host: str, port: int) -> bool:
    with socket.socket() as probe:
        return probe.connect_ex((host, port)) == 0


# types from the schemas

Said = tuple[str, Any]
"""A type and a value of it, as JSON."""


@pytest.fixture(scope="module")
def schemas(shared: Daemon, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Generate the types as the page says."""
    where = tmp_path_factory.mktemp("types")
    run([sys.executable, str(CLIENTS / "python/schemas.py"), "schemas", shared.endpoint], where)
    return where / "schemas"


@pytest.fixture(scope="module")
def heard(shared: Daemon) -> list[Said]:
    """Return a JSON message of every key that the daemon publishes or answers."""
    results: list[Said] = []
    with Bus(shared.endpoint) as bus:
        bus.linked()
        for row in bus.get("topics")["topics"]:
            key, kind = row["key"].removeprefix("acsard/acsar/"), row["type"]
            if "<" in key or key == "alive" or row["direction"] == "in":
                continue
            by_itself = row["rate"] not in ("latched", "on change")
            if row["direction"] == "out" and by_itself:
                with bus.follow(f"json/{key}") as messages:
                    results.append((kind, messages.find(lambda _: True, 5.0, key).value))
            elif row["direction"] != "service":
                results.append((kind, bus.get(key)))
        results.append(("ServiceReply", bus.get("srv/activate")))
    return results


def wrong(messages: list[Said]) -> list[Said]:
    """Return messages that no daemon sends."""
    of = dict(messages)
    lacking = {name: value for name, value in of["Odometry"].items() if name != "twist"}
    return [("RobotState", of["RobotState"] | {"mode": "idle"}), ("Odometry", lacking)]


def judged(words: Sequence[str], where: Path, messages: list[Said]) -> list[str]:
    """Give these messages to a program that reads them with the generated types.

    Returns its output lines: the type of each message, and `read` or `refused`.
    """
    text = "".join(json.dumps(message) + "\n" for message in messages)
    done = subprocess.run(
        words, cwd=where, env=environment(), input=text, capture_output=True, text=True, check=False
    )
    assert done.returncode == 0, f"{words}\n{done.stdout}\n{done.stderr}"
    return done.stdout.splitlines()


READER_PY = """
import importlib, json, sys
for line in sys.stdin:
    kind, value = json.loads(line)
    model = getattr(importlib.import_module(f"acsard_types.{kind}"), kind)
    try:
        model.model_validate_json(json.dumps(value))
        print(kind, "read")
    except ValueError:
        print(kind, "refused")
"""


@pytest.mark.languages
@pytest.mark.timeout(600)
def test_types_made_by_datamodel_code_generator_compile_and_parse_the_daemon_s_messages(
    schemas: Path, heard: list[Said], kept: Path
) -> None:
    install, generate = commands()[-2:]
    venv = kept / "venv"
    run([sys.executable, "-m", "venv", str(venv)], kept)
    run([str(venv / "bin" / install.split()[0]), *install.split()[1:], "--quiet"], kept)
    program, *words = generate.split()
    run([str(venv / "bin" / program), *words], schemas.parent)
    python = str(venv / "bin/python")
    run([python, "-m", "compileall", "-q", "acsard_types"], schemas.parent)
    sent = ("Twist", {"linear": {"x": 1.0}, "angular": {}})
    misspelt = ("Twist", {"linear": {"X": 1.0}, "angular": {}})
    lies = [*wrong(heard), misspelt]
    results = judged([python, "-c", READER_PY], schemas.parent, [*heard, sent, *lies])
    good = [*(kind for kind, _ in heard), "Twist"]
    assert results == [f"{kind} read" for kind in good] + [f"{kind} refused" for kind, _ in lies]
