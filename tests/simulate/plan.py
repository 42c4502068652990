"""Creates the plan of a seed: the actions of robot, board, senders, operators and host.

A plan is plain data, so `shrink.py` can remove parts of it and `corpus/` can store it. Times are in
s of true time from the start. Each plan leaves out a random part of the kinds of trouble, because
one kind often hides another one. This is swarm testing (Groce and others, 2012).
"""

from __future__ import annotations

import itertools
import random
from typing import Any

from tests.simulate import bad_moments, board_inputs, gyro_faults, wiring
from tests.simulate.product import problems

Plan = dict[str, Any]

KINDS = (
    "silent board", "damaged lines", "lying board", "slow board", "resets", "unplugging",
    "blocked output", "stalls", "suspends", "clock steps", "restarts", "full disk",
    "stops", "activation", "settings", "poses", "lost calls",
    "congestion", "loss", "disorder", "sender clocks", "hostile senders", "shared identities",
    "pushes", "odd configuration",
    "other dialect", "unreadable board", "extreme timing", "other vehicle",
    "stop storms", "ros parameters", "typed latches",
    "crashes", "damaged file", "kills on a full disk", "sender bursts", "bad stamps",
)  # fmt: skip
"""The kinds of trouble that a run may have."""

LATER_KINDS = ("wrong gyro samples", "hanging gyro", "unstamped zeros")
"""More kinds of trouble. They have dice of their own, so the plans without them stay as they
were."""

WAYS = (
    "client",
    "client",
    "page",
    "signed",
    "rmw",
    "header",
    "zenoh",
    "plain",
    "bridge",
    "bridged",
)
SOURCES = ("teleop", "app", "ros2_control", "nav")

LIES = (
    "stuck_encoder", "frozen_encoder", "dead_motor", "reversed_motor", "reversed_encoder",
    "bias", "swapped_motors", "swapped_encoders", "late_watchdog", "no_watchdog",
)  # fmt: skip

TWO_WHEELS, OTHER_LETTERS = 0.25, 0.1
"""Share of the plans with two wheels, and of those whose four motors have other letters."""

OF_A_MOTOR = {
    "stuck_encoder", "frozen_encoder", "dead_motor", "reversed_motor", "reversed_encoder", "bias",
    "runaway",
}  # fmt: skip
OF_TWO_MOTORS = {"swapped_motors", "swapped_encoders"}

DIALECTS = (
    "unpadded", "spaces", "trailing_comma", "no_sample", "no_check", "plain_only",
    "watchdog_fed_by_bad_lines",
)  # fmt: skip
"""Other forms of the protocol, to which a board may change while it runs."""


def make_plan(seed: int, seconds: float | None = None, wheels: int | None = None) -> Plan:
    """Return the plan of this seed, whose robot has so many wheels if their number is given.

    A plan with two wheels, or with other letters, has all else of the one with four.
    """
    dice = random.Random(f"plan {seed}")
    share = dice.choice((0.2, 0.5, 0.7))
    kinds = sorted(kind for kind in KINDS if dice.random() < share)
    length = seconds or round(dice.choice((40, 60, 60, 90, 240)) * dice.uniform(0.8, 1.2), 1)
    while True:
        config, extras = _config(
            dice,
            *(kind in kinds for kind in ("odd configuration", "extreme timing", "other vehicle")),
        )
        if not problems(config):
            break
    if "pushes" not in kinds:  # a push may turn the wheels faster than the bound
        _draw_low_bound(random.Random(f"low bound {seed}"), config)
    if "other dialect" in kinds:
        extras["board"] += _dialect(dice, config["mcu"])
    sources = [source["name"] for source in config["commands"]["sources"]]
    plan: Plan = {
        "seed": seed,
        "seconds": length,
        "kinds": kinds,
        "config": config,
        "senders": [
            _sender(dice, n, kinds, length, sources) for n in range(dice.choice((1, 1, 1, 2, 3, 6)))
        ],
        "events": [],
        "lawful": dice.choice(("a new client", "a sender of the plan")),
        "share": dice.choice((0.5, 0.5, 2.0)),
        **extras,
    }
    if "shared identities" in kinds:
        for sender in plan["senders"][1:]:
            if dice.random() < 0.5:
                first = plan["senders"][0]
                sender.update(id=first["id"], way=first["way"], source=first["source"])
    _draw_routers(random.Random(f"routers {seed}"), plan)
    driven = _draw_lawful_driver(random.Random(f"lawful driver {seed}"), plan)
    events = _events(dice, kinds, length, config, plan["senders"])
    if driven:
        events += _rare_events(random.Random(f"rare events {seed}"), plan)
    plan["events"] = sorted(events, key=lambda event: event["at"])
    board_inputs.add(plan)
    bad_moments.add(plan)
    if "moment" not in plan:  # in a plan with a moment nothing else happens
        dice = random.Random(f"later kinds {seed}")
        later = [kind for kind in LATER_KINDS if dice.random() < share]
        plan["kinds"] = sorted([*kinds, *later])
        gyro_faults.add(plan, later)
        if "unstamped zeros" in later:
            senders = plan["senders"][1:] if driven else plan["senders"]
            _draw_unstamped_zeros(random.Random(f"unstamped zeros {seed}"), senders)
    dice = random.Random(f"wheels {seed}")
    chance = dice.random()
    if wheels == 2 or (wheels is None and chance < TWO_WHEELS):
        _leave_two_wheels(dice, plan)
    elif wheels is None and chance < TWO_WHEELS + OTHER_LETTERS:
        mcu, letters = plan["config"]["mcu"], sorted(dice.sample(wiring.LETTERS, 4))
        motors = wiring.wheels(plan["config"]).items()
        mcu["wheels"] = {name: m[0] + letters["abcd".index(m[1])] for name, m in motors}
    return plan


