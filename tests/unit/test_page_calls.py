"""Calls of the page: each press of STOP is answered by a stop that was sent after it."""

from __future__ import annotations

import asyncio
import threading
from copy import copy
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast
from unittest.mock import Mock

import pytest
from aiohttp import StreamReader, web
from aiohttp.test_utils import make_mocked_request
from msgspec.structs import replace

from acsard.bus.address import Address
from acsard.client.connection import Connection
from acsard.core.config.live import LIVE
from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config, WebConfig
from acsard.core.messages.schema import ServiceReply
from acsard.core.values import Role
from acsard.host.errors import NoAnswerError
from acsard.web.access import IDENTITY_KEY
from acsard.web.app import Page, settings_in
from acsard.web.callers import AdmittedClient, RequestRefusedError
from acsard.web.calls import Calls, unanswered
from acsard.web.connections import Connections
from acsard.web.followed_robot import About, FollowedRobot
from acsard.web.metrics import Counts
from acsard.web.tokens import ReadTokens, Vault
from acsard.web.viewer import Parts
from tests.each import each
from tests.unit.test_access_page import MAINTAINER

PATIENCE_S = 20.0


class StoppedRobot:
    """A daemon that answers a stop when the test lets it, as the connection of the page."""

    id, gone = "acsar", ""

    def __init__(self, name: str = "") -> None:
        self.client, self.name = self, name
        self.asked: list[str] = []
        self.go = threading.Event()

    def named(self, name: str) -> StoppedRobot:
        other = copy(self)  # the same lists and the same event
        other.name = name
        return other

    def request(self, verb: str, fields: object) -> ServiceReply:
        assert (verb, fields) == ("stop", {})
        self.asked.append(self.name)
        number = len(self.asked)
        assert self.go.wait(PATIENCE_S)
        return ServiceReply(True, str(number))


async def test_one_stop_is_under_way_and_one_behind_it_answers_all_later_presses() -> None:
    robot = StoppedRobot()
    calls = Calls(cast(Any, robot))
    phone, tv = (AdmittedClient("viewer", name, name) for name in ("phone", "tv"))
    async with asyncio.timeout(PATIENCE_S):
        first = asyncio.create_task(calls.call(phone, "stop", {}))
        while not robot.asked:
            await asyncio.sleep(0.01)
        later = [asyncio.create_task(calls.call(phone, "stop", {})) for _ in range(100)]
        other = asyncio.create_task(calls.call(tv, "stop", {}))
        while len(robot.asked) < 2:
            await asyncio.sleep(0.01)
        await asyncio.sleep(0.05)
        # The stop of another caller does not wait: it is a cause of its own.
        assert robot.asked == ["phone@page", "tv@page"]
        robot.go.set()
        assert (await first).message == "1"
        assert (await other).message == "2"
        assert {reply.message for reply in await asyncio.gather(*later)} == {"3"}
        assert (await calls.call(phone, "stop", {})).message == "4"


async def test_a_stop_that_has_no_answer_is_reported_and_the_next_one_is_sent() -> None:
    robot = StoppedRobot()
    robot.go.set()
    calls, phone = Calls(cast(Any, robot)), AdmittedClient("viewer", "phone", "phone")

    def silent(*_: object) -> ServiceReply:
        raise NoAnswerError("no answer on the Zenoh key acsard/acsar/srv/stop")

    robot.request = silent  # type: ignore[method-assign, assignment]
    reply = await calls.call(phone, "stop", {})
    assert reply == ServiceReply(False, unanswered("stop"))
    assert "Zenoh" not in reply.message
    del robot.request
    assert (await calls.call(phone, "stop", {})).success


@pytest.mark.parametrize("verb", ["stop", "set"])
async def test_a_call_without_a_daemon_is_answered_with_a_plain_sentence(verb: str) -> None:
    robot: Any = SimpleNamespace(client=None, gone="no daemon answers at tcp/127.0.0.1:7447 yet")
    here = AdmittedClient("maintainer", "here")
    reply = await Calls(robot).call(here, verb, {})
    assert reply == ServiceReply(
        False, f"the robot's daemon does not answer, so `{verb}` is not confirmed: does it run?"
    )


ABOUT = About("1", True, 1.0, 4.0, 10.0, "", {"teleop": 0.25, "app": 0.25})


def followed(client: Connection | None) -> FollowedRobot:
    result = FollowedRobot(Address("tcp/127.0.0.1:1", "acsar", ""), Mock(), ABOUT, Counts())
    result.client = client
    return result


def page_of(directory: Path, client: Connection | None = None) -> Page:
    counts = Counts()
    tokens = ReadTokens(Vault(directory, "acsar"))
    return Page(
        Parts(followed(client), counts), tokens, frozenset(), Connections(counts), WebConfig()
    )


class Daemon:
    """A client of the robot that records the calls."""

    name, where = "", Address("", "acsar", "")

    def __init__(self, calls: list[str]) -> None:
        self._calls = calls

    def named(self, name: str) -> Daemon:
        return self

    def request(self, verb: str, payload: object) -> ServiceReply:
        self._calls.append(verb)
        return ServiceReply(True, "stopped")


def page_with_daemon(directory: Path) -> tuple[Page, list[str]]:
    """Return a page, and the list of the calls that reach the robot."""
    calls = list[str]()
    return page_of(directory, cast(Connection, Daemon(calls))), calls


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


UNREADABLE = [b"{", b"[]", b"1"]


@each("body", [b"", *UNREADABLE])
@each("end", [True, False])
async def test_a_stop_does_not_wait_for_a_body(body: bytes, end: bool, tmp_path: Path) -> None:
    page, calls = page_with_daemon(tmp_path)
    async with asyncio.timeout(20.0):
        assert (await page.service(posted("stop", body, end=end))).status == 200
    assert calls == ["stop"]


@each("body", UNREADABLE)
async def test_another_service_with_an_unreadable_body_is_only_refused(
    body: bytes, tmp_path: Path
) -> None:
    page, calls = page_with_daemon(tmp_path)
    with pytest.raises(RequestRefusedError):
        await page.service(posted("clear", body, role="maintainer"))
    assert calls == []


ROWS = {row.key: row for row in settings_in(effective(Config()))}


def test_each_setting_that_may_change_has_a_row_and_no_other() -> None:
    sources = {f"commands.sources.{source.name}.timeout" for source in Config().commands.sources}
    assert set(ROWS) == (set(LIVE) - {"commands.sources.*.timeout"}) | sources


def test_a_row_has_its_value_its_unit_its_range_and_when_it_may_change() -> None:
    row = ROWS["limits.linear_speed"]
    assert row.unit == "m/s"
    assert row.value == Config().limits.linear_speed
    assert isinstance(row.low, float)
    assert isinstance(row.high, float)
    assert row.low <= row.value <= row.high
    assert row.when == "at any time"
    assert "stands" in ROWS["limits.wheel_speed"].when
