"""The page of one robot shows and stops the other robots of its router, and does nothing else."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import ExitStack
from pathlib import Path
from typing import NamedTuple

import aiohttp
import pytest
import zenoh

from tests.system.browser import Page, hands
from tests.system.chromium import CHROMIUM, PHONE, browsing
from tests.system.harness import Bus, Daemon, Tables, client_config, free_endpoint, until

pytestmark = pytest.mark.slow

OURS, THEIRS = "robot1", "robot2"


class Two(NamedTuple):
    """Two robots behind a router, and the page of the first."""

    ours: Bus
    theirs: Bus
    daemon: Daemon
    page: Page


@pytest.fixture(scope="module")
def two(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Two]:
    where, router = tmp_path_factory.mktemp("two"), free_endpoint()
    with ExitStack() as stack:
        stack.enter_context(zenoh.open(client_config(router, "router")))
        buses, daemons = [], []
        for name in (OURS, THEIRS):
            settings: Tables = {
                "robot": {"id": name},
                "bus": {"connect": [router]},
                "ros": {"namespace": name},
            }
            daemons.append(stack.enter_context(Daemon(where, config=settings, name=name)))
            buses.append(stack.enter_context(Bus(daemons[-1].endpoint, name)))
            buses[-1].linked()
        page = stack.enter_context(Page(daemons[0], where, "--connect", router))
        yield Two(buses[0], buses[1], daemons[0], page)


@pytest.fixture(autouse=True)
def cleared(two: Two) -> None:
    for bus in (two.ours, two.theirs):
        bus.ask("srv/clear")
        bus.at_rest()


async def test_another_robot_can_be_followed_and_stopped_and_nothing_else(two: Two) -> None:
    async with hands(two.page) as ours:
        await ours.say(subscribe="fleet")
        fleet = await ours.find(lambda message: len(message.get("fleet", ())) == 2)
        assert [entry["robot"] for entry in fleet["fleet"]] == [OURS, THEIRS]
        assert fleet["note"] == ""
        await ours.say(subscribe="state", robot=THEIRS)
        state = await ours.find(lambda message: message.get("robot") == THEIRS)
        assert state["value"]["mode"] == "ready"
        await ours.say(call="stop", id=1, robot=THEIRS)
        assert (await ours.find(lambda message: message.get("answer") == 1))["ok"]
        await ours.say(call="clear", id=2, robot=THEIRS)
        refused = await ours.find(lambda message: message.get("answer") == 2)
        assert not refused["ok"]
        assert "own page" in refused["text"]
    assert two.theirs.state()["mode"] == "stopped"
    assert two.ours.state()["mode"] == "ready"
    (stopped,) = [entry for entry in two.theirs.get("events")["events"] if entry["name"] == "stop"][
        -1:
    ]
    assert stopped["by"].startswith("here@page")


async def test_a_page_without_a_connection_stops_another_robot_too(two: Two) -> None:
    async with aiohttp.ClientSession(two.page.here) as session:
        wishes = (
            (THEIRS, "stop", 200, "ready"),
            (THEIRS, "clear", 403, "ready"),
            (3, "stop", 400, "stopped"),
        )
        for robot, verb, status, own_mode in wishes:
            async with session.post(f"/api/srv/{verb}", json={"robot": robot}) as answer:
                assert answer.status == status, await answer.text()
            assert two.theirs.state()["mode"] == "stopped"
            assert two.ours.state()["mode"] == own_mode


async def test_a_stop_of_an_absent_robot_or_an_invalid_id_is_answered_with_an_error(
    two: Two,
) -> None:
    async with hands(two.page) as ours:
        names = {"robot3": "no answer", "a/**": "not a robot's id"}
        for name, why in names.items():
            await ours.say(call="stop", robot=name)
            answer = await ours.find(lambda message: "answer" in message)
            assert not answer["ok"]
            assert why in answer["text"]


async def test_a_page_connected_to_a_daemon_says_why_it_shows_no_other_robots(
    two: Two, tmp_path: Path
) -> None:
    with Page(two.daemon, tmp_path) as beside:
        async with hands(beside) as ours:
            await ours.say(subscribe="fleet")
            listing = await ours.find(lambda message: message.get("fleet"))
            assert [row["robot"] for row in listing["fleet"]] == [OURS]
            assert "daemons forward no messages" in listing["note"]
            assert f"acsard web --connect ROUTER --id {OURS}" in listing["note"]


@pytest.mark.skipif(CHROMIUM is None, reason="needs chromium-headless-shell")
def test_a_card_opens_its_robot_which_can_be_seen_and_stopped_and_not_driven(two: Two) -> None:
    with browsing() as browser:
        browser.size(*PHONE)
        browser.open(two.page.here)

        def shows(name: str, words: str) -> None:
            until(lambda: words in browser.text(name), 10.0, f"{name} says {words!r}")

        shows("mode", "READY")
        browser.tap("tab-robots")
        shows("cards", THEIRS)
        shows("cards", "Nobody drives.")
        shows("cards", "x 0.00 m · y 0.00 m · 0°")
        two.theirs.get("srv/set", {"settings": {"rates.odom": 50.0}})
        shows("cards", "settings differ: rates.odom = 50.0, not 0.0")
        assert browser.js("document.querySelectorAll('#cards li.warning').length") == 1
        two.theirs.get("srv/set", {"settings": {"rates.odom": 0.0}})
        link = f"document.querySelector('#cards a[href*={THEIRS}]')"
        until(lambda: browser.js(f"Boolean({link})"), 10.0, "a card to open")
        browser.js(f"{link}.click()")
        shows("other", f"This is {THEIRS} on the page of {OURS}")
        shows("robot", THEIRS)
        shows("mode", "READY")
        shows("age", "live")
        shows("stop", f"STOP {THEIRS}")
        badge = "document.getElementById('simulated').hidden"
        until(lambda: browser.js(badge) is False, 10.0, "the badge of a simulator")
        assert browser.js("document.getElementById('tab-set').hidden") is True
        stick = "document.getElementById('stick')"
        assert browser.js(f"{stick}.getAttribute('aria-disabled')") == "true"
        assert THEIRS in browser.js(f"{stick}.title")
        shows("hint", f"To drive {THEIRS}, open its own page")
        before = two.theirs.count("commands"), two.ours.count("commands")
        browser.touch("Start", browser.middle("stick"))
        x, y = browser.middle("stick")
        browser.touch("Move", (x, y - 60))
        browser.touch("End")
        browser.tap("stop")
        until(lambda: two.theirs.state()["mode"] == "stopped", 5.0, "it stops")
        shows("mode", "STOPPED")
        # There is no Release button here, and no text mentions one.
        shows("reason", f"Release is on the own page of {THEIRS}")
        assert browser.js("document.getElementById('clear').hidden") is True
        browser.tap("tab-robots")
        shows("cards", f"Release is on the own page of {THEIRS}")
        browser.tap("tab-drive")
        assert "press Release" not in browser.js("document.body.textContent")
        assert two.ours.state()["mode"] == "ready"
        assert before == (two.theirs.count("commands"), two.ours.count("commands"))
        two.theirs.ask("srv/clear")
        shows("mode", "READY")
        # The robot is seen while another client drives it, and then goes silent.
        with two.theirs.commanding(0.1):
            shows("mode", "DRIVING")
            shows("who", "app")
        browser.js("document.querySelector('#other a').click()")
        shows("robot", OURS)
        shows("mode", "READY")
        assert browser.js(f"{stick}.getAttribute('aria-disabled')") == "false"
        assert browser.said == []
