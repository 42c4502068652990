"""A recording is a file of concatenated zstd frames, each readable alone.

A frame holds records of MessagePack, each after its length and CRC-32: first a `Head` with all that
a replay needs to begin there, then `Steps` of about one second each. Nothing marks the end of a
file, so a file that was cut off anywhere is an ordinary file. Damage costs the rest of its frame.
Structs of core are stored as maps without their defaults: another version ignores fields that it
does not know, and fills in those that it misses.

To read: `listed(directory)` gives the files of a directory in order, and `Recording(paths, begin,
end)` the `Head`s and `RecordedStep`s of files between two wall-clock times.
"""

from __future__ import annotations

import stat
import struct
import zlib
from collections.abc import Generator, Iterable, Iterator, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO, get_args

import msgspec
import zstandard
from msgspec import Struct
from msgspec.structs import replace

from acsard.core.codes import Reason
from acsard.core.formatting import printable
from acsard.core.values import (
    NS_PER_S,
    AcsardError,
    Event,
    Heard,
    Instant,
    Ns,
    Received,
    Status,
    Trip,
    Verb,
    WallNs,
)
from acsard.host.errors import MSGSPEC_ERRORS, RecordingError
from acsard.recording.recorded_steps import (
    Micropose,
    PlainStep,
    RecordedOutputs,
    RecordedStep,
    checksum,
    micropose,
)

SUFFIX = ".rec.zst"

MAGIC = b"\x28\xb5\x2f\xfd"  # of a zstd frame

MAX_FILE_BYTES = 1 << 28  # to be read; the recorder begins a new file long before

MAX_RECORD_BYTES = 1 << 24  # uncompressed; a second of driving takes 50 000

WINDOW_LOG = 18

_PARAMETERS = zstandard.ZstdCompressionParameters.from_level(3, window_log=WINDOW_LOG)

# Bytes that are decompressed at once. Forged ones grow at most to 32 MB.
_PIECE = 1024

_PREFIX = struct.Struct("<II")  # length and CRC-32 of a record

_MAX_NS = 1 << 62  # the year 2116

ALWAYS = (-(1 << 63), 1 << 64)

# Of a file, read to find out when it begins: a head has 40 000, uncompressed.
_BEGINNING = 1 << 18

_VERBS = frozenset(get_args(Verb))


class Head(Struct, frozen=True, tag="head"):
    """The beginning of a frame: the robot between two steps."""

    version: str  # of acsard
    robot: str  # id
    number: int  # of the next step, from 0 at the daemon's start
    mono_ns: Ns
    wall_ns: WallNs
    config: str = ""  # every key in force, as an `acsard.toml`
    state: bytes = b""  # of the robot and its guard, `state.freeze`; b"": as after a start
    started_ns: WallNs = 0  # start of the daemon


class Read(Struct, frozen=True, array_like=True):
    """The bytes of one read from the serial port."""

    age_ns: Ns  # at the step
    ahead_ns: Ns  # wall clock minus monotonic clock
    data: bytes


class Row(Struct, frozen=True, array_like=True):
    """A `RecordedStep`.

    Differences of times compress better than times: a recording is a third smaller.
    """

    since_ns: Ns  # the row before; of the first row, the monotonic time
    ahead_ns: Ns  # wall clock minus monotonic clock
    reads: tuple[Read, ...]
    heard: Heard  # without `received`
    driven: bool
    line: bytes | None
    sent: bytes | None
    trip: Trip
    late_ns: Ns
    status: Status | None  # None: as in the row before
    poses: tuple[Micropose, ...]
    events: tuple[Event, ...]


class Steps(Struct, frozen=True, tag="steps"):
    first: int  # number of the first step
    rows: tuple[Row, ...]
    checksum: int  # of exact poses, twists and wheel angles (`recorded_steps.checksum`)


class Waits(Struct, frozen=True, tag="waits"):
    """What sources wait for while another one drives, when it has changed."""

    at: Instant
    reasons: dict[str, tuple[str, str]]  # code and text by source

    @classmethod
    def of(cls, at: Instant, reasons: Mapping[str, Reason]) -> Waits:
        return cls(at, {source: (why.code, why.text) for source, why in reasons.items()})


class Failure(Struct, frozen=True, tag="failure"):
    """The step in which the daemon failed, as the last record of its run."""

    number: int
    why: str  # the exception
    now: Instant | None = None  # None if the daemon failed elsewhere
    heard: Heard | None = None


