"""What a calibration says of logs with planted faults.

`python -m tests.unit.planted_logs [SEEDS [FIRST]]` prints a row for each fault and the sensors that
show it, and one for each kind of sound log. Each seed is another random drive of 80 s by a robot
with a track of 1 or 1.5 wheel separations. No fault is written or agrees, in 80 % the cause is
named, and all sound logs are accepted, or the exit code is 1.
"""

from __future__ import annotations

import sys
from collections import Counter

import numpy as np

from acsard.calibration.log import LogError, read
from acsard.calibration.result import calibrate
from acsard.core.config.settings import Config, DriveConfig
from tests.unit.calibration_bags import TRACK, motion
from tests.unit.calibration_faults import FAULTS, NOT_SHOWN, SENSORS, csv, named, planted, sound
from tests.unit.calibration_robots import wander

SHARE = 0.8
SKIDS = 1.0, TRACK  # effective track / wheel separation


def outcome(data: bytes, seed: int, fault: str = "") -> str:
    """Return "named", "refused", "agrees" or "written"; for a sound log, "right" or "wrong"."""
    skid = SKIDS[seed % 2]
    config = Config(
        drive=DriveConfig(wheel_separation=DriveConfig().wheel_separation * TRACK / skid)
    )
    try:
        found = calibrate(read(data), config, "drive.csv")
    except LogError as error:
        text = str(error)
        return (
            "agrees" if "agrees" in text else "named" if fault and named(fault, text) else "refused"
        )
    if fault:
        return "written"
    track, left, right = found.found.values()
    truth = np.array([skid / 1.005, 1.01])
    off = np.array([2 * track / (left + right), right / left]) / truth - 1
    kept = not any("left out" in note for note in found.notes)
    return "right" if kept and np.all(np.abs(off) < 0.015) else "wrong"


def log(fault: str, way: str, seed: int) -> bytes:
    drive = motion(wander(np.random.default_rng(seed), 80.0))
    return planted(fault, way, seed, drive) if fault else csv(sound(seed, SENSORS[way], drive))


def main(count: int = 10, first: int = 0) -> int:
    bad = 0
    print("| sensors | fault | outcomes |\n|---|---|---|")
    rows = [(way, fault) for way in SENSORS for fault in ("", *FAULTS)]
    for way, fault in [row for row in rows if row[1] not in NOT_SHOWN[row[0]]]:
        seeds = range(first, first + count)
        outcomes = Counter(outcome(log(fault, way, seed), seed, fault) for seed in seeds)
        words = ", ".join(f"{n} {word}" for word, n in outcomes.most_common())
        good = outcomes["named"] >= SHARE * count if fault else outcomes["right"] == count
        fails = not good or bool(outcomes["written"] + outcomes["agrees"])
        bad += fails
        print(
            f"| {way} | {fault or 'none'} | {words}{' **beyond the bound**' * fails} |", flush=True
        )
    return int(bad > 0)


if __name__ == "__main__":
    sys.exit(main(*map(int, sys.argv[1:])))
