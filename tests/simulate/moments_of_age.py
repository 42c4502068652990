"""Adds senders whose commands arrive late to some plans, or whose clocks are slewed.

The commands wait in a queue that exists before the first of them, or that begins in a pause of the
sender, or the sender is silent for so long that it must send a zero again. Stamps cannot show this.
Other programs come and go, and fill the tables of clocks. `bad_moments.py` says
what a moment is.
"""

from __future__ import annotations

import math
import random
from typing import Any

Plan = dict[str, Any]
Sender = dict[str, Any]

STAMPED = ("client", "client", "page", "signed", "rmw", "header")
"""Ways whose commands have an echo or a stamp."""

SILENCE_S = 10.0
"""A sender without a command for this time is disarmed."""

HOUR_S = 3700.0


def speeds(dice: random.Random) -> list[float]:
    """Return a random linear speed in m/s and an angular one in rad/s, which is often zero."""
    turn = dice.choice((0.0, round(dice.uniform(-2.0, 2.0), 3)))
    return [dice.choice((-1, 1)) * round(dice.uniform(0.1, 1.0), 3), turn]


def queued(plan: Plan, dice: random.Random, driver: Sender) -> None:
    """Let each command of some senders wait equally long, from the first one on."""
    driver |= {"way": dice.choice((*STAMPED, "bridge")), "phases": _stop_and_go(plan, dice, 0.0)}
    late = round(dice.choice((0.2, 0.4, 1.0, 3.0, 8.0)) * dice.uniform(0.9, 1.3), 3)
    end = dice.choice((plan["seconds"] + 1.0, round(dice.uniform(10.0, 30.0), 3)))
    driver["congestion"] = [[0.0, end, "jump", late]]
    if dice.random() < 0.5:  # the beats reach it at once, or wait as its commands do
        driver["both_ways"] = True


def plateau(plan: Plan, dice: random.Random, driver: Sender) -> None:
    """Let a delay begin in a pause of the sender, and stay until another pause."""
    way = dice.choice(STAMPED)
    phases: list[list[Any]] = []
    congestion: list[list[Any]] = []
    at = 0.0
    while at < plan["seconds"]:
        phases += _drive(dice, at)
        at += dice.uniform(5.0, 9.0)
        pause = dice.choice((0.6, 2.2, 4.0, 9.0, 12.0))
        phases.append([round(at, 3), None, None])
        at += pause
        phases += _drive(dice, at)
        lasts = dice.uniform(5.0, 9.0)
        late = round(dice.choice((0.3, 0.6, 1.0, 3.0, 8.0)) * dice.uniform(0.9, 1.3), 3)
        begin = round(at - pause * dice.uniform(0.1, 0.9), 3)
        congestion.append([begin, round(at + lasts, 3), "jump", late])
        at += lasts
        phases.append([round(at, 3), None, None])
        at += dice.choice((0.6, 2.2, 4.0))
    driver |= {"way": way, "phases": phases, "congestion": congestion}


def silence(plan: Plan, dice: random.Random, driver: Sender) -> None:
    """Let an armed sender be silent for about the time that disarms it, and then send a speed."""
    driver["way"] = dice.choice((*STAMPED, "plain", "bridge"))
    hour = dice.random() < 0.02
    if hour:  # at another rate it takes too long
        plan["config"]["control"]["rate"] = 10.0
        for source in plan["config"]["commands"]["sources"]:
            source["timeout"] = max(0.25, source["timeout"])
        driver["hz"] = 10.0
    phases: list[list[Any]] = []
    at = 0.0
    while at < plan["seconds"]:
        phases += _drive(dice, at)
        at += dice.uniform(3.0, 6.0)
        phases.append([round(at, 3), None, None])
        at += HOUR_S if hour else dice.choice((0.7, 0.9, 1.1, 1.2, 1.5)) * SILENCE_S
        phases.append([round(at, 3), *speeds(dice)])
        if hour:
            plan["seconds"] = round(at + 10.0, 1)
            driver["to"] = plan["seconds"]
            break
        at += dice.uniform(2.0, 4.0)
    driver["phases"] = phases