def _leave_two_wheels(dice: random.Random, plan: Plan) -> None:
    """Leave the robot one motor on each side. It takes over the faults of the two motors there."""
    before, letters = wiring.wheels(plan["config"]), dice.sample(wiring.LETTERS, 2)
    after = {
        name: dice.choice("+-") + letter for name, letter in zip(wiring.TWO, letters, strict=True)
    }
    plan["config"]["mcu"]["wheels"] = after
    motor_of = {
        "abcd".index(motor[1]): sorted(letters).index(after[name.rpartition("_")[2]][1])
        for name, motor in before.items()
    }
    events: list[dict[str, Any]] = []
    for event in plan["events"]:
        match event:
            case {"do": "board", "fault": [name, motor, *more]} if name in OF_A_MOTOR:
                event["fault"] = [name, motor_of[motor], *more]
                if event in events:
                    continue
            case {"do": "board", "fault": [name, motor, _]} if name in OF_TWO_MOTORS:
                event["fault"] = [name, motor_of[motor], 1 - motor_of[motor]]
            case {"do": "flip", "place": place}:
                event["place"] = place % 16  # of the two speeds
            case {"do": "tear", "taken": taken}:
                event["taken"] = taken // 2
        events.append(event)
    plan["events"] = events


def _draw_low_bound(dice: random.Random, config: dict[str, Any]) -> None:
    """In a tenth of the plans put `feedback.wheel_speed` just above the limit of the wheels.

    In some of these plans the wheels are slow and their encoders coarse. One encoder count then
    looks faster than this bound.
    """
    if dice.random() >= 0.1:
        return
    limits, sim = config["limits"], config["sim"]
    if dice.random() < 0.5:
        limits["wheel_speed"] = round(dice.uniform(3.0, 6.0), 2)
        if "encoder_counts" not in sim:
            sim["encoder_counts"] = 96 if config["control"]["rate"] in (100.0, "auto") else 400
    bound = round(limits["wheel_speed"] * dice.uniform(1.11, 1.3), 2)
    config["feedback"] = config.get("feedback", {}) | {"wheel_speed": bound}


def _draw_routers(dice: random.Random, plan: Plan) -> None:
    """Put most senders whose Zenoh session stamps their messages behind routers that stamp them.

    The session that stamps changes during the plan: another router, the sender itself, or the
    daemon. In a tenth of the plans, all senders are behind routers and command one source.
    """
    senders, together = plan["senders"], dice.random() < 0.1
    for sender in senders:
        if not together and (sender["way"] != "zenoh" or dice.random() < 0.2):
            continue
        own, t = f"session of {sender['id']}", 0.0
        names = ("session of router 1", "session of router 1", "session of router 2", own, "")
        routers: list[list[Any]] = []
        while t < plan["seconds"]:
            routers.append([round(t, 3), dice.choice(names)])
            t += dice.choice((dice.uniform(0.05, 0.5), dice.uniform(0.5, 3.0), 30.0))
        sender.update(way="routed", routers=routers, wheels=False, churn=False)
        if together:
            sender["source"] = senders[0]["source"]


def _draw_unstamped_zeros(dice: random.Random, senders: list[dict[str, Any]]) -> None:
    """Let some senders stamp only their speeds, and often end a drive with a single zero.

    A ROS node may fill the header of its speeds and end with an empty `TwistStamped`. The daemon
    then uses the header's stamp for a speed and the attachment's stamp for a zero, so two clocks
    stamp the messages of one sender. The network often swaps the last two messages of a drive.
    """
    ids = [sender["id"] for sender in senders]
    for sender in senders:
        phases = sender["phases"]
        if sender["way"] not in ("rmw", "signed", "header", "client"):
            continue
        if sender["churn"] or sender["bad_stamps"] or ids.count(sender["id"]) > 1:
            continue
        if sender["way"] != "signed":
            sender["way"] = "rmw"  # `header` has no numbers, and `client` echoes
        ends = [
            [after[0], dice.random() < 0.7]
            for before, after in itertools.pairwise(phases)
            if (before[1] or before[2]) and after[1] == after[2] == 0.0 and dice.random() < 0.8
        ]
        sender.update(stamps_speeds=True, ends=ends, wheels=False)


