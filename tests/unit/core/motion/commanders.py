"""Commanders for the tests of the arbiter, with a simulated time."""

from __future__ import annotations

from acsard.core.config.settings import CommandsConfig, Source
from acsard.core.motion.arbiter import Arbiter, Choice
from acsard.core.values import NS_PER_S, REST, Command, SourceStatus, Twist

MS = 1_000_000
HOUR_NS = 3600 * NS_PER_S
GO = Twist(0.5, 0.2)
BACK = Twist(-0.3, 0.0)

HIGH = Source("high", 100)
SLOW = Source("slow", 100, timeout=1.0)
LEFT = Source("left", 50)
RIGHT = Source("right", 50)
LOW = Source("low", 10)


class Bench:
    """An arbiter with a simulated time. The senders' clocks are ahead by `offset_ns`."""

    def __init__(
        self,
        *sources: Source,
        armed: bool = True,
    ) -> None:
        self.commands = CommandsConfig(sources)
        self.arbiter = Arbiter()
        self.arbiter.require_neutral()
        self.now_ns = 10 * NS_PER_S
        self.offset_ns = 1_800_000_000 * NS_PER_S
        if armed:
            for source in sources:
                self.send(source, REST)
            self.wait(3000)

    def wait(self, ms: float) -> Bench:
        self.now_ns += int(ms * MS)
        return self

    def send(
        self,
        source: Source | str,
        twist: Twist = GO,
        sender: str = "",
        shared: bool = False,
        cancelled: bool = False,
    ) -> str:
        name = source if isinstance(source, str) else source.name
        return self.accept(
            Command(name, twist, self.now_ns, sender=sender, cancelled=cancelled, shared=shared)
        )

    def accept(self, command: Command) -> str:
        """Return "", or the code for which the command is refused."""
        refused = self.arbiter.accept(command, self.commands)
        return "" if refused is None else refused.what

    def stamped(
        self,
        source: Source,
        late_ms: float = 0.0,
        clock: str = "",
        twist: Twist = GO,
        sender: str = "",
        shared: bool = False,
    ) -> str:
        """Send a command that the sender stamped `late_ms` ago."""
        stamp_ns = self.now_ns + self.offset_ns - int(late_ms * MS)
        return self.accept(
            Command(source.name, twist, self.now_ns, stamp_ns, clock, sender, shared=shared)
        )

    def prove_clock(self, source: Source, clock: str = "", sender: str = "") -> Bench:
        """Send zeros until the arbiter accepts the stamps of this sender's clock."""
        answers = [self.wait(50).stamped(source, 0.0, clock, REST, sender) for _ in range(20)]
        assert answers[-1] == ""
        return self

    def unreadable(self, source: Source, sender: str) -> None:
        """Record that an undecodable command arrived from this sender."""
        self.arbiter.notice(source.name, sender, self.now_ns)

    def choice(self) -> Choice:
        return self.arbiter.choose(self.now_ns, self.commands)

    def driver(self) -> str:
        """Return the source whose command is followed now, or "" if there is none."""
        choice = self.choice()
        return "" if choice.twist is None else choice.source

    def status(self, source: Source) -> SourceStatus:
        (status,) = (s for s in self.statuses() if s.name == source.name)
        return status

    def statuses(self) -> tuple[SourceStatus, ...]:
        return self.arbiter.status(self.now_ns, self.commands)
