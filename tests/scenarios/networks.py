"""A relay between a ROS program and the daemon, and the silences that it makes.

A relay that holds bytes delivers all messages in order at the end of a silence, and one that drops
them loses them. A liveliness token stays until the lease of its session is over: a silence that is
longer ends the session, with all bytes that wait, and both come back with the network.
"""

from __future__ import annotations

import random
from typing import Literal, NamedTuple

import msgspec

from acsard.core.values import NS_PER_S
from tests.scenarios.speakers import Message, Speaker
from tests.scenarios.world import START, World

Way = Literal["rmw", "bridge", "plain"]
WAYS: tuple[Way, ...] = ("rmw", "bridge", "plain")
Event = Literal["clear", "activate", "restart", "reset", "unplug"]
EVENTS: tuple[Event, ...] = ("clear", "activate", "restart", "reset", "unplug")

LEASE_S: dict[Way, float] = {"rmw": 60.0, "bridge": 10.0, "plain": 10.0}
"""Of the program's session, or of its bridge's."""


class Silence(NamedTuple):
    """A silence of the network around an event, which happens 0 s behind the start of the test."""

    way: Way
    event: Event
    holds: bool
    """The relay holds all bytes, or drops them."""
    begin: float
    lasts: float
    again: float
    """From the event to a shorter one behind it, s; 0 for none."""


def random_silence(seed: int) -> Silence:
    """Return a silence of 0.5 to 12 s that begins before its event, with it, or behind it."""
    dice = random.Random(f"silence {seed}")
    way, event = WAYS[seed % 3], EVENTS[seed // 3 % 5]
    lasts = round(dice.choice((dice.uniform(0.5, 12.0), dice.uniform(0.8, 1.3))), 3)
    begin = dice.choice((-dice.uniform(0.0, lasts), 0.0, dice.uniform(0.0, 2.0)))
    again = dice.choice((0.0, lasts + begin + dice.uniform(0.2, 4.0)))
    return Silence(way, event, dice.random() < 0.5, round(begin, 3), lasts, round(again, 3))


class Road:
    """The network between a publisher that never stops and the robot, whose daemon may restart."""

    HZ = 20.0

    def __init__(self, way: Way, holds: bool, silences: list[tuple[float, float]]) -> None:
        """The silences are begins and ends, s of the clock whose 0 is `zero_ns`."""
        self.world = World()
        self.zero_ns = START.mono_ns
        self._way, self._holds, self._silences = way, holds, silences
        self._speaker = self._program()
        self._held: list[Message] = []
        self._token = False
        self._lease_s = LEASE_S[way]

    def _program(self, sent: int = 0) -> Speaker:
        speaker = Speaker(self.world, self._way, "nav")
        speaker.key, speaker._sent = "cmd/nav", sent
        return speaker

    @property
    def now(self) -> float:
        return (self.world.now_ns - self.zero_ns) / NS_PER_S

    def restart(self) -> None:
        """Kill the daemon, and start it 0.3 s later on the same board."""
        old = self.world
        self.world = World(plugged=False)
        self.world.now_ns = self.world.next_period_ns = old.now_ns
        self.world.mcu = old.mcu
        if old.port.mcu is not None:
            self.world.port.plug(old.mcu)
        self._speaker = self._program(self._speaker._sent)
        self._token = False
        self._held.clear()  # in the kernel of the robot's computer, or of no use to a new session

    def run(self, until: float, linear: float | None) -> None:
        """Let time pass while the program sends this speed in m/s at 20 Hz, or nothing."""
        while self.now < until - 1e-9:
            silence = next((s for s in self._silences if s[0] <= self.now < s[1]), None)
            self._pass_tokens(silence)
            if silence is None:
                self._deliver_held()
            if linear is not None:
                message = self._speaker.message(linear)
                if silence is None:
                    self._speaker.deliver(message)
                elif self._holds and self.now - silence[0] < self._lease_s:
                    self._held.append(message)
            self.world.run(1.0 / self.HZ)

    def _deliver_held(self) -> None:
        for message in self._held:
            self._speaker.deliver(message)
        self._held.clear()

    def _pass_tokens(self, silence: tuple[float, float] | None) -> None:
        if silence is None and not self._token and self._way != "plain":
            self._announce(True)
        elif silence is not None and self.now - silence[0] >= self._lease_s:
            self._held.clear()
            if self._token:
                self._announce(False)

    def _announce(self, present: bool) -> None:
        self._speaker.announce()
        announced = self.world.bus.announced
        announced[-1] = msgspec.structs.replace(announced[-1], present=present)
        self._token = present
