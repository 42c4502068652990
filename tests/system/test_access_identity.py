"""Over TLS an operator cannot drive as another sender, whatever attachment it sends."""

from __future__ import annotations

import threading
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from acsard.client import Client, connect
from tests.system.browser import Page, hands, run
from tests.system.harness import Bus, until
from tests.system.identities import Gated

pytestmark = pytest.mark.network


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