def _draw_lawful_driver(dice: random.Random, plan: Plan) -> bool:
    """In a quarter of the plans let the first sender obey all rules and have the highest priority.

    `liveness.py` checks that such a sender drives, and few plans have one by chance. Returns
    whether this plan has one.
    """
    if dice.random() >= 0.25:
        return False
    seconds: float = plan["seconds"]
    first: dict[str, Any] = plan["senders"][0]
    source = max(plan["config"]["commands"]["sources"], key=lambda item: item["priority"])
    below = {
        item["name"]
        for item in plan["config"]["commands"]["sources"]
        if item["priority"] < source["priority"]
    }
    hz = dice.choice((20.0, 50.0)) if source["timeout"] > 0.1 else 50.0
    first |= {
        "way": dice.choice(("client", "plain", "bridge")), "source": source["name"],
        "wheels": False, "hz": hz, "from": 0.0, "to": seconds,
        "jitter": min(first["jitter"], 0.002), "phases": _drives(dice, seconds),
        "congestion": [], "clock": [], "bursts": [], "bad_stamps": 0.0, "junk": 0.0,
        "churn": False, "loss": 0.0, "twice": 0.0, "swap": 0.0,
    }  # fmt: skip
    plan["senders"] = [first] + [
        item
        for item in plan["senders"][1:]
        if item["source"] in below
        and not (item["junk"] or item["churn"])
        and item["id"] != first["id"]
    ]
    return True


def _rare_events(dice: random.Random, plan: Plan) -> list[dict[str, Any]]:
    """Return trouble for a fifth of the plans with a lawful driver, timed by its drives.

    The trouble is an echo during changes of the speed, or a blocked output while the board still
    reports. Both are rare by chance.
    """
    mcu, phases = plan["config"]["mcu"], plan["senders"][0]["phases"]
    times = [phase[0] for phase in phases if 1.0 < phase[0] < plan["seconds"] - 4.0]
    special = "link_check" in mcu or "reply_period" in mcu or plan["board"]
    if dice.random() >= 0.2 or special or not times:
        return []
    echo = dice.random() < 0.5
    if not echo:
        mcu["reply_period"] = 0.1
        plan["board"] = [["free_running", 0.1]]
    events: list[dict[str, Any]] = []
    for time in dice.sample(times, min(3, len(times))):
        if echo:
            at, lasts = max(1.0, time - dice.random()), round(dice.uniform(2.0, 6.0), 3)
            event = {"do": "board", "fault": ["echo"]}
        else:
            at, lasts = time + dice.uniform(0.5, 3.0), dice.choice((1.0, 3.0))
            event = {"do": "block"}
        events.append({"at": round(at, 3), "for": lasts, **event})
    return events


def _drives(dice: random.Random, seconds: float) -> list[list[Any]]:
    """Return the phases of a sender that drives for some minutes, rests, and often reverses."""
    phases: list[list[Any]] = []
    t = 0.0
    while t < seconds:
        phases.append([round(t, 3), 0.0, 0.0])
        t += dice.choice((1.3, 2.5, 5.5))
        for _ in range(dice.choice((1, 2, 3, 12))):
            speed = dice.choice((-1, 1)) * round(dice.uniform(0.1, 1.2), 3)
            turn = dice.choice((0.0, round(dice.uniform(-3.0, 3.0), 3)))
            phases.append([round(t, 3), speed, turn])
            t += dice.uniform(3.0, 15.0)
    return phases


def _config(
    dice: random.Random, odd: bool, timing: bool, vehicle: bool
) -> tuple[dict[str, Any], dict[str, Any]]:
    """Return a random configuration (tables of `acsard.toml`) and lasting board properties."""
    linear, angular = round(dice.uniform(0.2, 2.0), 2), round(dice.uniform(0.5, 6.0), 2)
    slow = round(max(linear / 5, dice.choice((0.5, 1.0, 3.0))) + 0.001, 3)
    slow_turn = round(max(angular / 5, dice.choice((2.0, 4.0, 9.0))) + 0.001, 3)
    config: dict[str, Any] = {
        "mcu": {"port": "/dev/board"},
        "control": {"rate": 100.0},
        "limits": {
            "linear_speed": linear,
            "angular_speed": angular,
            "linear_acceleration": round(dice.uniform(0.3, 4.0), 2),
            "angular_acceleration": round(dice.uniform(1.0, 12.0), 2),
            "linear_deceleration": slow,
            "angular_deceleration": slow_turn,
            "linear_stop_deceleration": round(max(slow, linear / 2) * dice.uniform(1.01, 3.0), 3),
            "angular_stop_deceleration": round(
                max(slow_turn, angular / 2) * dice.uniform(1.01, 3.0), 3
            ),
            "wheel_speed": round(dice.uniform(10.0, 40.0), 2),
        },
        "sim": {"motor_time_constant": round(dice.uniform(0.02, 0.12), 3)},
        "commands": {
            "sources": [
                {"name": name, "priority": priority, "timeout": dice.choice((0.25, 0.25, 0.5))}
                for name, priority in zip(SOURCES, (100, 50, 20, 10), strict=True)
            ]
        },
    }
    extras: dict[str, Any] = {"board": []}
    if odd:
        _make_odd(dice, config, extras)
    if timing:
        _make_extreme(dice, config)
    if vehicle:
        _make_other(dice, config)
    if not config.get("odometry", {}).get("gyro") and dice.random() < 0.4:
        config["sim"]["motor_time_constant"] = round(dice.uniform(0.25, 0.4), 3)
    return config, extras


