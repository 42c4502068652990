"""Finishes a recording that was cut off: as a copy, or in place if the disk has no room.

No readable data is thrown away. A file that this version cannot read stays as it is, and so does a
file whose end the disk has no room for.
"""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from io import FileIO
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.records import Attachment, DataEnd, Footer, McapRecord, Metadata

from acsard.core.formatting import many
from acsard.host.errors import RecordingError
from acsard.recording.chunks import LAST_BLOCK, places
from acsard.recording.end_record import END, EndRecord, fields
from acsard.recording.file import Gist, Index, Recording, event_of, rewrite
from acsard.recording.mcap_records import MAGIC, walk

FULL = (errno.ENOSPC, errno.EDQUOT)
"""Error numbers of a disk without room."""

NOTHING_BYTES = 64 << 10
"""A file above this size is more than a header and one second, so it held data, even if this
version cannot read it.
"""


def recover(part: Path, whole: Path, cut: str, room: bool) -> str:
    """Make a finished file `whole` of `part`.

    Returns a message for the log, or "" without trouble. `cut` is a key of `CUTS`; `room` says that
    the disk has room for a copy. A file without content is deleted. A file that cannot be read or
    ended is only renamed. Raises `OSError`.
    """
    seen, told = part.stat(), ""
    try:
        if not _begins(part):
            if seen.st_size > NOTHING_BYTES or _has_chunks(part):
                raise RecordingError(f"{part} has no readable beginning")
            part.unlink()
            return f"{part.name} is removed: it has no beginning" if seen.st_size else ""
        recording = Recording(part)
        if not any(True for _ in recording.messages()):
            if recording.damaged or seen.st_size > NOTHING_BYTES or _has_chunks(part):
                raise RecordingError(f"{part} has no intact data")
            part.unlink()
            return ""
        if room and _beside(recording, part, whole, cut):
            if recording.damaged:
                lost = many(recording.damaged, "damaged place is", "damaged places are")
                told = f"{lost} left out of {whole.name}"
        else:
            if not _in_place(recording, part, cut):
                told = (
                    f"{whole.name} was cut and gets no end record, because the disk is full; "
                    "everything else is in it"
                )
            part.rename(whole)
    except RecordingError as error:
        part.rename(whole)
        return f"it was cut and stays cut, as {whole.name}: {error}"
    # The file time must be the time of the recording's end, not of its recovery.
    os.utime(whole, ns=(seen.st_atime_ns, seen.st_mtime_ns))
    return told


def _begins(part: Path) -> bool:
    """Return whether the file has its configuration. Without it, none of the file can be read."""
    records = (found.record for found in walk(part.read_bytes()))
    return any(isinstance(record, Attachment) for record in records)


def _has_chunks(part: Path) -> bool:
    """Return whether a chunk was begun in the file, even if none of it can be read."""
    return any(True for _ in places(part.read_bytes(), 0))


def _beside(recording: Recording, part: Path, whole: Path, cut: str) -> bool:
    """Write a copy without the damaged parts; return False if the disk is full."""
    written = part.with_name(f".{part.name}.new")
    written.unlink(missing_ok=True)
    try:
        rewrite(recording, written, cut)
    except OSError as error:
        if error.errno not in FULL:
            raise
        return False
    written.rename(whole)
    part.unlink()
    return True


def _in_place(recording: Recording, part: Path, cut: str) -> bool:
    """Write the end behind the last whole second, over the torn part.

    A chunk that was cut, or whose head is not the true one, gets its true head. If a power cut
    interrupted an earlier recovery behind the end, only the heads are written. Returns False if the
    disk has no room; then the file is as it was. No second is given up to gain room: some disks
    give none back, and then all would be lost.
    """
    gist = Gist(recording.about)
    for topic, wall_ns, data in recording.messages():
        gist.message(topic, wall_ns, data)
        if topic == "events":
            gist.event(event_of(recording, data))
    before = part.read_bytes()
    puts, size = _mends(before, gist.closing(cut))
    if not puts and size == len(before):
        return True
    with part.open("r+b", buffering=0) as stream:
        try:
            for at, data in puts:
                _put(stream, at, data)
        except OSError as error:
            with suppress(OSError):
                stream.truncate(len(before))
                for at, data in puts:
                    _put(stream, at, before[at : at + len(data)])
            if error.errno not in FULL:
                raise
            return False
        stream.truncate(size)
        os.fsync(stream.fileno())
    return True


def _mends(before: bytes, last: EndRecord) -> tuple[list[tuple[int, bytes]], int]:
    """Return the offset and the bytes of each write that finishes a file, and the file's new size.

    The end comes before the heads, because the disk may have no room for it.
    """
    heads: list[tuple[int, bytes]] = []
    chunk, index = None, Index()
    for found in walk(before):
        if isinstance(found.record, Footer) and before.startswith(MAGIC, found.end):
            return heads, found.end + len(MAGIC)
        # A record behind a chunk belongs to an earlier end, which the new one overwrites.
        if found.record is not None and chunk is None:
            length = len(_encoded(found.record))
            index.record(found.record, found.end - length, length)
        if found.chunk and found.messages:
            chunk = found.chunk
            index.chunk()
            for message in chunk.messages:
                index.message(message.channel, message.wall_ns)
            if chunk.complete and not before.startswith(head := chunk.head(before), chunk.begin):
                heads.append((chunk.begin, head))
    # Another process has changed the file since it was read.
    if chunk is None:
        raise OSError(errno.ESTALE, os.strerror(errno.ESTALE))
    before_end = b""
    if not chunk.complete:
        before_end = LAST_BLOCK
        heads.append((chunk.begin, chunk.head(before)))
    end = before_end + _end(last, index, chunk.end + len(before_end))
    return [(chunk.end, end), *heads], chunk.end + len(end)


def _put(stream: FileIO, at: int, data: bytes) -> None:
    """Write `data` at a position and sync it; after an `OSError` a part may have been written."""
    stream.seek(at)
    while data:
        data = data[stream.write(data) :]
    os.fsync(stream.fileno())


def _end(last: EndRecord, index: Index, at: int) -> bytes:
    """Return the end of an MCAP file, to be written at that offset.

    Its summary leaves out the copy of the schema and the channels, for want of room. Without the
    statistics, some readers take the file for an empty one.
    """
    closing = Metadata(END, fields(last))
    data = _encoded(closing)
    index.record(closing, at, len(data))
    data += _encoded(DataEnd(0))
    summary_at = at + len(data)
    return data + _encoded(*index.records(), Footer(summary_at, 0, 0)) + MAGIC


def _encoded(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())