class Damage(Struct, frozen=True):
    """A part of a file that cannot be read."""

    path: Path
    begin: int  # offset
    end: int
    why: str

    def __str__(self) -> str:
        what = f"bytes {self.begin} to {self.end}"
        return f"{self.path.name}: {what} cannot be read: {self.why}"


class Unread(Struct):
    """Steps of a robot that this version of acsard cannot continue, up to its first rest."""

    version: str  # of acsard, that wrote it
    begin_ns: Ns
    end_ns: Ns

    def __str__(self) -> str:
        seconds = (self.end_ns - self.begin_ns) / NS_PER_S
        return (
            f"{seconds:.1f} s cannot be replayed: acsard {self.version} wrote its robot in another "
            "layout, and a fresh one begins where it rests"
        )


Record = Head | Steps | Waits | Failure

ReadRecord = Head | RecordedStep | Waits | Failure

_decoder: msgspec.msgpack.Decoder[Record] = msgspec.msgpack.Decoder(Record)
_encode = msgspec.msgpack.Encoder().encode


# Writing


class FrameWriter:
    """Appends frames to a file. Every method may raise `OSError`; then only close the file."""

    def __init__(self, file: BinaryIO) -> None:
        self._file = file
        self._compressor: zstandard.ZstdCompressionObj | None = None

    def begin(self, head: Head) -> None:
        """Begin a new frame."""
        self.end()
        compressor = zstandard.ZstdCompressor(compression_params=_PARAMETERS)
        self._compressor = compressor.compressobj()
        self.add(head)

    def add(self, record: Record) -> None:
        """Write a record so that it can be read as soon as the file is flushed."""
        self._add(_encode(record))

    def add_steps(self, first: int, steps: Sequence[PlainStep]) -> None:
        """Write successive steps, as several records if one would be too large to be read."""
        data = _encode(encode_steps(first, steps))
        if len(data) > MAX_RECORD_BYTES and len(steps) > 1:
            half = len(steps) // 2
            self.add_steps(first, steps[:half])
            self.add_steps(first + half, steps[half:])
        else:
            self._add(data)

    def _add(self, data: bytes) -> None:
        assert self._compressor is not None
        block = self._compressor.compress(_PREFIX.pack(len(data), zlib.crc32(data)) + data)
        self._file.write(block + self._compressor.flush(zstandard.COMPRESSOBJ_FLUSH_BLOCK))

    def end(self) -> None:
        """End the frame, if there is one."""
        if self._compressor is not None:
            self._file.write(self._compressor.flush())
            self._compressor = None


def encode_steps(first: int, steps: Sequence[PlainStep]) -> Steps:
    """Return successive steps as a record."""
    rows, before, before_ns, crc = [], None, 0, 0
    for now, heard, driven, line, sent, trip, late_ns, news, status in steps:
        now_ns = now.mono_ns
        reads = [Read(now_ns - r.at.mono_ns, ahead_ns(r.at), r.data) for r in heard.received]
        rows.append(
            Row(
                now_ns - before_ns,
                ahead_ns(now),
                tuple(reads),
                replace(heard, received=()) if reads else heard,
                driven,
                line,
                sent,
                trip,
                late_ns,
                None if status == before else status,
                tuple(map(micropose, news.estimates)),
                news.events,
            )
        )
        before, before_ns, crc = status, now_ns, checksum(news.estimates, crc)
    return Steps(first, tuple(rows), crc)


def ahead_ns(at: Instant) -> Ns:
    """Return how far the wall clock is ahead of the monotonic clock."""
    return at.wall_ns - at.mono_ns


# Reading


def listed(directory: Path) -> list[Path]:
    """Return the recordings in a directory, the oldest first. Raises `OSError`."""
    # A pipe or a link with such a name is not a recording, and reading a pipe may never end.
    numbered = [
        (number, path)
        for path in directory.iterdir()
        if (number := number_of(path)) is not None and path.is_file() and not path.is_symlink()
    ]
    return [path for _, path in sorted(numbered)]


def number_of(path: Path) -> int | None:
    """Return the number in the name of a recording, by which they are ordered."""
    head, _, rest = path.name.partition("-")
    is_number = head.isascii() and head.isdecimal() and len(head) < 16
    return int(head) if is_number and rest.endswith(SUFFIX) else None