def _make_odd(dice: random.Random, config: dict[str, Any], extras: dict[str, Any]) -> None:
    mcu, sim, limits = config["mcu"], config["sim"], config["limits"]
    config["control"]["rate"] = dice.choice((20.0, 50.0, 100.0, 100.0, 150.0))
    config["drive"] = {
        "wheel_radius": round(dice.uniform(0.04, 0.15), 3),
        "wheel_separation": round(dice.uniform(0.2, 0.8), 3),
    }
    if dice.random() < 0.3:
        limits["linear_jerk"] = round(dice.uniform(1.0, 20.0), 1)
        limits["angular_jerk"] = round(dice.uniform(5.0, 80.0), 1)
    letters, signs = dice.sample("abcd", 4), [dice.choice("+-") for _ in range(4)]
    wheels = ("front_right", "front_left", "rear_left", "rear_right")
    mcu["wheels"] = {w: s + m for w, s, m in zip(wheels, signs, letters, strict=True)}
    sim["encoder_counts"] = counts = dice.choice((96, 400, 1024, 3200))
    match dice.randrange(6):
        case 0:
            mcu["link_check"] = "on"
        case 1:
            mcu.update(link_check="on", encoder_counts=counts)
        case 2:
            mcu["encoder_counts"] = counts
        case 3:
            mcu["trailing_comma"] = True
            if dice.random() < 0.7:
                extras["board"] = [["comma_latched"], ["trailing_comma"]]
        case 4:
            mcu["reply_period"] = 0.1
            extras["board"] = [["free_running", 0.1]]
    if _asks_too_often(config):
        config["control"]["rate"] = 110.0
    commands = config["commands"]
    pauses = dice.random() >= 0.85
    names = [*SOURCES, "twin"]
    commands["sources"] = [
        {
            "name": name,
            "priority": dice.choice((10, 50, 50, 100)),
            "timeout": dice.choice((0.15, 0.25, 0.5, 1.0, 3.0)),
        }
        for name in names
    ]
    if pauses:
        for source in commands["sources"]:
            source["neutral_first"] = "pause"
    if dice.random() < 0.3:
        config["odometry"] = {"gyro": True}


def _asks_too_often(config: dict[str, Any]) -> bool:
    """Return whether a board would have to answer too often without its counts."""
    rate, mcu = config["control"]["rate"], config["mcu"]
    counts = "link_check" in mcu and "encoder_counts" in mcu
    return rate != "auto" and rate > 111.0 and not (counts or "reply_period" in mcu)


def _make_extreme(dice: random.Random, config: dict[str, Any]) -> None:
    """Draw rates, timeouts and pauses from their whole range, and one to six sources.

    A board that is asked more than 111 times a second gets a link with its counts, if it can.
    """
    rate, period = dice.choice(
        ((10.0, 0.1), (110.0, 0.0091), (300.0, 0.0034), ("auto", 0.01), (100.0, 0.01))
    )
    config["control"]["rate"] = rate
    if period < 0.01 and config["sim"].get("encoder_counts") == 96:
        # A board may send no counts, and one in 5 ms is 13 rad/s, by which the pose drifts.
        for table in ("sim", "mcu"):
            if "encoder_counts" in config[table]:
                config[table]["encoder_counts"] = 400
    if _asks_too_often(config) and "trailing_comma" in config["mcu"]:
        config["control"]["rate"] = 110.0  # such a board has no checksum
    elif _asks_too_often(config):
        counts = config["sim"].setdefault("encoder_counts", 3200)
        config["mcu"] |= {"link_check": "on", "encoder_counts": counts, "baud_rate": 250000}
    names = dice.sample((*SOURCES, "twin", "sixth"), dice.randrange(1, 7))
    timeouts = [t for t in (0.05, 0.1, 0.25, 0.5, 2.0, 10.0) if t >= 2 * period]
    commands = config["commands"]
    commands["sources"] = [
        {"name": name, "priority": dice.choice((0, 10, 50, 100)), "timeout": dice.choice(timeouts)}
        for name in names
    ]


