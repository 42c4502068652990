"""Adds rare coincidences of events to some plans, because chance seldom produces them.

`MOMENTS` lists the coincidences. A plan with one of them keeps its configuration, but gets new
senders and events, so that nothing else hides the effect. Each coincidence has a separate random
generator, so all other plans stay the same.
"""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

from tests.simulate import moments_of_age, moments_of_wheels
from tests.simulate.board_inputs import NEVER_S
from tests.simulate.promises import INPUTS

Plan = dict[str, Any]
Event = dict[str, Any]

PLACES = ("front", "rear")
"""Bumpers from which a robot may drive away."""

CALL: Event = {
    "do": "call", "late": 0.01, "lost": False, "twice": False, "by": "op9", "via": "native",
}  # fmt: skip


def add(plan: Plan) -> None:
    """Give this plan at most one coincidence of `MOMENTS`, each with its own probability."""
    for name, (share, fits, give) in MOMENTS.items():
        dice = random.Random(f"a moment {name} {plan['seed']}")
        if dice.random() < share and fits(plan):
            plan["moment"] = name
            give(plan, dice)
            plan["events"].sort(key=lambda event: event["at"])
            return


def _best(plan: Plan) -> dict[str, Any]:
    """Return the source of the highest priority."""
    sources: list[dict[str, Any]] = plan["config"]["commands"]["sources"]
    return max(sources, key=lambda source: source["priority"])


def _driver(plan: Plan, source: dict[str, Any], **more: Any) -> dict[str, Any]:
    """Return the plan's first sender with a good network, an exact clock, and fields `more`."""
    usual = {
        "source": source["name"], "wheels": False, "from": 0.0, "to": plan["seconds"],
        "delay": 0.001, "jitter": 0.0, "congestion": [], "clock": [], "bursts": [],
        "bad_stamps": 0.0, "junk": 0.0, "churn": False, "loss": 0.0, "twice": 0.0, "swap": 0.0,
    }  # fmt: skip
    first: dict[str, Any] = plan["senders"][0]
    return first | usual | more


def _need_zeros(plan: Plan) -> None:
    """Let only zeros arm the senders, and no pauses."""
    for source in plan["config"]["commands"]["sources"]:
        source.pop("neutral_first", None)


def _speed(dice: random.Random) -> list[float]:
    """Return a random linear speed in m/s and an angular one in rad/s, which is often zero."""
    turn = dice.choice((0.0, round(dice.uniform(-2.0, 2.0), 3)))
    return [dice.choice((-1, 1)) * round(dice.uniform(0.1, 1.0), 3), turn]


def _call(at: float, verb: str, **more: Any) -> Event:
    return {"at": round(at, 4), "verb": verb, **CALL, **more}


def _late_step(plan: Plan, dice: random.Random) -> None:
    """Let one late step read a call, a zero, and an event that disarms the sender.

    The call releases a latch or changes a timeout. The three arrive in any order, a few ms apart.
    The sender sends speeds, this one zero, and speeds again.
    """
    config, source = plan["config"], _best(plan)
    _need_zeros(plan)
    safety = config.setdefault("safety", {})
    if "bumpers" not in safety and dice.random() < 0.5:
        safety.update(bumpers=[dice.choice(PLACES) for _ in range(2)], bumper="away")
        plan["board"].append(["bumpers"])
    away, events = safety.get("bumper") == "away", []
    hz = 50.0 if source["timeout"] < 0.2 else 20.0
    rests_s = 1.0 + 0.3
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
    """Return the events of such a step: a stall at this time, and the call and event during it."""
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
            events.append({"at": round(at + 0.001, 4), "do": "unplug", "for": open_s, "new": False})
        case _:
            after = round(0.001 + dice.uniform(0.0, first_s + second_s), 4)
            lasts = dice.choice((0.005, 0.03, 0.5))
            fault = ["bumper_pressed", dice.randint(1, 2), after, lasts]
            whole = round(after + lasts + 0.1, 4)
            events.append({"at": round(at - 0.001, 4), "do": "board", "for": whole, "fault": fault})
    return events