def slewed(plan: Plan, dice: random.Random, driver: Sender) -> None:
    """Slew the clock of a sender that stamps its commands, by 0.1 to 8 %, back and forward.

    In half of the plans no stamp is later than the first ones by more than a part of the timeout,
    so the sender drives on.
    """
    timeout = _timeout(plan, driver)
    driver |= {"way": dice.choice(("rmw", "rmw", "signed", "header", "zenoh")), "drift": 0.0}
    driver["ahead"] = round(dice.uniform(-0.4, 0.0), 3)
    even, at, offset = dice.random() < 0.5, dice.uniform(4.0, 10.0), 0.0
    while at < plan["seconds"] - 4.0:
        by = dice.choice((-1, 1)) * dice.choice((0.1, 0.2, 0.3, 0.5, 1.0, 3.0))
        if even:
            by = dice.uniform(-0.5, 0.3) * timeout - offset
        rate = 0.001 * 80.0 ** dice.random()
        lasts = min(abs(by) / rate, 40.0)
        rate = math.copysign(rate, by)
        offset += rate * lasts
        driver["clock"].append(["slew", round(at, 3), round(at + lasts, 3), round(rate, 6)])
        at += lasts + dice.uniform(1.0, 15.0)
    if even:
        driver["even"] = True


def publishers(plan: Plan, dice: random.Random, driver: Sender) -> None:
    """Let up to 20 programs come and go on the source of one that waits behind a queue.

    The daemon knows its clock from before the queue. At the end one more program comes, which is
    prompt, and drives.
    """
    timeout = _timeout(plan, driver)
    begin = dice.uniform(6.0, 9.0) + max(0.0, timeout - 3.0)
    plan["seconds"] = max(plan["seconds"], 60.0 + 2.0 * max(0.0, timeout - 3.0))
    late = round(timeout + dice.choice((0.3, 1.0, 3.0, 8.0)), 3)
    driver |= {
        "way": dice.choice(("rmw", "rmw", "signed")), "refused": True, "hz": 20.0,
        "phases": _stop_and_go(plan, dice, 0.0),
        "congestion": [[round(begin, 3), plan["seconds"] + 1.0, "jump", late]],
    }  # fmt: skip
    usual = driver | {"congestion": [], "hz": dice.choice((20.0, 50.0))}
    del usual["refused"]
    at = begin + dice.uniform(2.0, 4.0)

    def add(at: float, end: float, phases: list[list[Any]]) -> dict[str, Any]:
        number = len(plan["senders"])
        own = {
            "name": f"s{number}", "id": f"s{number}/{dice.getrandbits(64):016x}",
            "from": round(at, 3), "to": round(end, 3), "phases": phases,
            "way": dice.choice(("rmw", "rmw", "signed")),
        }  # fmt: skip
        program: Sender = usual | own
        plan["senders"].append(program)
        return program

    # In most plans, all are there for long enough to have their clocks proven.
    longer = dice.choice(((timeout,), (timeout,), (0.0, timeout)))
    for _ in range(dice.choice((8, 15, 17, 20, 20))):
        zeros = dice.choice((0.1, 0.4, 0.8, 5.0))
        add(at, at + dice.uniform(0.4, 1.5) + dice.choice(longer), [
            [round(at, 3), 0.0, 0.0], [round(at + zeros, 3), *speeds(dice)],
        ])  # fmt: skip
        at += dice.uniform(0.3, 1.2)
    at += 2.0 + timeout
    phases: list[list[Any]] = []
    last = add(at, plan["seconds"], phases)
    last["even"] = True
    while at < plan["seconds"]:
        phases += [[round(at, 3), 0.0, 0.0], [round(at + 2.5, 3), *speeds(dice)]]
        at += dice.uniform(6.0, 9.0)


def _timeout(plan: Plan, sender: Sender) -> float:
    sources = plan["config"]["commands"]["sources"]
    (timeout,) = (s["timeout"] for s in sources if s["name"] == sender["source"])
    return float(timeout)


def _drive(dice: random.Random, at: float) -> list[list[Any]]:
    """Return phases that begin with a zero and go on with a speed."""
    rests = dice.choice((0.3, 0.6, 1.3))
    return [[round(at, 3), 0.0, 0.0], [round(at + rests, 3), *speeds(dice)]]


def _stop_and_go(plan: Plan, dice: random.Random, at: float) -> list[list[Any]]:
    phases: list[list[Any]] = []
    while at < plan["seconds"]:
        phases += _drive(dice, at)
        at += dice.uniform(2.0, 6.0)
    return phases
