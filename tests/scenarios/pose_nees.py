"""NEES of the pose of robots with drawn errors, one row for each thing that may go wrong.

`python -m tests.scenarios.pose_nees [SEEDS [NAME]]` prints the rows of this name, or all, with four
wheels and with two. NEES is that of `tests/unit/nees.py`, and 3 if errors and covariance agree.
"""

from __future__ import annotations

import math
import random
import sys
from collections.abc import Callable
from contextlib import AbstractContextManager, nullcontext
from itertools import product
from multiprocessing import Pool

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from acsard.core.config.settings import Config, McuConfig, OdometryConfig, SimConfig, WheelMap
from tests.scenarios.boards import blocks, reports_its_last_instant, turn_encoders
from tests.scenarios.imperfect_gyro import ImperfectGyro
from tests.scenarios.world import World
from tests.unit.nees import nees
from tests.wheels import MAPS

CALIBRATED = OdometryConfig(
    wheel_separation_multiplier_std=0.02, wheel_radius_ratio_std=0.003, distance_scale_std=0.003,
    distance_variance_per_metre=2e-5, yaw_variance_per_metre=1e-5, yaw_variance_per_radian=7e-4,
    gyro_scale_std=0.004,
)  # fmt: skip
"""The robots have its errors that do not average out, and its noise of turns."""

SLIP_STD = 0.035
"""Of the share of a turn that is lost in a second: the above at about 0.5 rad/s."""

FAULT_S = 8.0
"""In the drive, until a fault begins that not the whole drive has."""


class Row(Struct, frozen=True):
    """A kind of robot; `begin` prepares it, and `disturb` acts in each second of the drive."""

    mcu: McuConfig = McuConfig()
    counts: int = 3200
    odometry: OdometryConfig = CALIBRATED
    begin: Callable[[World], object] = lambda world: None
    disturb: Callable[[World, float], object] = lambda world, second: None
    fault: Callable[[World], AbstractContextManager[None]] = lambda world: nullcontext()
    seconds: float = 24.0


class Result(Struct, frozen=True):
    nees: float
    distance: float
    """Error, in deviations."""
    heading: float
    doubts: frozenset[str]


def drawn(row: Row, seed: int, wheels: WheelMap) -> World:
    """Return a robot whose true track and radii differ from the configuration as it declares."""
    dice, mcu = random.Random(seed), replace(row.mcu, wheels=wheels)
    config = Config(mcu=mcu, sim=SimConfig(encoder_counts=row.counts), odometry=row.odometry)
    gyro = ImperfectGyro(
        bias=0.01, noise=0.005, share=1.0 + dice.gauss(0.0, row.odometry.gyro_scale_std)
    )
    world = World(config, gyro=gyro if row.odometry.gyro else None)
    vehicle, declared = world.mcu.vehicle, row.odometry
    ratio = dice.gauss(0.0, declared.wheel_radius_ratio_std)
    size = 1.0 + dice.gauss(0.0, declared.distance_scale_std)
    vehicle._left_radius *= size * (1.0 - ratio / 2.0)
    vehicle._right_radius *= size * (1.0 + ratio / 2.0)
    # The declared deviation is of the multiplier by which the configuration is too small.
    vehicle._track *= max(0.4, 1.0 + dice.gauss(0.0, declared.track_std(len(wheels.names))))
    right, left, *rear = [dice.uniform(0.0, 0.5) for _ in range(4)]
    turn_encoders(world.mcu, [right, left, *((left, right) if wheels.left else rear)])
    return world


def run(row: Row, seed: int, wheels: WheelMap) -> Result:
    """Drive a robot at random, and compare its pose with the true one."""
    world, dice, doubts = drawn(row, seed, wheels), random.Random(seed + 1000), set[str]()
    begun = world.mcu.vehicle.pose
    row.begin(world)
    world.run(1.5)
    world.drive(0.2, 0.3, 0.5)
    second = 0.0
    with row.fault(world):
        while second < row.seconds:
            seconds = dice.choice((1.0, 2.0, 3.0))
            stops = dice.random() < 0.15
            speed = 0.0 if stops else dice.uniform(-0.3, 0.7), 0.0 if stops else dice.uniform(-1, 1)
            for _ in range(round(seconds)):
                world.mcu.vehicle.turn_slip = dice.gauss(0.0, SLIP_STD)
                row.disturb(world, second)
                world.hold(*speed, seconds=1.0)
                doubts.add(world.state.pose_doubt)
                second += 1.0
        world.hold(0.0, 0.0, 1.5)
    world.run(1.0)
    doubts.add(world.state.pose_doubt)
    state, cells, true = world.state, world.odom.pose.covariance, world.mcu.vehicle.pose
    picked = [cells[k] for k in (0, 1, 5, 6, 7, 11, 30, 31, 35)]
    covariance = np.array(picked).reshape(3, 3)
    pose = np.array([state.x, state.y, state.yaw])
    end = np.array([[true.x - begun.x], [true.y - begun.y], [true.yaw]])
    far = math.dist((state.x, state.y), (true.x, true.y)) / math.sqrt(cells[0] + cells[7])
    turned = abs(math.remainder(state.yaw - true.yaw, math.tau)) / math.sqrt(cells[35])
    return Result(float(nees(pose, covariance, end)[0]), far, turned, frozenset(doubts - {""}))


CHECKED = McuConfig(link_check="on", encoder_counts=3200)
DEFAULTS = OdometryConfig()
GYRO = replace(CALIBRATED, gyro=True)