def _alone(plan: Plan, dice: random.Random, phases: list[list[Any]]) -> dict[str, Any]:
    """Replace all senders by one on the source of the highest priority, and remove all events.

    Returns the sender.
    """
    source = _best(plan)
    hz = 50.0 if source["timeout"] < 0.2 else 20.0
    way = dice.choice(("client", "plain", "bridge"))
    driver = _driver(plan, source, way=way, hz=hz, phases=phases)
    plan["senders"], plan["events"] = [driver], []
    return driver


def _drives(
    plan: Plan, dice: random.Random, rests: float, shortest: float, longest: float
) -> list[Any]:
    """Return the phases of a sender that rests and drives in turn.

    Each rest takes `rests` seconds plus the configured pause. A phase is a start time, a linear and
    an angular speed.
    """
    rests += 1.0
    phases: list[list[Any]] = []
    at = 0.0
    while at < plan["seconds"]:
        phases.append([round(at, 3), 0.0, 0.0])
        at += rests
        for _ in range(dice.choice((1, 2, 4))):
            phases.append([round(at, 3), *_speed(dice)])
            at += dice.uniform(shortest, longest)
    return phases


def _is_plain(plan: Plan) -> bool:
    """Return whether the board is a prompted one on a link without checksums and has no faults."""
    mcu = plan["config"]["mcu"]
    return not ("link_check" in mcu or "reply_period" in mcu or plan["board"])


def _any(plan: Plan) -> bool:
    return True


def _without_check(plan: Plan) -> bool:
    """Return whether the link has no checksums. The daemon then uses every status line."""
    return "link_check" not in plan["config"]["mcu"]


def _may_be_ideal(plan: Plan) -> bool:
    """Return whether the configuration allows a board whose lag is a few control periods."""
    config = plan["config"]
    rate, gyro = config["control"]["rate"], config.get("odometry", {}).get("gyro")
    return _is_plain(plan) and not gyro and isinstance(rate, float) and rate >= 20.0


def _half_duplex(plan: Plan, dice: random.Random) -> None:
    """Let the daemon receive its own lines in addition to the replies, under load."""
    _alone(plan, dice, _drives(plan, dice, 0.3, 1.0, 4.0))
    fault = ["half_duplex", dice.choice((0.0, 0.2, 0.3, 0.5, 0.7))]
    at, lasts = round(dice.uniform(2.0, 5.0), 3), round(dice.uniform(15.0, 30.0), 3)
    plan["events"] = [{"at": at, "do": "board", "for": lasts, "fault": fault}]


def _flip(plan: Plan, dice: random.Random) -> None:
    """Invert one bit of a digit in one of the first lines after a silence or after a clear."""
    _alone(plan, dice, _drives(plan, dice, 2.5, 1.0, 4.0))
    at = 4.0
    while at < plan["seconds"] - 6.0:
        place = 8 * dice.randrange(4) + dice.choice((1, 2, 2, 2, 3, 5, 6))
        flip: Event = {
            "do": "flip", "place": place, "mask": dice.choice((1, 2, 4, 8, 8)),
            "behind": dice.choice((0, 0, 1, 2, 3)),
        }  # fmt: skip
        if dice.random() < 0.5:
            lasts = round(dice.uniform(0.2, 0.9), 3)
            plan["events"] += [
                {"at": round(at, 3), "do": "board", "for": lasts, "fault": ["mute"]},
                {"at": round(at + lasts / 2, 4), **flip},
            ]
        else:
            clear = round(at + dice.uniform(2.0, 3.0), 3)
            plan["events"] += [
                _call(at, "stop", put=False),
                _call(clear, "clear", named=True),
                {"at": round(clear + 0.01 + dice.uniform(-0.015, 0.005), 4), **flip},
            ]
        at += dice.uniform(4.0, 7.0)


def _ideal(plan: Plan, dice: random.Random) -> None:
    """Give the board very fine encoders, a lag of whole periods, and a constant answer time."""
    config = plan["config"]
    lag = dice.choice((1, 2, 3, 4)) / config["control"]["rate"]
    config["mcu"].pop("encoder_counts", None)
    config["sim"]["encoder_counts"] = dice.choice((100_000, 300_000, 1_000_000))
    config["sim"]["motor_time_constant"] = round(lag, 6)
    plan["board"] = [["constant_answers", dice.choice((0.5, 1.3, 2.5))]]
    _alone(plan, dice, _drives(plan, dice, 0.3, 1.0, 5.0))


