"""Finishes a recording that was cut off, so that the file has an end record.

The readable data goes to a new file, or, on a full disk, the end record into the old one. No
readable data is deleted. A file that this version cannot read, or without room for the end record,
is only renamed.
"""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from io import FileIO
from pathlib import Path

from mcap.records import Attachment, Footer

from acsard.core.formatting import many
from acsard.host.errors import RecordingError
from acsard.recording.end_record import EndRecord
from acsard.recording.mcap_file import (
    EndRecordBuilder,
    Index,
    Recording,
    event_of,
    file_end,
    rewrite,
)
from acsard.recording.mcap_records import LAST_BLOCK, MAGIC, chunk_places, encoded, walk

DISK_FULL = (errno.ENOSPC, errno.EDQUOT)

MAX_DELETED_BYTES = 64 << 10  # a larger file has more than a header and one second of steps


def recover(part: Path, whole: Path, cut: str, room: bool) -> str:
    """Finish `part` as `whole`, and return a message for the log, or "".

    `cut` is a key of `CUT_TEXTS`, and `room` says that a copy fits. A small file without data is
    deleted. Raises `OSError`.
    """
    before, message = part.stat(), ""
    try:
        if not _has_configuration(part):
            if before.st_size > MAX_DELETED_BYTES or _has_chunks(part):
                raise RecordingError(f"{part} has no readable beginning: nothing can be recovered")
            part.unlink()
            return f"{part.name} was deleted: its beginning is missing" if before.st_size else ""
        recording = Recording(part)
        if not any(True for _ in recording.messages()):
            if recording.damaged or before.st_size > MAX_DELETED_BYTES or _has_chunks(part):
                raise RecordingError(f"{part} has no intact data: nothing can be recovered")
            part.unlink()
            return ""
        if room and _copy(recording, part, whole, cut):
            if recording.damaged:
                lost = many(recording.damaged, "damaged place is", "damaged places are")
                message = f"{lost} left out of {whole.name}"
        else:
            if not _finish_in_place(recording, part, cut):
                message = (
                    f"{whole.name} was cut off. Because the disk is full, the file gets no end "
                    "record, but it has all other data"
                )
            part.rename(whole)
    except RecordingError as error:
        part.rename(whole)
        return (
            "acsard cannot finish a recording that was cut off; its file now has the name "
            f"{whole.name}, and its content is unchanged: {error}"
        )
    # The file time must be the time of the recording's end, not of its recovery.
    os.utime(whole, ns=(before.st_atime_ns, before.st_mtime_ns))
    return message


def _has_configuration(part: Path) -> bool:
    # The attachment of a recording contains the configuration. `Recording` refuses a file without a
    # configuration.
    return any(isinstance(place.record, Attachment) for place in walk(part.read_bytes()))


def _has_chunks(part: Path) -> bool:
    # Another version may be able to read its data.
    return any(True for _ in chunk_places(part.read_bytes(), 0))


def _copy(recording: Recording, part: Path, whole: Path, cut: str) -> bool:
    # False: the disk is full, and `part` stays.
    written = part.with_name(f".{part.name}.new")
    written.unlink(missing_ok=True)
    try:
        rewrite(recording, written, cut)
    except OSError as error:
        if error.errno not in DISK_FULL:
            raise
        return False
    written.rename(whole)
    part.unlink()
    return True


def _finish_in_place(recording: Recording, part: Path, cut: str) -> bool:
    # End record and footer overwrite the incomplete end, and growing chunks get true headers.
    # False: no room for the end record, and nothing changes.
    # Readable data is not removed to make room, because on some disks this does not help.
    builder = EndRecordBuilder(recording.about)
    for topic, wall_ns, data in recording.messages():
        builder.message(topic, wall_ns, data)
        if topic == "events":
            builder.event(event_of(recording, data))
    before = part.read_bytes()
    writes, size = _writes(before, builder.end_record(cut))
    if not writes and size == len(before):
        return True
    with part.open("r+b", buffering=0) as stream:
        try:
            for at, data in writes:
                _write_at(stream, at, data)
        except OSError as error:
            with suppress(OSError):
                stream.truncate(len(before))
                for at, data in writes:
                    _write_at(stream, at, before[at : at + len(data)])
            if error.errno not in DISK_FULL:
                raise
            return False
        stream.truncate(size)
        os.fsync(stream.fileno())
    return True


def _writes(before: bytes, last: EndRecord) -> tuple[list[tuple[int, bytes]], int]:
    # Pairs of offset and bytes, and the finished size. An earlier recovery may have left only chunk
    # headers to write.
    # The first write is the end of the file, because the disk may have no room for the end.
    heads: list[tuple[int, bytes]] = []
    chunk, index = None, Index()
    for place in walk(before):
        if isinstance(place.record, Footer) and before.startswith(MAGIC, place.end):
            return heads, place.end + len(MAGIC)
        # A record after a chunk belongs to the end that an earlier recovery began to write. The new
        # end overwrites it.
        if place.record is not None and chunk is None:
            length = len(encoded(place.record))
            index.record(place.record, place.end - length, length)
        if place.chunk and place.messages:
            chunk = place.chunk
            index.chunk()
            for message in chunk.messages:
                index.message(message.channel, message.wall_ns)
            if chunk.complete and not before.startswith(head := chunk.head(before), chunk.begin):
                heads.append((chunk.begin, head))
    # The file had a chunk when it was read. If the chunk is missing now, another process has
    # changed the file.
    if chunk is None:
        raise OSError(errno.ESTALE, os.strerror(errno.ESTALE))
    before_end = b""
    if not chunk.complete:
        before_end = LAST_BLOCK
        heads.append((chunk.begin, chunk.head(before)))
    # The summary section does not repeat the schema and the channels, because the disk may be
    # nearly full. It has the statistics, because some readers treat a file without statistics as
    # empty.
    end = before_end + file_end(last, index, chunk.end + len(before_end))
    return [(chunk.end, end), *heads], chunk.end + len(end)


def _write_at(stream: FileIO, at: int, data: bytes) -> None:
    # An `OSError` may leave a part written.
    stream.seek(at)
    while data:
        data = data[stream.write(data) :]
    os.fsync(stream.fileno())
