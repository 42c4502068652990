"""Commanders of an arbiter in a simulated time; they act by a story in words."""

from __future__ import annotations

import math

from acsard.core.config.settings import CommandsConfig, McuConfig, Source
from acsard.core.link.link_setup import LinkSetup
from acsard.core.link.step_times import StepTimes
from acsard.core.motion.arbiter import Arbiter, Choice
from acsard.core.values import (
    BRIDGES,
    NS_PER_S,
    REST,
    Announcement,
    Command,
    SourceStatus,
    Twist,
)

MS = 1_000_000
GO = Twist(0.5, 0.2)
TWISTS = {
    "go": GO,
    "back": Twist(-0.3, 0.0),
    "zero": REST,
    "cancelled": REST,
    "nan": Twist(math.nan, 0.0),
    "inf": Twist(0.0, -math.inf),
    "huge": Twist(1e308, -1e308),
    "tiny": Twist(0.0, 1e-9),
    "negative-zero": Twist(-0.0, -0.0),
}
SOURCES = (
    Source("high", 100),
    Source("slow", 100, timeout=1.0),
    Source("left", 50),
    Source("right", 50),
    Source("low", 10),
    Source("pause", 5, neutral_first="pause"),
)


SETUP = LinkSetup.of(McuConfig(), 100.0)


def begin(arbiter: Arbiter, steps: StepTimes, now_ns: int, commands: CommandsConfig) -> None:
    """Begin a step, as the robot does."""
    before_ns = steps.begin(SETUP, now_ns)
    if before_ns is not None and steps.is_late:
        arbiter.resume(before_ns, now_ns, commands)


class Commanders:
    """Senders of `SOURCES`. Their clocks are ahead of the robot's by `offset_ns`."""

    def __init__(self, armed: bool = False, reverse: bool = False) -> None:
        self.commands = CommandsConfig(SOURCES[::-1] if reverse else SOURCES)
        self.arbiter, self.steps = Arbiter(), StepTimes()
        self.bridges = 0
        self.now_ns = 10 * NS_PER_S
        self.offset_ns = 1_800_000_000 * NS_PER_S
        if armed:
            for source in SOURCES:
                self.act(source.name, "zero")
            self.wait(3000)

    def wait(self, ms: float) -> Commanders:
        self.now_ns += int(ms * MS)
        return self

    def act(self, who: str, what: str) -> str:
        """Send a command. Return "", or the code for which it is refused.

        `source.sender`, with `*` if several programs may share the identity, `^` for one behind a
        bridge of ROS, and `#5` for the fifth command of a ROS publisher; `@50`: its stamp is 50 ms
        old.
        """
        who, _, number = who.partition("#")
        source, _, sender = who.rstrip("*^").partition(".")
        what, stamped, late_ms = what.partition("@")
        if what == "unreadable":
            self.arbiter.notice(source, sender, self.now_ns)
            return ""
        stamp_ns = self.now_ns + self.offset_ns - int(float(late_ms) * MS) if stamped else None
        return self.accept(
            Command(
                source, TWISTS[what], self.now_ns, stamp_ns, sender, sender,
                cancelled=what == "cancelled", shared=who.endswith(("*", "^")),
                sequence=int(number) if number else None, bridged=who.endswith("^"),
                ros=bool(number) or who.endswith("^"),
            )
        )  # fmt: skip

    def accept(self, command: Command) -> str:
        refused = self.arbiter.accept(command, self.commands)
        return "" if refused is None else refused.what

    def play(self, story: str) -> Commanders:
        """Play a story, such as `high zero; 200 high nan ! not_finite > high; 51 ? low command`.

        A step may begin with a wait in ms. `!` is the refusal; `>` who drives; `?` what a source
        waits for. `reset` requires a zero, `wake` is a step of the daemon. The token of a publisher
        appears (`+pause.a`) or disappears (`-pause.a`); without a name it is that of a bridge.
        """
        for step in story.split(";"):
            did, _, wait = step.partition("?")
            did, _, driver = did.partition(">")
            did, _, refused = did.partition("!")
            words = did.split()
            if words and words[0].lstrip("-").replace(".", "").isdigit():
                self.wait(float(words.pop(0)))
            match words:
                case ["reset"]:
                    self.arbiter.require_neutral(self.now_ns)
                case ["wake"]:
                    begin(self.arbiter, self.steps, self.now_ns, self.commands)
                case [token] if token[0] in "+-":
                    source, _, sender = token[1:].partition(".")
                    present = token[0] == "+"
                    if not sender:
                        self.bridges += 1 if present else -1
                        present = self.bridges > 0
                    self.arbiter.announce(
                        Announcement(source, sender or BRIDGES, present, self.now_ns)
                    )
                case [who, what]:
                    assert self.act(who, what) == refused.strip(), step
            if driver:
                assert self.driver() == driver.strip(), step
            if wait:
                source, what = wait.split()
                assert self.status(source).waits_for.what == what, step
        return self

    def prove_clock(self, who: str) -> Commanders:
        """Send zeros until the arbiter accepts the stamps of this sender's clock."""
        answers = [self.wait(50).act(who, "zero@0") for _ in range(20)]
        assert answers[-1] == ""
        return self

    def choice(self) -> Choice:
        return self.arbiter.choose(self.now_ns, self.commands)

    def driver(self) -> str:
        """Return who drives, and `back` or `zero` if it wants that; "-" if nobody does."""
        choice = self.choice()
        if choice.twist is None:
            return "-"
        name = f"{choice.source}.{choice.sender}".rstrip(".")
        wish = next(wish for wish, twist in TWISTS.items() if twist == choice.twist)
        return name if wish == "go" else f"{name} {wish}"

    def status(self, source: str) -> SourceStatus:
        (status,) = (s for s in self.statuses() if s.name == source)
        return status

    def statuses(self) -> tuple[SourceStatus, ...]:
        return self.arbiter.status(self.now_ns, self.commands)
