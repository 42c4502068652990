"""Adds boards whose wheels, counts or speeds are wrong to some plans, and links that flicker.

`bad_moments.py` says what a moment is.
"""

from __future__ import annotations

import math
import random
from typing import Any

from tests.simulate.promises import INPUTS

Plan = dict[str, Any]
Sender = dict[str, Any]

MOTORS = "abcd"


def slow_wheels(plan: Plan, dice: random.Random, driver: Sender) -> None:
    """Drive slowly, while motors are reversed, swapped, dead or run away."""
    config = plan["config"]
    config.get("odometry", {}).pop("gyro", None)
    radius = round(dice.choice((0.03, 0.075, 0.15, 0.2)) * dice.uniform(0.9, 1.1), 3)
    counts = dice.choice((16, 64, 400, 3200))
    config["drive"] = config.get("drive", {}) | {"wheel_radius": radius}
    config["sim"]["encoder_counts"] = counts
    if "encoder_counts" in config["mcu"]:
        config["mcu"]["encoder_counts"] = counts
    config.get("feedback", {}).pop("wheel_speed", None)
    fastest = config["limits"]["linear_speed"] / radius
    config["limits"]["wheel_speed"] = round(min(40.0, max(3.0, 2.0 * fastest)), 2)
    events: list[dict[str, Any]] = []
    phases: list[list[Any]] = []
    at = 0.0
    while at < plan["seconds"]:
        phases += [[round(at, 3), 0.0, 0.0], [round(at + 1.3, 3), *slow_speeds(dice, config)]]
        begin = at + 1.3 + dice.uniform(0.0, 4.0)
        turns = math.tau / 16 * 3 * radius / 0.05  # the way of three of the coarsest counts
        lasts = dice.uniform(4.0, 8.0) + turns
        at = begin + lasts
        if dice.random() < 0.5:  # it ends while the fault goes on
            phases.append([round(begin + dice.uniform(0.5, 2.0), 3), 0.0, 0.0])
        for fault in _wheel_faults(dice, config):
            event = {"at": round(begin, 3), "do": "board", "for": round(lasts, 3), "fault": fault}
            events.append(event)
        phases.append([round(at, 3), 0.0, 0.0])
        at += dice.uniform(3.0, 4.0)
        events.append(_named_clear(at))
        at += 0.5
    driver |= {"phases": phases}
    plan["events"] = events


def to_and_fro(plan: Plan, dice: random.Random, driver: Sender) -> None:
    """Move the stick to and fro between two wishes, mostly while motors keep their speed.

    A part of the links flickers meanwhile.
    """
    config = plan["config"]
    _make_brisk(dice, config)
    phases: list[list[Any]] = []
    at = 0.0
    while at < plan["seconds"] - 8.0:
        v = round(dice.choice((-1, 1)) * dice.uniform(0.2, 1.0), 3)
        w = dice.choice((0.0, 0.0, round(dice.uniform(-0.5, 0.5), 3)))
        phases += [[round(at, 3), 0.0, 0.0], [round(at + 1.3, 3), v, w]]
        begin = at + 1.3 + 1.5 + dice.uniform(0.0, 1.0)
        lasts = dice.uniform(6.0, 20.0)
        at = begin + lasts
        phases += _swings(dice, v, w, begin, at)
        if dice.random() < 0.7:
            for motor in _motors(config, dice.choice(("all", "all", "side", "one")), dice):
                plan["events"].append({
                    "at": round(begin, 3), "do": "board", "for": round(lasts, 3),
                    "fault": ["runaway", motor],
                })  # fmt: skip
        if dice.random() < 0.3:
            plan["events"] += _flickers(dice, begin, at)
        phases.append([round(at, 3), 0.0, 0.0])
        at += dice.uniform(3.0, 4.0)
        plan["events"].append(_named_clear(at))
        at += 0.5
    driver["phases"] = phases