def _inputs(plan: Plan, dice: random.Random, names: tuple[str, ...]) -> str:
    """Give the board one of these inputs, and no other, and return its name."""
    config, name = plan["config"], dice.choice(names)
    config.pop("battery", None)
    config["safety"] = {}
    plan["board"] = [fault for fault in plan["board"] if fault[0] not in INPUTS]
    if name == "bumpers":
        config["safety"] = {"bumpers": [dice.choice(PLACES) for _ in range(dice.randint(1, 4))]}
    plan["board"].append({"driver": ["driver_fault", NEVER_S, 1.0]}.get(name, [name]))
    return name


def _press(dice: random.Random, plan: Plan, name: str, lasts: float) -> list[Any]:
    """Return a fault of the board that presses an input, or reports a fault of a motor driver."""
    match name:
        case "bumpers":
            number = dice.randint(1, len(plan["config"]["safety"]["bumpers"]))
            return ["bumper_pressed", number, 0.0, lasts]
        case "estop":
            return ["estop_pressed", 0.0, lasts]
    return ["driver_fault", 0.0, lasts]


def _named_stop(plan: Plan, dice: random.Random) -> None:
    """Press an input of a robot that a client has stopped."""
    _alone(plan, dice, _drives(plan, dice, 0.3, 1.0, 4.0))
    name, at = _inputs(plan, dice, ("bumpers", "estop")), 4.0
    while at < plan["seconds"] - 6.0:
        via = dice.choice(("native", "native", "rmw", "bridge"))
        by = f"op{dice.randrange(3)}"
        plan["events"].append(_call(at, "stop", put=False, by=by, via=via))
        lasts = dice.choice((0.01, 0.1, 1.0))
        pressed = round(at + dice.choice((0.005, 0.05, 1.0)), 3)
        fault = _press(dice, plan, name, lasts)
        whole = round(lasts + 0.2, 3)
        plan["events"] += [
            {"at": pressed, "do": "board", "for": whole, "fault": fault},
            _call(pressed + lasts + 0.5, "clear", named=True),
            _call(pressed + lasts + 0.8, "clear", named=True),
        ]
        at += dice.uniform(8.0, 12.0)


def _other_board(plan: Plan, dice: random.Random) -> None:
    """Replace a board that reports a fault or a press by one that never reports this input."""
    _alone(plan, dice, _drives(plan, dice, 0.3, 1.0, 4.0))
    name = _inputs(plan, dice, ("driver", "estop"))
    at, lasts = round(dice.uniform(3.0, 15.0), 3), round(dice.uniform(0.3, 3.0), 3)
    unplug_s = round(at + dice.uniform(0.05, 2.0), 3)
    plan["events"] = [
        {
            "at": at, "do": "board", "for": plan["seconds"],
            "fault": _press(dice, plan, name, plan["seconds"]),
        },
        {"at": unplug_s, "do": "unplug", "for": lasts, "new": True, "without": [name]},
        _call(unplug_s + lasts + 5.0, "clear", named=True),
        _call(unplug_s + lasts + 6.0, "clear", named=True),
    ]  # fmt: skip


def _behind_a_press(plan: Plan, dice: random.Random) -> None:
    """Press the emergency stop while the robot drives.

    For some time after the release, the motor drivers have no power, or a person pushes the robot.
    """
    _alone(plan, dice, _drives(plan, dice, 0.3, 1.5, 4.0))
    _inputs(plan, dice, ("estop",))
    drivers, at = dice.random() < 0.5, 5.0
    if drivers:
        plan["board"].append(["driver_fault", NEVER_S, 1.0])
    while at < plan["seconds"] - 22.0:
        lasts = dice.choice((0.06, 0.5, 3.0, 6.0))
        longer = round(dice.uniform(0.2, 3.0), 3)
        rolls = round(lasts * dice.uniform(0.5, 0.9), 3)
        speed = dice.choice((-1, 1)) * round(dice.uniform(0.2, 0.8), 2)
        whole = round(lasts + longer, 3)
        begins, lacks, fault = at + rolls, round(whole - rolls, 3), ["pushed", speed]
        if drivers:
            begins, lacks, fault = at + 0.02, whole, ["driver_fault", 0.0, whole]
        press = ["estop_pressed", 0.0, lasts]
        plan["events"] += [
            {"at": round(at, 3), "do": "board", "for": round(lasts + 0.2, 3), "fault": press},
            {"at": round(begins, 3), "do": "board", "for": lacks, "fault": fault},
            _call(at + whole + 1.0, "clear", named=True),
            _call(at + whole + 1.5, "clear", named=True),
        ]
        at += whole + dice.uniform(8.0, 12.0)


