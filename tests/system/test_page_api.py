"""A client that opens the robot's page sees it, drives it and stops it.

When the client leaves, its drive ends.
"""

from __future__ import annotations

import asyncio
import json
import os
import pty
import re
import select
import signal
import socket
import sys
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from acsard.core.config.parsing import parse
from acsard.recording.file import MAGIC
from acsard.web.openapi import KEYS
from tests.system.browser import Page, answer, hands, text
from tests.system.harness import (
    PATIENCE_S,
    ROOT,
    START_S,
    Bus,
    Daemon,
    Program,
    acsard,
    children,
    environment,
    finish,
    free_endpoint,
    running,
    until,
    write_config,
)
from tests.unit import page_schemas


@pytest.fixture
def bus(standing: Bus) -> Bus:
    return standing


async def test_a_page_that_has_not_heard_the_robot_does_not_call_it_simulated(
    tmp_path: Path,
) -> None:
    """The file's port is the simulator, but no daemon runs: people may stand in the way."""
    nobody = Daemon(tmp_path)
    assert parse(nobody.config.read_bytes()).mcu.simulated
    with Page(nobody, tmp_path) as page:
        async with hands(page) as ours:
            greeting = (await ours.find(lambda message: "hello" in message))["hello"]
    assert greeting["simulated"] is False


def simulated(message: Any) -> bool:
    return bool(message.get("hello", {}).get("simulated"))


@pytest.mark.network
async def test_every_message_of_the_socket_is_described_and_every_described_one_occurs(
    tmp_path: Path,
) -> None:
    messages: list[Any] = []
    config: dict[str, dict[str, object]] = {
        "odometry": {"gyro": True},
        "sim": {"faults": ["battery=80:600"]},
    }
    with (
        running(tmp_path, config=config) as (daemon, _),
        Page(daemon, tmp_path) as page,
    ):
        async with hands(page) as ours:
            await ours.find(lambda message: "path" in message)
            # The first one may come before the page has heard the robot.
            if not any(map(simulated, ours.heard)):
                await ours.find(simulated)
            hello = next(filter(simulated, ours.heard))["hello"]
            assert (hello["robot"], hello["role"]) == ("acsar", "maintainer")
            assert hello["limits"] == {"linear": 1.0, "angular": 4.0}
            for key in KEYS:
                await ours.say(subscribe=key)
                await ours.find(
                    lambda message, key=key: message.get("key") == key and message["value"]  # type: ignore[misc]
                )
            await ours.say(subscribe="nothing")
            await ours.find(lambda message: "refused" in message)
            await ours.call("clear")
            await ours.say(ping=12.5)
            assert (await ours.find(lambda message: "pong" in message))["pong"] == 12.5
            daemon.signal(signal.SIGSTOP)
            try:
                await ours.find(lambda message: "gone" in message)
            finally:
                daemon.signal(signal.SIGCONT)
            messages.extend(ours.heard)
    kinds = page_schemas.kinds(messages)
    assert kinds >= set(page_schemas.FRAMES), set(page_schemas.FRAMES) - kinds
    for example in {frozenset(frame): frame for frame in messages}.values():
        assert [
            spoilt
            for spoilt in page_schemas.spoilt(example)
            if page_schemas.is_described_frame(spoilt)
        ] == []


TYPED = ("/api/state", "/api/whoami", "/api/settings", "/api/recordings", "/api/info")
"""Some paths with a type of their own, which not any JSON fits."""


