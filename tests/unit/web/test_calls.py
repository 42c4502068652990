"""Each press of STOP is answered by a stop that was sent after it; settings can be kept."""

from __future__ import annotations

import asyncio
import threading
import tomllib
from copy import copy
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import pytest
from msgspec.structs import replace

from acsard.core.messages.schema import Change, Info, ReplyData, ServiceReply
from acsard.host.errors import NoAnswerError
from acsard.web.callers import AdmittedClient
from acsard.web.calls import Calls, unanswered

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


class KeepingRobot:
    """A daemon on this machine that sets everything, as the connection of the page."""

    id, gone = "acsar", ""

    def __init__(self) -> None:
        self.client, self.asked = self, list[object]()

    def named(self, name: str) -> KeepingRobot:
        return self

    def get(self, key: str) -> Info:
        return Info("acsar", "0", 1, "sim", True, 100.0, [], [])

    def set(self, settings: object) -> ServiceReply:
        return self.request("set", {"settings": settings})

    def request(self, verb: str, fields: object) -> ServiceReply:
        self.asked.append(fields)
        return ServiceReply(True, "done", ReplyData(changes={"rates.telemetry": Change(10.0, 5.0)}))

    def refresh_about(self) -> None: ...


async def test_keep_writes_the_file_of_the_page_or_says_why_it_may_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, file = KeepingRobot(), tmp_path / "robot.toml"
    monkeypatch.setattr("acsard.machine.kept_settings.is_daemon_here", lambda pid: True)
    here = AdmittedClient("maintainer", "here")
    calls, wish = Calls(cast(Any, robot), str(file)), {"settings": {"rates.telemetry": 5}}
    file.touch(0o444)
    refused = await calls.call(here, "set", wish | {"keep": True})
    assert "it is read-only" in refused.message
    assert not refused.success
    assert not robot.asked
    file.chmod(0o644)
    kept = await calls.call(here, "set", wish | {"keep": True})
    assert kept == replace(robot.request("", wish), message=f"done; written to {file}")
    del robot.asked[-1]
    assert tomllib.loads(file.read_text()) == {"rates": {"telemetry": 5}}
    assert (await calls.call(here, "set", wish | {"keep": False})).message == "done"
    assert robot.asked == [wish, wish]