def flickering(plan: Plan, dice: random.Random, driver: Sender) -> None:
    """Let the board fall silent for 0.1 to 0.3 s, again and again for some seconds."""
    at = 3.0
    while at < plan["seconds"] - 3.0:
        end = min(at + dice.uniform(2.0, 8.0), plan["seconds"] - 1.0)
        plan["events"] += _flickers(dice, at, end)
        at = end + dice.uniform(2.0, 8.0)


def _flickers(dice: random.Random, begin: float, end: float) -> list[dict[str, Any]]:
    """Return silences of the board between these times: 0.1 to 0.3 s each 0.3 to 1 s."""
    events, at = [], begin
    every, silent = dice.uniform(0.3, 1.0), dice.uniform(0.1, 0.3)
    silent = min(silent, every - 0.1)
    while at + silent < end:
        lasts = round(silent * dice.uniform(0.9, 1.1), 3)
        events.append({"at": round(at, 3), "do": "board", "for": lasts, "fault": ["mute"]})
        at += every * dice.uniform(0.95, 1.05)
    return events


def _swings(dice: random.Random, v: float, w: float, begin: float, end: float) -> list[list[Any]]:
    """Return phases that go from these speeds to another wish and back, or rest all the time."""
    share, other = dice.uniform(0.3, 0.7), dice.choice((-1.0, -1.0, 0.0, 0.0, 0.4))
    period = 0.2 * 15.0 ** dice.random()  # 0.2 to 3 s, evenly by its logarithm
    if dice.random() < 0.1:
        return [[round(begin, 3), 0.0, 0.0]]
    phases: list[list[Any]] = []
    at = begin
    while at + period < end:
        phases += [
            [round(at, 3), round(other * v, 3), round(other * w, 3)],
            [round(at + period * (1.0 - share), 3), v, w],
        ]
        at += period
    return phases


def _make_brisk(dice: random.Random, config: dict[str, Any]) -> None:
    """Let the limits allow 1 m/s, and speeds that follow a stick."""
    config.get("odometry", {}).pop("gyro", None)
    for name in ("wheel_speed", "response_time"):
        config.get("feedback", {}).pop(name, None)
    radius = round(dice.choice((0.04, 0.075, 0.15)) * dice.uniform(0.9, 1.1), 3)
    config["drive"] = config.get("drive", {}) | {"wheel_radius": radius}
    limits, down = config["limits"], round(dice.uniform(1.5, 4.0), 2)
    for name in ("linear_jerk", "angular_jerk"):
        limits.pop(name, None)
    limits |= {
        "linear_speed": 1.2, "angular_speed": 3.0, "wheel_speed": round(1.8 / radius, 2),
        "linear_acceleration": round(dice.uniform(1.5, 4.0), 2), "angular_acceleration": 12.0,
        "linear_deceleration": down, "linear_stop_deceleration": round(1.3 * down, 3),
        "angular_deceleration": 12.0, "angular_stop_deceleration": 20.0,
    }  # fmt: skip
    motors_s = config["sim"]["motor_time_constant"]
    config["sim"]["motor_time_constant"] = min(motors_s, 0.2)


def _named_clear(at: float) -> dict[str, Any]:
    return {
        "at": round(at, 4), "do": "call", "verb": "clear", "named": True, "late": 0.01,
        "lost": False, "twice": False, "by": "op9", "via": "native",
    }  # fmt: skip


def slow_speeds(dice: random.Random, config: dict[str, Any]) -> list[float]:
    """Return a speed of 0.05 to 0.3 m/s and a turn rate, which is often zero."""
    v = dice.choice((-1, 1)) * min(dice.uniform(0.05, 0.3), config["limits"]["linear_speed"])
    return [round(v, 3), dice.choice((0.0, 0.0, round(dice.uniform(-0.5, 0.5), 3)))]