def free(period: float) -> Callable[[World], AbstractContextManager[None]]:
    return lambda world: world.mcu.fault("free_running", period)


def stalls(seconds: float, every: int = 1) -> Callable[[World, float], object]:
    return lambda world, second: None if second % every else world.stall(seconds)


def at(begin: float, act: Callable[[World], object]) -> Callable[[World, float], object]:
    return lambda world, second: act(world) if second == begin else None


def reverse_left(world: World) -> None:
    signs = tuple(-1 if n in (0, 1) else 1 for n in range(len(world.mcu.switches.encoder_signs)))
    world.mcu.switches.encoder_signs = signs


def freeze(world: World) -> None:
    world.mcu.switches.frozen = 1


def overflow(world: World) -> None:
    """Let the firmware's field for a speed hold less than 10 rad/s, as a signed number."""
    speeds = world.mcu._speeds

    def wrapped(now_ns: int) -> list[float]:
        return [(speed + 10.0) % 20.0 - 10.0 for speed in speeds(now_ns)]

    world.mcu._speeds = wrapped  # type: ignore[method-assign]


def pushed_away(world: World) -> None:
    """Pull the cable for 8 s, in which a person pushes the robot for 2 s."""
    mcu = world.mcu
    world.hold(0.0, 0.0, 1.5)
    world.port.unplug()
    with mcu.fault("pushed", 0.6):
        world.run(2.0)
        mcu.advance(world.now_ns)
    world.run(6.0)
    world.port.plug(mcu)
    world.run(1.0)


def lose(world: World) -> None:
    world.mcu.switches.lose_reply = 20


def biased(world: World) -> None:
    assert world.gyro is not None
    world.gyro.bias = 0.06


def biased_side(world: World) -> AbstractContextManager[None]:
    return world.mcu.fault("bias", 1, 1.5)


ROWS = {
    "prompted, 3200 counts": Row(),
    "prompted, 3200 counts, stalled": Row(disturb=stalls(0.15)),
    "prompted, 20 counts": Row(McuConfig(encoder_counts=20), 20),
    "prompted, 20 counts, stalled": Row(McuConfig(encoder_counts=20), 20, disturb=stalls(0.15)),
    "free-running, 3200 counts": Row(McuConfig(reply_period=0.01), fault=free(0.01)),
    "free-running, 3200 counts, stalled": Row(
        McuConfig(reply_period=0.01), disturb=stalls(0.15), fault=free(0.01)
    ),
    "free-running, 10 Hz, 20 unknown counts": Row(McuConfig(reply_period=0.1), 20, fault=free(0.1)),
    "checked, 3200 counts": Row(CHECKED),
    "checked, 20 counts, lost, stalled": Row(
        replace(CHECKED, encoder_counts=20), 20, begin=lose, disturb=stalls(0.15)
    ),
    "prompted, 3200 counts, 5 % lost": Row(begin=lose),
    "prompted, 20 counts, 5 % lost": Row(McuConfig(encoder_counts=20), 20, begin=lose),
    "last instant, stalled 0.4 s": Row(
        begin=lambda world: reports_its_last_instant(world.mcu), disturb=stalls(0.4, 5)
    ),
    "last instant, stalled 0.15 s": Row(
        begin=lambda world: reports_its_last_instant(world.mcu), disturb=stalls(0.15)
    ),
    "blocked 80 ms twice a second": Row(begin=lambda world: blocks(world.mcu, 0.5, 0.08)),
    "counts 7 % too large": Row(replace(CHECKED, encoder_counts=2990)),
    "counts 15 % too small": Row(replace(CHECKED, encoder_counts=3680)),
    "left encoders reversed": Row(disturb=at(FAULT_S, reverse_left)),
    "a wheel 1.5 times too fast": Row(fault=biased_side),
    "a wheel keeps its last speed": Row(disturb=at(FAULT_S, freeze)),
    "the speed field overflows": Row(begin=overflow),
    "pushed without its cable": Row(CHECKED, disturb=at(FAULT_S, pushed_away)),
    "gyro": Row(odometry=GYRO),
    "gyro, its bias steps": Row(odometry=GYRO, disturb=at(FAULT_S, biased)),
    "not calibrated": Row(odometry=DEFAULTS),
    "not calibrated, 20 unknown counts": Row(counts=20, odometry=DEFAULTS),
    "not calibrated, gyro": Row(odometry=replace(DEFAULTS, gyro=True)),
}


def run_of(case: tuple[str, int, WheelMap]) -> Result:
    name, seed, wheels = case
    return run(ROWS[name], seed, wheels)


def main(seeds: int, chosen: str) -> None:
    with Pool(2) as pool:
        for name, wheels in product([name for name in ROWS if chosen in name], MAPS):
            results = pool.map(run_of, [(name, 7000 + seed, wheels) for seed in range(seeds)])
            values = [result.nees for result in results]
            quiet = [result.nees for result in results if not result.doubts]
            print(
                f"{name:40} {len(wheels.names)} wheels: NEES {np.mean(values):6.2f}, "
                f"median {np.median(values):5.2f}, most {max(values):6.2f}, unsaid "
                f"{max(quiet, default=0.0):6.2f}; largest {max(r.distance for r in results):4.1f} "
                f"and {max(r.heading for r in results):4.1f} sigma; "
                f"{sorted(set().union(*[r.doubts for r in results]))}",
                flush=True,
            )


if __name__ == "__main__":
    words = sys.argv[1:]
    main(int(words[0]) if words else 20, words[1] if len(words) > 1 else "")
