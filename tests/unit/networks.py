"""Random networks between a sender and the daemon; the true age of each command is known."""

from __future__ import annotations

import random
from collections.abc import Callable, Iterator

from msgspec import Struct

from acsard.core.motion.ages import Ages, Order
from acsard.core.values import NS_PER_S, Command, Echo, Ns, Twist

TIMEOUT_NS = NS_PER_S // 4

SPEED = Twist(0.5, 0.0)

START_S, RUN = 1000.0, 7

PROMPT_S = 0.1  # a command this young is prompt, beyond the least delay of its network

Delay = Callable[[float], float]  # s after the start -> s


class Network(Struct):
    """The delays of both directions, and a step of the sender's clock."""

    up: Delay
    down: Delay
    loss: float = 0.0
    step_at: float = 0.0
    step: float = 0.0
    seconds: float = 60.0

    def journeys(self, dice: random.Random) -> Iterator[tuple[int, float, float, float]]:
        """Yield number, sending, arrival and newest beat of each command, in true time, s."""
        beats = list(self._beats())
        last, newest = 0.0, 0
        for number in range(int(self.seconds * 20.0)):
            at = number / 20.0 + dice.uniform(-0.002, 0.002)
            while newest + 1 < len(beats) and beats[newest + 1][1] <= at:
                newest += 1
            if dice.random() < self.loss or beats[newest][1] > at:
                continue  # a program without a beat waits
            last = max(at + self.up(at), last)
            yield number + 1, at, last, beats[newest][0]

    def _beats(self) -> Iterator[tuple[float, float]]:
        last, at = 0.0, -2.0
        while at < self.seconds:
            last = max(last, at + self.down(max(at, 0.0)))
            yield at, last
            at += 0.05

    def stamp(self, at: float) -> float:
        return at + (self.step if self.step and at >= self.step_at else 0.0)


def _ns(seconds: float) -> Ns:
    return round((START_S + seconds) * NS_PER_S)


class Outcome(Struct):
    """Figures of a network: oldest obeyed command, s; prompt commands and refused ones."""

    oldest: float = 0.0
    prompt: int = 0
    refused: int = 0
    verdicts: tuple[str, ...] = ()


def play(network: Network, echoes: bool, dice: random.Random) -> Outcome:
    """Play a network, and judge each command by its echo or by its stamp."""
    ages, order, outcome, verdicts = Ages(), Order(), Outcome(), set()
    journeys = list(network.journeys(dice))
    least = min(arrived - sent for _, sent, arrived, _ in journeys)
    for number, sent, arrived, beat in journeys:
        command = Command(
            "app",
            SPEED,
            _ns(arrived),
            None if echoes else _ns(network.stamp(sent)),
            "clock",
            "sender",
            sequence=number,
            echo=Echo(RUN, _ns(beat)) if echoes else None,
            age_ns=_ns(arrived) - _ns(beat) if echoes else None,
        )
        verdict = ages.judge(command, order, TIMEOUT_NS, stalled=False)
        verdicts.add(verdict)
        age = arrived - sent
        if not verdict:
            outcome.oldest = max(outcome.oldest, age)
        if age < least + PROMPT_S:
            outcome.prompt += 1
            outcome.refused += bool(verdict)
    outcome.verdicts = tuple(sorted(verdicts))
    return outcome


def jitter(dice: random.Random, base: float, peaks: float = 0.0) -> Delay:
    """Return a delay with an exponential tail and, in a share of `peaks`, 0.1 s more."""

    def delay(_: float) -> float:
        return base + dice.expovariate(1 / 0.004) + (0.1 if dice.random() < peaks else 0.0)

    return delay


# Round trip and share of peaks, with the largest share of prompt commands that may be refused.
ROUND_TRIPS = {"LAN": (0.002, 0.0, 0.005), "100 ms": (0.1, 0.02, 0.02), "200 ms": (0.2, 0.0, 0.05)}
