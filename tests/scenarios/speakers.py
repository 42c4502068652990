"""Simulated programs that send commands over a delayed network, stamped by adjustable clocks."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from typing import Literal, NamedTuple

import msgspec

from acsard.core.incoming.commands import Arrival, Via, publisher_name
from acsard.core.messages.encodings import encode
from acsard.core.messages.schema import Header, Time, Twist, TwistStamped, Vector3
from acsard.core.ros.attachments import Attachment
from acsard.core.values import BRIDGES, NS_PER_S, Announcement
from tests.scenarios.world import World
from tests.stepped import Outputs

Way = Literal["client", "signed", "rmw", "header", "zenoh", "routed", "plain", "bridge"]
FOREIGN: tuple[Way, ...] = ("signed", "rmw", "header", "zenoh")
"""Routes on which messages have stamps of a wall clock. Our own client echoes a beat."""
STAMPED: tuple[Way, ...] = ("client", *FOREIGN)
AHEAD_NS = NS_PER_S // 2
"""Zenoh replaces a timestamp that is further ahead of the receiver's clock than this."""


class Message(NamedTuple):
    """A command on its way: m/s, stamp by the program's clock, number, and time of its beat."""

    linear: float
    stamp_ns: int
    number: int
    beat_us: int


class Speaker:
    """A program that commands the source `app`. Its clock is `ahead` s ahead of the robot's."""

    def __init__(self, world: World, way: Way, name: str = "a", ahead: float = 0.0) -> None:
        self.world, self.way, self.name, self.ahead = world, way, name, ahead
        self._sent = 0
        self.key = "cmd/app"
        self.via: Via = way if way in ("rmw", "bridge") else "native"
        self.session = "session of a router" if way == "routed" else f"session of {name}"
        """The id of the Zenoh session that stamps its messages."""

    def message(self, linear: float) -> Message:
        """Create the next message."""
        self._sent += 1
        world = self.world
        stamp_ns = int(world.instant.wall_ns + self.ahead * NS_PER_S)
        return Message(linear, stamp_ns, self._sent, world.now_ns // 1000)

    def deliver(self, message: Message, angular: float = 0.0) -> None:
        """Deliver the message now."""
        linear, stamp_ns, number, beat_us = message
        world, way = self.world, self.way
        twist = Twist(Vector3(linear), Vector3(z=angular))
        stamped = TwistStamped(Header(Time.from_ns(stamp_ns)), twist)
        headed = way in ("client", "signed", "header")
        payload = encode(stamped if headed else twist, "cdr")
        attachment, sender, told_ns = b"", "", None
        if way == "rmw":
            attachment = Attachment(number, stamp_ns, self._gid).pack()
        elif way in ("client", "signed"):
            signature = {"sender": self.name, "stamp": stamp_ns, "sequence": number}
            echo = {"echo": {"run": 0, "boot_us": beat_us}} if way == "client" else {}
            attachment = msgspec.msgpack.encode(signature | echo)
        by_zenoh = way in ("client", "signed", "zenoh", "routed")
        if by_zenoh and stamp_ns - world.instant.wall_ns <= AHEAD_NS:
            sender, told_ns = self.session, stamp_ns
        kind = "TwistStamped" if headed else "Twist"
        encoding = f"application/cdr;geometry_msgs/msg/{kind}"
        arrival = Arrival(
            self.key, True, payload, encoding, world.now_ns, told_ns, sender, self.via, attachment
        )
        arrival = msgspec.structs.replace(
            arrival,
            boot_ns=world.now_ns,
            received_ns=None if sender else world.instant.wall_ns,
        )
        world.bus.arrivals.append(arrival)

    def announce(self) -> None:
        """Let the liveliness token of this ROS publisher, or that of its bridge, appear."""
        sender = publisher_name(self._gid) if self.way == "rmw" else BRIDGES
        token = Announcement(self.key.removeprefix("cmd/"), sender, True, self.world.now_ns)
        self.world.bus.announced.append(token)

    @property
    def _gid(self) -> bytes:
        return self.name.encode().ljust(16)

    def send(self, linear: float) -> None:
        """Send a message that arrives at once."""
        self.deliver(self.message(linear))

    def hold(self, linear: float, seconds: float, hz: float = 20.0) -> None:
        """Send this speed in m/s at `hz` for `seconds`."""
        for _ in range(round(seconds * hz)):
            self.send(linear)
            self.world.run(1 / hz)

    def open(self, linear: float = 0.4, hz: float = 20.0) -> None:
        """Send zeros for 1 s, then a speed for 1 s. Check that the robot drives at the end."""
        self.hold(0.0, 1.0, hz)
        self.hold(linear, 1.0, hz)
        assert self.world.state.mode == "driving", (self.way, self.world.state.reason)


def over(
    world: World,
    speaker: Speaker,
    delay: Callable[[float], float],
    speed: Callable[[float], float],
    seconds: float,
    hz: float = 20.0,
) -> tuple[float, int]:
    """Send commands through a network that delays them, and return how old they were when obeyed.

    A command sent `t` seconds after the call has the speed `speed(t)` in m/s. It arrives `delay(t)`
    seconds later, or later still to keep the order. Returns the age on arrival of the oldest speed
    that the robot obeyed, in s, and the number of speeds that it obeyed.
    """
    start_ns, queue = world.now_ns, deque[tuple[int, Message]]()
    sent: dict[int, tuple[Message, float]] = {}
    oldest, obeyed = 0.0, set[int]()

    def watch(outputs: Outputs) -> None:
        nonlocal oldest
        arrived_ns = outputs.command_ns
        if arrived_ns in sent and outputs.mode == "driving" and outputs.applied.linear:
            assert arrived_ns is not None
            message, age = sent[arrived_ns]
            if message[0]:
                oldest = max(oldest, age)
                obeyed.add(arrived_ns)

    before, world.watch = world.watch, watch
    number, last_ns = 0, 0
    while number < seconds * hz or queue:
        send_ns = start_ns + int(number / hz * NS_PER_S)
        if number < seconds * hz and (not queue or send_ns <= queue[0][0]):
            world.run(max(0.0, (send_ns - world.now_ns) / NS_PER_S))
            t = number / hz
            last_ns = max(last_ns + 1, world.now_ns + int(delay(t) * NS_PER_S))
            queue.append((last_ns, speaker.message(speed(t))))
            sent[last_ns] = (queue[-1][1], (last_ns - world.now_ns) / NS_PER_S)
            number += 1
            continue
        arrive_ns, message = queue.popleft()
        world.run(max(0.0, (arrive_ns - world.now_ns) / NS_PER_S))
        sent[world.now_ns] = (message, sent.pop(arrive_ns)[1])
        speaker.deliver(message)
        if world._listens:
            world.run(0.0)
    world.run(0.3)
    world.watch = before
    return oldest, len(obeyed)


def moved(world: World, since_ns: int) -> bool:
    """Return whether the daemon has sent a line with a wheel speed since `since_ns`."""
    return first_motion(world, since_ns) is not None


def first_motion(world: World, since_ns: int) -> float | None:
    """Return how long after `since_ns` the daemon has sent a wheel speed, s, or None."""
    still = (b"ap00.00,bp00.00,cp00.00,dp00.00\r\n", b"?\r\n")
    moving_ns = (at for at, line in world.port.sent if at >= since_ns and line not in still)
    first_ns = next(moving_ns, None)
    return None if first_ns is None else (first_ns - since_ns) / NS_PER_S