def _restart_in_fault(plan: Plan, dice: random.Random) -> None:
    """Restart the daemon while a fault is latched but its cause is already over."""
    _alone(plan, dice, _drives(plan, dice, 0.3, 1.5, 3.0))
    plan["config"].pop("feedback", None)
    driver, at = dice.random() < 0.5, 5.0
    if driver:
        _inputs(plan, dice, ("driver",))
    while at < plan["seconds"] - 16.0:
        lasts = round(dice.uniform(0.1, 1.0) if driver else dice.uniform(3.0, 5.0), 3)
        kind = dice.choice(("dead_motor", "reversed_motor", "stuck_encoder"))
        fault = _press(dice, plan, "driver", lasts) if driver else [kind, dice.randrange(4)]
        ends = round(at + lasts + dice.choice((0.05, 1.0, 2.0)), 3)
        away = round(dice.uniform(0.2, 2.0), 3)
        way = dice.choice(("kill", "term", "crash before the robot", "crash behind the robot"))
        clear = ends + away + dice.uniform(8.0, 12.0)
        plan["events"] += [
            {"at": round(at, 3), "do": "board", "for": round(lasts + 0.01, 3), "fault": fault},
            {"at": ends, "do": "restart", "way": way, "for": away},
            _call(clear, "clear", named=True),
        ]
        at = clear + dice.uniform(6.0, 10.0)


def _slow_sender(plan: Plan, dice: random.Random) -> None:
    """Let a sender that obeys all rules send only one command every few seconds.

    Its timeout is longer than that.
    """
    source = _best(plan)
    source["timeout"] = dice.choice((2.0, 5.0, 5.0, 10.0))
    every = source["timeout"] * dice.uniform(0.2, 0.45)
    plan["seconds"] = max(plan["seconds"], 90.0)
    phases = _drives(plan, dice, 5.0 * every, 5.0 * every, 12.0 * every)
    driver = _alone(plan, dice, phases)
    way = dice.choice(("client", "client", "page", "plain", "signed", "rmw"))
    driver |= {"way": way, "hz": round(1.0 / every, 4), "seldom": True}


def _routed(plan: Plan, dice: random.Random) -> None:
    """Let two programs without an id send through a router that is not linked to the robot."""
    _need_zeros(plan)
    _best(plan)["timeout"] = dice.choice((0.25, 0.5, 1.0))
    first = _alone(plan, dice, [])
    ahead = round(dice.uniform(-0.4, 0.3), 3)
    first |= {"way": "routed", "ahead": ahead, "drift": 0.0}
    first["routers"] = [[0.0, "session of a far router"]]
    second = first | {"name": "s1", "id": f"s1/{dice.getrandbits(64):016x}"}
    first["phases"] = [[0.0, 0.0, 0.0]]
    if dice.random() < 0.5:
        first["phases"] = _drives(plan, dice, 0.5, 1.0, 4.0)
    first["hz"] = dice.choice((10.0, 20.0))
    speeds: list[list[Any]] = []
    at = 0.0
    while at < plan["seconds"]:
        # The other program never sends a zero.
        speeds.append([round(at, 3), *_speed(dice)])
        at += dice.uniform(2.0, 10.0)
        if dice.random() < 0.3:
            speeds.append([round(at, 3), None, None])
            at += dice.choice((0.5, 3.0))
    plan["senders"] = [first, second | {"phases": speeds}]


