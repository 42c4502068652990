"""Plans whose events meet in a way that chance seldom gives.

A part of the plans has one of the moments in `MOMENTS`. Such a plan keeps its configuration, but
has senders and events of its own, so that nothing else hides what the moment shows. Each moment has
dice of its own, so the other plans stay as they are.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

Plan = dict[str, Any]
Event = dict[str, Any]

PLACES = ("front", "rear")
"""Bumpers from which a robot may drive away."""

CALL: Event = {
    "do": "call", "late": 0.01, "lost": False, "twice": False, "by": "op9", "via": "native",
}  # fmt: skip


def add(plan: Plan) -> None:
    """Give some plans a moment."""
    for name, (share, give) in MOMENTS.items():
        dice = random.Random(f"a moment {name} {plan['seed']}")
        if dice.random() < share:
            plan["moment"] = name
            give(plan, dice)
            plan["events"].sort(key=lambda one: one["at"])
            return


def removed(plan: Plan) -> Plan:
    """Return the plan without the faults that an older simulated board does not know."""
    return plan | {
        "board": [fault for fault in plan["board"] if fault[0] not in NEW],
        "events": [
            event
            for event in plan["events"]
            if event["do"] not in NEW and event.get("fault", [""])[0] not in NEW
        ],
    }


NEW: frozenset[str] = frozenset()
"""Events and faults of the board that only these plans have."""


def _best(plan: Plan) -> dict[str, Any]:
    """Return the source of the highest priority."""
    sources: list[dict[str, Any]] = plan["config"]["commands"]["sources"]
    return max(sources, key=lambda one: one["priority"])


def _driver(plan: Plan, source: dict[str, Any], **more: Any) -> dict[str, Any]:
    """Return the first sender of the plan, on a good network and with nothing odd."""
    usual = {
        "source": source["name"], "wheels": False, "from": 0.0, "to": plan["seconds"],
        "delay": 0.001, "jitter": 0.0, "congestion": [], "clock": [], "bursts": [],
        "bad_stamps": 0.0, "junk": 0.0, "churn": False, "loss": 0.0, "twice": 0.0, "swap": 0.0,
    }  # fmt: skip
    first: dict[str, Any] = plan["senders"][0]
    return first | usual | more


def _speed(dice: random.Random) -> list[float]:
    """Return a speed, and often a turn rate."""
    turn = dice.choice((0.0, round(dice.uniform(-2.0, 2.0), 3)))
    return [dice.choice((-1, 1)) * round(dice.uniform(0.1, 1.0), 3), turn]


def _call(at: float, verb: str, **more: Any) -> Event:
    return {"at": round(at, 4), "verb": verb, **CALL, **more}


def _late_step(plan: Plan, dice: random.Random) -> None:
    """Let one step, which comes late, read a call, a zero and an event that asks for a zero.

    The call releases a latch or changes a timeout. They come in any order, a few ms apart. The
    sender has sent speeds before, sends that one zero, and goes on with speeds.
    """
    config, source = plan["config"], _best(plan)
    config["control"].pop("auto_activate", None)
    config["commands"]["neutral_first"] = True
    safety = config.setdefault("safety", {})
    if "bumpers" not in safety and dice.random() < 0.5:
        safety.update(bumpers=[dice.choice(PLACES) for _ in range(2)], bumper="away")
        plan["board"].append(["bumpers"])
    away, events = safety.get("bumper") == "away", []
    hz = 50.0 if source["timeout"] < 0.2 else 20.0
    rests_s = config["commands"].get("neutral_pause", 1.0) + 0.3
    phases, at = [[0.0, 0.0, 0.0], [rests_s, *_speed(dice)]], rests_s + 4.0
    while at < plan["seconds"] - rests_s - 4.0:
        at = round(round(at * hz) / hz, 3)
        phases += [
            [round(at - 0.2 / hz, 4), 0.0, 0.0],
            [round(at + 0.8 / hz, 4), *_speed(dice)],
            [round(at + 2.0, 3), 0.0, 0.0],
            [round(at + 2.0 + rests_s, 3), *_speed(dice)],
        ]
        events += _meeting(dice, round(at - 0.004, 4), source["name"], away)
        at += rests_s + dice.uniform(6.0, 8.0)
    way = dice.choice(("client", "client", "page", "plain"))
    plan["senders"], plan["events"] = [_driver(plan, source, way=way, hz=hz, phases=phases)], events


def _meeting(dice: random.Random, at: float, source: str, away: bool) -> list[Event]:
    """Return a stall that begins at this time, and what comes while it lasts."""
    first_s, second_s = (dice.choice((0.002, 0.012, 0.05, 0.2)) for _ in range(2))
    events: list[Event] = [
        {"at": at, "do": "stall", "for": first_s},
        # The events at these times wait for the end of the first stall. No step is between them.
        {"at": round(at + 0.002, 4), "do": "stall", "for": second_s},
    ]
    settings = {f"commands.sources.{source}.timeout": dice.choice((0.3, 0.4, 0.5))}
    late = round(0.02 + dice.uniform(0.0, first_s + second_s), 4)
    match dice.randrange(5):
        case 0 | 1:
            events.append(_call(at - 2.5, "stop"))
            events.append(_call(at - 0.02, "clear", named=True, late=late))
        case 2:
            events.append(_call(at - 2.5, "deactivate"))
            events.append(_call(at - 0.02, "activate", named=True, late=late))
        case 3:
            events.append(_call(at - 0.02, "set", settings=settings, late=late))
    match dice.randrange(2 + 2 * away):
        case 0:
            deaf = dice.choice((0.002, 0.01, 0.05))
            events.append({"at": round(at + 0.001, 4), "do": "reset", "deaf": deaf})
        case 1:
            open_s = dice.choice((0.0, 0.002))
            events.append(
                {"at": round(at + 0.001, 4), "do": "unplug", "for": open_s, "new": False}
            )
        case _:
            after = round(0.001 + dice.uniform(0.0, first_s + second_s), 4)
            lasts = dice.choice((0.005, 0.03, 0.5))
            fault = ["bumper_pressed", dice.randint(1, 2), after, lasts]
            whole = round(after + lasts + 0.1, 4)
            events.append(
                {"at": round(at - 0.001, 4), "do": "board", "for": whole, "fault": fault}
            )
    return events


MOMENTS: dict[str, tuple[float, Callable[[Plan, random.Random], None]]] = {
    "late step": (0.05, _late_step),
}
"""The share of the plans that have each moment, and the function that makes them."""
