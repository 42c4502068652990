"""Checks and calibrations over the page's WebSocket are started, answered and abandoned."""

from __future__ import annotations

import asyncio
import json
import signal
import time
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any, cast

import aiohttp
import pytest

from acsard.machine.authority import Authority
from acsard.terminal.json_prompt import MAX_INPUT_SILENCE_S
from tests import described
from tests.system.browser import Page, run, text
from tests.system.bystander import lost
from tests.system.guided import Guided, NoDaemon, commands, guiding, none_left
from tests.system.harness import Bus, Daemon, FarPeer, Program, acsard, until, wheels
from tests.system.hosts import Hosts, inside, on

pytestmark = pytest.mark.slow


async def beside(call: Callable[[], Any]) -> Any:
    """Run a blocking call in a thread, so that the pings continue."""
    return await asyncio.to_thread(call)


async def drives(guided: Guided, standing: Bus) -> None:
    """Start the first leg and wait until the robot moves.

    If a busy machine ends the leg, it is started again.
    """
    for _ in range(4):
        await guided.begin("calibrate", method="umbmark")
        await guided.answer(await guided.asks("How wide"), 300)
        await guided.starts("1. Place the")
        status = await guided.says(
            lambda status: status.get("progress", 0.0) > 0.15 or "ended" in status
        )
        if "ended" not in status:
            break
        await guided.says(lambda status: status.get("running") == "")
    await beside(
        lambda: until(lambda: (standing.state()["linear"] or 0.0) > 0.25, 10.0, "the leg moves")
    )
    assert standing.state()["source"] == "app"


async def test_a_board_is_checked_without_a_daemon_from_the_first_question_to_the_written_file(
    tmp_path: Path,
) -> None:
    alone = NoDaemon(tmp_path)
    with Page(alone, tmp_path) as served:
        async with guiding(served) as guided:
            await guided.begin("check", port="sim")
            subject = await guided.says(lambda message: "subject" in message)
            assert subject["simulated"] is True
            question = await guided.asks("lifted")
            assert question["answers"] == ["lifted"]
            # An answer that is not allowed is reported, and the question is asked again. Nothing
            # has turned.
            await guided.answer(question, "yes")
            question = await guided.asks("lifted")
            assert question["wrong"] == "answer with one of: lifted"
            await guided.answer(question, "lifted")
            await guided.sees(("fl", "fr", "rl", "rr"))
            result = await guided.says(lambda message: "result" in message)
            assert 'front_left = "+a"' in result["result"]
            await guided.answer(await guided.asks(str(alone.config)), "write")
            end = await guided.ended()
            assert (end["ended"], end["meaning"]) == (1, "failure")  # it was another map
            frames = guided.ours.heard
            findings = [s["guide"]["finding"] for s in frames if "finding" in str(s)]
            kinds = {"Subject", "Doing", "Progress", "Question", "FindingMessage", "Result"}
            assert described.kinds(frames) >= kinds
    names = [finding["name"] for finding in findings]
    assert names[0] == "baud rate"
    assert "watchdog" in names
    written = tomllib.loads(alone.config.read_text())["mcu"]
    assert written["wheels"] == {"front_right": "+b", "front_left": "+a"}
    assert written["port"] == "sim"


async def test_a_key_stops_the_leg_and_other_clients_see_the_procedure_and_cannot_control_it(
    page: Page, standing: Bus
) -> None:
    before = page.refused()
    async with guiding(page) as guided, guiding(page) as other:
        await drives(guided, standing)
        about = await other.says(lambda message: message.get("running"))
        assert (about["running"], about["by"], about["yours"]) == ("calibrate", "here", False)
        # Only one runs at a time, and no other client answers, presses or ends it.
        await other.begin("check", port="sim")
        refused = await other.ours.find(lambda message: message.get("refused") == "begin")
        assert "a calibration is already running (started by here)" in refused["reason"]
        await other.ours.say(press="key")
        await other.ours.say(press="leave")
        for number in range(100):
            await other.ours.say(reply=number, value=1)
        # Answers without a question do nothing, however many come.
        for number in range(150):
            await guided.ours.say(reply=number, value="start")
        refused = await guided.ours.find(lambda message: message.get("refused") == "reply")
        assert "is not open on this page" in refused["reason"]
        assert (standing.state()["linear"] or 0.0) > 0.25
        pressed = time.monotonic()
        await guided.ours.say(press="key")
        await beside(standing.stands)
        took = time.monotonic() - pressed
        # 0.3 m/s at 1 m/s2, and a part of the way.
        assert took < 0.3 + 0.4 + lost(pressed, pressed + took)
        end = await guided.ended()
        assert (end["ended"], end["meaning"]) == (1, "failure")
        assert "a key was pressed" in end["text"]
        assert "did not change any file" in end["text"]
        await other.says(lambda message: message.get("running") == "")
    none_left(page)
    assert page.refused()["malformed"] >= before.get("malformed", 0) + 200


def cut_connection(guided: Guided, page: Page) -> None:
    """Cut the connection like a browser that is killed."""
    cast(Any, guided.ours.socket)._response.connection.transport.abort()