def _make_other(dice: random.Random, config: dict[str, Any]) -> None:
    """Draw wheel multipliers, bounds that a healthy wheel never exceeds, and error rates."""
    config["drive"] = config.get("drive", {}) | {
        "wheel_separation_multiplier": round(dice.uniform(0.8, 1.6), 3),
        "left_wheel_radius_multiplier": round(dice.uniform(0.95, 1.05), 3),
        "right_wheel_radius_multiplier": round(dice.uniform(0.95, 1.05), 3),
    }
    config["feedback"] = {
        "wheel_speed": round(config["limits"]["wheel_speed"] * dice.uniform(1.5, 2.0), 2),
        "response_time": dice.choice((0.2, 0.5, 1.0)),
    }
    config["odometry"] = config.get("odometry", {}) | {
        name: dice.choice((1e-5, 1e-4, 1e-3, 1e-2))
        for name in (
            "distance_variance_per_metre", "yaw_variance_per_metre", "yaw_variance_per_radian"
        )
    }  # fmt: skip


def _dialect(dice: random.Random, mcu: dict[str, Any]) -> list[list[Any]]:
    """Return lasting variations of the board's protocol that these settings of the daemon allow."""
    possible = ["unpadded", "spaces", "watchdog_fed_by_bad_lines"]
    # A board with a reply period ends its lines with a comma in any case.
    if not (mcu.get("trailing_comma") or mcu.get("reply_period")):
        possible.append("trailing_comma")
    if mcu.get("encoder_counts"):
        possible += ["no_sample"] if "link_check" in mcu else ["plain_only", "no_check"]
    chosen = dice.sample(possible, dice.choice((0, 1, 1, 2)))
    if "no_check" in chosen and "plain_only" in chosen:
        chosen.remove("no_check")
    return [[name] for name in chosen]


def _phases(dice: random.Random, seconds: float, lawful: bool) -> list[list[Any]]:
    """Return the phases of a sender: start times, each with a speed and a turn rate.

    None in place of the speeds means silence.
    """
    habits = ["stop and go"] * 3 + ["pauses"] * 3
    habit = dice.choice(habits if lawful else [*habits, "never neutral", "wild"])
    phases: list[list[Any]] = []
    t = 0.0 if habit == "never neutral" else dice.uniform(0.0, 3.0)
    while t < seconds:
        speed = dice.choice((-1, 1)) * dice.uniform(0.05, 1.2)
        turn = dice.choice((0.0, dice.uniform(-3.0, 3.0)))
        if dice.random() < 0.1:
            speed, turn = speed * 20, turn * 20
        match habit:
            case "never neutral":
                phases.append([round(t, 3), speed, turn])
                t += dice.uniform(2.0, 20.0)
                continue
            case "wild":
                phases.append([round(t, 3), speed, turn])
                t += dice.uniform(0.05, 0.5)
                if dice.random() < 0.1:
                    phases.append([round(t, 3), 0.0, 0.0])
                    t += dice.uniform(0.5, 3.0)
                continue
        phases.append([round(t, 3), 0.0, 0.0])
        t += dice.choice((0.2, 0.6, 1.3, 1.3, 2.5, 3.5))
        phases.append([round(t, 3), speed, turn])
        t += dice.uniform(0.5, 10.0)
        if habit == "pauses" or dice.random() < 0.2:
            phases.append([round(t, 3), None, None])
            t += dice.choice((0.15, 0.4, 2.2, 10.0))
            if habit == "pauses" and dice.random() < 0.5:
                phases.append([round(t, 3), speed, turn])
                t += dice.uniform(0.5, 5.0)
    return [[at, None if v is None else round(v, 3), None if w is None else round(w, 3)]
            for at, v, w in phases]  # fmt: skip


def _tried_again(
    dice: random.Random, phases: list[list[Any]], congestion: list[list[Any]]
) -> list[list[Any]]:
    """Return phases in which an operator releases the stick and tries again during a congestion."""
    if all(speed != 0.0 for _, speed, _ in phases):
        return phases
    for begin, end, _, _ in congestion:
        if end - begin < 4.0 or dice.random() < 0.5:
            continue
        t = begin + dice.uniform(0.5, 2.0)
        phases = [phase for phase in phases if not t <= phase[0] < end]
        while t < end:
            phases.append([round(t, 3), 0.0, 0.0])
            t += dice.choice((0.3, 0.6, 1.3, 2.5))
            phases.append([round(t, 3), round(dice.uniform(-1.2, 1.2), 3), 0.0])
            t += dice.uniform(0.5, 3.0)
    return sorted(phases, key=lambda phase: float(phase[0]))


