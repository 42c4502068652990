"""Tests of the rows of a fleet, for present and for lost robots.

The Zenoh session reaches no other program.
"""

from __future__ import annotations

import asyncio
import time
from collections.abc import Callable, Iterator
from typing import Any

import pytest
import zenoh
from msgspec.structs import replace

from acsard.bus.address import Address
from acsard.client import Client
from acsard.core.messages.encodings import encode, encoding_name
from acsard.core.messages.schema import Info
from acsard.web.fleet_rows import FleetTracker
from acsard.web.metrics import Counts
from acsard.web.robots import About, Robots
from acsard.web.socket_messages import Row
from tests.unit.web.test_metrics import STATE

PATIENCE_S = 20.0

ABOUT = About("1", True, 1.0, 4.0, 10.0, "", {"teleop": 0.25, "app": 0.25})

INFO = Info("r2", "1.2.3", 42, "/dev/pts/3", True, 100.0, [], [])


WARNS = "recording fails: disk full"


def quiet() -> zenoh.Config:
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    return config


@pytest.fixture
def session() -> Iterator[zenoh.Session]:
    session = zenoh.open(quiet())
    yield session
    for _ in range(100):
        try:
            session.close()
        except RuntimeError:  # a thread of an abandoned call still holds the session
            time.sleep(0.05)
        else:
            return
    raise AssertionError("somebody keeps the session")


def robots(client: Client | None) -> Robots:
    def connect() -> Client:
        raise AssertionError("nobody runs this")

    result = Robots(Address("tcp/127.0.0.1:1", "acsar", ""), connect, ABOUT, Counts())
    result.client = client
    return result


async def row(fleet: FleetTracker, look: Callable[[Row], Any]) -> Row:
    """Wait for a row for which `look` is true, and return it."""
    async with asyncio.timeout(PATIENCE_S):
        while True:
            for entry in fleet.rows():
                if look(entry):
                    return entry
            await asyncio.sleep(0.01)


@pytest.mark.slow
async def test_a_robot_that_is_present_and_silent_is_not_shown_in_its_last_mode(
    session: zenoh.Session,
) -> None:
    fleet = FleetTracker(robots(Client(session, "acsar", "teleop")))
    token = session.liveliness().declare_token("acsard/r2/alive")
    fleet.join(1)
    await row(fleet, lambda entry: entry.robot == "r2")
    key, named = "acsard/r2/state", encoding_name("msgpack", "RobotState")
    session.put(key, encode(STATE, "msgpack"), encoding=named)
    await row(fleet, lambda entry: entry.mode == STATE.mode)
    silent = await row(fleet, lambda entry: entry.mode is None)
    assert (silent.speed, silent.link, silent.place) == (None, "", None)
    assert silent.reason == f"the robot was {STATE.mode}"
    assert silent.age is not None
    token.undeclare()
    fleet.leave(1)


async def test_a_robot_is_reported_with_its_version_and_seconds_and_as_gone_when_its_token_is(
    session: zenoh.Session,
) -> None:
    def say() -> None:
        full = replace(STATE, recording_error="disk full")
        session.put(
            "acsard/r2/state", encode(full, "msgpack"),
            encoding=encoding_name("msgpack", "RobotState"),
        )  # fmt: skip

    def info(query: zenoh.Query) -> None:
        payload = encode(INFO, "msgpack")
        query.reply("acsard/r2/info", payload, encoding=encoding_name("msgpack", "Info"))
        query.drop()

    fleet = FleetTracker(robots(Client(session, "acsar", "teleop")))
    session.declare_queryable("acsard/r2/info", info)
    token = session.liveliness().declare_token("acsard/r2/alive")
    fleet.join(1)
    silent = await row(fleet, lambda entry: entry.robot == "r2")
    assert (silent.mode, silent.speed, silent.age) == (None, None, None)
    say()
    present = await row(fleet, lambda entry: entry.mode == STATE.mode and entry.version)
    assert (present.version, present.speed) == ("1.2.3", STATE.linear)
    assert (present.place, present.warnings) == ([STATE.x, STATE.y, STATE.yaw], [WARNS])
    say()
    await asyncio.sleep(0.5)
    (late,) = fleet.rows()
    assert late.age is not None
    assert 0.4 < late.age < PATIENCE_S
    token.undeclare()
    absent = await row(fleet, lambda entry: entry.mode == "gone")
    assert STATE.mode in absent.reason
    assert absent.version == ""
    fleet.leave(1)


async def test_the_fleet_is_searched_again_after_no_connection_or_a_failed_bus(
    session: zenoh.Session,
) -> None:
    with zenoh.open(quiet()) as ended:
        pass
    known = robots(None)
    fleet = FleetTracker(known)
    fleet.join(1)
    assert fleet.rows() == []
    known.client = Client(ended, "acsar", "teleop")
    fleet.rows()
    await asyncio.sleep(0.1)
    known.client = Client(session, "acsar", "teleop")
    token = session.liveliness().declare_token("acsard/r2/alive")
    await row(fleet, lambda entry: entry.robot == "r2")
    token.undeclare()
    fleet.leave(1)
