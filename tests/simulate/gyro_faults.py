"""Plans whose gyro reports wrong rates, and the simulation of these rates.

`acsard/core/motion/gyro.py` describes how the product handles them, and `pose.py` allows its known
limits. A wrong sample counts if it differs by at most 0.5 rad/s from the rate before it. The
product also accepts two similar wrong samples in a row, so no plan contains these.

These plans have separate random generators, so all other plans stay the same.
"""

from __future__ import annotations

import itertools
import random
from typing import Any

from tests.scenarios.imperfect_gyro import ImperfectGyro

Plan = dict[str, Any]

SAMPLE_S = 0.01
"""Interval of the simulated gyro, s."""

HIGHEST = 34.9
"""Highest wrong rate, rad/s, which is 2000 degrees per second, the end of the range of many
gyros."""

APART_S = 0.1
"""Shortest time between two wrong samples, s."""

PASSES = 0.6
"""A wrong sample that differs by at most this from the true one may count, rad/s."""


def add(plan: Plan, kinds: list[str]) -> None:
    """Add the gyro faults of these kinds to a plan whose robot has a gyro."""
    if not plan["config"].get("odometry", {}).get("gyro"):
        return
    if "wrong gyro samples" in kinds:
        _add_wrong_samples(plan, random.Random(f"wrong gyro samples {plan['seed']}"))
    if "hanging gyro" in kinds:
        _add_hangs(plan, random.Random(f"hanging gyro {plan['seed']}"))
    plan["events"].sort(key=lambda event: event["at"])


def _moment(plan: Plan, dice: random.Random) -> float:
    """Return a time, mostly one at which a sender turns the robot or has just stopped it."""
    changes = [p[0] for s in plan["senders"] for p in s["phases"] if p[0] > 1.0]
    if changes and dice.random() < 0.7:
        return float(min(dice.choice(changes) + dice.uniform(-0.5, 2.0), plan["seconds"]))
    return dice.uniform(1.0, plan["seconds"])


def _add_wrong_samples(plan: Plan, dice: random.Random) -> None:
    times: list[float] = []
    for _ in range(1 + int(plan["seconds"] / dice.choice((2.0, 10.0, 30.0)))):
        at = _moment(plan, dice)
        for _ in range(dice.choice((1, 1, 1, 3, 10))):
            if all(abs(at - other) > APART_S for other in times):
                times.append(at)
            at += dice.uniform(1.5 * APART_S, 1.0)
    highest = dice.choice((HIGHEST, HIGHEST, 5.0))
    for at in times:
        rate = dice.choice((highest, dice.uniform(0.0, highest))) * dice.choice((-1, 1))
        fault = ["wrong", round(rate, 3)]
        plan["events"].append({"at": round(at, 3), "do": "gyro", "fault": fault})


def _add_hangs(plan: Plan, dice: random.Random) -> None:
    """Add times in which the gyro repeats its rate, often that of a turn that has just ended."""
    ends = [
        after[0]
        for sender in plan["senders"]
        for before, after in itertools.pairwise(sender["phases"])
        if before[2] and not after[2]
    ]
    at = 0.0
    for _ in range(1 + int(plan["seconds"] / 30)):
        at = max(at + 1.0, _moment(plan, dice))
        if ends and dice.random() < 0.6:
            at = max(1.0, dice.choice(ends) + dice.choice((-2.0, -0.1, 0.1)) * dice.random())
        lasts = round(dice.choice((0.3, 1.5, 4.0, 9.0)) * dice.uniform(0.7, 1.3), 3)
        event = {"at": round(at, 3), "do": "gyro", "for": lasts, "fault": ["hangs"]}
        plan["events"].append(event)


GYRO_BIAS = 0.01
"""Bias of the gyro, rad/s."""


class GyroFaults:
    """The rates that a gyro reports instead of the measured ones."""

    def __init__(self) -> None:
        self.hanging = False
        """The gyro repeats its next rate until this is false again."""
        self.hung: float | None = None
        """The rate that it repeats, rad/s, None while it works."""
        self.spoiled = 0.0
        """Turn that the wrong samples may have added which look like right ones, rad."""
        self._wrong: float | None = None

    def spoil(self, rate: float) -> None:
        """Let the next sample report this rate in rad/s, unless the gyro hangs."""
        self._wrong = rate

    def reported(self, measured: float) -> float:
        """Return the rate that the gyro reports when the true rate is `measured`, both in rad/s."""
        wrong, self._wrong = self._wrong, None
        if not self.hanging:
            self.hung = None
        elif self.hung is None:
            self.hung = measured
        if self.hung is not None:
            return self.hung
        if wrong is None:
            return measured
        if abs(wrong - measured) <= PASSES:
            # It counts for its own interval, and until the next sample it is the present rate.
            self.spoiled += 2.0 * SAMPLE_S * abs(wrong - measured)
        return wrong


class FaultyGyro(ImperfectGyro):
    """The gyro of a plan's robot: it has a bias, noise, a delay of 10 ms, and the plan's faults."""

    def __init__(self, faults: GyroFaults) -> None:
        super().__init__(bias=GYRO_BIAS, noise=0.005, late=1)
        self._faults = faults

    def rate(self, true: float) -> float:
        return self._faults.reported(super().rate(true))
