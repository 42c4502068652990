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


class Journey(Struct):
    """A command on its way: when it was sent and when it arrived, in true time, s; its number."""

    sent: float
    arrived: float
    number: int
    beat: float = 0.0  # time of the newest beat at the sender


class Network(Struct):
    """The delays of both directions; what the network and the two computers do besides."""

    up: Delay
    down: Delay
    loss: float = 0.0
    repeated: float = 0.0
    swapped: float = 0.0
    step_at: float = 0.0  # the clock of the sender is set at this time
    step: float = 0.0  # by so much
    drift: float = 0.0
    suspended_at: float = 0.0
    suspended: float = 0.0
    queued: bool = False  # from the first command on
    hz: float = 20.0
    seconds: float = 30.0

    def journeys(self, dice: random.Random) -> list[Journey]:
        """Return the commands in the order in which they arrive."""
        beats = list(self._beats())
        sent, last, newest = [], 0.0, 0
        for number in range(int(self.seconds * self.hz)):
            at = number / self.hz + dice.uniform(-0.002, 0.002)
            while newest + 1 < len(beats) and beats[newest + 1][1] <= at:
                newest += 1
            if dice.random() < self.loss or beats[newest][1] > at:
                continue  # a program without a beat waits
            last = max(at + self.up(at), last)
            sent.append(Journey(at, self._awake(last), number + 1, beats[newest][0]))
        for index in range(1, len(sent)):
            if dice.random() < self.swapped:
                one, two = sent[index - 1], sent[index]
                one.arrived, two.arrived = two.arrived, one.arrived
        again = [
            Journey(one.sent, one.arrived + dice.choice([0.001, 0.2, 3.0]), one.number, one.beat)
            for one in sent
            if dice.random() < self.repeated
        ]
        return sorted([*sent, *again], key=lambda one: one.arrived)

    def _awake(self, at: float) -> float:
        # A suspended computer reads the command when it wakes up.
        end = self.suspended_at + self.suspended
        return max(at, end) if self.suspended and at >= self.suspended_at else at

    def _beats(self) -> Iterator[tuple[float, float]]:
        last, at = 0.0, -2.0
        while at < self.seconds:
            if not (self.suspended and 0 <= at - self.suspended_at < self.suspended):
                last = max(last, at + self.down(max(at, 0.0)))
                yield at, last
            at += 0.05

    def stamp(self, at: float) -> float:
        return at * (1 + self.drift) + (self.step if self.step and at >= self.step_at else 0.0)

    def monotonic(self, at: float) -> float:
        """Return the monotonic time, which does not go on in a suspend."""
        end = self.suspended_at + self.suspended
        return at if not self.suspended or at < end else at - self.suspended


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
    journeys = network.journeys(dice)
    least = min((one.arrived - one.sent for one in journeys), default=0.0)
    newest = 0
    for one in journeys:
        command = Command(
            "app",
            SPEED,
            _ns(network.monotonic(one.arrived)),
            None if echoes else _ns(network.stamp(one.sent)),
            "clock",
            "sender",
            sequence=one.number,
            echo=Echo(RUN, _ns(one.beat)) if echoes else None,
            age_ns=_ns(one.arrived) - _ns(one.beat) if echoes else None,
        )
        verdict = ages.judge(command, order, TIMEOUT_NS, stalled=False)
        verdicts.add(verdict)
        age = one.arrived - one.sent
        if not verdict:
            outcome.oldest = max(outcome.oldest, age)
            assert one.number > newest, "an old command was obeyed again"
            newest = one.number
        elif one.number <= newest:
            continue
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


def trouble(dice: random.Random, base: Delay, seconds: float, queued: bool) -> Delay:
    """Return `base` with a queue from the start, plateaus, growth and bursts."""
    parts: list[tuple[str, float, float, float]] = []
    if queued:
        end = dice.uniform(1, 1.5 * seconds)
        parts.append((dice.choice(["plateau", "drain"]), 0.0, end, dice.uniform(0.3, 10)))
    for _ in range(dice.randrange(4)):
        begin = dice.uniform(2, seconds)
        kind = dice.choice(["plateau", "growth", "drain", "burst"])
        parts.append((kind, begin, begin + dice.uniform(0.2, 15), dice.uniform(0.05, 8)))

    def delay(at: float) -> float:
        value = base(at)
        for kind, begin, end, height in parts:
            if begin <= at < end:
                share = (at - begin) / (end - begin)
                value += {
                    "plateau": height, "growth": height * share, "drain": height * (1 - share),
                    "burst": end - at,
                }[kind]  # fmt: skip
        return value

    return delay


def random_network(dice: random.Random) -> Network:
    seconds, queued = dice.uniform(8, 40), dice.random() < 0.3
    up = jitter(dice, dice.uniform(0.001, 0.05), dice.choice([0.0, 0.02]))
    down = jitter(dice, dice.uniform(0.001, 0.05), dice.choice([0.0, 0.02]))
    set_clock, sleeps = dice.random() < 0.2, dice.random() < 0.15
    return Network(
        trouble(dice, up, seconds, queued),
        trouble(dice, down, seconds, False),
        loss=dice.choice([0.0, 0.0, 0.05, 0.3]),
        repeated=dice.choice([0.0, 0.0, 0.05]),
        swapped=dice.choice([0.0, 0.0, 0.03]),
        step_at=dice.uniform(0, seconds),
        step=dice.uniform(-10, 10) if set_clock else 0.0,
        drift=dice.uniform(-5e-5, 5e-5),
        suspended_at=dice.uniform(0, seconds),
        suspended=dice.uniform(0.1, 20) if sleeps else 0.0,
        queued=queued,
        hz=dice.choice([5.0, 20.0, 50.0]),
        seconds=seconds,
    )


# Round trip and share of peaks, with the largest share of prompt commands that may be refused.
ROUND_TRIPS = {"LAN": (0.002, 0.0, 0.005), "100 ms": (0.1, 0.02, 0.02), "200 ms": (0.2, 0.0, 0.05)}