def _newcomers(plan: Plan, dice: random.Random) -> None:
    """Start one new sender after another on a congested network.

    The network first stores each sender's commands, and then delivers them faster than they were
    sent.
    """
    _best(plan)["timeout"] = dice.choice((0.25, 0.5, 1.0))
    first = _alone(plan, dice, [])
    senders: list[dict[str, Any]] = []
    at = 1.0
    while at < plan["seconds"] - 6.0:
        waits_s, faster = dice.uniform(1.5, 6.0), round(dice.uniform(1.5, 6.0), 3)
        zeros_s = dice.choice((0.1, 0.3, 0.6, 1.3))
        begin, end = round(at, 3), round(at + 2.0 * waits_s, 3)
        number = len(senders)
        newcomer = {
            "name": f"s{number}", "id": f"s{number}/{dice.getrandbits(64):016x}",
            "way": dice.choice(("client", "client", "page", "signed", "rmw")),
            "hz": dice.choice((10.0, 20.0, 50.0)), "from": begin, "to": end,
            "phases": [[begin, 0.0, 0.0], [round(begin + zeros_s, 3), *_speed(dice)]],
            "congestion": [[begin, end, "drain", faster]],
        }  # fmt: skip
        senders.append(first | newcomer)
        at = end + dice.uniform(1.0, 3.0)
    plan["senders"] = senders


def _later_and_later(plan: Plan, dice: random.Random) -> None:
    """Let the network delay the commands of a foreign clock more and more, in steps.

    During each step the sender sends zeros and speeds.
    """
    _best(plan)["timeout"] = dice.choice((0.25, 0.5))
    driver = _alone(plan, dice, [])
    phases, congestion = [[0.0, 0.0, 0.0], [2.5, *_speed(dice)]], []
    at, late_s = 5.0, 0.0
    while at < plan["seconds"] - 4.0:
        late_s += dice.choice((0.4, 0.6, 0.9))
        end = at + dice.uniform(4.0, 8.0)
        congestion.append([round(at, 3), round(end, 3), "jump", round(late_s, 3)])
        while at < end - 2.5:
            phases += [[round(at + 0.5, 3), 0.0, 0.0], [round(at + 1.5, 3), *_speed(dice)]]
            at += dice.uniform(2.0, 3.0)
        at = end
    way = dice.choice(("signed", "rmw"))
    driver |= {"way": way, "phases": phases, "congestion": congestion}


def _stall_behind_a_zero(plan: Plan, dice: random.Random) -> None:
    """Stall the whole process between a zero of one program and the speeds of another one.

    Both programs share a sender identity. The daemon takes its first step after the stall before
    the bus delivers the waiting speeds.
    """
    source = _best(plan)
    pause_s = 1.0
    _need_zeros(plan)
    source["timeout"] = dice.choice((0.25, 0.5))
    first = _alone(plan, dice, [])
    hz = dice.choice((5.0, 10.0))
    first |= {"way": dice.choice(("plain", "bridge")), "hz": 20.0}
    second = first | {"name": "s1", "id": f"s1/{dice.getrandbits(64):016x}", "hz": hz}
    second["phases"] = [[0.0, *_speed(dice)]]
    phases: list[list[Any]] = [[0.0, None, None]]
    at = 3.0
    while at < plan["seconds"] - 4.0:
        at = round(at * 20.0) / 20.0
        phases += [[round(at - 0.01, 3), 0.0, 0.0], [round(at + 0.01, 3), None, None]]
        plan["events"].append({
            "at": round(at + dice.uniform(0.01, 0.5 / hz), 4), "do": "stall",
            "for": round(min(0.95, pause_s * dice.uniform(0.8, 1.2)), 3),
            "deaf": dice.choice((0.001, 0.004, 0.05)),
        })  # fmt: skip
        at += dice.uniform(4.0, 6.0)
    first["phases"] = phases
    plan["senders"] = [first, second]


def _coarse(plan: Plan, dice: random.Random) -> None:
    """Give the robot encoders with few counts, and wheels that respond as late as allowed."""
    config, counts = plan["config"], dice.choice((16, 20, 32, 48))
    config.pop("feedback", None)
    config["drive"] = {"wheel_radius": 0.05, "wheel_separation": 0.3}
    config["limits"] |= {
        "linear_speed": 1.0, "angular_speed": 4.0, "wheel_speed": 40.0,
        "linear_acceleration": 1.0, "linear_deceleration": 1.0,
        "angular_acceleration": 4.0, "angular_deceleration": 4.0,
        "linear_stop_deceleration": 3.0, "angular_stop_deceleration": 12.0,
    }  # fmt: skip
    config["sim"] |= {"encoder_counts": counts, "motor_time_constant": dice.choice((0.15, 0.2))}
    config["mcu"].pop("encoder_counts", None)
    if dice.random() < 0.5:
        config["mcu"]["encoder_counts"] = counts
    for name in ("linear_jerk", "angular_jerk"):
        config["limits"].pop(name, None)
    driver = _alone(plan, dice, [])
    at, phases = 0.0, []
    while at < plan["seconds"]:
        rests_s = 1.5 + (1.0 if at == 0.0 else 0.0)
        speed = dice.choice((-1, 1)) * round(dice.uniform(0.8, 1.0), 3)
        phases += [[round(at, 3), 0.0, 0.0], [round(at + rests_s, 3), speed, 0.0]]
        at += rests_s + dice.uniform(1.3, 2.5)
    driver["phases"] = phases


