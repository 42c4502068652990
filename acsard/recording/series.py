"""Finds the recordings of a range of time, and reads successive files as one recording.

The daemon splits the recording of one run into several files. The last step of a file and the first
step of the next file have consecutive numbers. Such files are read as one `Series`, so that a drive
or a replay can continue from one file to the next.
"""

from __future__ import annotations

import math
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from msgspec import Struct, field

from acsard.core.values import NS_PER_S, AcsardError
from acsard.host.errors import RecordingError
from acsard.recording.directory import listed, stem
from acsard.recording.end_record import read_end
from acsard.recording.file import Recording, Topic
from acsard.recording.time_span import Contents, Span, clock, part_between, read_contents

TIME_TOLERANCE_S = 60.0
"""Tolerance of a search, s.

- A file is read if the times in its end record are at most this far from the searched range. The
  tolerance is needed because the end record has the time of the first step in the last message. If
  the disk is slow, this message may contain many seconds of steps.
- In a series, the first step of a file comes less than this time after the last step of the
  previous file.
"""

MIN_GAP_S = 2.0
"""A time without a recording counts as a gap if it is longer than this, s."""


class Series(Recording):
    """Successive files of one run of the daemon, read as one recording.

    No step is missing between the files.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        """Read the first file. The other files are read by `messages()`.

        `paths` are the paths of the files in order. Raises `RecordingError` if the first file is
        not a readable recording.
        """
        super().__init__(_present(paths[0]))
        self.paths = list(paths)

    def messages(self) -> Iterator[tuple[Topic, int, bytes]]:
        """Yield the triple (topic, wall-clock time in ns since 1970, data) of each message.

        The files are read one after the other, in their order. After the last message, `damaged`
        is the number of damaged places in all files. `ended`, `cut`, `why` and `unfinished`
        describe the last file. Raises `RecordingError` if a file is not a readable recording.
        """
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
    """A recording with steps in the searched range of time."""

    recording: Recording
    part: Span
    """Part of the recording that is in the searched range."""


class Search(Struct):
    """Result of a search: the recordings in a range of time, and the gaps between them."""

    found: list[FoundRecording] = field(default_factory=list)
    """The recordings that have steps in the range, the oldest first."""
    unreadable: list[str] = field(default_factory=list)
    """A sentence for each file that cannot be read."""
    gaps: list[tuple[float, float]] = field(default_factory=list)
    """Pairs: the beginning and the end of each part of the range without a recording, s since 1970.

    Parts of at most `MIN_GAP_S` are left out.
    """


class NothingRecordedError(AcsardError):
    """No recording has a step in the searched range of time.

    The text of this error names the nearest recordings before and after the range.
    """


class _CoveredRange(NamedTuple):
    """A range of time for which a file contains steps."""

    begin: float
    """Wall-clock time, s since 1970."""
    end: float
    """Wall-clock time, s since 1970."""
    path: Path


def search(files: Sequence[Path], first: float, last: float, tell: Callable[[int], None]) -> Search:
    """Find the recordings that have steps in a range of time.

    Successive files without a missing step between them are joined into a `Series`. If a file
    begins during a drive, its series also includes the files with the earlier part of this drive.

    Args:
        files: paths of the files to search, the oldest first.
        first: beginning of the range, s since 1970; -inf for no limit.
        last: end of the range, s since 1970; inf for no limit.
        tell: receives the number of files that have been searched, before each file.

    Raises:
        NothingRecordedError: no recording has a step in the range.
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
    """Return a list of indices in `files` for each recording of one or more successive files.

    `chosen` maps the index of each file with steps in the searched range to its contents.
    """
    groups: list[list[int]] = []
    for number, contents in sorted(chosen.items()):
        if groups and number - 1 in chosen and _continues(chosen[number - 1], contents):
            groups[-1].append(number)
        else:
            groups.append([*_earlier(files, number, contents), number])
    return groups


def _earlier(files: Sequence[Path], number: int, contents: Contents) -> list[int]:
    """Return the indices of the earlier files of a drive, the oldest file first.

    The file with the index `number` and the contents `contents` begins during this drive. If that
    file does not begin during a drive, the result is empty.
    """
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
    """Return the present path of a recording, which the daemon may have renamed."""
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
    """Return a text for a range of time, for example "from 2026-11-21 14:05:00".

    `first` and `last` are times in s since 1970. An infinite limit does not appear in the text.
    """
    parts = [
        f"{word} {clock(at, day=True)}"
        for word, at in (("from", first), ("to", last))
        if math.isfinite(at)
    ]
    return " ".join(parts) or "at any time"
