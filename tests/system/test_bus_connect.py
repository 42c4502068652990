"""The log, `diagnostics` and `doctor` report a router that is missing, ends or returns."""

from __future__ import annotations

import json
import signal
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
import zenoh

from tests.system.harness import (
    Bus,
    Daemon,
    Program,
    client_config,
    free_endpoint,
    twist,
    until,
)
from tests.system.strangers import ROUTER, command_line
from tests.system.test_doctor import examined

pytestmark = pytest.mark.network


def router(where: Path, endpoint: str) -> Program:
    return Program(command_line(ROUTER, endpoint), where)


def row(bus: Bus) -> Any:
    """Return the router's row in `diagnostics`."""
    rows = [
        status for status in bus.get("diagnostics")["status"] if status["name"] == "acsard: router"
    ]
    return rows[0] if rows else None


def wait_for_event(daemon: Daemon, name: str, times: int) -> str:
    """Wait until the daemon has logged this event `times` times. Return the last one's text."""
    until(lambda: len(daemon.events(name)) >= times, 5.0, f"{name}, {times} times")
    return str(daemon.events(name)[times - 1]["text"])


def test_a_peer_says_that_its_router_is_missing_and_that_it_came_and_went(tmp_path: Path) -> None:
    meeting = free_endpoint()
    config = {"bus": {"connect": [meeting]}}
    with Daemon(tmp_path, config=config) as daemon, Bus(daemon.endpoint) as bus:
        assert meeting in wait_for_event(daemon, "router_missing", 1)
        until(lambda: row(bus) is not None, 2.0, "diagnostics say it")
        assert (row(bus)["level"], row(bus)["message"]) == (1, f"not connected to {meeting}")
        toml = f'[bus]\nlisten = ["{daemon.endpoint}"]\nconnect = ["{meeting}"]\n'
        _, findings = examined(tmp_path, toml)
        rows = [(finding["level"], finding["text"]) for finding in findings["router"]]
        assert rows == [("warning", f"not connected to {meeting}")]
        with router(tmp_path, meeting) as there:
            assert wait_for_event(daemon, "router_found", 1) == f"connected to {meeting}"
            until(lambda: row(bus)["level"] == 0, 2.0, "diagnostics say it")
            _, findings = examined(tmp_path, toml)
            rows = [(finding["level"], finding["text"]) for finding in findings["router"]]
            assert rows == [("ok", "connected")]
            there.signal(signal.SIGKILL)
            wait_for_event(daemon, "router_missing", 2)
        assert bus.count("router_missing") == 2
        assert bus.state()["link"] == "up"  # local driving does not depend on the router


def test_a_client_says_that_its_router_went_and_came_back(tmp_path: Path) -> None:
    meeting = free_endpoint()
    config = {"bus": {"mode": "client", "connect": [meeting]}}
    toml = f'[bus]\nmode = "client"\nconnect = ["{meeting}"]\n'
    with Daemon(tmp_path, config=config, ready=False) as daemon:
        until(lambda: daemon.events("connecting"), 20.0, "it waits for its router")
        _, findings = examined(tmp_path, toml)
        assert findings["router"][0]["text"] == f"no program listens at {meeting}"
        assert "only through the Zenoh router" in findings["daemon"][0]["text"]
        with router(tmp_path, meeting):
            wait_for_event(daemon, "router_found", 1)
        wait_for_event(daemon, "router_missing", 1)
        with router(tmp_path, meeting):
            wait_for_event(daemon, "router_found", 2)
            with Bus(meeting) as bus:
                until(lambda: row(bus)["message"] == "connected", 2.0, "diagnostics say it")


@pytest.mark.parametrize("routers", [1, pytest.param(2, marks=pytest.mark.nightly)])
def test_the_zeros_of_a_program_behind_routers_release_no_other_program(
    tmp_path: Path, routers: int
) -> None:
    """Two programs send through the same routers: one zeros, the other one speeds.

    The first router stamps all messages, so both look like one sender. The robot does not drive
    until the zeros pause. With two routers, the daemon has no link to the first one.
    """
    ends = [free_endpoint() for _ in range(routers)]
    with ExitStack() as stack:
        for place, endpoint in enumerate(ends):
            program = Program(command_line(ROUTER, endpoint, *ends[:place][-1:]), tmp_path)
            stack.enter_context(program).says("routing")
        daemon = stack.enter_context(Daemon(tmp_path, config={"bus": {"connect": ends[-1:]}}))
        bus = stack.enter_context(Bus(daemon.endpoint))
        zeros, speeds = [stack.enter_context(zenoh.open(client_config(ends[0]))) for _ in range(2)]
        wait_for_event(daemon, "router_found", 1)
        bus.linked()

        def put(session: zenoh.Session, linear: float) -> Any:
            session.put("acsard/acsar/cmd/app", json.dumps(twist(linear)))
            return bus.state()

        def arrive(session: zenoh.Session) -> None:
            """Send speeds until some arrive. A new session first has to learn of the subscriber."""
            before = bus.count("commands")
            until(lambda: put(session, 0.1)["counters"].get("commands", 0) > before + 5, 10.0)

        arrive(zeros)
        arrive(speeds)
        begun = time.monotonic()

        def sends() -> Any:
            """Send a zero, and also a speed, except between 2 and 4 s. Return the state."""
            state = put(zeros, 0.0)
            return state if 2.0 < time.monotonic() - begun < 4.0 else put(speeds, 0.1)

        while time.monotonic() < begun + 2.0:
            assert sends()["mode"] != "driving"
            time.sleep(0.05)
        state = until(
            lambda: (status := sends())["mode"] == "driving" and status, 10.0, "it drives"
        )
        assert state["sender"].startswith("session ")
