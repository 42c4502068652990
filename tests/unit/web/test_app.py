"""The page's server lists the settings, and checks tokens even while the disk hangs."""

from __future__ import annotations

import asyncio
import os
from collections.abc import Awaitable, Callable
from pathlib import Path
from typing import Any, cast
from unittest.mock import Mock

import pytest
from aiohttp import StreamReader, web
from aiohttp.test_utils import make_mocked_request
from msgspec.structs import replace

from acsard.client import Client
from acsard.core.config.live import LIVE
from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config, WebConfig
from acsard.core.messages.schema import ServiceReply
from acsard.core.values import NS_PER_S, Role
from acsard.host import clock
from acsard.host.threads import NoThreadError
from acsard.web import app
from acsard.web.acceptor import Acceptor
from acsard.web.admission import IDENTITY_KEY
from acsard.web.app import Page, settings_in
from acsard.web.callers import AdmittedClient, RequestRefusedError
from acsard.web.camera import Camera
from acsard.web.metrics import Counts
from acsard.web.tokens import FILE, Vault
from acsard.web.viewer import Parts
from tests.each import each
from tests.unit.web.hanging_disk import threads_named
from tests.unit.web.test_callers import MAINTAINER
from tests.unit.web.test_fleet_rows import robots


def fails(error: Exception) -> Callable[..., Awaitable[Any]]:
    async def in_thread(*_: object) -> None:
        raise error

    return in_thread


class Phone:
    """A viewer with a token."""

    who = replace(MAINTAINER, token="lent")

    def __init__(self, ends: list[str]) -> None:
        self.end = ends.append


def page_with_phone(directory: Path, ends: list[str]) -> Page:
    counts = Counts()
    parts = Parts(robots(None), counts)
    page = Page(parts, Vault(directory, "acsar"), frozenset(), Acceptor(counts), WebConfig())
    page._viewers.add(Phone(ends))  # type: ignore[arg-type]
    return page


