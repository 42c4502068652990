"""Creates the messages of one sender of a plan: their times of sending and arrival, and bytes.

This module does not use the product. The formats are those of
`explanation/commands.md` of the manual.
"""

from __future__ import annotations

import hashlib
import json
import math
import random
import struct
from functools import lru_cache
from typing import Any, NamedTuple

import msgspec

from tests.simulate import wiring

NS = 1_000_000_000
ECHOING = ("client", "page")
"""Ways of the programs that copy the newest beat into each command."""

FOREIGN = ("signed", "rmw", "header", "zenoh", "routed", "bridged")
AHEAD_NS = NS // 2
"""Zenoh replaces a timestamp that is further ahead of the receiver's clock."""

SWAPPED_NS = 2_000_000
"""If the network swaps the last two messages of a drive, the speed arrives this long after the
zero."""

LAST_STAMP = 2**63 - 1
"""No attachment has a higher stamp, and each stamp is above 0: another attachment is ignored."""

BAD_STAMPS = (-5 * NS, 0, 4_102_444_800 * NS, LAST_STAMP, 2**64 - 1)
"""Stamps of broken clocks: before 1970, without a time, in 2100, and at the ends of the types."""

JUNK = ("garbage", "not a number", "delete", "wildcard", "huge", "stranger", "cancels", "fields")


class Message(NamedTuple):
    """One command with its true times, in ns."""

    sent_ns: int
    arrives_ns: int
    v: float
    w: float
    stamp_ns: int
    number: int
    junk: str


class Sample(NamedTuple):
    """A sample as the bus delivers it, with its sender's identity."""

    key: str
    payload: bytes
    options: dict[str, Any]
    identity: str
    shared: bool
    clock: str
    """The clock that stamped it, "" without a stamp."""
    beat: tuple[int, int] | None = None
    """The run and the true time of the beat that it echoes, ns."""


def messages(sender: dict[str, Any], seed: int, seconds: float, wall_ns: int) -> list[Message]:
    """Return all messages of a sender in the order of their arrival.

    `wall_ns` is the wall-clock time at the start of the plan.
    """
    dice = random.Random(f"{seed} {sender['name']}")
    # Most senders of junk send few kinds of it, because one kind may hide what another one does.
    swarm = random.Random(f"junk {seed} {sender['name']}")
    kinds = swarm.sample(JUNK, swarm.choice((1, 1, 2, len(JUNK))))
    bad_stamps = random.Random(f"stamps {seed} {sender['name']}")
    bad_share = sender.get("bad_stamps", 0.0)
    arrivals: list[Message] = []
    last_ns, number, t = 0, 0, float(sender["from"])
    phases, place = sender["phases"], -1
    ends, ended = dict(sender.get("ends", ())), -1
    while t < min(sender["to"], seconds):
        while place + 1 < len(phases) and phases[place + 1][0] <= t:
            place += 1
        chance = [dice.random() for _ in range(6)]
        wish: list[Any] = phases[place][1:] if place >= 0 else [None, None]
        # A drive in `ends` has a single zero at its end.
        repeats = place >= 0 and phases[place][0] in ends and place == ended
        if wish[0] is not None and not repeats:
            number += 1
            late = (
                sender["delay"] + _jitter(sender["jitter"], chance[0]) + congestion_delay(sender, t)
            )
            arrives_ns = int((t + late) * NS)
            lost = chance[1] < sender["loss"] or _is_away(sender, t)
            junk = kinds[int(chance[2] * 1e6) % len(kinds)] if chance[3] < sender["junk"] else ""
            if not lost:
                arrives_ns = last_ns = max(last_ns + 1000, arrives_ns)
                if chance[4] < sender["swap"]:
                    arrives_ns += int(1.5 / sender["hz"] * NS)
                stamp_ns = wall_ns + int((t + _ahead(sender, t)) * NS)
                if bad_share and bad_stamps.random() < bad_share:
                    stamp_ns = bad_stamps.choice(BAD_STAMPS)
                v, w = float(wish[0]), float(wish[1])
                message = Message(int(t * NS), arrives_ns, v, w, stamp_ns, number, junk)
                if place >= 0 and ends.get(phases[place][0]):
                    _let_last_wait(arrivals, number - 1, arrives_ns + SWAPPED_NS)
                arrivals.append(message)
                if chance[5] < sender["twice"]:
                    again_ns = arrives_ns + int(chance[0] * 0.4 * NS)
                    arrivals.append(message._replace(arrives_ns=again_ns))
            ended = place
        hz = _hz(sender, t)
        t += (0.9 + 0.2 * chance[0]) / hz if sender["jitter"] else 1 / hz
    end_ns = int((seconds + 0.2) * NS)
    return sorted(
        (item for item in arrivals if item.arrives_ns < end_ns), key=lambda m: m.arrives_ns
    )