def _sender(
    dice: random.Random, n: int, kinds: list[str], seconds: float, sources: list[str]
) -> dict[str, Any]:
    way = dice.choice(WAYS)
    # Most plans need a sender that drives: a robot at rest hides most defects.
    lawful = n == 0 and dice.random() < 0.8
    begin = round(dice.choice((0.0, 0.0, dice.uniform(0.0, seconds / 2))), 3)
    sender: dict[str, Any] = {
        "name": f"s{n}",
        "id": f"s{n}/{dice.getrandbits(64):016x}",
        "way": way,
        "source": "teleop" if way == "page" and "teleop" in sources else dice.choice(sources),
        "wheels": way in ("client", "signed", "plain", "rmw") and dice.random() < 0.2,
        "form": dice.choice(("json", "msgpack", "cdr")),
        "hz": dice.choice((5.0, 10.0, 20.0, 20.0, 50.0)),
        "from": begin,
        "to": round(dice.choice((seconds, seconds, dice.uniform(begin, seconds))), 3),
        "ahead": round(dice.choice((0.0, dice.uniform(-0.4, 0.4), dice.uniform(-1e5, 1e5))), 3),
        "drift": dice.choice((0.0, 1e-5, -1e-4)),
        "delay": dice.choice((0.001, 0.005, 0.03)),
        "jitter": dice.choice((0.0, 0.0, 0.002, 0.02)),
        "phases": _phases(dice, seconds, lawful),
        "congestion": [],
        "clock": [],
        "bursts": [],
        "bad_stamps": 0.0,
        "junk": 0.0,
        "churn": False,
        "loss": 0.0,
        "twice": 0.0,
        "swap": 0.0,
    }
    if "loss" in kinds:
        sender["loss"] = dice.choice((0.0, 0.02, 0.2))
    if "disorder" in kinds:
        sender["twice"], sender["swap"] = dice.choice((0.0, 0.05)), dice.choice((0.0, 0.05))
    shared = way in ("header", "plain", "bridge", "bridged")
    if "hostile senders" in kinds and dice.random() < (0.8 if shared else 0.6):
        sender["junk"] = dice.choice((0.02, 0.3, 0.3))
        sender["churn"] = not lawful and dice.random() < 0.6 and way in ("client", "signed", "rmw")
        if dice.random() < 0.1 and not shared:
            sender["hz"] = 400.0
        elif sender["churn"]:
            sender["hz"] = 100.0  # enough names to fill a table without a bound
    if "congestion" in kinds:
        # A sender whose first messages wait is new to the daemon when they pour in.
        first = max(begin, sender["phases"][0][0])
        t = dice.choice((first, first, dice.uniform(0.0, 20.0)))
        while t < seconds:
            length = dice.choice((dice.uniform(0.5, 5.0), dice.uniform(5.0, 25.0)))
            shape = dice.choice(("grow", "grow", "jump", "jump", "hole", "drain", "burst"))
            if shape == "grow":
                length *= 1.5
            size = {
                "grow": dice.choice((0.01, 0.03, 0.045, 0.08, 0.5)),
                "jump": dice.choice((0.3, 0.6, 1.0, 2.0, 3.0, 8.0)),
                "hole": 0.0,
                "drain": dice.uniform(1.2, 6.0),
                "burst": dice.choice((0.1, 0.3, 1.0)),
            }[shape]
            sender["congestion"].append([round(t, 3), round(t + length, 3), shape, round(size, 3)])
            t += length + dice.uniform(1.0, 15.0)
        sender["phases"] = _tried_again(dice, sender["phases"], sender["congestion"])
    if "sender bursts" in kinds:
        for _ in range(dice.randrange(1, 4)):
            t = dice.uniform(0.0, seconds)
            sender["bursts"].append(
                [round(t, 3), round(t + dice.uniform(0.05, 1.0), 3), dice.choice((200, 500, 1000))]
            )
    if "bad stamps" in kinds and dice.random() < 0.5:
        sender["bad_stamps"] = dice.choice((0.02, 0.3, 1.0))
    if "sender clocks" in kinds and way not in ("client", "page"):
        t = dice.uniform(2.0, 30.0)
        while t < seconds:
            if dice.random() < 0.5:
                sender["clock"].append(["step", round(t, 3), round(dice.uniform(-3.0, 3.0), 3)])
            else:
                rate = dice.choice((-0.08, -0.0005, 0.0005, 0.08))
                sender["clock"].append(["slew", round(t, 3), round(t + 20.0, 3), rate])
            t += dice.uniform(5.0, 60.0)
    return sender


