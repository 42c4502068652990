"""The record of a benchmark, and the figures that follow from it; pure."""

from __future__ import annotations

from msgspec import Struct

from acsard.bench.matching import Chunk, Fed, commands_to_lines, lines_of, lines_to_samples
from acsard.config.settings import Config
from acsard.drive.kinematics import Kinematics
from acsard.mcu.codec import Codec
from acsard.values import Instant


class Seen(Struct, frozen=True):
    """All data on the wire, with monotonic times in ns."""

    heard: list[Chunk] = []
    """Bytes from the daemon, with the times at which they were readable."""
    said: list[Chunk] = []
    """Lines to the daemon, with the times at which the last byte was handed over."""


class Sent(Struct, frozen=True):
    """A command, with the time at which it was published and the line that it must become."""

    at_ns: int
    line: bytes


class Sample(Struct, frozen=True):
    """An odometry sample, with its arrival and its content."""

    at: Instant
    stamp_ns: int
    """Stamp by the wall clock, ns."""
    speed: float
    """Linear speed, m/s."""


class Record(Struct, frozen=True):
    """The raw times of one run."""

    began_ns: int
    """Time just before the daemon was started."""
    window_ns: tuple[int, int]
    """Time window that counts: from the end of the start to the beginning of the end."""
    seen: Seen | None
    """Data on the wire; None on a real port, whose wire cannot be observed."""
    sent: list[Sent]
    samples: list[Sample]

    @property
    def said(self) -> list[Chunk]:
        """The feedback lines within the window."""
        first_ns, last_ns = self.window_ns
        lines = lines_of(self.seen.said) if self.seen else []
        return [line for line in lines if first_ns <= line[0] < last_ns]


def command_waits(record: Record) -> list[int]:
    """Return the ns from each command to its line on the wire; lost commands are left out."""
    if record.seen is None:
        return []
    sent = [(sent.at_ns, sent.line) for sent in record.sent]
    return commands_to_lines(sent, lines_of(record.seen.heard))


def feedback_fates(config: Config, record: Record) -> list[Fed]:
    """Return the delay of each feedback line that became an odometry sample."""
    codec = Codec(config.mcu.wheels, config.mcu.trailing_comma)
    kinematics = Kinematics(config.drive)
    said = [(at_ns, kinematics.twist(codec.decode(line)).linear) for at_ns, line in record.said]
    samples = [(sample.at.mono_ns, sample.speed) for sample in record.samples]
    return lines_to_samples(said, samples)