def _let_last_wait(arrivals: list[Message], number: int, until_ns: int) -> None:
    """Let the message with this number, which is the last one so far, arrive at this time."""
    for place in range(max(0, len(arrivals) - 2), len(arrivals)):
        if arrivals[place].number == number:
            arrivals[place] = arrivals[place]._replace(arrives_ns=until_ns)


def _hz(sender: dict[str, Any], t: float) -> float:
    """Return how often the sender sends at this time, Hz."""
    for begin, end, hz in sender.get("bursts", ()):
        if begin <= t < end:
            return float(hz)
    return float(sender["hz"])


def _jitter(scale: float, chance: float) -> float:
    return min(0.1, -scale * math.log(1.0 - chance)) if scale else 0.0


def congestion_delay(sender: dict[str, Any], t: float) -> float:
    """Return the additional network delay of a message that is sent at `t`, in s."""
    for begin, end, shape, size in sender["congestion"]:
        if shape == "drain":
            # Everything waits until half of the time is over, then flows faster than it was sent.
            middle = (begin + end) / 2
            if begin <= t < end:
                return float(max(0.0, middle + (t - begin) / size - t))
            continue
        if not begin <= t < end:
            continue
        match shape:
            case "grow":
                return float(size * (t - begin))
            case "jump":
                return float(size)
            case "hole":
                return float(end - t)
            case "burst":
                return float(size - (t - begin) % size)
    return 0.0


def _is_away(sender: dict[str, Any], t: float) -> bool:
    """Return whether the network loses all that is sent at `t`."""
    away: list[list[float]] = sender.get("away", [])
    return any(begin <= t < end for begin, end in away)


def _ahead(sender: dict[str, Any], t: float) -> float:
    """Return the offset of the sender's clock from true time at `t`, in s."""
    ahead = sender["ahead"] + sender["drift"] * t
    for kind, at, *rest in sender["clock"]:
        if kind == "step" and t >= at:
            ahead += rest[0]
        elif kind == "slew" and t >= at:
            ahead += rest[1] * (min(t, rest[0]) - at)
    return float(ahead)


def is_slewed(sender: dict[str, Any], t: float) -> bool:
    """Return whether the clock of this sender is slewed at `t`."""
    return any(kind == "slew" and at <= t < rest[0] for kind, at, *rest in sender["clock"])


def stable(sender: dict[str, Any]) -> bool:
    """Return whether nothing adjusts this sender's clock, and all its stamps are true."""
    return not sender["clock"] and not sender.get("bad_stamps")