async def test_a_phone_stays_if_no_thread_can_read_the_tokens(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    ends = list[str]()
    page = page_with_phone(tmp_path, ends)
    monkeypatch.setattr(app, "in_thread", fails(NoThreadError("no thread")))
    await page.tidy()
    assert not ends


async def test_a_phone_leaves_if_the_disk_hangs_and_only_one_thread_waits_for_the_disk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(app, "READ_TIMEOUT_S", 0.02)
    ends, file = list[str](), tmp_path / FILE
    os.mkfifo(file)
    page = page_with_phone(tmp_path, ends)
    for count in range(1, 4):
        await page.tidy()
        assert len(ends) == count
        assert threads_named("valid_digests") == 1
    hanging = os.open(file, os.O_WRONLY)
    file.unlink()
    os.close(hanging)
    async with asyncio.timeout(20.0):
        while threads_named("valid_digests"):
            await asyncio.sleep(0.01)
    Vault(tmp_path, "acsar").invite("viewer", "phone", 1)
    (token,) = Vault(tmp_path, "acsar").all()
    monkeypatch.setattr(Phone, "who", replace(MAINTAINER, token=token.digest))
    await page.tidy()  # may still use the result of the read that hung
    ends.clear()
    await page.tidy()
    assert not ends


async def test_the_age_of_a_picture_counts_a_suspend(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The age must include the suspend, in which the monotonic clock stands still."""
    counts, headers = Counts(), dict[str, str]()
    parts = Parts(robots(None), counts)
    page = Page(parts, Vault(tmp_path, "acsar"), frozenset(), Acceptor(counts), WebConfig())
    page._camera = Camera("http://127.0.0.1:1/")

    async def sent(request: web.Request, body: bytes, fields: dict[str, str], *_: object) -> None:
        headers.update(fields)

    monkeypatch.setattr(app, "sent_in_pieces", sent)
    page._camera._take(b"picture")
    slept_ns = clock.asleep_ns() + 3600 * NS_PER_S
    monkeypatch.setattr(clock, "asleep_ns", lambda: slept_ns)
    request = make_mocked_request("GET", "/api/camera")
    request[IDENTITY_KEY] = MAINTAINER
    await page.picture(request)
    page._camera.close()
    assert int(headers["Age-Ms"]) >= 3_600_000
    assert int(headers["Waited-Ms"]) < 60_000


class Daemon:
    """A client of the page's own robot that records the calls, and of other robots."""

    certificate, session, name = "", None, ""

    def __init__(self, calls: list[tuple[str, str]], robot: str = "acsar") -> None:
        self._calls, self._robot = calls, robot

    def sibling(self, robot: str) -> Daemon:
        return Daemon(self._calls, robot)

    def request(self, verb: str, payload: object) -> ServiceReply:
        self._calls.append((verb, self._robot))
        return ServiceReply(True, "stopped")


def page_with_daemon(directory: Path) -> tuple[Page, list[tuple[str, str]]]:
    """Return a page, and the list of the calls that reach a robot: verb and robot."""
    counts, calls = Counts(), list[tuple[str, str]]()
    parts = Parts(robots(cast(Client, Daemon(calls))), counts)
    vault = Vault(directory, "acsar")
    return Page(parts, vault, frozenset(), Acceptor(counts), WebConfig()), calls


def posted(verb: str, *body: bytes, end: bool = True, role: Role = "viewer") -> web.Request:
    """Return a request that calls a service. If `end` is false, the body has not ended yet."""
    content = StreamReader(Mock(_reading_paused=False), 2**16)
    for part in body:
        content.feed_data(part)
    if end:
        content.feed_eof()
    request = make_mocked_request("POST", f"/api/srv/{verb}", payload=content)
    request[IDENTITY_KEY] = replace(MAINTAINER, role=role)
    return request


UNREADABLE = [b"{", b"[]", b'{"robot": null}', b'{"robot": 1}', b'{"robot": ["r2"]}']


@each("body", UNREADABLE)
async def test_a_stop_whose_body_names_no_other_robot_stops_this_robot_and_is_refused(
    body: bytes, tmp_path: Path
) -> None:
    page, calls = page_with_daemon(tmp_path)
    with pytest.raises(RequestRefusedError):
        await page.service(posted("stop", body))
    assert calls == [("stop", "acsar")]


@each("body", UNREADABLE)
async def test_another_service_with_an_unreadable_body_is_only_refused(
    body: bytes, tmp_path: Path
) -> None:
    page, calls = page_with_daemon(tmp_path)
    with pytest.raises(RequestRefusedError):
        await page.service(posted("clear", body, role="maintainer"))
    assert calls == []


async def test_a_stop_of_another_robot_does_not_stop_this_robot(tmp_path: Path) -> None:
    page, calls = page_with_daemon(tmp_path)
    await page.service(posted("stop", b'{"robot": "r2"}'))
    with pytest.raises(RequestRefusedError):
        await page.service(posted("stop", b'{"robot": "r 2/**"}'))
    assert calls == [("stop", "r2")]


@each("named", ["r2", "acsar"])
async def test_a_stop_whose_body_is_late_stops_this_robot_first_and_then_the_named_one(
    named: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The stop of the named robot does not wait until the page's own robot has answered."""
    monkeypatch.setattr(app, "STOP_BODY_TIMEOUT_S", 0.01)
    page, calls = page_with_daemon(tmp_path)
    call, own_answer = page._parts.calls.call, asyncio.Event()

    async def slow(
        who: AdmittedClient, verb: str, payload: dict[str, object], robot: str = ""
    ) -> ServiceReply:
        answer = await call(who, verb, payload, robot)
        if not robot:
            await own_answer.wait()
        return answer

    monkeypatch.setattr(page._parts.calls, "call", slow)
    request = posted("stop", b'{"robot"', end=False)
    answer = asyncio.create_task(page.service(request))
    async with asyncio.timeout(20.0):
        while not calls:
            await asyncio.sleep(0.01)
    assert calls == [("stop", "acsar")]
    assert not answer.done()
    request.content.feed_data(f': "{named}"}}'.encode())
    request.content.feed_eof()
    expected = [("stop", robot) for robot in dict.fromkeys(("acsar", named))]
    async with asyncio.timeout(20.0):
        while calls != expected:
            await asyncio.sleep(0.01)
    own_answer.set()
    assert (await answer).status == 200
    assert calls == expected


ROWS = {row.key: row for row in settings_in(effective(Config()))}


def test_each_setting_that_may_change_has_a_row_and_no_other() -> None:
    sources = {f"commands.sources.{source.name}.timeout" for source in Config().commands.sources}
    assert set(ROWS) == (set(LIVE) - {"commands.sources.*.timeout"}) | sources


def test_a_row_has_its_value_its_range_and_when_it_may_change() -> None:
    row = ROWS["limits.linear_speed"]
    assert row.value == Config().limits.linear_speed
    assert isinstance(row.low, float)
    assert isinstance(row.high, float)
    assert row.low <= row.value <= row.high
    assert row.when == "at any time"
    assert "stands" in ROWS["limits.wheel_speed"].when


def test_a_setting_with_fixed_choices_lists_them() -> None:
    row = ROWS["log.level"]
    assert isinstance(row.choices, list)
    assert row.value in row.choices
    assert len(row.choices) > 2
