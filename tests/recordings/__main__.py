"""Rewrite the recordings after an intended change of the robot's behaviour.

Give the reason for the change in the commit.
"""

from __future__ import annotations

from pathlib import Path

from msgspec.structs import replace

from acsard.core.config.settings import Config
from acsard.recording.file import SUFFIX
from tests.scenarios.taped import Tape, drive_through_faults
from tests.scenarios.world import World

HERE = Path(__file__).parent

PLAIN = Config()
CHECKED = replace(
    PLAIN,
    mcu=replace(PLAIN.mcu, link_check="on", encoder_counts=3200),
    odometry=replace(PLAIN.odometry, gyro=True),
)


def quiet(world: World) -> None:
    """Drive without faults: two clients command the robot, and one stops and clears it."""
    world.drive(0.5, 0.3, 2.0, source="nav")
    world.drive(0.3, -0.8, 2.0, source="teleop")
    world.call("stop")
    world.run(2.0)  # a clear that names no latch is refused for 2 s
    world.call("clear")
    world.drive(-0.4, 0.0, 1.0)
    world.loop.shutting_down = True
    world.run(0.7)


def stuck(world: World) -> None:
    """Stop a wheel's encoder. The pose leaves this wheel out, and it is reported as blocked."""
    world.drive(0.5, 0.0, 1.0)
    with world.mcu.fault("stuck_encoder", 0):
        world.hold(0.5, 0.4, seconds=3.0)


def faults(world: World) -> None:
    """Run through the first dozen faults of the simulator, half a second each."""
    drive_through_faults(world, 12.0)


DRIVES = (
    ("quiet", PLAIN, quiet),
    ("stuck", PLAIN, stuck),
    ("faults", PLAIN, faults),
    ("checked", CHECKED, quiet),
)


def main() -> None:
    for name, config, drive in DRIVES:
        tape = Tape()
        world = World(config, recorder=tape)
        drive(world)
        path = tape.save(HERE / f"{name}{SUFFIX}", config)
        print(f"{path.name}: {path.stat().st_size} bytes, {len(tape.taken)} steps")


if __name__ == "__main__":
    main()
