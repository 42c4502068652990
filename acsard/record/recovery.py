"""A recording that was cut -> a finished one: beside it, or in its place where there is no room.

Nothing that anybody could read is thrown away: what this version cannot read is left as it is, and
so is what the disk has no room to end.
"""

from __future__ import annotations

import errno
import os
from contextlib import suppress
from io import FileIO
from pathlib import Path

from mcap.data_stream import RecordBuilder
from mcap.records import Attachment, DataEnd, Footer, Metadata

from acsard.host.errors import RecordingError
from acsard.record.closing import END, Closing, fields
from acsard.record.file import Gist, Recording, event_of, rewrite
from acsard.record.walk import MAGIC, walk

FULL = (errno.ENOSPC, errno.EDQUOT)
"""What a disk says that has no room."""

NOTHING_BYTES = 64 << 10
"""What is larger than a beginning and a chunk had something in it, be it unreadable here."""


def recover(part: Path, whole: Path, cut: str, room: bool) -> str:
    """Make a finished file `whole` of `part`; what there is to tell of it, "" where it went well.

    `cut` is a word of `CUTS`; `room` says that the disk has some for a copy. One with nothing in it
    goes; one that cannot be read here, or not be ended, only gets the other name. Raises `OSError`.
    """
    seen, told = part.stat(), ""
    try:
        if not _begins(part):
            if seen.st_size > NOTHING_BYTES or _has_chunks(part):
                raise RecordingError(f"{part} has no beginning that can be read")
            part.unlink()
            return f"{part.name} is removed: it has no beginning" if seen.st_size else ""
        recording = Recording(part)
        if not any(True for _ in recording.messages()):
            if recording.damaged or seen.st_size > NOTHING_BYTES:
                raise RecordingError(f"{part} has nothing whole in it")
            part.unlink()
            return ""
        if not room or not _beside(recording, part, whole, cut):
            if not _in_place(recording, part, cut):
                told = f"{whole.name} was cut and has no end, for want of room; all else is in it"
            part.rename(whole)
    except RecordingError as error:
        part.rename(whole)
        return f"it was cut and stays so, as {whole.name}: {error}"
    os.utime(whole, ns=(seen.st_atime_ns, seen.st_mtime_ns))  # when it ended, not when it was found
    return told


def _begins(part: Path) -> bool:
    """It can be told whose it is; without that nobody can read any of it."""
    records = (found.record for found in walk(part.read_bytes()))
    return any(isinstance(record, Attachment) for record in records)


def _has_chunks(part: Path) -> bool:
    return any(found.inside for found in walk(part.read_bytes()))


def _beside(recording: Recording, part: Path, whole: Path, cut: str) -> bool:
    """A copy, without what is damaged; False where the disk is full."""
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
    """The end goes behind the last whole chunk, over what is torn; False where the disk does not
    take it: then the file is as it was. No chunk is given up for the room: some disks give none
    back, and all of them would go."""
    gist = Gist(recording.about)
    for topic, wall_ns, data in recording.messages():
        gist.message(topic, wall_ns, data)
        if topic == "events":
            gist.event(event_of(recording, data))
    if recording.ended:
        return True
    end = _end(gist.closing(cut))
    before = part.read_bytes()
    at = max((found.end for found in walk(before) if found.inside), default=0)
    if not at:  # somebody else has changed it since
        raise OSError(errno.ESTALE, os.strerror(errno.ESTALE))
    with part.open("r+b", buffering=0) as stream:
        try:
            _put(stream, at, end)
        except OSError as error:
            with suppress(OSError):
                stream.truncate(len(before))
                _put(stream, at, before[at : at + len(end)])
            if error.errno not in FULL:
                raise
            return False
        stream.truncate(at + len(end))
        os.fsync(stream.fileno())
    return True


def _put(stream: FileIO, at: int, data: bytes) -> None:
    """There, and on the disk; raises `OSError`, when some of it may be there."""
    stream.seek(at)
    while data:
        data = data[stream.write(data) :]
    os.fsync(stream.fileno())


def _end(last: Closing) -> bytes:
    """The least that makes a file a finished one: no index, which is read without, too."""
    builder = RecordBuilder()
    Metadata(END, fields(last)).write(builder)
    DataEnd(0).write(builder)
    Footer(0, 0, 0).write(builder)
    return bytes(builder.end()) + MAGIC