def sample(
    sender: dict[str, Any],
    message: Message,
    config: dict[str, Any],
    robot_wall_ns: int,
    beat: tuple[int, int] | None = None,
    boot_ns: int = 0,
) -> Sample:
    """Return a message as it arrives at the robot, whose wall clock shows `robot_wall_ns`.

    `beat` is the one that its sender has received last, and `boot_ns` the time since the start of
    the robot's computer at the true time 0.
    """
    way, source = sender["way"], sender["source"]
    options: dict[str, Any] = {}
    own = f"{sender['id']}{message.number}" if sender["churn"] else sender["id"]
    identity, shared, clock = own, False, own
    keeps = message.stamp_ns - robot_wall_ns <= AHEAD_NS
    session, stamp_ns = "", None
    by_key = f"native/{source}"
    # The seconds of a header end below the highest stamp.
    stamp_counts = message.stamp_ns > 0 and (way == "header" or message.stamp_ns <= LAST_STAMP)
    match way:
        case "client" | "page" | "signed" | "header" if not stamp_counts:
            identity, shared, clock = by_key, True, ""
    match way:
        case "client" | "page" | "signed":
            options["attachment"] = msgspec.msgpack.encode(
                {"sender": own, "stamp": message.stamp_ns, "sequence": message.number}
                | ({} if beat is None or identity != own else {"echo": _echo(beat, boot_ns)})
            )
        case "rmw":
            gid = _gid(own)
            options["attachment"] = struct.pack(
                "<qqB16s", message.number, min(message.stamp_ns, LAST_STAMP), 16, gid
            )
        case "header" if stamp_counts:
            identity, shared, clock = by_key, True, f"header {by_key}"
        case "zenoh" | "routed" | "bridged":
            session = _stamper(sender, message, own)
            identity, shared, clock = session or by_key, True, session
            stamp_ns = message.stamp_ns if session else None
        case "plain":
            identity, shared, clock = by_key, True, ""
        case "bridge":
            identity, shared, clock = f"bridge/{source}", True, ""
    if sender.get("stamps_speeds") and (message.v or message.w):
        clock = f"header {own}"  # the attachment has the stamps of the zeros
    via = "bridge" if way.startswith("bridge") else "rmw" if way == "rmw" else "native"
    if stamp_ns is not None and not keeps:
        session, stamp_ns, shared, clock = "", None, True, ""
        identity = f"{via if via == 'bridge' else 'native'}/{source}"
    options.update(via=via, session=session, stamp_ns=stamp_ns)
    key, payload = _payload(sender, message, config, via, options)
    if identity != own:
        beat = None  # its stamp makes its attachment invalid
    return Sample(key, payload, options, identity, shared, clock, beat)


