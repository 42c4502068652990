"""Yields the records of an MCAP file one after the other, and skips damaged places.

A chunk's length and end are known twice: from the head of its record and from its own content. A
damaged head therefore costs nothing. If a chunk is damaged, or a record's length leads nowhere, the
reader searches for the next sound chunk.
"""

from __future__ import annotations

import io
import re
import struct
from collections.abc import Callable, Iterator
from typing import NamedTuple

from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Attachment, Chunk, DataEnd, Footer, Header, McapRecord, Metadata
from mcap.stream_reader import breakup_chunk

from acsard.record.closing import DAMAGE

MAGIC = b"\x89MCAP0\r\n"
"""Magic bytes at the start of every MCAP file."""

HEAD = struct.Struct("<BQ")
"""Head of a record: its opcode and the number of bytes after the head."""

BEFORE = HEAD.size + 28
"""Number of bytes in a chunk's record, with its head, before the name of its compression."""

COMPRESSED = re.compile(rb"\x04\0\0\0zstd")
"""The name of the compression in every recording, with its length."""

READ: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.DATA_END: DataEnd.read,
    Opcode.FOOTER: Footer.read,
    Opcode.HEADER: Header.read,
    Opcode.METADATA: Metadata.read,
}
"""Readers of the records that are used here, besides chunks. All other records are skipped."""

OTHERS = frozenset(Opcode) - READ.keys() - {Opcode.CHUNK}


class Found(NamedTuple):
    """A record that is used, or a damaged place."""

    record: McapRecord | None
    """The record; None for a chunk and for damage."""
    inside: list[McapRecord]
    """Records in a chunk; empty otherwise."""
    end: int
    """Offset of the record's end in the file, bytes. After damage, reading goes on there."""

    @property
    def damaged(self) -> bool:
        return self.record is None and not self.inside


def walk(data: bytes) -> Iterator[Found]:
    """Yield the records up to the footer, or to the end of the data."""
    at, stream = len(MAGIC), io.BytesIO(data)
    if not data.startswith(MAGIC):
        return
    while at + HEAD.size <= len(data):
        opcode, length = HEAD.unpack_from(data, at)
        claimed = at + HEAD.size + length
        found = _chunk(data, stream, at, claimed) or _read(stream, at, opcode, claimed, len(data))
        if found is None and opcode in OTHERS and claimed <= len(data):
            at = claimed
            continue
        if found is None:
            after = _next(data, stream, at + 1)
            if after is None and (not opcode or claimed > len(data)):
                return
            found = Found(None, [], after or claimed)
        yield found
        if isinstance(found.record, Footer):
            return
        at = found.end


def _chunk(data: bytes, stream: io.BytesIO, at: int, claimed: int) -> Found | None:
    """Return the sound chunk whose record begins at `at`, even if its head is damaged, or None.

    If the head and the content disagree about the chunk's end, the next sound chunk decides.
    Compressed data decodes even if its recorded length is too great, and such a length would
    otherwise swallow the records after it.
    """
    found = _sound(data, stream, at)
    if found is None or found.end == claimed:
        return found
    after = _next(data, stream, at + 1)
    if after is not None:
        return found._replace(end=min(found.end, after))
    return found._replace(end=claimed) if claimed < found.end == len(data) else found


def _sound(data: bytes, stream: io.BytesIO, at: int) -> Found | None:
    if data[at] != Opcode.CHUNK and not COMPRESSED.match(data, at + BEFORE):
        return None
    stream.seek(at + HEAD.size)
    try:
        inside = breakup_chunk(Chunk.read(ReadDataStream(stream)), validate_crc=True)
    except DAMAGE:
        return None
    return Found(None, inside, stream.tell()) if inside else None


def _read(stream: io.BytesIO, at: int, opcode: int, claimed: int, size: int) -> Found | None:
    """Return the record that begins at `at`; None if it is not one of `READ`, or is cut off."""
    read = READ.get(opcode)
    if read is None:
        return None
    stream.seek(at + HEAD.size)
    try:
        record = read(ReadDataStream(stream))
    except DAMAGE:
        return None
    end = stream.tell()
    return Found(record, [], end) if end < size or end == claimed else None


def _next(data: bytes, stream: io.BytesIO, begin: int) -> int | None:
    """Return the offset of the next sound chunk, or None."""
    for match in COMPRESSED.finditer(data, begin + BEFORE):
        if _sound(data, stream, match.start() - BEFORE):
            return match.start() - BEFORE
    return None