def _events(
    dice: random.Random,
    kinds: list[str],
    seconds: float,
    config: dict[str, Any],
    senders: list[dict[str, Any]],
) -> list[dict[str, Any]]:
    events: list[dict[str, Any]] = []
    phases = [
        phase
        for sender in senders
        for phase in sender["phases"]
        if sender["from"] <= phase[0] < sender["to"]
    ]
    changes, drives = [phase[0] for phase in phases], [phase[0] for phase in phases if phase[1]]

    def moment() -> float:
        """Return a random time. Half of them follow a sender's change or another event closely."""
        chance = dice.random()
        if chance < 0.3 and changes:
            at = dice.choice(changes) + dice.choice((0.3, 3.0)) * dice.random()
        elif chance < 0.5 and events:
            at = dice.choice(events)["at"] + dice.uniform(0.0, 3.0)
        else:
            at = dice.uniform(1.0, seconds)
        return float(round(max(1.0, min(at, seconds)), 3))

    def add(kind: str, every: float) -> list[float]:
        """Return times for events of this kind, about one in `every` s."""
        if kind not in kinds:
            return []
        count = dice.randrange(1, max(2, int(2 * seconds / every)))
        return [moment() for _ in range(count)]

    def series(at: float) -> list[float]:
        """Return either this time alone or a series of times from it on.

        A series may meet a ramp, which is too short for a single time to meet.
        """
        if dice.random() < 0.6:
            return [at]
        gap, count = dice.uniform(0.3, 1.5), dice.randrange(3, 15)
        return [start_s for n in range(count) if (start_s := round(at + n * gap, 3)) < seconds]

    def board(at: float, length: float, *fault: Any) -> None:
        events.append({"at": at, "do": "board", "for": round(length, 3), "fault": list(fault)})

    def once(at: float, do: str, **more: Any) -> None:
        events.append({"at": at, "do": do, **more})

    for at in add("silent board", 40):
        board(at, dice.choice((0.05, 0.2, 0.5, 0.95, 1.3, 4.0)), "mute")
    for at in add("damaged lines", 40):
        kind = dice.choice(
            ("noise", "partial_line", "lost_replies", "lost_commands", "bit_errors", "echo")
        )
        board(
            at,
            dice.uniform(0.2, 10.0),
            kind,
            *([dice.choice((3, 7, 50))] if kind.startswith("lost") or kind == "bit_errors" else []),
        )
    for at in add("lying board", 60):
        kind = dice.choice(LIES)
        first, second = dice.sample(range(4), 2)
        more: list[Any] = (
            [first] if kind.split("_")[0] in ("stuck", "frozen", "dead", "reversed") else []
        )
        if kind == "bias":
            more = [first, dice.choice((-1.0, 0.5, 3.0, 9.0))]
        elif kind.startswith("swapped"):
            more = [first, second]
        board(at, dice.uniform(0.5, 8.0), kind, *more)
    for at in add("slow board", 40):
        kind, *values = dice.choice(
            (("slow_reply", 0.03), ("ftdi", 0.016), ("stalls", 1.0, 0.15), ("sparse_replies", 0.05))
        )
        board(at, dice.uniform(1.0, 20.0), kind, *values)
    for at in add("other dialect", 60):
        board(at, dice.uniform(0.2, 10.0), dice.choice(DIALECTS))
    for at in add("unreadable board", 60):
        board(
            at,
            dice.choice((0.05, 0.2, 1.0, 5.0)) * dice.uniform(0.5, 1.0),
            *dice.choice((("endless",), ("wrong_baud", dice.choice((9600, 38400, 57600))))),
        )
    for at in add("pushes", 40):
        board(at, dice.uniform(0.2, 4.0), "pushed", round(dice.uniform(-1.0, 1.0), 2))
    for at in add("resets", 60):
        once(at, "reset", deaf=dice.choice((0.3, 1.0, 2.0)))
    for at in add("unplugging", 60):
        if drives and dice.random() < 0.7:
            # A loose contact opens for a moment when the robot shakes.
            for begin in dice.sample(drives, min(len(drives), dice.randrange(2, 7))):
                shaken = round(min(begin + dice.uniform(0.5, 4.0), seconds), 3)
                once(shaken, "unplug", **{"for": round(dice.uniform(0.05, 0.4), 3)}, new=False)
            continue
        once(at, "unplug", **{"for": round(dice.uniform(0.05, 5.0), 3)}, new=dice.random() < 0.4)
    for at in add("blocked output", 40):
        times = series(at)
        # The board stays silent in a pause of the output, so one of 0.1 s already loses the link.
        lasts = dice.choice((0.02, 0.06, 0.08, 0.2) if len(times) > 1 else (0.02, 0.08, 0.6, 2.0))
        for each in times:
            if dice.random() < 0.5:
                once(each, "block", **{"for": lasts})
            else:
                once(each, "tear", taken=dice.randrange(40))
    for at in add("stalls", 30):
        times, how = series(at), dice.choice(("stall", "stall in step"))
        lasts = dice.choice((0.015, 0.06, 0.2, 0.4, 1.5) if len(times) == 1 else (0.015, 0.1, 0.2))
        for each in times:
            once(each, how, **{"for": lasts})
    for at in add("suspends", 90):
        once(
            at,
            "suspend",
            **{"for": round(dice.choice((0.5, 5.0, 60.0, 3600.0)) * dice.uniform(0.5, 1.0), 3)},
        )
        if dice.random() < 0.3:
            again = round(at + dice.choice((0.03, 0.3, 3.0)) * dice.uniform(1.0, 2.0), 3)
            lasts = round(dice.uniform(0.5, 60.0), 3)
            if again < seconds:  # Otherwise the board boots while the last sender sends its zeros.
                once(again, "suspend", **{"for": lasts})
    for at in add("clock steps", 40):
        once(at, "wall", by=round(dice.choice((0.3, 3.0, 1e5)) * dice.uniform(-1.0, 1.0), 3))
    for at in add("restarts", 60):
        once(
            at,
            "restart",
            way=dice.choice(("kill", "term")),
            **{"for": round(dice.uniform(0.2, 3.0), 3)},
        )
    for at in add("full disk", 60):
        once(at, "disk", **{"for": round(dice.uniform(1.0, 30.0), 3)})
    for at in add("crashes", 60):
        once(
            at,
            "restart",
            way=dice.choice(("crash before the robot", "crash behind the robot")),
            stop=dice.random() < 0.5,
            **{"for": round(dice.uniform(0.2, 3.0), 3)},
        )
    for at in add("damaged file", 90):
        once(
            at,
            "restart",
            way=dice.choice(("kill", "term")),
            damage=dice.choice(("cut", "zeros", "version")),
            **{"for": round(dice.uniform(0.2, 3.0), 3)},
        )

    def call(at: float, verb: str, **more: Any) -> None:
        lossy = "lost calls" in kinds
        late = dice.choice((0.01, 0.01, 0.3, 1.5, 6.0, 15.0)) if lossy else 0.01
        events.append({
            "at": at, "do": "call", "verb": verb, "late": late,
            "lost": lossy and dice.random() < 0.2, "twice": lossy and dice.random() < 0.2,
            "by": f"op{dice.randrange(3)}",
            "via": dice.choice(("native", "native", "rmw", "bridge")),
            **more,
        })  # fmt: skip

    for at in add("stops", 15):
        call(at, "stop", put=dice.random() < 0.5)
        for _ in range(dice.randrange(4)):
            after = round(at + dice.choice((0.0, 0.05, 1.0, 3.0)) + dice.uniform(0.0, 2.0), 3)
            call(after, "clear", named=dice.random() < 0.7)
        if dice.random() < 0.8:
            call(round(at + dice.uniform(2.0, 8.0), 3), "clear", named=True)
    for at in add("kills on a full disk", 60):
        once(at, "disk", **{"for": round(dice.uniform(1.0, 5.0), 3)})
        late = round(at + dice.uniform(0.0, 1.0), 3)
        call(late, dice.choice(("stop", "clear", "deactivate", "activate")), named=True)
        killed = round(late + 0.01 + dice.choice((0.0, 0.02, 0.2)) * dice.random(), 3)
        once(killed, "restart", way="kill", **{"for": round(dice.uniform(0.2, 5.0), 3)})
    if "lying board" in kinds:
        for at in [round(dice.uniform(1.0, seconds), 3) for _ in range(int(seconds / 10))]:
            call(at, "clear", named=True)
    for at in add("activation", 20):
        call(at, "deactivate")
        for _ in range(dice.randrange(1, 3)):
            after = round(at + dice.choice((0.0, 2.5)) + dice.uniform(0.0, 2.0), 3)
            call(after, "activate", named=dice.random() < 0.7)
        if dice.random() < 0.8:
            call(round(at + dice.uniform(2.0, 8.0), 3), "activate", named=True)
    for at in add("poses", 40):
        if dice.random() < 0.5:
            call(at, "reset_odometry")
        else:
            call(
                at,
                "set_pose",
                pose=[
                    round(dice.uniform(-9, 9), 2),
                    round(dice.uniform(-9, 9), 2),
                    round(dice.uniform(-3, 3), 2),
                ],
            )
    for at in add("settings", 20):
        via = dice.choice(("native", "rmw", "bridge")) if "ros parameters" in kinds else "native"
        call(at, "set", settings=_settings(dice, config), via=via, whole=dice.random() < 0.5)
    for at in add("stop storms", 60):
        # The operator hammers on the button, or a program is in a loop.
        count, gap = dice.choice(((5, 0.3), (20, 0.1), (100, 0.01), (300, 0.002)))
        call(at, "stop", put=dice.random() < 0.5, times=count, gap=gap)
        for _ in range(dice.randrange(1, 4)):
            call(round(at + dice.uniform(0.0, 3.0), 3), "clear", named=True)
        call(round(at + dice.uniform(3.0, 8.0), 3), "clear", named=True)
    for at in add("typed latches", 30):
        typed = dice.choice((1, 1, 2, 3, 0))
        call(at, dice.choice(("clear", "clear", "activate")), named=True, typed=typed)
    return events


def _settings(dice: random.Random, config: dict[str, Any]) -> dict[str, float]:
    """Return settings for a `set`, legal or not. The daemon must refuse illegal ones."""
    limits, settings = config["limits"], {}
    what = dice.choice(("limits", "limits", "commands", "both"))
    if what != "commands":
        for name in dice.sample(sorted(limits), dice.randrange(1, 3)):
            share = dice.choice((0.1, 0.5, 0.8, 1.3, 3.0))
            settings[f"limits.{name}"] = round(limits[name] * share, 3)
    if what != "limits":
        source = dice.choice(config["commands"]["sources"])["name"]
        settings[f"commands.sources.{source}.timeout"] = dice.choice((0.1, 0.25, 0.4, 1.0))
    return settings
