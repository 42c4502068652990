"""Simulated drives of two minutes, ten minutes and an hour give the same result in every run.

The stored trace depends on every line to the MCU and on the final values on the bus. It changes
only if the robot's behaviour changes. If it does, find the reason, and store the new trace with

    python -m tests.scenarios.test_hour
"""

from __future__ import annotations

import json
import random
import time
import zlib
from pathlib import Path

import pytest

from acsard.core.simulator.fake_mcu import FakeMcu
from tests.scenarios.world import World
from tests.stepped import Outputs

GOLDEN = Path(__file__).parent.parent / "vectors" / "golden_hour.json"
SHORT, SLOW, LONG = 2, 10, 60
"""Minutes. The hour is for the soak runs, since it takes half a minute of real time."""


def drive_with_troubles(minutes: int) -> dict[str, object]:
    """Drive for `minutes`, each minute with another kind of trouble, and return the trace.

    All random numbers come from a fixed seed.
    """
    world = World(wanted={"state"})
    dice = random.Random(2026)
    trace = 0

    def watch(outputs: Outputs) -> None:
        nonlocal trace
        if outputs.line is not None:
            trace = zlib.crc32(outputs.line, trace)
        for estimate in outputs.estimates:
            trace = zlib.crc32(b"%.6f" % estimate.pose.x, trace)

    world.watch = watch
    for minute in range(minutes):
        start_ns = world.now_ns
        _drive_about(world, dice)
        _trouble(world, minute % 6)
        world.run(60.0 - (world.now_ns - start_ns) / 1e9)
    state = world.state
    return {
        "trace": trace,
        "valid_lines": world.mcu.valid_lines,
        "mode": state.mode,
        "reason": state.reason,
        "x": round(state.x, 6),
        "y": round(state.y, 6),
        "yaw": round(state.yaw, 6),
        "counters": state.counters,
        "events": len(world.events),
    }


def _drive_about(world: World, dice: random.Random) -> None:
    for source in ("nav", "app", "teleop"):
        world.drive(
            dice.uniform(-1.5, 1.5), dice.uniform(-3, 3), dice.uniform(1, 8), source, hz=10.0
        )
    world.send(0.0, source="teleop")
    world.run(1.0)


def _trouble(world: World, kind: int) -> None:
    match kind:
        case 0:
            world.call("stop")
            world.hold(0.5, seconds=1.0)
            world.call("clear")
        case 1:
            world.port.unplug()
            world.hold(0.5, seconds=2.0)
            world.mcu = FakeMcu(world.config, world.now_ns)
            world.port.plug(world.mcu)
        case 2:
            world.mcu.reset(world.now_ns)
            world.hold(0.5, seconds=4.0)
        case 3:
            with world.mcu.noise():
                world.hold(0.5, seconds=2.0)
        case 4:
            world.put("cmd/app", b'{"linear": {"x": 0.5}}')
            world.stall(0.3)
        case 5:
            with world.mcu.mute():
                world.hold(0.5, seconds=0.7)


def ends_as_it_always_did(minutes: int) -> None:
    began = time.perf_counter()
    ended = drive_with_troubles(minutes)
    print(f"\n{minutes} minutes in virtual time: {time.perf_counter() - began:.1f} s; {ended}")
    assert ended == json.loads(GOLDEN.read_text())[f"{minutes} minutes"]


@pytest.mark.slow
def test_a_drive_of_two_minutes_ends_in_the_recorded_state() -> None:
    ends_as_it_always_did(SHORT)


@pytest.mark.slow
@pytest.mark.nightly
def test_a_drive_of_ten_minutes_ends_in_the_recorded_state() -> None:
    ends_as_it_always_did(SLOW)


@pytest.mark.soak
def test_a_drive_of_an_hour_ends_in_the_recorded_state() -> None:
    ends_as_it_always_did(LONG)


if __name__ == "__main__":
    golden = {f"{minutes} minutes": drive_with_troubles(minutes) for minutes in (SHORT, SLOW, LONG)}
    GOLDEN.write_text(json.dumps(golden, indent=2) + "\n")
    print(GOLDEN.read_text())
