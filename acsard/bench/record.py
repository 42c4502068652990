"""What a benchmark recorded, and what follows from it: no clock, no process, only times."""

from __future__ import annotations

from msgspec import Struct

from acsard.bench.matching import Chunk, Fed, commands_to_lines, lines_of, lines_to_samples
from acsard.config.settings import Config
from acsard.drive.kinematics import Kinematics
from acsard.mcu.codec import Codec
from acsard.values import Instant


class Seen(Struct, frozen=True):
    """All that went over the wire, monotonic times in ns."""

    heard: list[Chunk] = []
    """Bytes from the host, and when they were there to be read."""
    said: list[Chunk] = []
    """Lines to the host, and when the last byte was handed over."""


class Sent(Struct, frozen=True):
    """A command, when it was put, and the line it must become."""

    at_ns: int
    line: bytes


class Sample(Struct, frozen=True):
    """An odometry sample, when it came, and what it says."""

    at: Instant
    stamp_ns: int
    """Wall clock."""
    speed: float
    """m/s."""


class Record(Struct, frozen=True):
    """The raw times of one run."""

    began_ns: int
    """Before the program was started."""
    window_ns: tuple[int, int]
    """From the end of the start to the beginning of the end: what counts."""
    seen: Seen | None
    """None on a real port, whose wire cannot be seen."""
    sent: list[Sent]
    samples: list[Sample]

    @property
    def said(self) -> list[Chunk]:
        """The feedback lines that count."""
        first_ns, last_ns = self.window_ns
        lines = lines_of(self.seen.said) if self.seen else []
        return [line for line in lines if first_ns <= line[0] < last_ns]


def command_waits(record: Record) -> list[int]:
    """ns from each command to its line on the wire; one that never came is left out."""
    if record.seen is None:
        return []
    sent = [(sent.at_ns, sent.line) for sent in record.sent]
    return commands_to_lines(sent, lines_of(record.seen.heard))


def feedback_fates(config: Config, record: Record) -> list[Fed]:
    """What became of the feedback lines that were heard of."""
    codec = Codec(config.mcu.wheels, config.mcu.trailing_comma)
    kinematics = Kinematics(config.drive)
    said = [(at_ns, kinematics.twist(codec.decode(line)).linear) for at_ns, line in record.said]
    samples = [(sample.at.mono_ns, sample.speed) for sample in record.samples]
    return lines_to_samples(said, samples)