def first_head(path: Path) -> Head | None:
    """Return the head at the beginning of a file, or None if it is damaged. Raises `OSError`."""
    with path.open("rb") as file:
        return _head(file.read(_BEGINNING), 0)


class Recording:
    """The records of files, in order, from one wall-clock time to another.

    Every frame that has such a step is read from its `Head` on, so that a replay can begin there;
    `contains` says whether a step is in the time. Each call of `records` reads again.
    """

    def __init__(
        self, paths: Iterable[Path], begin_ns: WallNs = ALWAYS[0], end_ns: WallNs = ALWAYS[1]
    ) -> None:
        self.paths = list(paths)
        self.begin_ns, self.end_ns = begin_ns, end_ns
        self.damage: list[Damage | Unread] = []  # so far, of the last `records()`

    def contains(self, at: Instant) -> bool:
        """Return whether a step at this time was asked for."""
        return self.begin_ns <= at.wall_ns <= self.end_ns

    def includes(self, record: ReadRecord) -> bool:
        """Return whether a record is in the time; a head and a failure always are."""
        match record:
            case RecordedStep():
                return self.contains(record.now)
            case Waits():
                return self.contains(record.at)
        return True

    def records(self) -> Iterator[ReadRecord]:
        """Yield each record. Raises `RecordingError` for a file that is not a recording."""
        self.damage = []
        for path in self.paths:
            for record in self._records(path):
                match record:
                    case Damage():
                        self.damage.append(record)
                    case Steps():
                        yield from steps_of(record)
                    case _:
                        yield record

    def _records(self, path: Path) -> Iterator[Record | Damage]:
        try:
            yield from _records(path, self.begin_ns, self.end_ns)
        except RecordingError as error:
            # One bad file must not hide the others.
            if len(self.paths) == 1:
                raise
            yield Damage(path, 0, path.stat().st_size if path.exists() else 0, str(error))

    def steps(self) -> Iterator[RecordedStep]:
        """Yield the steps in the time. Raises `RecordingError` as `records`."""
        for record in self.records():
            if isinstance(record, RecordedStep) and self.contains(record.now):
                yield record

    def head(self) -> Head | None:
        """Return the first head, or None. Raises `RecordingError` as `records`."""
        return next((record for record in self.records() if isinstance(record, Head)), None)

    def nothing(self) -> RecordingError:
        """Return the error that says why the last `records()` had nothing."""
        unread = f": {self.damage[0]}" if self.damage else ""
        if (self.begin_ns, self.end_ns) != ALWAYS:
            return RecordingError(
                "nothing was recorded in that time: correct --from and --to; `acsard recording` "
                f"lists when each recording begins{unread and f'. Not read{unread}'}"
            )
        if unread:
            return RecordingError(f"nothing of it can be read{unread}")
        return RecordingError("this recording is empty: the daemon ended within its first second")


class FrameError(AcsardError):
    """The content of a frame is not that of a recording."""


_DAMAGE = (zstandard.ZstdError, FrameError, *MSGSPEC_ERRORS)


def _records(path: Path, begin_ns: WallNs, end_ns: WallNs) -> Iterator[Record | Damage]:
    always = (begin_ns, end_ns) == ALWAYS
    data, at = _content(path, begin_ns, end_ns), 0
    if not MAGIC.startswith(data[:4]) and _next_frame(data, 0) is None:
        raise RecordingError(f"{path} is not a recording of acsard, or its beginning is missing")
    while at < len(data):
        try:
            if not always and (after := _skipped(data, at, begin_ns, end_ns)):
                at = after
                continue
            end = yield from _frame(data, at)
            if end is None and _next_frame(data, at + 1) is not None:
                raise FrameError("a frame has no end")
            at = len(data) if end is None else end
        except _DAMAGE as error:
            begin, at = at, _next_frame(data, at + 1) or len(data)
            # Which check of the library notices depends on the bytes.
            why = "a checksum is wrong" if "corruption" in str(error) else str(error)
            yield Damage(path, begin, at, printable(why)[:200])


