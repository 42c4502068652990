"""No command of our client is obeyed that waited in a queue, even if there always was a queue."""

from __future__ import annotations

import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.system.bystander import lost
from tests.system.harness import Bus, Daemon, Program, until
from tests.system.relay import Relay

pytestmark = pytest.mark.network

QUEUE_S = 1.5

# A dead-man joystick: arguments are the endpoint, and for how many s it sends and is held.
JOYSTICK = """
import sys, time
from pathlib import Path
from acsard.client import connect

with connect(sys.argv[1]) as robot:
    while robot._connection._beats.newest() is None:
        time.sleep(0.01)
    print("connected", flush=True)
    while not Path("begin").exists():
        time.sleep(0.01)
    for number in range(int(sys.argv[2]) * 20):
        robot.send(0.5 if number < int(sys.argv[3]) * 20 else 0.0)
        time.sleep(0.05)
"""


@pytest.fixture
def delay(shared: Daemon) -> Iterator[Relay]:
    with Relay(shared.endpoint) as delay:
        yield delay


def joystick(delay: Relay, where: Path, seconds: int, held: int) -> Program:
    words = [sys.executable, "-c", JOYSTICK, delay.endpoint, str(seconds), str(held)]
    return Program(words, where)


def test_a_new_client_drives_within_0_3_s_of_its_zero(
    shared: Daemon, bus: Bus, tmp_path: Path
) -> None:
    bus.at_rest()
    (tmp_path / "begin").touch()
    with (
        bus.follow("cmd/app") as sent,
        bus.follow("cmd_vel_out") as applied,
        Relay(shared.endpoint) as delay,
        joystick(delay, tmp_path, 1, 1) as client,
    ):
        assert client.ended(20.0) == 0, client
    began = next(entry.at for entry in sent.seen if entry.value["linear"]["x"] == 0.0)
    moved = next(entry.at for entry in applied.seen if entry.value["twist"]["linear"]["x"] > 0.0)
    print(f"drives {moved - began:.3f} s after its zero")
    assert moved - began < 0.3 + lost(began, moved)
    bus.at_rest()


@pytest.mark.parametrize("fault", ["a queue", "a partition that heals"])
def test_a_robot_whose_client_falls_behind_stops_in_time_and_obeys_nothing_that_waited(
    bus: Bus, delay: Relay, tmp_path: Path, fault: str
) -> None:
    bus.at_rest()
    (tmp_path / "begin").touch()
    refused = bus.count("command_too_old")
    with bus.follow("cmd_vel_out") as applied, joystick(delay, tmp_path, 6, 5) as program:
        until(lambda: (bus.state()["linear"] or 0.0) > 0.49, 20.0, f"it drives\n{program}")
        late = time.monotonic()
        if fault == "a queue":
            delay.seconds = QUEUE_S
        else:
            delay.open.clear()
        slower = applied.find(
            lambda step: step["twist"]["linear"]["x"] < 0.49, 5.0, "slower", after=late
        )
        rest = applied.find(
            lambda step: step["twist"]["linear"]["x"] == 0.0, 5.0, "at rest", after=late
        )
        # What is sent before the joystick is let go would drive on, if it were obeyed.
        until(lambda: bool(program.process.poll() is not None or time.monotonic() > late + 1.5))
        delay.open.set()
        until(lambda: bus.count("command_too_old") > refused, 5.0, "what waited is refused")
        program.ended(20.0)
        speeds = [e.value["twist"]["linear"]["x"] for e in applied.seen if e.at > rest.at]
    print(f"slower {slower.at - late:.3f} s after {fault}")
    assert slower.at - late < 0.25 + 0.1 + lost(late, slower.at)
    assert fault != "a queue" or not any(speeds)
