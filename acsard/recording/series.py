"""Finds the recordings of a range of time, and reads successive files as one recording.

The daemon splits the recording of one run into files. If their step numbers follow each other, they
are one `Series`, so that a drive or a replay goes on from file to file.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from msgspec import Struct, field

from acsard.core.values import NS_PER_S, AcsardError
from acsard.host.errors import RecordingError
from acsard.recording.end_record import read_end
from acsard.recording.mcap_directory import listed, stem
from acsard.recording.mcap_file import Recording, Topic
from acsard.recording.time_span import Contents, Span, clock, part_between, read_contents

# Tolerance of a search by the times of end records: the last message may have many seconds of steps
# if the disk is slow. Also the longest time between two files of a series.
TIME_TOLERANCE_S = 60.0

MIN_GAP_S = 2.0  # without a recording


class Series(Recording):
    """Successive files of one run of the daemon without a missing step, read as one recording."""

    def __init__(self, paths: Sequence[Path]) -> None:
        # Reads only the first file. Raises `RecordingError`.
        super().__init__(_present(paths[0]))
        self.paths = list(paths)

    def messages(self) -> Iterator[tuple[Topic, int, bytes]]:
        self.damaged, self.ended, self.cut, self.why = 0, False, "", ""
        self.unfinished = None
        for path in self.paths:
            part, counted = _read(path), 0
            for message in part.messages():
                self.damaged += part.damaged - counted
                counted = part.damaged
                yield message
            self.damaged += part.damaged - counted
            self.ended, self.cut, self.why = part.ended, part.cut, part.why
            self.unfinished = part.unfinished


class FoundRecording(NamedTuple):
    recording: Recording
    part: Span  # in the searched range


class Search(Struct):
    """The result of a search."""

    found: list[FoundRecording] = field(default_factory=list)  # the oldest first
    unreadable: list[str] = field(default_factory=list)  # a sentence for each such file
    gaps: list[tuple[float, float]] = field(default_factory=list)  # s since 1970, over `MIN_GAP_S`


class NothingRecordedError(AcsardError):
    """No recording has a step in the range; the text names the nearest ones."""


class _CoveredRange(NamedTuple):
    begin: float  # s since 1970
    end: float  # s since 1970
    path: Path


def search(files: Sequence[Path], first: float, last: float, tell: Callable[[int], None]) -> Search:
    """Find the recordings that have steps in a range of time, s since 1970.

    Files are joined into a `Series`, with the earlier part of a drive that a file begins in. `tell`
    gets the number of searched files. Raises `NothingRecordedError`.
    """
    result, pieces = Search(), list[_CoveredRange]()
    chosen: dict[int, Contents] = {}
    for number, path in enumerate(files):
        tell(number)
        try:
            covered = _covered(path)
            if covered.begin - TIME_TOLERANCE_S > last or covered.end + TIME_TOLERANCE_S < first:
                pieces.append(covered)
                continue
            contents = read_contents(_read(path))
        except RecordingError as error:
            result.unreadable.append(str(error))
            continue
        if contents is None:
            continue
        pieces += [
            _CoveredRange(stretch.begin, stretch.end, path) for stretch in contents.stretches
        ]
        if part_between(contents.stretches, first, last) is not None:
            chosen[number] = contents
    for group in _groups(files, chosen):
        paths = [files[number] for number in group]
        recording = _read(paths[0]) if len(paths) == 1 else Series(paths)
        contents = chosen[group[0]] if len(paths) == 1 else read_contents(recording)
        part = part_between(contents.stretches, first, last) if contents else None
        if part is not None:
            result.found.append(FoundRecording(recording, part))
    if not result.found:
        raise NothingRecordedError(_nearest(pieces, first, last))
    result.gaps = _gaps(pieces, first, last)
    return result


def _gaps(pieces: Sequence[_CoveredRange], first: float, last: float) -> list[tuple[float, float]]:
    inside = sorted(piece for piece in pieces if piece.begin <= last and first <= piece.end)
    ends = [first]
    for piece in inside:
        ends.append(max(ends[-1], piece.end))
    begins = [*(piece.begin for piece in inside), last]
    pairs = zip(ends, begins, strict=True)
    return [(end, begin) for end, begin in pairs if MIN_GAP_S < begin - end < math.inf]


def _groups(files: Sequence[Path], chosen: dict[int, Contents]) -> list[list[int]]:
    # `chosen` has files in the range.
    groups: list[list[int]] = []
    for number, contents in sorted(chosen.items()):
        if groups and number - 1 in chosen and _continues(chosen[number - 1], contents):
            groups[-1].append(number)
        else:
            groups.append([*_earlier(files, number, contents), number])
    return groups


def _earlier(files: Sequence[Path], number: int, contents: Contents) -> list[int]:
    # The earlier files of a drive in which this file begins.
    indices: list[int] = []
    while number > 0 and contents.first.recorded.status[0] == "driving":
        number -= 1
        try:
            before = read_contents(_read(files[number]))
        except RecordingError:
            break
        if before is None or not _continues(before, contents):
            break
        indices.insert(0, number)
        contents = before
    return indices


def _continues(before: Contents, contents: Contents) -> bool:
    follows = contents.first.number == before.last.number + 1
    mono_ns = contents.first.inputs.now.mono_ns - before.last.inputs.now.mono_ns
    return follows and 0 <= mono_ns < TIME_TOLERANCE_S * NS_PER_S


def _covered(path: Path) -> _CoveredRange:
    end = read_end(path) or _read(path).compute_end_record()
    earliest_ns = end.wall_ns if end.earliest_ns is None else end.earliest_ns
    return _CoveredRange(min(earliest_ns, end.wall_ns) / NS_PER_S, end.last_ns / NS_PER_S, path)


def _present(path: Path) -> Path:
    # The daemon may have renamed it.
    if path.exists() or not path.parent.is_dir():
        return path
    return next((p for p in listed(path.parent) if stem(p) == stem(path)), path)


def _read(path: Path) -> Recording:
    return Recording(_present(path))


def _nearest(pieces: Sequence[_CoveredRange], first: float, last: float) -> str:
    before = max([p for p in pieces if p.end < first], key=lambda p: p.end, default=None)
    after = min([p for p in pieces if p.begin > last], key=lambda p: p.begin, default=None)
    text = f"nothing was recorded {in_words(first, last)}"
    ends = f"the last recording before that time is {_described(before)}" if before else ""
    begins = f"the first recording after that time is {_described(after)}" if after else ""
    return "; ".join(filter(None, [text, ends, begins]))


def _described(piece: _CoveredRange) -> str:
    return f"{piece.path.name}, {clock(piece.begin, day=True)} to {clock(piece.end, day=True)}"


def in_words(first: float, last: float) -> str:
    """Return a range, s since 1970, as "from 2026-11-21 14:05:00"; inf is left out."""
    parts = [
        f"{word} {clock(at, day=True)}"
        for word, at in (("from", first), ("to", last))
        if math.isfinite(at)
    ]
    return " ".join(parts) or "at any time"