def _echo(beat: tuple[int, int], boot_ns: int) -> dict[str, int]:
    return {"run": beat[0], "boot_us": (beat[1] + boot_ns) // 1000}


def _stamper(sender: dict[str, Any], message: Message, own: str) -> str:
    """Return the Zenoh session that stamps this message, or "" if the daemon's own session does."""
    if sender["way"] == "bridged":
        return "session of the bridge"
    if sender["way"] == "routed":
        at_s = message.sent_ns / NS
        return next((name for since_s, name in reversed(sender["routers"]) if at_s >= since_s), "")
    return f"session of {own}"


@lru_cache(64)
def _gid(own: str) -> bytes:
    return hashlib.sha256(own.encode()).digest()[:16]


def _payload(
    sender: dict[str, Any],
    message: Message,
    config: dict[str, Any],
    via: str,
    options: dict[str, Any],
) -> tuple[str, bytes]:
    kind = "wheel_cmd" if sender["wheels"] and via == "native" else "cmd"
    if message.junk == "cancels" and len(wiring.wheels(config)) == 2:
        kind = "cmd"  # each speed of two wheels moves the robot
    key, v, w = f"{kind}/{sender['source']}", message.v, message.w
    match message.junk:
        case "garbage":
            return key, b'{"linear": {"x": '
        case "delete":
            options["put"] = False
        case "wildcard":
            return f"{kind}/*", b'{"linear": {"x": 1.0}, "angular": {}}'
        case "huge":
            return key, b'{"linear": {"x": 1.0}, "angular": {}}' + b" " * 5000
        case "stranger":
            key = f"{kind}/stranger"
        case "not a number":
            v = math.nan
        case "fields":
            return key, b'{"linear": {"x": 1.0, "warp": 9}, "angular": {}}'
    if kind == "wheel_cmd":
        return key, _wheels(config, v, w, cancels=message.junk == "cancels")
    if message.junk == "cancels":
        linear, angular = {"x": 0.0, "y": 1.0}, {"z": 0.0}
    else:
        linear, angular = {"x": v}, {"z": w}
    if sender["form"] == "cdr" or via != "native" or math.isnan(v):
        sideways = 1.0 if message.junk == "cancels" else 0.0
        return key, _cdr(sender, message, linear["x"], sideways, angular["z"], options)
    body: dict[str, Any] = {"linear": linear, "angular": angular}
    if _is_stamped(sender):
        seconds, nanoseconds = _seconds(sender, message)
        body = {"header": {"stamp": {"sec": seconds, "nanosec": nanoseconds}}, "twist": body}
    if sender["form"] == "msgpack":
        return key, msgspec.msgpack.encode(body)
    return key, json.dumps(body).encode()


def _cdr(
    sender: dict[str, Any],
    message: Message,
    v: float,
    sideways: float,
    w: float,
    options: dict[str, Any],
) -> bytes:
    twist = struct.pack("<6d", v, sideways, 0.0, 0.0, 0.0, w)
    name = "TwistStamped" if _is_stamped(sender) else "Twist"
    options["encoding"] = f"application/cdr;geometry_msgs/msg/{name}"
    if not _is_stamped(sender):
        return b"\0\1\0\0" + twist
    seconds, nanoseconds = _seconds(sender, message)
    # An empty frame_id is a length of 1 and a NUL; the doubles are aligned to 8.
    return b"\0\1\0\0" + struct.pack("<iIIB3x", seconds, nanoseconds, 1, 0) + twist


def _is_stamped(sender: dict[str, Any]) -> bool:
    """Return whether this sender sends messages with a header."""
    return sender["way"] == "header" or bool(sender.get("stamps_speeds"))


def _seconds(sender: dict[str, Any], message: Message) -> tuple[int, int]:
    """Return the stamp of a header in signed 32-bit seconds and ns.

    It is 0 for a zero if the sender stamps only its speeds.
    """
    if sender.get("stamps_speeds") and not (message.v or message.w):
        return 0, 0
    return divmod(min(message.stamp_ns, (2**31 - 1) * NS), NS)


def _wheels(config: dict[str, Any], v: float, w: float, cancels: bool) -> bytes:
    drive = config.get("drive", {})
    radius = drive.get("wheel_radius", 0.05)
    track = drive.get("wheel_separation", 0.3) * drive.get("wheel_separation_multiplier", 1.0)
    half = w * track / 2
    left = (v - half) / (radius * drive.get("left_wheel_radius_multiplier", 1.0))
    right = (v + half) / (radius * drive.get("right_wheel_radius_multiplier", 1.0))
    wheels = wiring.wheels(config)
    speeds = ([1.0, -1.0, 1.0, -1.0] if cancels else [right, left, left, right])[: len(wheels)]
    names = [f"{wheel}_wheel_joint" for wheel in wheels]
    # msgpack says NaN, JSON does not.
    return msgspec.msgpack.encode({"name": names, "velocity": speeds})


def parameters(settings: dict[str, float]) -> bytes:
    """Return a request of ROS in CDR that sets these parameters."""
    out = struct.pack("<I", len(settings))
    for name, value in settings.items():
        text = name.encode() + b"\0"
        out += b"\0" * (-len(out) % 4) + struct.pack("<I", len(text)) + text
        out += b"\3\0"  # the type of a double, and no bool
        out += b"\0" * (-len(out) % 8) + struct.pack("<qd", 0, value)
        # An empty string is a length of 1 and a NUL; then come five empty lists.
        out += struct.pack("<IB3x5I", 1, 0, 0, 0, 0, 0, 0)
    return b"\0\1\0\0" + out


def read_reply(reply: bytes, via: str, listed: bool = False) -> tuple[bool, str]:
    """Return whether a call worked, and the answer in words.

    `listed` is true for a reply of ROS with a list of results, of which the first is read.
    """
    if via == "native":
        decoded = msgspec.json.decode(reply)
        return decoded["success"], decoded["message"]
    if listed:
        reply = reply[4:]
    # CDR: a bool, three bytes to the next multiple of four, and a string with its length.
    length = struct.unpack_from("<I", reply, 8)[0]
    return bool(reply[4]), reply[12 : 12 + length - 1].decode()
