"""Measures what lost and damaged lines cost, with a simulated board in virtual time."""

from __future__ import annotations

import math
from contextlib import nullcontext
from pathlib import Path
from typing import Literal

from acsard.core.config.settings import Config, McuConfig, SimConfig
from tests.scenarios.pose_nees import CALIBRATED
from tests.scenarios.world import World
from tests.tools.reference import table

COUNTS = 3200  # of an encoder, per turn

FAULTS: dict[str, tuple[str, int]] = {
    "none": ("", 0),
    "one reply of 20 is lost": ("lost_replies", 20),
    "one reply of 5 is lost": ("lost_replies", 5),
    "one command of 5 is lost": ("lost_commands", 5),
    "a bit flips in one line of 50": ("bit_errors", 50),
    "a bit flips in one line of 7": ("bit_errors", 7),
}


def link(_: Path) -> str:
    """Drive a robot for a minute in virtual time with each fault of the line."""
    return table(
        ("the serial line", "`mcu.link_check`", "replies taken, of lines sent",
         "fastest speed that the board obeys / that acsard sends, rad/s",
         "pose wrong by / its standard deviation, m", "times that the link was given up"),
        [
            (what, check, *_driven(fault, every, check))
            for what, (fault, every) in FAULTS.items()
            for check in ("off", "on")
        ],
    )  # fmt: skip


def _driven(fault: str, every: int, check: Literal["off", "on"]) -> tuple[str, ...]:
    mcu = McuConfig(link_check=check, encoder_counts=COUNTS)
    world = World(Config(mcu=mcu, sim=SimConfig(encoder_counts=COUNTS), odometry=CALIBRATED))
    world.run(1.0)
    world.drive(0.3, seconds=0.5)
    before, obeyed, sent = dict(world.state.counters), 0.0, 0.0

    def watch(_: object) -> None:
        nonlocal obeyed, sent
        speeds = world.loop.robot.speeds
        obeyed = max(obeyed, *map(abs, world.mcu.vehicle.set_points))
        sent = max(sent, *map(abs, speeds.as_tuple()))

    world.watch = watch
    with world.mcu.fault(fault, every) if fault else nullcontext():
        for leg in range(20):
            world.hold(0.3, 0.5 if leg % 2 else -0.4, seconds=3.0)
        world.hold(0.0, seconds=1.0)
    state, cells, true = world.state, world.odom.pose.covariance, world.mcu.vehicle.pose
    gained = {name: count - before.get(name, 0) for name, count in state.counters.items()}
    taken, lines = gained["lines"], gained["lines_sent"]
    lost = sum(event.name in ("link_stale", "link_down") for event in world.events)
    off = math.dist((state.x, state.y), (true.x, true.y))
    return (
        f"{taken / lines:.0%}", f"{obeyed:.1f} / {sent:.1f}",
        f"{off:.2f} / {math.sqrt(cells[0] + cells[7]):.2f}", str(lost),
    )  # fmt: skip