def _late_lines(plan: Plan, dice: random.Random) -> None:
    """Stall the computer while a free-running board reports over a slow wire.

    During the stall the board stops its motors, and its lines wait in the buffer.
    """
    config = plan["config"]
    period, baud = dice.choice(((0.01, 38400), (0.01, 115200), (0.02, 19200), (0.05, 9600)))
    config["mcu"] |= {"baud_rate": baud, "reply_period": period}
    config["control"]["rate"] = min(100.0, 1.0 / period)
    for source in config["commands"]["sources"]:
        source["timeout"] = max(source["timeout"], 0.25)
    plan["board"] = [["free_running", period]]
    _alone(plan, dice, _drives(plan, dice, 0.5, 4.0, 8.0))
    at = 5.0
    while at < plan["seconds"] - 4.0:
        lasts = round(dice.uniform(0.5, 1.6), 3)
        plan["events"].append({"at": round(at, 3), "do": "stall", "for": lasts})
        at += lasts + dice.uniform(5.0, 9.0)


def _wheel_limit(plan: Plan, dice: random.Random) -> None:
    """Let one axis speed up while the other one slows down gently, at the wheels' speed limit."""
    config = plan["config"]
    limits, drive = config["limits"], config.get("drive", {})
    radius = drive.get("wheel_radius", 0.05)
    linear, angular = limits["linear_speed"], limits["angular_speed"]
    fastest = max(linear, angular * drive.get("wheel_separation", 0.3) / 2) / radius
    config.get("feedback", {}).pop("wheel_speed", None)
    for name in ("linear_jerk", "angular_jerk"):
        limits.pop(name, None)
    limits |= {
        "wheel_speed": round(min(99.0, fastest * dice.uniform(0.95, 1.1)), 2),
        "linear_acceleration": round(dice.uniform(2.0, 4.0), 2),
        "angular_acceleration": round(dice.uniform(8.0, 12.0), 2),
        "linear_deceleration": round(linear / 5 + 0.001, 3),
        "angular_deceleration": round(angular / 5 + 0.001, 3),
    }
    driver, at = _alone(plan, dice, []), 0.0
    while at < plan["seconds"]:
        driver["phases"].append([round(at, 3), 0.0, 0.0])
        at += 1.0 + 1.0
        for _ in range(6):
            v, w = dice.choice((-linear, 0.0, linear)), dice.choice((-angular, 0.0, angular))
            driver["phases"].append([round(at, 3), v, w])
            at += dice.uniform(2.0, 6.0)


def _driven(
    give: Callable[[Plan, random.Random, dict[str, Any]], None],
) -> Callable[[Plan, random.Random], None]:
    """Return what gives a plan one sender that rests and drives, and lets `give` change both."""

    def alone(plan: Plan, dice: random.Random) -> None:
        _need_zeros(plan)
        driver = _alone(plan, dice, [])
        driver["phases"] = _drives(plan, dice, 0.3, 1.0, 5.0)
        give(plan, dice, driver)

    return alone


