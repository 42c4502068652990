"""A sweep over faults of wheels: how wrong and how certain the pose is, from the fault on.

`python -m tests.scenarios.pose_faults [NAME]` prints each case whose NEES exceeds 6, unsaid.
"""

from __future__ import annotations

import math
import sys
from collections.abc import Iterator
from contextlib import ExitStack
from functools import partial
from itertools import product
from multiprocessing import Pool

import numpy as np
from msgspec import Struct
from msgspec.structs import replace

from acsard.core.config.settings import Config, McuConfig, SimConfig, WheelMap
from acsard.core.simulator.fake_mcu import FakeMcu
from tests.scenarios.imperfect_gyro import ImperfectGyro
from tests.scenarios.pose_nees import CALIBRATED
from tests.scenarios.world import World
from tests.unit.nees import nees
from tests.wheels import FOUR, MAPS

ENCODERS = {
    "dead encoder": 0.0, "half": 0.5, "a fifth too slow": 0.8, "a fifth too fast": 1.2,
    "1.5 times": 1.5, "twice": 2.0, "reversed encoder": -1.0,
}  # fmt: skip
"""By which factor the board multiplies speeds and counts."""

MOTORS = {"dead motor": 0.0, "weak motor": 0.7, "strong motor": 1.5, "reversed motor": -1.0}
"""By which factor the motor obeys."""

OTHERS = "frozen encoder", "runaway motor", "swapped motors", "swapped encoders"

DRIVES = {
    "straight": [(0.4, 0.0)], "back": [(-0.3, 0.0)], "turning": [(0.3, 0.8)],
    "on the spot": [(0.0, 1.2)], "to and fro": [(0.4, 0.0), (-0.4, 0.0)],
    "stop and go": [(0.4, 0.3), (0.0, 0.0)], "slalom": [(0.4, 0.8), (0.4, -0.8)],
    "one side stands": [(0.15, 1.0)],
}  # fmt: skip
"""Commands of a second each, in turn."""

LEAD_S, FAULT_S, REST_S = 3, 6, 2


class Case(Struct, frozen=True):
    fault: str
    which: str
    """The wheel, or `right` or `all`."""
    drive: str
    wheels: WheelMap = FOUR
    gyro: bool = False
    counts: int = 3200
    declared: bool = True
    checked: bool = False
    silence: float = 0.0
    """In each second, s; the daemon stalls in it, unless the board is `mute`."""
    mute: bool = False

    @property
    def name(self) -> str:
        sensors = f"{self.counts} counts" + " not declared" * (not self.declared)
        sensors += ", gyro" * self.gyro + ", checked" * self.checked
        if self.silence:
            sensors += f", {'mute' if self.mute else 'stalled'} {self.silence} s"
        return (
            f"{len(self.wheels.names)} wheels, {sensors}: {self.fault}, {self.which}, {self.drive}"
        )


class Result(Struct, frozen=True):
    nees: float
    """The largest."""
    at: float
    """When, in s since the fault began."""
    unsaid: float
    """The largest while `state` said nothing of the pose."""
    error: tuple[float, float]
    """m and rad, at that time."""
    deviation: tuple[float, float]
    mode: str
    doubt: str
    wheel_fault: str


def cases() -> Iterator[Case]:
    """Return all cases, those of four wheels first."""
    for wheels, drive, gyro in product(MAPS, DRIVES, (False, True)):
        names = wheels.names
        one = names[-1]
        for fault in (*ENCODERS, *MOTORS, *OTHERS):
            if fault.startswith("swapped"):
                groups = [f"{names[0]} {names[1]}"]
            else:
                groups = [one, "left", "all"] if len(names) == 4 else [one, "all"]
            for which in groups:
                yield Case(fault, which, drive, wheels, gyro)
    encoders = product(MAPS, DRIVES, ENCODERS, ((3200, False), (64, False), (20, True)))
    for wheels, drive, fault, (counts, declared) in encoders:
        for which in ("left", "all"):
            yield Case(fault, which, drive, wheels, counts=counts, declared=declared)
    silences = product(MAPS, DRIVES, ENCODERS, (0.3, 0.6), (False, True), (False, True))
    for wheels, drive, fault, silence, mute, checked in silences:
        for which in ("left", "all"):
            yield Case(
                fault, which, drive, wheels, checked=checked, silence=silence, mute=mute,
            )  # fmt: skip


def motors(case: Case) -> list[int]:
    named = zip(case.wheels.names, case.wheels.motors, strict=True)
    return [
        case.wheels.letters.index(motor[1])
        for name, motor in named
        if case.which == "all" or case.which in name or name in case.which.split()
    ]


def run_away(mcu: FakeMcu, places: list[int]) -> None:
    """Let these wheels keep their set points, whatever the board commands."""
    vehicle = mcu.vehicle
    kept = {place: vehicle.set_points[place] for place in places}

    def advance(dt: float, push: float | None = None) -> None:
        for place, speed in kept.items():
            kept[place] = speed = speed or vehicle.set_points[place]
            vehicle.set_points[place] = speed
        type(vehicle).advance(vehicle, dt, push)

    vars(vehicle)["advance"] = advance