def _wheel_faults(dice: random.Random, config: dict[str, Any]) -> list[list[Any]]:
    """Return faults of one motor, of those of a side, or of all."""
    motors = _motors(config, dice.choice(("one", "one", "side", "all")), dice)
    match dice.choice(("reversed", "reversed", "runaway", "runaway", "swapped", "dead", "gain")):
        case "reversed":
            return [["reversed_motor", motor] for motor in motors]
        case "runaway":
            return [["runaway", motor] for motor in motors]
        case "gain":
            return [["gain", round(dice.uniform(1.4, 2.0), 2)]]
        case "dead":
            return [["dead_motor", motor] for motor in motors]
    right, left = _motors(config, "right", dice), _motors(config, "left", dice)
    return [["swapped_motors", dice.choice(right), dice.choice(left)]]


def _motors(config: dict[str, Any], which: str, dice: random.Random) -> list[int]:
    """Return the motors of `one` random wheel, a random `side`, the `right`, the `left` or all."""
    wheels = config["mcu"].get("wheels") or {
        "front_right": "+a", "front_left": "+b", "rear_left": "+c", "rear_right": "+d",
    }  # fmt: skip
    if which == "one":
        return [dice.randrange(4)]
    side = dice.choice(("right", "left")) if which == "side" else which
    names = [name for name in wheels if which == "all" or name.endswith(side)]
    return sorted(MOTORS.index(wheels[name][1]) for name in names)


def stuck_encoder(plan: Plan, dice: random.Random, driver: Sender) -> None:
    """Drive steadily, while one encoder after the other is stuck."""
    plan["config"].get("odometry", {}).pop("gyro", None)
    events: list[dict[str, Any]] = []
    phases: list[list[Any]] = []
    at = 0.0
    while at < plan["seconds"]:
        phases += [
            [round(at, 3), 0.0, 0.0],
            [round(at + 1.3, 3), *slow_speeds(dice, plan["config"])],
        ]
        begin, lasts = at + 1.3 + dice.uniform(1.0, 4.0), dice.uniform(6.0, 10.0)
        at = begin + lasts
        events.append({
            "at": round(begin, 3), "do": "board", "for": round(lasts, 3),
            "fault": ["stuck_encoder", dice.randrange(4)],
        })  # fmt: skip
        phases.append([round(at, 3), 0.0, 0.0])
        at += dice.uniform(3.0, 4.0)
        events.append(_named_clear(at))
        at += 0.5
    driver |= {"phases": phases}
    plan["events"] = events


def replies_twice(plan: Plan, dice: random.Random, driver: Sender) -> None:
    """Let a repeater send each reply of a checked link twice."""
    config = plan["config"]
    config.get("odometry", {}).pop("gyro", None)
    config["control"]["rate"] = 50.0
    config["mcu"]["link_check"] = "on"
    plan["board"] = [["replies_twice"]]


def wrong_counts(plan: Plan, dice: random.Random, driver: Sender) -> None:
    """Let the configuration name a wrong number of counts on a link with a check."""
    config = plan["config"]
    config.get("odometry", {}).pop("gyro", None)
    counts = dice.choice((400, 1024, 3200))
    config["control"]["rate"] = dice.choice((50.0, 100.0))
    config["sim"]["encoder_counts"] = counts
    wrong = int(counts * dice.choice((0.25, 0.5, 0.7, 1.4, 2.0, 4.0)))
    config["mcu"] |= {"link_check": "on", "encoder_counts": wrong}
    config["mcu"].pop("reply_period", None)
    config["mcu"].pop("trailing_comma", None)
    _keep_inputs(plan)


def set_points(plan: Plan, dice: random.Random, driver: Sender) -> None:
    """Let a board without encoders report its set points."""
    config = plan["config"]
    config.get("odometry", {}).pop("gyro", None)
    for name in ("encoder_counts", "link_check", "reply_period", "trailing_comma"):
        config["mcu"].pop(name, None)
    config["feedback"] = config.get("feedback", {}) | {"encoders": False}
    _keep_inputs(plan)
    plan["board"].append(["set_points"])


def _keep_inputs(plan: Plan) -> None:
    """Remove the lasting faults of the board that do not report inputs."""
    plan["board"] = [fault for fault in plan["board"] if fault[0] in INPUTS]
