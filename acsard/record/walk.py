"""The records of an MCAP file one after the other, over whatever is damaged in it.

What a chunk is and where it ends is told twice, by the head of its record and by itself: a damaged
head costs nothing. Where a chunk itself is damaged, or a record leads nowhere, the next sound chunk
is looked for, wherever it lies.
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
"""Begins every file of this kind, whatever it is called."""

HEAD = struct.Struct("<BQ")
"""Of a record: what it is, and its bytes after this."""

BEFORE = HEAD.size + 28
"""bytes of a chunk's record, head and all, before the name of its compression."""

COMPRESSED = re.compile(rb"\x04\0\0\0zstd")
"""That name, as every recording has it."""

READ: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.DATA_END: DataEnd.read,
    Opcode.FOOTER: Footer.read,
    Opcode.HEADER: Header.read,
    Opcode.METADATA: Metadata.read,
}
"""What is of use here, beside chunks; all others are passed over."""

OTHERS = frozenset(Opcode) - READ.keys() - {Opcode.CHUNK}


class Found(NamedTuple):
    """A record that is of use, or a place where one is damaged."""

    record: McapRecord | None
    """None of a chunk, and of damage."""
    inside: list[McapRecord]
    """Of a chunk; empty of all others."""
    end: int
    """Where it ends, bytes from the beginning of the file; of damage where the next one begins."""

    @property
    def damaged(self) -> bool:
        return self.record is None and not self.inside


def walk(data: bytes) -> Iterator[Found]:
    """Up to the footer, or as far as there is anything."""
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
    """The sound chunk whose record begins there, whatever its head says; None where none is.

    Where head and chunk differ about its end, the next one tells: a length that is too great would
    swallow all behind it, for what is compressed knows itself where it ends.
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
    """The record of use that begins there; None where none is, or it is cut by the end."""
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
    """Where the next sound chunk begins."""
    for match in COMPRESSED.finditer(data, begin + BEFORE):
        if _sound(data, stream, match.start() - BEFORE):
            return match.start() - BEFORE
    return None