def left(guided: Guided, page: Page) -> None:
    asyncio.get_running_loop().create_task(guided.ours.say(press="leave"))


@pytest.mark.parametrize("how", [cut_connection, left])
async def test_a_browser_that_disconnects_during_a_leg_leaves_zeros_and_no_child_process(
    page: Page, standing: Bus, how: Callable[[Guided, Page], None]
) -> None:
    async with guiding(page) as guided:
        await drives(guided, standing)
        (child,) = commands(page)
        begun = time.monotonic()
        how(guided, page)
        await beside(standing.stands)
        took = time.monotonic() - begun
        assert took < 0.3 + 0.4 + lost(begun, begun + took)
        await beside(lambda: none_left(page))
        await beside(lambda: until(lambda: ended(child), 3.0, "the child ends"))
    async with guiding(page) as another:
        await another.says(lambda message: message.get("running") == "")
        await another.begin("calibrate", method="tape")
        await another.asks("How far apart")
    none_left(page)


async def test_a_guide_client_that_sends_no_signs_of_life_loses_its_procedure(
    page: Page, standing: Bus
) -> None:
    async with guiding(page, pings=False) as guided:
        for _ in range(4):  # a busy machine may end it before
            await guided.begin("calibrate", method="umbmark")
            await guided.answer(await guided.asks("How wide"), 300)
            await guided.starts()
            end = await guided.ended()
            if "sent no sign of life" in end["text"]:
                break
            await guided.says(lambda message: message.get("running") == "")
        assert f"page or program sent no sign of life for {MAX_INPUT_SILENCE_S:g} s" in end["text"]
        await beside(standing.stands)


async def test_a_client_that_falls_silent_during_a_leg_stops_it_within_a_second(
    page: Page, standing: Bus
) -> None:
    async with guiding(page) as guided:
        await drives(guided, standing)
        silent = time.monotonic()
        guided.falls_silent()
        await beside(standing.stands)
        took = time.monotonic() - silent
        # Add the ramp: 0.3 m/s at 1 m/s2, and a part of the way.
        assert took < 1.0 + 0.3 + 0.4 + lost(silent, silent + took)
    none_left(page)


LINES = 10
"""Number of consecutive lines with one speed that count as steady."""


@pytest.mark.network
async def test_a_network_that_fails_during_a_leg_stops_it_within_a_second(
    hosts: Hosts, tmp_path: Path
) -> None:
    """The network delivers nothing more, but no connection closes and no program gets an error."""
    Authority.make(tmp_path / "tls", "test", 1, [hosts.address]).issue(
        tmp_path / "tls", "robot", [hosts.address], 1
    )

    def fast(since: float) -> float:
        """Return the speed of a wheel if all of the last lines have it, else 0."""
        lines = [entry.line for entry in peer.since(since) if entry.line != b"-"][-LINES:]
        speeds = [abs(wheels(line)[0]) for line in lines]
        steady = len(speeds) == LINES and len(set(speeds)) == 1
        return speeds[0] if steady else 0.0

    def slower(start: float, than: float) -> float | None:
        """Return the time of the first line after `start` that is slower than `than`, or None."""
        for entry in peer.since(start):
            if entry.line != b"-" and abs(wheels(entry.line)[0]) < than:
                return entry.at
        return None

    with (
        FarPeer(tmp_path) as peer,
        on(hosts.robot, Daemon(tmp_path, peer.path)) as daemon,
        on(hosts.robot, Page(daemon, tmp_path, at=hosts.address)) as served,
    ):
        token = served.invite("maintainer", "phone")
        with inside(hosts.stranger):
            async with guiding(served, token=token) as guided:
                await guided.begin("calibrate", method="umbmark")
                await guided.answer(await guided.asks("How wide"), 300)
                begun = time.monotonic()
                await guided.starts("1. Place the")
                speed = await beside(lambda: until(lambda: fast(begun), 10.0, "the leg moves"))
                hosts.cut()
                start = time.monotonic()
                try:
                    at = await beside(
                        lambda: until(lambda: slower(start, speed), 5.0, "it slows down")
                    )
                finally:
                    hosts.heal()
                print(f"slower after {at - start:.2f} s")
                # The page's server, the command and the daemon. A busy machine delays each.
                assert at - start < 1.0 + 3 * lost(start, at)
        none_left(served)


def test_a_server_that_is_killed_at_a_question_takes_its_child_with_it(
    daemon: Daemon, tmp_path: Path
) -> None:
    with Page(daemon, tmp_path) as page:

        async def story() -> None:
            async with guiding(page) as guided:
                await guided.begin("calibrate", method="umbmark")
                await guided.asks("How wide")
                (child,) = commands(page)
                page.signal(signal.SIGKILL)
                await beside(lambda: until(lambda: ended(child), 8.0, "the child ends"))

        with pytest.raises((AssertionError, aiohttp.ClientError, ConnectionError)):
            run(lambda: _then_fail(story))