def _content(path: Path, begin_ns: WallNs, end_ns: WallNs) -> bytes:
    # Empty if the file ended before `begin_ns`, or began after `end_ns`: a change of the clock
    # begins a new file.
    try:
        status = path.stat()
        if not stat.S_ISREG(status.st_mode):
            raise RecordingError(f"cannot read {path}: it is not a file")
        if status.st_size > MAX_FILE_BYTES:
            raise RecordingError(
                f"cannot read {path}: it has more than {MAX_FILE_BYTES >> 20} MB, as no recording "
                "of acsard has"
            )
        with path.open("rb") as file:
            beginning = file.read(_BEGINNING)
            if (head := _head(beginning, 0)) is not None:
                # If the file was written before it began, a copy has its time by another clock.
                over = head.wall_ns < status.st_mtime_ns + NS_PER_S < begin_ns
                if over or head.wall_ns > end_ns:
                    return b""
            return beginning + file.read(MAX_FILE_BYTES)
    except OSError as error:
        raise RecordingError(
            f"cannot read {path}: {error.strerror}; `acsard recording` lists the recordings"
        ) from None


def _frame(data: bytes, at: int) -> Generator[Record, None, int | None]:
    # Yields the records of the frame at this offset, and returns that of its end, or None if the
    # data ends before. Raises `_DAMAGE`.
    decompressor = zstandard.ZstdDecompressor(max_window_size=1 << WINDOW_LOG).decompressobj()
    plain, is_first = bytearray(), True
    while at < len(data) and not decompressor.eof:
        plain += decompressor.decompress(data[at : at + _PIECE])
        at += _PIECE
        while (record := _taken(plain)) is not None:
            if isinstance(record, Head) is not is_first:
                raise FrameError("a frame does not have one head, at its beginning")
            is_first = False
            yield record
    if not decompressor.eof:
        return None
    return min(at, len(data)) - len(decompressor.unused_data)


def _taken(plain: bytearray) -> Record | None:
    # The first record of the decompressed bytes, which it removes. None if it is not complete.
    if len(plain) < _PREFIX.size:
        return None
    length, crc = _PREFIX.unpack_from(plain)
    if length > MAX_RECORD_BYTES:
        raise FrameError(f"a record has {length} bytes")
    end = _PREFIX.size + length
    if len(plain) < end:
        return None
    data = bytes(plain[_PREFIX.size : end])
    if zlib.crc32(data) != crc:
        raise FrameError("a checksum is wrong")
    del plain[:end]
    return _decoder.decode(data)


def _next_frame(data: bytes, at: int) -> int | None:
    # Offset of the first frame from this one on that begins with a head.
    at = data.find(MAGIC, at)
    while at >= 0 and _head(data, at) is None:
        at = data.find(MAGIC, at + 1)
    return at if at >= 0 else None


def _head(data: bytes, at: int) -> Head | None:
    try:
        record = next(_frame(data, at), None)
    except _DAMAGE:
        return None
    return record if isinstance(record, Head) else None


def _skipped(data: bytes, at: int, begin_ns: WallNs, end_ns: WallNs) -> int | None:
    # Offset of the next frame if no step of the one at this offset is in the time. A frame's steps
    # lie between its head and the next one.
    head, following = _head(data, at), _next_frame(data, at + 1)
    if head is None:
        return None
    if following is None:
        return len(data) if head.wall_ns > end_ns else None
    last = _head(data, following)
    assert last is not None
    # A clock that was set back: the frame begins later than it ends.
    over = head.wall_ns < last.wall_ns < begin_ns
    return following if over or min(head.wall_ns, last.wall_ns) > end_ns else None


def steps_of(steps: Steps) -> Iterator[RecordedStep]:
    """Yield the steps of a record."""
    status = Status("", "booting", "", "")
    now_ns, last = 0, len(steps.rows) - 1
    for index, row in enumerate(steps.rows):
        now_ns += row.since_ns
        status = row.status or status
        reads = [Received(_instant(now_ns - r.age_ns, r.ahead_ns), r.data) for r in row.reads]
        # Another version may have more services.
        requests = [request for request in row.heard.requests if request.verb in _VERBS]
        crc = steps.checksum if index == last else None
        yield RecordedStep(
            steps.first + index,
            _instant(now_ns, row.ahead_ns),
            replace(row.heard, received=tuple(reads), requests=tuple(requests)),
            row.driven,
            row.trip,
            row.late_ns,
            RecordedOutputs(row.line, row.sent, status, row.poses, row.events, crc),
            begins=index == 0,
        )


def _instant(mono_ns: Ns, ahead_ns: Ns) -> Instant:
    # Forged times are cut to those of a real clock.
    mono_ns = min(max(mono_ns, -_MAX_NS), _MAX_NS)
    return Instant(mono_ns, min(max(mono_ns + ahead_ns, -_MAX_NS), _MAX_NS))
