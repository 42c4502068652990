"""A camera's stream on the page: the picture, its age, and the sign for a frozen picture."""

from __future__ import annotations

import asyncio
import re
import time
from collections.abc import Iterator
from contextlib import AsyncExitStack
from pathlib import Path
from typing import Any

import aiohttp
import pytest

from acsard.machine.authority import Authority
from acsard.web.server import TICK_S
from tests.system.browser import NAME, Page
from tests.system.camera_stream import Stream
from tests.system.chromium import CHROMIUM, PHONE, browsing
from tests.system.harness import Daemon, free_endpoint, resident_kb, running, until

pytestmark = pytest.mark.slow


class Filmed:
    def __init__(self, stream: Stream, server: Page) -> None:
        self.stream, self.server = stream, server


@pytest.fixture
def filmed(tmp_path: Path) -> Iterator[Filmed]:
    stream = Stream()
    Authority.make(tmp_path / "tls", "test", 1, [NAME]).issue(tmp_path / "tls", "robot", [NAME], 1)
    config = {"web": {"camera": f"http://127.0.0.1:{stream.port}/stream"}}
    with running(tmp_path, config=config) as (daemon, _), Page(daemon, tmp_path) as server:
        yield Filmed(stream, server)
    stream.close()


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium-headless-shell")
def test_the_page_shows_the_camera_with_its_age_and_marks_a_frozen_picture_within_a_second(
    filmed: Filmed,
) -> None:
    pixel = (
        "document.querySelector('#camera canvas').getContext('2d').getImageData(9, 9, 1, 1).data[0]"
    )
    marked = "document.getElementById('camera').matches('.frozen')"
    words = "document.querySelector('#camera figcaption').textContent"
    with browsing() as browser:
        browser.size(*PHONE)
        browser.open(filmed.server.here)

        def lives() -> bool:
            return browser.js(marked) is False and bool(re.fullmatch(r"\d+ ms", browser.js(words)))

        def freezes(why: str) -> None:
            begun = time.monotonic()
            until(lambda: browser.js(marked), 5.0, why)
            took = time.monotonic() - begun
            assert took < 1.3, f"{why}: {took:.2f} s"  # a picture may still come at its begin
            assert browser.js(words).startswith("FROZEN ")

        until(lives, 10.0, "the picture lives")
        first = browser.js(pixel)
        until(lambda: browser.js(pixel) != first, 5.0, "the picture changes")
        filmed.stream.runs = False  # the server repeats the last picture
        freezes("repeated")
        filmed.stream.runs = True
        until(lives, 5.0, "it lives again")
        filmed.stream.silent = True
        freezes("silent")
        filmed.stream.silent = False
        until(lives, 10.0, "it lives again")
        browser.ask("Network.enable")
        slow = {"latency": 1500, "downloadThroughput": -1, "uploadThroughput": -1}
        browser.ask("Network.emulateNetworkConditions", offline=False, **slow)
        freezes("each picture is 1.5 s old when a slow network has delivered it")
        time.sleep(4.0)  # two pictures have come since
        assert browser.js(marked)
        browser.ask("Network.emulateNetworkConditions", offline=False, **slow | {"latency": 0})
        until(lives, 10.0, "it lives again")
        wide = "['camera', 'map', 'stick'].map(name => document.getElementById(name).clientWidth)"
        assert min(browser.js(wide)) > 90
        browser.open("about:blank")
        until(lambda: filmed.stream.clients == 0, 15.0, "no client reads the stream any more")


async def test_the_camera_needs_a_token_and_ends_with_it(filmed: Filmed) -> None:
    server = filmed.server
    async with server.client() as stranger, stranger.get(f"{server.away}/api/camera") as reply:
        assert reply.status == 401
    async with server.client(server.invite("viewer", "tv")) as viewer:
        url = f"{server.away}/api/camera"
        first = await got(viewer, url)
        assert first.status == 200
        assert first.content_type == "image/jpeg"
        assert int(first.headers["Age-Ms"]) < 1000
        second = await got(viewer, url, first.headers["ETag"])
        assert second.status == 200
        assert second.headers["ETag"] != first.headers["ETag"]
        filmed.stream.silent = True
        await asyncio.sleep(0.3)
        last = await got(viewer, url)
        assert (await got(viewer, url, last.headers["ETag"])).status == 304
        server.vault.revoke("tv")
        await asyncio.sleep(TICK_S + 0.5)
        assert (await got(viewer, url)).status == 401


async def test_pictures_that_no_client_reads_cost_little_memory(filmed: Filmed) -> None:
    """In a former version the server stored a separate picture for each of these clients."""
    server, pid = filmed.server, filmed.server.pid
    filmed.stream.more = 900_000
    url, clients = f"{server.away}/api/camera", []
    tokens = [server.invite("viewer", f"tv{n}") for n in range(12)]
    async with AsyncExitStack() as stack:
        for token in tokens * 2:
            clients.append(await stack.enter_async_context(server.client(token)))
        assert (await got(clients[0], url)).status == 200
        before = resident_kb(pid)
        # The streams of these answers are opened and not read.
        asking = [asyncio.create_task(client.get(url)) for client in clients]
        most, end = 0, time.monotonic() + 3.0
        while time.monotonic() < end:
            most = max(most, resident_kb(pid) - before)
            await asyncio.sleep(0.05)
        for task in asking:
            task.cancel()
        print(f"\n24 clients that read no pictures: {most / 1000:+.1f} MB")
        assert most < 15_000


async def test_three_pages_with_one_token_get_pictures_and_answers(filmed: Filmed) -> None:
    server = filmed.server
    async with server.client(server.invite("viewer", "tv")) as viewer:

        async def page() -> None:
            for _ in range(60):
                assert (await got(viewer, f"{server.away}/api/camera")).status == 200
                await asyncio.sleep(0.05)  # as the page does

        await asyncio.gather(page(), page(), page())
        assert (await got(viewer, f"{server.away}/api/state")).status == 200


async def got(viewer: aiohttp.ClientSession, url: str, tag: str = "") -> Any:
    async with viewer.get(url, headers={"If-None-Match": tag} if tag else {}) as answer:
        await answer.read()
        return answer


def test_a_robot_without_a_camera_says_which_setting_names_one(tmp_path: Path) -> None:
    async def story(url: str) -> None:
        async with aiohttp.ClientSession() as session, session.get(f"{url}/api/camera") as response:
            assert response.status == 404
            assert await response.json() == {
                "error": "no camera is configured",
                "detail": "to show one, set web.camera to the address of its stream",
            }

    with Daemon(tmp_path) as daemon, Page(daemon, tmp_path) as server:
        asyncio.run(story(server.here))


def test_a_stream_that_cannot_be_read_is_named_with_the_reason(tmp_path: Path) -> None:
    port = free_endpoint().rpartition(":")[2]

    async def story(url: str) -> None:
        async with aiohttp.ClientSession() as session, session.get(f"{url}/api/camera") as response:
            assert response.status == 503
            problem = await response.json()
            assert problem["error"] == "the camera's stream cannot be read"
            assert port in problem["detail"]

    config = {"web": {"camera": f"http://127.0.0.1:{port}/stream"}}
    with Daemon(tmp_path, config=config) as daemon, Page(daemon, tmp_path) as server:
        asyncio.run(story(server.here))