@pytest.mark.parametrize(
    "number", [signal.SIGKILL, pytest.param(signal.SIGSTOP, marks=pytest.mark.nightly)]
)
def test_a_server_that_ends_or_hangs_takes_its_child_with_it(
    daemon: Daemon, standing: Bus, tmp_path: Path, number: signal.Signals
) -> None:
    with Page(daemon, tmp_path) as page:

        async def story() -> None:
            async with guiding(page) as guided:
                await drives(guided, standing)
                (child,) = commands(page)
                page.signal(number)
                await beside(standing.stands)
                await beside(
                    lambda: until(lambda: ended(child), 8.0, "the child ends with its server")
                )

        try:
            with pytest.raises((AssertionError, aiohttp.ClientError, ConnectionError)):
                run(lambda: _then_fail(story))
        finally:
            page.signal(signal.SIGCONT)


async def _then_fail(story: Callable[[], Any]) -> None:
    await story()
    raise ConnectionError("the server is gone")


def ended(pid: int) -> bool:
    """Return whether the process has ended. A zombie, whose parent hangs, counts as ended."""
    try:
        return " Z " in Path(f"/proc/{pid}/stat").read_text()
    except FileNotFoundError:
        return True


@pytest.mark.network
async def test_a_client_without_the_role_maintainer_begins_no_procedure(
    page: Page, standing: Bus
) -> None:
    before = page.refused().get("role", 0)
    for role in ("viewer", "operator"):
        token = page.invite(role, role)
        async with guiding(page, token=token) as theirs:
            for what in ("calibrate", "check"):
                await theirs.begin(what)
            refused = await theirs.ours.find(lambda message: message.get("refused") == "begin")
            assert "for maintainers" in refused["reason"]
            url = f"{page.away}/api/guide"
            async with page.client(token) as session, session.get(url) as answer:
                assert answer.status == 403
    assert page.refused()["role"] == before + 6
    assert commands(page) == []


INJECTED: list[dict[str, object]] = [
    {"begin": "run"},
    {"begin": "calibrate", "words": ["--write"]},
    {"begin": "check", "port": "--yes"},
]
"""The unit tests of `web/guide.py` have all other wishes that are refused."""


async def test_only_the_offered_procedures_can_begin(page: Page) -> None:
    async with guiding(page) as guided:
        for wish in INJECTED:
            await guided.ours.say(**wish)
            reply = await guided.ours.find(
                lambda reply: "refused" in reply or "ended" in reply.get("guide", {})
            )
            if "guide" in reply:
                assert reply["guide"]["ended"] == 2, reply
                assert reply["guide"]["text"], reply
            else:
                await asyncio.sleep(1.0)  # a refusal is sent once a second
        assert not any("question" in str(reply) for reply in guided.ours.heard)
    assert commands(page) == []


async def test_a_port_that_the_daemon_holds_is_reported_with_the_way_to_end_it(
    tmp_path: Path,
) -> None:
    with Program(acsard("sim"), tmp_path) as sim:
        port = sim.says("acsard run --port").split()[-1]
        with Daemon(tmp_path, port=port) as holder, Page(holder, tmp_path) as served:
            with Bus(holder.endpoint) as bus:
                bus.linked()
            async with guiding(served) as guided:
                await guided.begin("check", port=port)
                end = await guided.ended()
            assert end["ended"] == 75
            assert end["meaning"] == "port, bus address or robot id in use"
            assert f"process {holder.pid}" in end["text"]
            assert "systemctl stop acsard" in end["text"]
            listing = json.loads(await text(f"{served.here}/api/guide"))
            # A pty counts as an ordinary port: the advice for the simulator does not apply to it.
            assert (listing["method"], listing["advice"]) == ("", "")


@pytest.mark.nightly
async def test_a_browser_that_disconnects_while_a_motor_turns_leaves_zeros_and_a_free_port(
    tmp_path: Path,
) -> None:
    with Program(acsard("sim", "--fault", "no_watchdog"), tmp_path) as sim:
        port = sim.says("acsard run --port").split()[-1]
        with Page(NoDaemon(tmp_path, port), tmp_path) as served:
            async with guiding(served) as guided:
                await guided.begin("check", port=port)
                await guided.lifted()
                await guided.says(lambda message: "motor a" in message.get("doing", ""))
                cut_connection(guided, served)
            await beside(lambda: none_left(served))
        # The next check finds the wheels at rest, and the port free.
        with Program(acsard("mcu", "check", "--port", port, "--yes"), tmp_path) as again:
            again.says("PASS    motor a", 30.0)


async def test_the_guide_lists_the_procedures_and_ports_that_it_offers(page: Page) -> None:
    offers = json.loads(await text(f"{page.here}/api/guide"))
    assert sorted(offers["methods"]) == ["gyro", "positions", "tape", "umbmark", "wall"]
    assert offers["method"] == "positions"
    assert "no floor to measure with a tape" in offers["advice"]
    assert offers["ports"][0]["port"] == "sim"  # the configured port
    if len(offers["ports"]) == 1:
        assert "systemctl stop acsard" in offers["note"]