async def first_recording(session: aiohttp.ClientSession) -> str:
    """Wait until the daemon has begun its first recording, and return its name."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            async with session.get("/api/recordings") as answer:
                assert answer.status == 200
                rows = await answer.json()
            if rows:
                return str(rows[0]["name"])
            await asyncio.sleep(0.1)


async def test_each_http_answer_is_as_described(page: Page, bus: Bus) -> None:
    statuses: dict[tuple[str, str], int] = {}
    async with aiohttp.ClientSession(page.here) as session:
        name = await first_recording(session)
        for path, operations in page_schemas.DOCUMENT["paths"].items():
            asked = path.replace("{name}", name).replace("{type}", "Twist")
            for method in operations:
                async with session.request(method, asked) as answer:
                    media = answer.content_type
                    if "{name}" in path:
                        assert (await answer.content.read(len(MAGIC))) == MAGIC
                    body = await answer.json() if media == "application/json" else None
                statuses[method, path] = answer.status
                response = path, method, answer.status, media, body
                assert page_schemas.answers(*response), response
                if path in TYPED:
                    assert not page_schemas.answers(*response[:4], {"of": "nothing"}), path
    assert {endpoint for endpoint in statuses if statuses[endpoint] == 200} > {
        ("get", path) for path in TYPED
    }
    assert statuses["post", "/api/srv/stop"] == 200
    assert statuses["post", "/api/srv/set"] == 409


@pytest.mark.slow
def test_the_example_of_the_page_drives_as_pasted(page: Page, bus: Bus) -> None:
    text = (ROOT / "deploy/manual/pages/howto/http.md").read_text()
    (code,) = re.findall(r"^```python\n(.*?)^```", text, re.S | re.M)
    assert "http://127.0.0.1:8080" in code
    before = bus.state()["x"]
    code = code.replace("http://127.0.0.1:8080", page.here)
    done = finish([sys.executable, "-c", code], ROOT)
    assert (done.code, done.err) == (0, "")
    assert "driving" in done.out
    assert bus.at_rest()["x"] > before + 0.2


class Terminal(Program):
    """`acsard run` in the foreground of a terminal."""

    def __init__(self, where: Path, *words: str) -> None:
        self.endpoint = free_endpoint()
        self.master, self.slave = pty.openpty()
        run = acsard("run", "--listen", self.endpoint, *words)
        super().__init__(run, where, environment(), stdout=self.slave, stderr=self.slave)
        self.seen = ""

    def __exit__(self, *error: object) -> None:
        super().__exit__(*error)
        os.close(self.slave)
        os.close(self.master)

    def shows(self, pattern: str) -> re.Match[str]:
        """Wait for the text on the screen."""

        def look() -> re.Match[str] | None:
            while select.select([self.master], [], [], 0.0)[0]:
                self.seen += os.read(self.master, 4096).decode(errors="replace")
            return re.search(pattern, self.seen)

        return until(look, START_S, f"{pattern} on the screen: {self.seen}")

    def page(self) -> list[int]:
        """Return the process ids of `acsard web` below this daemon."""
        return children(self.pid, "acsard web")


@pytest.mark.slow
def test_a_daemon_in_a_terminal_serves_its_page_at_a_free_port_and_restarts_it(
    tmp_path: Path,
) -> None:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        port = listener.getsockname()[1]
        config = write_config(
            tmp_path / "a.toml", {"web": {"address": [f"http://127.0.0.1:{port}"]}}
        )
        with Terminal(tmp_path, "--config", str(config), "--record", "box") as daemon:
            daemon.shows(rf"page +http://127.0.0.1:{port}, for a browser")
            url = daemon.shows(
                rf"ready +(http://127.0.0.1:\d+/) +\(instead of http://127.0.0.1:{port}/, at which"
            )[1]
            assert json.loads(asyncio.run(text(f"{url}api/whoami")))["role"] == "maintainer"

            def listed() -> bool:
                """Return whether the page lists a recording."""
                status, content = asyncio.run(answer(f"{url}api/recordings"))
                return status == 200 and ".rec.zst" in content

            until(listed, START_S, "what the option has recorded is listed")
            (first,) = daemon.page()
            with Bus(daemon.endpoint) as bus:
                before = bus.get("info")
                os.kill(first, signal.SIGKILL)
                daemon.shows("page_ended")
                (second,) = until(daemon.page, START_S, "another page")
                assert second != first
                assert bus.get("info") == before
            # A person saves a wrong file, and corrects it later.
            valid = config.read_text()
            config.write_text(f"{valid}\nbroken = [\n")
            os.kill(second, signal.SIGKILL)
            daemon.shows("page ended with exit code 78; it is restarted")
            daemon.seen = ""
            config.write_text(valid)
            daemon.shows(
                rf"page ready +http://127.0.0.1:\d+/ +\(instead of http://127.0.0.1:{port}/"
            )
            (third,) = daemon.page()
            daemon.signal(signal.SIGKILL)
            until(lambda: not Path(f"/proc/{third}").exists(), START_S, "the page ends too")
