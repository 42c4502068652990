"""Over TLS an operator cannot drive as another sender, whatever attachment it sends."""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import msgspec
import pytest
import zenoh

from acsard.client import Client, connect
from acsard.core.values import NS_PER_S
from tests.system.browser import Page, hands, run
from tests.system.harness import Bus, twist, until
from tests.system.identities import Gated

pytestmark = pytest.mark.network

AHEAD_NS = NS_PER_S // 50
ATTACK_S = 1.5


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Gated]:
    robot = Gated(tmp_path_factory.mktemp("identity"))
    with robot.daemon, Bus(robot.plain) as bus:
        bus.linked()
        until(lambda: robot.lets_in("operator"), 10.0, "the TLS gateway")
        yield robot


@contextmanager
def driving(client: Client, seconds: float) -> Iterator[None]:
    """Let the client drive straight at 0.2 m/s in a separate thread while the body runs."""
    failed: list[BaseException] = []

    def drive() -> None:
        try:
            client.drive(0.2, seconds=seconds)
        except BaseException as error:  # noqa: BLE001 - raised again in the test's thread
            failed.append(error)

    thread = threading.Thread(target=drive)
    thread.start()
    try:
        yield
    finally:
        thread.join()
    if failed:
        raise failed[0]


def attack(session: zenoh.Session, keys: tuple[str, ...], sender: str) -> None:
    """Send commands that turn the robot and claim to be the newest ones of `sender`."""
    end_s, sequence = time.monotonic() + ATTACK_S, 1_000_000
    while time.monotonic() < end_s:
        sequence += 1
        signature = {"sender": sender, "stamp": time.time_ns() + AHEAD_NS, "sequence": sequence}
        for key in keys:
            payload = json.dumps(twist(0.0, 1.0))
            session.put(key, payload, attachment=msgspec.json.encode(signature))
        time.sleep(0.02)


def attacked(robot: Gated, victim: Client, sender: str = "") -> list[Any]:
    """Let an operator attack the victim while it drives. Return the states during the attack.

    The attack uses this sender id, or the id that `state` publishes if it is empty.
    """
    keys = tuple(f"acsard/acsar/cmd/teleop{end}" for end in ("", "/operator", "/maintainer"))
    with (
        Bus(robot.plain) as bus,
        robot.opened("operator") as session,
        bus.follow("state") as states,
        driving(victim, ATTACK_S + 3.0),
    ):
        until(lambda: (bus.state()["linear"] or 0.0) > 0.15, 10.0, "the victim drives")
        begun = len(states.seen)
        attack(session, keys, sender or bus.state()["sender"])
        return [entry.value for entry in states.seen[begun:]]


def test_a_stolen_secret_does_not_take_the_robot_under_another_certificate(robot: Gated) -> None:
    with connect(robot.plain, source="teleop") as victim, Bus(robot.plain) as bus:
        refused = bus.count("command_other_certificate")
        states = attacked(robot, victim, victim._connection._sender._id)
        assert bus.count("command_other_certificate") > refused
        assert (
            "this sender id is already in use on the robot's own machine" in bus.state()["refused"]
        )
    assert not [state for state in states if abs(state["angular"] or 0.0) > 0.05]
    assert {state["sender"] for state in states if state["mode"] == "driving"} == {
        victim._connection.sender
    }
    events = robot.daemon.events("command_refused")
    assert any(event["by"] == f"{victim._connection.sender} [operator]" for event in events)


def test_the_sender_of_a_client_over_tls_has_the_name_of_its_certificate(robot: Gated) -> None:
    tls = robot.own("operator")
    with connect(robot.tls, tls=tls) as client, Bus(robot.plain) as bus:
        bus.at_rest()  # the other tests' drives are over
        with bus.follow("state") as states:
            client.drive(0.2, seconds=0.5)
        # After the timeout of the last command the robot ramps down for nobody.
        senders = {e.value["sender"] for e in states.seen if e.value["mode"] == "driving"} - {""}
    assert senders == {client._connection.sender}
    assert client._connection.sender.endswith(" [operator]")


def test_a_page_server_connected_over_tls_drives_under_its_certificate_s_name(
    robot: Gated, tmp_path: Path
) -> None:
    async def story() -> None:
        async with hands(page) as ours:
            hello = await ours.find(
                lambda frame: frame.get("hello", {}).get("sender", "").endswith(" [operator]")
            )
            await ours.say(subscribe="state", rate=50)
            await ours.until_driving(0.2)
            state = await ours.state(lambda state: (state["linear"] or 0.0) > 0.1)
            assert state["sender"] == hello["hello"]["sender"]

    by_tls = ["--connect", robot.tls, "--tls", robot.own("operator")]
    with Page(robot.daemon, tmp_path, *by_tls) as page, Bus(robot.plain) as bus:
        run(story)
        bus.at_rest()
