"""Finds the recordings of a range of time, and reads successive files as one recording.

The daemon splits the recording of one run into several files. The last step of one file and the
first step of the next file have consecutive numbers. Such files are read as one `Series`, so that a
drive or a replay can continue from one file to the next.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import NamedTuple

from msgspec import Struct, field

from acsard.core.values import NS_PER_S, AcsardError
from acsard.host.errors import RecordingError
from acsard.recording.directory import listed
from acsard.recording.end_record import read_end
from acsard.recording.file import Recording, Topic
from acsard.recording.time_span import Contents, Span, clock, part_between, read_contents

MARGIN_S = 60.0
"""Tolerance for the times in an end record, and for the time between two files of a series, s.

The end record contains the time at which the last message begins. If the disk is slow, this message
may hold many seconds of steps. Therefore a file is read even if the times in its end record miss
the searched range by up to `MARGIN_S`. In a series, the first step of a file comes less than
`MARGIN_S` after the last step of the previous file.
"""

GAP_S = 2.0
"""Longest time without a recording, s, that the search does not report as a gap."""


class Series(Recording):
    """Successive files of one run of the daemon, read as one recording.

    No step is missing between the files.
    """

    def __init__(self, paths: Sequence[Path]) -> None:
        """Read the first of the files; `messages()` reads all of them.

        Raises `RecordingError` if the first file is not a recording that can be read.
        """
        super().__init__(_present(paths[0]))
        self.paths = list(paths)

    def messages(self) -> Iterator[tuple[Topic, int, bytes]]:
        """Yield the triple (topic, wall-clock time in ns since 1970, data) of each message.

        The messages are those of all files. `damaged` counts the damaged places of all files.
        `ended`, `cut`, `why` and `unfinished` describe the last file.
        """
        self.damaged, self.ended, self.cut, self.why = 0, False, "", ""
        self.unfinished = None
        for path in self.paths:
            part, counted = Recording(_present(path)), 0
            for message in part.messages():
                self.damaged += part.damaged - counted
                counted = part.damaged
                yield message
            self.damaged += part.damaged - counted
            self.ended, self.cut, self.why = part.ended, part.cut, part.why
            self.unfinished = part.unfinished


class Found(NamedTuple):
    """A recording with steps in the searched range of time.

    `part` is the part of the recording that lies in this range.
    """

    recording: Recording
    part: Span


class Search(Struct):
    """The recordings that have steps in a range of time, and the times without a recording."""

    found: list[Found] = field(default_factory=list)
    unreadable: list[str] = field(default_factory=list)
    """A sentence for each file that cannot be read."""
    gaps: list[tuple[float, float]] = field(default_factory=list)
    """Beginning and end of each gap (a part of the range without a recording), s since 1970."""


class NothingRecordedError(AcsardError):
    """No file has a step in the searched range of time.

    The message names the nearest recordings.
    """


class _Piece(NamedTuple):
    """A range of time, from `begin` to `end`, s since 1970, that the file `path` covers."""

    begin: float
    end: float
    path: Path


def search(files: Sequence[Path], first: float, last: float) -> Search:
    """Find the recordings that have steps between the times `first` and `last`, s since 1970.

    `files` are sorted, oldest first. If a file that is found begins during a drive, the result also
    includes the files with the earlier part of this drive. Raises `NothingRecordedError` if no
    recording is found.
    """
    result, pieces = Search(), list[_Piece]()
    chosen: dict[int, Contents] = {}
    for number, path in enumerate(files):
        try:
            covered = _covered(path)
            if covered.begin - MARGIN_S > last or covered.end + MARGIN_S < first:
                pieces.append(covered)
                continue
            contents = read_contents(Recording(_present(path)))
        except RecordingError as error:
            result.unreadable.append(str(error))
            continue
        if contents is None:
            continue
        pieces += [_Piece(one.begin, one.end, path) for one in contents.stretches]
        if part_between(contents.stretches, first, last) is not None:
            chosen[number] = contents
    for group in _groups(files, chosen):
        paths = [files[number] for number in group]
        recording = Recording(_present(paths[0])) if len(paths) == 1 else Series(paths)
        contents = chosen[group[0]] if len(paths) == 1 else read_contents(recording)
        part = part_between(contents.stretches, first, last) if contents else None
        if part is not None:
            result.found.append(Found(recording, part))
    if not result.found:
        raise NothingRecordedError(_nearest(pieces, first, last))
    result.gaps = _gaps(pieces, first, last)
    return result


def _gaps(pieces: Sequence[_Piece], first: float, last: float) -> list[tuple[float, float]]:
    """Return the ranges of time from `first` to `last` that no piece covers, s since 1970.

    Ranges that are not longer than `GAP_S` are left out.
    """
    inside = sorted(piece for piece in pieces if piece.begin <= last and first <= piece.end)
    ends = [first]
    for piece in inside:
        ends.append(max(ends[-1], piece.end))
    begins = [*(piece.begin for piece in inside), last]
    pairs = zip(ends, begins, strict=True)
    return [(end, begin) for end, begin in pairs if GAP_S < begin - end < math.inf]


def _groups(files: Sequence[Path], chosen: dict[int, Contents]) -> list[list[int]]:
    """Group the chosen files into series, and return the indices in `files` of each series.

    `chosen` maps the index of each chosen file to its contents. Each series begins with the files
    that `_earlier()` finds.
    """
    groups: list[list[int]] = []
    for number, contents in sorted(chosen.items()):
        if groups and number - 1 in chosen and _continues(chosen[number - 1], contents):
            groups[-1].append(number)
        else:
            groups.append([*_earlier(files, number, contents), number])
    return groups


def _earlier(files: Sequence[Path], number: int, contents: Contents) -> list[int]:
    """Return the indices of the files that contain the earlier part of a drive, oldest first.

    The robot is on this drive when the file with the index `number` begins. `contents` are the
    contents of that file. The list is empty if the file does not begin during a drive.
    """
    found: list[int] = []
    while number > 0 and contents.first.recorded.status[0] == "driving":
        number -= 1
        try:
            before = read_contents(Recording(_present(files[number])))
        except RecordingError:
            break
        if before is None or not _continues(before, contents):
            break
        found.insert(0, number)
        contents = before
    return found


def _continues(before: Contents, contents: Contents) -> bool:
    """Return whether `contents` continues `before` without a missing step, in the same run."""
    follows = contents.first.number == before.last.number + 1
    mono_ns = contents.first.inputs.now.mono_ns - before.last.inputs.now.mono_ns
    return follows and 0 <= mono_ns < MARGIN_S * NS_PER_S


def _covered(path: Path) -> _Piece:
    """Return the range of time that a file covers. If it has no end record, read the whole file."""
    end = read_end(path) or Recording(_present(path)).compute_end_record()
    earliest_ns = end.wall_ns if end.earliest_ns is None else end.earliest_ns
    return _Piece(min(earliest_ns, end.wall_ns) / NS_PER_S, end.last_ns / NS_PER_S, path)


def _present(path: Path) -> Path:
    """Return the present path of a recording. The daemon renames the file when it is finished."""
    if path.exists() or not path.parent.is_dir():
        return path
    stem = path.name.partition(".")[0]
    return next((p for p in listed(path.parent) if p.name.partition(".")[0] == stem), path)


def _nearest(pieces: Sequence[_Piece], first: float, last: float) -> str:
    """Return a sentence that says that nothing was recorded, and names the nearest recordings."""
    before = max([p for p in pieces if p.end < first], key=lambda p: p.end, default=None)
    after = min([p for p in pieces if p.begin > last], key=lambda p: p.begin, default=None)
    text = f"nothing was recorded {in_words(first, last)}"
    ends = f"the last recording before that time is {_described(before)}" if before else ""
    begins = f"the first recording after that time is {_described(after)}" if after else ""
    return "; ".join(filter(None, [text, ends, begins]))


def _described(piece: _Piece) -> str:
    return f"{piece.path.name}, {clock(piece.begin, day=True)} to {clock(piece.end, day=True)}"


def in_words(first: float, last: float) -> str:
    """Return words for the range of time from `first` to `last`, s since 1970.

    Both limits may be infinite.
    """
    parts = [
        f"{word} {clock(at, day=True)}"
        for word, at in (("from", first), ("to", last))
        if math.isfinite(at)
    ]
    return " ".join(parts) or "at any time"
