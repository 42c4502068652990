"""Measures simulated robots behind one router, and what is lost when the router is killed.

Robots and router are processes with the files and settings of the manual's page on fleets. Each
program that drives a robot is a client of its own.
"""

from __future__ import annotations

import json
import signal
import threading
import time
from contextlib import ExitStack
from functools import partial
from pathlib import Path
from statistics import median

import zenoh

from acsard import client
from acsard.bus.address import Address
from acsard.client.connection import open_connection
from acsard.top.roster import Roster, absence
from tests.system.fleet_router import (
    ITS_NAME,
    acsard_router,
    certified,
    listens,
    robot_at,
    secured_config,
)
from tests.system.harness import Program, acsard, cpu_seconds, finish, resident_kb, until
from tests.system.identities import free_tls_endpoint
from tests.tools.reference import table

FLEET = 12  # robots behind one router


def fleet(where: Path) -> str:
    """Measure many robots behind one router, as the manual's page has them, and end the router."""
    many, one = _behind_a_router(where, FLEET), _behind_a_router(where, 1)
    return table(
        ("quantity", f"{FLEET} robots", "1 robot"),
        [(what, value, one.get(what, "-")) for what, value in many.items()],
    )


def _behind_a_router(where: Path, count: int) -> dict[str, str]:
    names = [f"robot{n}" for n in range(1, count + 1)]
    where, endpoint, figures = where / str(count), free_tls_endpoint(), {}
    where.mkdir()
    certified(where, *names, "operator", ITS_NAME)
    own = str(where / "operator")

    def tool(*words: str) -> list[str]:
        return acsard(*words, "--id", ",".join(names), "--connect", endpoint, "--tls", own)

    with ExitStack() as stack:
        router = stack.enter_context(acsard_router(where, endpoint, names))
        listens(router)
        robots = [robot_at(endpoint, where, name, ready=False) for name in names]
        for robot in robots:
            stack.enter_context(robot)
        for robot in robots:
            robot.says("bus ")
        follower = stack.enter_context(Program(tool("echo", "state"), where))
        connection = stack.enter_context(open_connection(Address(endpoint, names[0], own)))
        roster = Roster(connection, names)

        def shown(mode: str = "") -> int:
            rows = [row for row in roster.rows() if not absence(row) and row.state is not None]
            return sum(mode in ("", row.state.mode) for row in rows if row.state is not None)

        def measured(doing: str) -> None:
            processes, lines = [router, *robots], len(follower.out)
            used, began = [cpu_seconds(each.pid) for each in processes], time.monotonic()
            time.sleep(15.0)
            took = time.monotonic() - began
            first, *others = (
                100 * (cpu_seconds(each.pid) - before) / took
                for each, before in zip(processes, used, strict=True)
            )
            figures[f"processor of the router, {doing}, % of a core"] = f"{first:.1f}"
            figures[f"processor of a daemon with its simulated board, {doing}, median / most"] = (
                f"{median(others):.1f} / {max(others):.1f}"
            )
            got = (len(follower.out) - lines) / took
            figures[f"`state` a second at a follower of all, {doing}"] = f"{got:.0f}"

        until(lambda: shown() == count, 30.0, "all robots are shown")
        took = []
        for _ in range(5):
            began = time.monotonic()
            listed = finish(tool("fleet", "--json"), where)
            took.append(time.monotonic() - began)
            assert listed.code == 0, listed.err
        figures["`acsard fleet --json` with a row and a state of each, median of 5, s"] = (
            f"{median(took):.1f}"
        )
        measured("at rest")
        figures["memory of the router, MB"] = f"{resident_kb(router.pid) / 1000:.0f}"

        ends: list[str] = []
        programs = [threading.Thread(target=_drive, args=(endpoint, name, own, ends))
                    for name in names]  # fmt: skip
        for program in programs:
            program.start()
        until(lambda: shown("driving") == count, 60.0, "all robots drive")
        measured("each robot driven")
        if count == 1:
            return figures
        session = zenoh.open(secured_config(endpoint, where / "operator"))
        stack.callback(session.close)
        ways: dict[str, list[float]] = {name: [] for name in names}
        kept = [
            session.declare_subscriber(f"acsard/{name}/json/odom", partial(_append, way))
            for name, way in ways.items()
        ]
        until(lambda: all(ways.values()), 10.0, f"each of {len(kept)} publishes its way")
        router.signal(signal.SIGKILL)
        killed = time.monotonic()
        router.ended(5.0)
        until(lambda: shown() == 0, 30.0, "all robots are missing")
        figures["router killed: `fleet` shows all as gone after, s"] = _since(killed)
        stopped = finish(tool("call", "stop"), where)
        unstopped = sum(name in stopped.err.partition(": go")[0] for name in names)
        figures["`acsard call stop` meanwhile: exit code / robots that it names as not stopped"] = (
            f"{stopped.code} / {unstopped}"
        )
        for program in programs:
            program.join()
        figures["driving programs that ended with an error"] = str(len(ends))
        before = {name: way[-1] for name, way in ways.items()}
        router = stack.enter_context(acsard_router(where, endpoint, names))
        back = time.monotonic()
        until(lambda: shown("ready") == count, 60.0, "all robots are shown again")
        figures["new router started: `fleet` shows all again, at rest, after, s"] = _since(back)
        for way in ways.values():
            way.clear()
        until(lambda: all(ways.values()), 10.0, "each publishes its way")
        figures["farthest that a robot at 0.3 m/s rolled after the kill, m"] = (
            f"{max(abs(way[-1] - before[name]) for name, way in ways.items()):.2f}"
        )
    return figures


def _drive(endpoint: str, name: str, own: str, ends: list[str]) -> None:
    try:
        with client.connect(endpoint, robot_id=name, tls=own) as driver:
            driver.drive(0.3, 0.0, seconds=600.0)
    except client.AcsardError as error:
        ends.append(str(error))


def _append(way: list[float], sample: zenoh.Sample) -> None:
    way.append(json.loads(sample.payload.to_bytes())["pose"]["pose"]["position"]["x"])


def _since(began: float) -> str:
    return f"{time.monotonic() - began:.1f}"
