"""The record of a benchmark, and the figures that are computed from the record.

Successive commands have different speeds, and so have successive feedback lines. Each output of the
measured daemon is therefore matched with its input by the speed, not by the time. All times are
monotonic, in ns.
"""

from __future__ import annotations

from bisect import bisect_left, bisect_right
from collections.abc import Iterable, Sequence

from msgspec import Struct

from acsard.core.config.settings import Config
from acsard.core.link.codec import Codec
from acsard.core.motion.kinematics import Kinematics

CYCLE_LENGTH = 1000
"""Number of commands, or of feedback lines, after which the speeds repeat. Two lines with equal
speeds are distinguished by their times."""

LOWEST, STEP = 5.0, 0.02
"""Lowest wheel speed, and the step between successive speeds, rad/s. The step is so small that the
limits on acceleration do not change the speeds."""

LOSS_TIMEOUT_NS = 1_000_000_000
"""Time after which a command without a line on the wire counts as lost, ns."""

Chunk = tuple[int, bytes]
"""A pair: a monotonic time, ns, and the bytes that were sent or received at that time."""


def staircase(number: int) -> float:
    """Return the speed of all wheels in the command or feedback line with this number, rad/s.

    The speeds rise and then fall, and repeat after `CYCLE_LENGTH` lines. The falling speeds lie
    between the rising speeds, so all speeds of a cycle differ.
    """
    half = CYCLE_LENGTH // 2
    place = number % CYCLE_LENGTH
    rung = 2 * place if place < half else 2 * (CYCLE_LENGTH - place) - 1
    return round(LOWEST + rung * STEP / 2, 2)


def lines_of(chunks: Iterable[Chunk]) -> list[Chunk]:
    """Return the non-empty lines in `chunks`, each with the time of its first byte, ns.

    Line ends and trailing commas are removed.
    """
    lines, rest, began_ns = [], b"", 0
    for at_ns, data in chunks:
        if not rest:
            began_ns = at_ns
        *whole, rest = (rest + data).split(b"\n")
        for line in whole:
            if line.strip():
                lines.append((began_ns, line.rstrip(b",\r")))
            began_ns = at_ns
    return lines


def commands_to_lines(sent: Sequence[Chunk], lines: Sequence[Chunk]) -> list[int]:
    """Return the time from each command to the line that carries it to the board, ns.

    If no such line follows within `LOSS_TIMEOUT_NS`, the command is lost and has no entry in the
    result.

    Args:
        sent: for each command, its time, ns, and the line that the daemon must make of the command.
        lines: for each line on the wire, its time, ns, and its text.
    """
    times: dict[bytes, list[int]] = {}
    for at_ns, line in lines:
        times.setdefault(line, []).append(at_ns)
    delays_ns = []
    for at_ns, line in sent:
        all_ns = times.get(line, [])
        place = bisect_left(all_ns, at_ns)
        if place < len(all_ns) and all_ns[place] - at_ns < LOSS_TIMEOUT_NS:
            delays_ns.append(all_ns[place] - at_ns)
    return delays_ns


def lines_to_samples(
    lines: Sequence[tuple[int, float]], samples: Iterable[tuple[int, float]]
) -> list[int]:
    """Return the time from each feedback line to its odometry sample, ns.

    Lines and samples are matched by their linear speed. A second sample of the same line is
    ignored.

    Args:
        lines: for each feedback line, its time, ns, and its linear speed, m/s.
        samples: for each odometry sample, its time of arrival, ns, and its linear speed, m/s.
    """
    all_ns = [at_ns for at_ns, _ in lines]
    places: dict[int, list[int]] = {}
    for index, (_, speed) in enumerate(lines):
        places.setdefault(_key(speed), []).append(index)
    matches, last_index = [], -1
    for at_ns, speed in samples:
        before = bisect_right(all_ns, at_ns)
        indices = places.get(_key(speed), [])
        place = bisect_left(indices, before) - 1
        if place >= 0 and indices[place] > last_index:
            last_index = indices[place]
            matches.append(at_ns - all_ns[last_index])
    return matches


def _key(speed: float) -> int:
    return round(speed * 1e6)


class RecordedTraffic(Struct, frozen=True):
    """All data that the simulated board received and sent, with monotonic times in ns."""

    from_daemon: list[Chunk] = []
    """Bytes from the daemon. Each chunk has the time at which the board could read it."""
    to_daemon: list[Chunk] = []
    """Bytes to the daemon. Each chunk has the time just before the board wrote it."""


class SentCommand(Struct, frozen=True):
    """A command: the monotonic time of its publication, ns, and the line that must carry it."""

    at_ns: int
    line: bytes


class Sample(Struct, frozen=True):
    """An odometry sample: its time of arrival, ns, and its linear speed, m/s."""

    at_ns: int
    speed: float


class Record(Struct, frozen=True):
    window_ns: tuple[int, int]
    """Start and end of the evaluated time, ns. Start-up and shutdown of the daemon are excluded."""
    seen: RecordedTraffic
    sent: list[SentCommand]
    samples: list[Sample]

    @property
    def feedback_lines(self) -> list[Chunk]:
        """Feedback lines that the board began to send in `window_ns`, each with its time, ns."""
        first_ns, last_ns = self.window_ns
        lines = lines_of(self.seen.to_daemon)
        return [line for line in lines if first_ns <= line[0] < last_ns]


def command_waits(record: Record) -> list[int]:
    """Return the time from each command to its line on the wire, ns. Lost ones have no entry."""
    sent = [(sent.at_ns, sent.line) for sent in record.sent]
    return commands_to_lines(sent, lines_of(record.seen.from_daemon))


def feedback_delays(config: Config, record: Record) -> list[int]:
    """Return the time from each feedback line to its odometry sample, ns."""
    codec = Codec(config.mcu.wheels, config.mcu.trailing_comma)
    kinematics = Kinematics(config.drive)
    lines = [
        (at_ns, kinematics.twist(codec.decode(line)).linear)
        for at_ns, line in record.feedback_lines
    ]
    samples = [(sample.at_ns, sample.speed) for sample in record.samples]
    return lines_to_samples(lines, samples)
