"""A camera's stream on the page: the picture, its age, and the sign for a frozen picture."""

from __future__ import annotations

import re
import time
from collections.abc import Iterator
from contextlib import closing

import pytest

from acsard.machine.authority import Authority
from acsard.web.access import REQUEST_RATE
from acsard.web.answers import PAGE_DIRECTORY
from tests.system.browser import NAME, Page
from tests.system.bystander import lost
from tests.system.camera_stream import Stream
from tests.system.chromium import CHROMIUM, PHONE, browsing
from tests.system.harness import running, until

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def stream() -> Iterator[Stream]:
    with closing(Stream()) as stream:
        yield stream


@pytest.fixture(scope="module")
def server(stream: Stream, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    where = tmp_path_factory.mktemp("filmed")
    Authority.make(where / "tls", "test", 1, [NAME]).issue(where / "tls", "robot", [NAME], 1)
    config = {"web": {"camera": f"http://127.0.0.1:{stream.port}/stream"}}
    with running(where, config=config) as (daemon, _), Page(daemon, where) as server:
        yield server


PIXEL = "document.querySelector('#camera canvas').getContext('2d').getImageData(9, 9, 1, 1).data[0]"
FROZEN = "document.getElementById('camera').matches('.frozen')"
WORDS = "document.querySelector('#camera figcaption').textContent"


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium-headless-shell")
def test_the_page_shows_the_camera_with_its_age_and_marks_a_frozen_picture_within_a_second(
    stream: Stream, server: Page
) -> None:
    with browsing() as browser:
        browser.size(*PHONE)
        browser.open(server.here)

        def lives() -> bool:
            return browser.js(FROZEN) is False and bool(re.fullmatch(r"\d+ ms", browser.js(WORDS)))

        def freezes(why: str) -> None:
            begun = time.monotonic()
            until(lambda: browser.js(FROZEN), 5.0, why)
            # A picture may still come at the begin.
            assert time.monotonic() - begun < 1.3 + 4 * lost(begun), why
            assert browser.js(WORDS).startswith("FROZEN ")

        until(lives, 10.0, "the picture lives")
        first = browser.js(PIXEL)
        until(lambda: browser.js(PIXEL) != first, 5.0, "the picture changes")
        stream.runs = False  # the server repeats the last picture
        freezes("repeated")
        stream.runs = True
        until(lives, 5.0, "it lives again")
        stream.silent = True
        freezes("silent")
        stream.silent = False
        until(lives, 10.0, "it lives again")
        browser.ask("Network.enable")
        slow = {"latency": 1500, "downloadThroughput": -1, "uploadThroughput": -1}
        browser.ask("Network.emulateNetworkConditions", offline=False, **slow)
        freezes("each picture is 1.5 s old when a slow network has delivered it")
        time.sleep(4.0)  # two pictures have come since
        assert browser.js(FROZEN)
    until(lambda: stream.clients == 0, 15.0, "no client reads the stream any more")


def test_three_pages_with_one_token_may_ask_for_pictures_and_drive() -> None:
    script = (PAGE_DIRECTORY / "camera.js").read_text(encoding="utf-8")
    (pause_ms,) = map(int, re.findall(r"^const LEAST = (\d+);", script, re.M))
    assert 3 * (1000 / pause_ms) + 20 < REQUEST_RATE.hz