def begin(world: World, case: Case, stack: ExitStack) -> None:
    mcu, which, switches = world.mcu, motors(case), world.mcu.switches
    if case.fault in ENCODERS:
        gains = [ENCODERS[case.fault] if n in which else 1.0 for n in range(len(switches.gains))]
        stack.enter_context(mcu.switched(partial(replace, gains=tuple(gains))))
    elif case.fault in MOTORS:
        drives = [MOTORS[case.fault] if n in which else 1.0 for n in range(len(switches.drives))]
        stack.enter_context(mcu.switched(partial(replace, drives=tuple(drives))))
    elif case.fault == "frozen encoder":
        speeds, kept = mcu._speeds, list(mcu._measured)

        def frozen(now_ns: int) -> list[float]:
            return [kept[n] if n in which else v for n, v in enumerate(speeds(now_ns))]

        mcu._speeds = frozen  # type: ignore[method-assign]
    elif case.fault == "runaway motor":
        run_away(mcu, [place for n in which for place in mcu._wiring[n][0]])
    else:
        one, other = which
        stack.enter_context(mcu.fault(case.fault.replace(" ", "_"), one, other))


def run(case: Case) -> Result:
    settings = McuConfig(
        wheels=case.wheels, encoder_counts=case.counts * case.declared,
        link_check="on" if case.checked else "off",
    )  # fmt: skip
    odometry = replace(CALIBRATED, gyro=case.gyro)
    config = Config(mcu=settings, odometry=odometry, sim=SimConfig(encoder_counts=case.counts))
    world = World(config, gyro=ImperfectGyro(bias=0.01, noise=0.005) if case.gyro else None)
    mcu = world.mcu
    world.run(1.5)
    world.drive(0.2, 0.3, 0.5)
    steps = DRIVES[case.drive]
    worst = Result(0.0, 0.0, 0.0, (0.0, 0.0), (0.0, 0.0), "", "", "")
    unsaid, since = 0.0, 0.0

    def look() -> None:
        nonlocal worst, unsaid
        value, error, deviation = judged(world)
        state = world.state
        if not state.pose_doubt:
            unsaid = max(unsaid, value)
        if value > worst.nees:
            worst = Result(
                value, since, 0.0, error, deviation, state.mode, state.pose_doubt, state.wheel_fault
            )

    with ExitStack() as stack:
        for second in range(LEAD_S + FAULT_S):
            if second == LEAD_S:
                begin(world, case, stack)
            speed = steps[second % len(steps)]
            if case.mute:
                with mcu.fault("mute"):
                    world.hold(*speed, seconds=case.silence)
            elif case.silence:
                world.stall(case.silence)
            for _ in range(10):
                world.hold(*speed, seconds=0.1)
                if second >= LEAD_S:
                    since += 0.1
                    look()
        for _ in range(10 * REST_S):
            world.hold(0.0, 0.0, 0.1)
            since += 0.1
            look()
    return replace(worst, unsaid=unsaid)


def judged(world: World) -> tuple[float, tuple[float, float], tuple[float, float]]:
    odom, true = world.odom, world.mcu.vehicle.pose
    cells, state = odom.pose.covariance, world.state
    picked = [cells[k] for k in (0, 1, 5, 6, 7, 11, 30, 31, 35)]
    pose = np.array([odom.pose.pose.position.x, odom.pose.pose.position.y, odom.yaw])
    # The newest sample is up to 50 ms older than the true pose.
    slack = np.diag([0.02**2, 0.02**2, 0.04**2])
    covariance = np.array(picked).reshape(3, 3) + slack
    value = float(nees(pose, covariance, np.array([[true.x], [true.y], [true.yaw]]))[0])
    off = math.dist(pose[:2], (true.x, true.y)), abs(math.remainder(pose[2] - true.yaw, math.tau))
    assert state is not None
    return value, off, (math.sqrt(cells[0] + cells[7]), math.sqrt(cells[35]))


def main(name: str) -> None:
    chosen = [case for case in cases() if name in case.name]
    found = 0
    with Pool(2) as pool:
        for case, result in zip(chosen, pool.imap(run, chosen, 4), strict=True):
            if result.unsaid > 6.0:
                found += 1
                (off, yaw), (sd, yaw_sd) = result.error, result.deviation
                print(
                    f"{case.name:75} NEES {result.nees:7.1f} unsaid {result.unsaid:7.1f} at "
                    f"{result.at:.1f} s: {off:.2f} m ({sd:.2f}), {yaw:.2f} rad ({yaw_sd:.2f}) "
                    f"{result.mode} {result.doubt} | {result.wheel_fault[:70]}",
                    flush=True,
                )
    print(f"{found} of {len(chosen)} cases are beyond 6, unsaid")


if __name__ == "__main__":
    main(sys.argv[1] if len(sys.argv) > 1 else "")