def _late_network(plan: Plan, dice: random.Random) -> None:
    """Let the network lose the commands around events that disarm, mostly where a pause arms.

    Each goal ends with a zero and then silence, but some last over an event, or end without a zero.
    The network is also lost between two goals, until the second one is under way.
    """
    driver = _alone(plan, dice, [])
    pauses = dice.random() < 0.8
    for source in plan["config"]["commands"]["sources"]:
        source["neutral_first"] = "pause" if pauses else "zero"
    driver["way"] = dice.choice(("rmw", "rmw", "rmw", "signed", "client", "bridge", "plain"))
    phases: list[list[Any]] = [[0.0, 0.0, 0.0], [1.4, None, None]]
    away: list[list[float]] = []

    def lose(begin: float) -> float:
        lasts = dice.uniform(0.5, 6.0)
        away.append([round(begin, 3), round(begin + lasts, 3)])
        return lasts

    at = 3.0
    while at < plan["seconds"] - 14.0:
        phases.append([round(at, 3), *_speed(dice)])
        at += dice.uniform(2.0, 4.0)
        if dice.random() < 0.5:
            lose(at + dice.uniform(-1.0, 1.0))
            plan["events"] += _disarming(dice, at)
            at += dice.uniform(6.0, 8.0)
        if dice.random() < 0.7:
            phases.append([round(at, 3), 0.0, 0.0])
            at += dice.choice((0.1, 0.5, 1.2))
        phases.append([round(at, 3), None, None])
        pause = dice.choice((0.3, 1.2, 3.0, 11.0))
        if dice.random() < 0.5:
            plan["events"] += _disarming(dice, at + 2.6)
            pause += 3.0
            if dice.random() < 0.7:
                pause += lose(at + 2.6 + dice.uniform(0.0, pause - 2.6)) / 2
        at += pause
    driver |= {"phases": phases, "away": away}


def _disarming(dice: random.Random, at: float) -> list[Event]:
    match dice.randrange(4):
        case 0:
            return [_call(at - 2.5, "stop"), _call(at, "clear", named=True)]
        case 1:
            return [_call(at - 2.5, "deactivate"), _call(at, "activate", named=True)]
        case 2:
            return [{"at": round(at, 3), "do": "restart", "way": "kill", "for": 0.3}]
        case _:
            return [{"at": round(at, 3), "do": "reset", "deaf": 0.05}]


MOMENTS: dict[str, tuple[float, Callable[[Plan], bool], Callable[[Plan, random.Random], None]]] = {
    "late step": (0.05, _any, _late_step),
    "half duplex": (0.12, _is_plain, _half_duplex),
    "flip": (0.12, _is_plain, _flip),
    "ideal board": (0.08, _may_be_ideal, _ideal),
    "stop beside a press": (0.02, _without_check, _named_stop),
    "other board": (0.02, _without_check, _other_board),
    "slow sender": (0.03, _any, _slow_sender),
    "behind a router": (0.02, _any, _routed),
    "backlogs of newcomers": (0.02, _any, _newcomers),
    "later and later": (0.02, _any, _later_and_later),
    "restart in a fault": (0.06, _without_check, _restart_in_fault),
    "behind a press": (0.04, _without_check, _behind_a_press),
    "stall behind a zero": (0.03, _any, _stall_behind_a_zero),
    "coarse encoders": (0.05, _may_be_ideal, _coarse),
    "late lines": (0.05, _may_be_ideal, _late_lines),
    "wheel limit": (0.04, _any, _wheel_limit),
    "queue from the start": (0.03, _any, _driven(moments_of_age.queued)),
    "plateau behind a pause": (0.03, _any, _driven(moments_of_age.plateau)),
    "long silence": (0.03, _any, _driven(moments_of_age.silence)),
    "slow wheels": (0.15, _is_plain, _driven(moments_of_wheels.slow_wheels)),
    "wrong counts": (0.03, _any, _driven(moments_of_wheels.wrong_counts)),
    "set points": (0.05, _is_plain, _driven(moments_of_wheels.set_points)),
    "stuck encoder": (0.03, _is_plain, _driven(moments_of_wheels.stuck_encoder)),
    "replies twice": (0.03, _is_plain, _driven(moments_of_wheels.replies_twice)),
    "late network": (0.05, _any, _late_network),
    "forward and back": (0.07, _any, _driven(moments_of_wheels.to_and_fro)),
    "dropouts": (0.06, _any, _driven(moments_of_wheels.flickering)),
    "clock that is slewed": (0.05, _any, _driven(moments_of_age.slewed)),
    "short-lived publishers": (0.04, _any, _driven(moments_of_age.publishers)),
}
"""The share of the plans that have each moment, of those that can have it, whether a plan can have
it, and what makes it."""
