"""Yields the records of an MCAP file one after the other, and skips damaged places.

If a chunk is damaged, the reader takes the messages before the damage. After a damaged chunk or a
record whose length is wrong, the reader searches for the next complete chunk.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import NamedTuple

import msgspec
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, DataEnd, Footer, Header, McapRecord, Metadata

from acsard.recording.chunks import MAX_CHUNK_BYTES, Message, ReadChunk, chunk_places, read_chunk

DAMAGE = (
    McapError, msgspec.MsgspecError, zstandard.ZstdError, struct.error,
    ValueError, OverflowError, EOFError, MemoryError,
)  # fmt: skip
"""Exceptions that the MCAP library raises for bytes that are not valid MCAP."""

MAGIC = b"\x89MCAP0\r\n"
"""Magic bytes at the start of every MCAP file."""

MAX_EFFORT = 256
"""Largest effort for damaged chunks, in unpacked bytes for each byte of the file.

The chunks in the recordings of the tests have an effort of 5 to 13. A damaged chunk is read up to
three times, and a damaged block in it counts as 128 KiB.
"""

HEAD = struct.Struct("<BQ")
"""Head of a record: its opcode and the number of bytes after the head."""

READ: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.DATA_END: DataEnd.read,
    Opcode.FOOTER: Footer.read,
    Opcode.HEADER: Header.read,
    Opcode.METADATA: Metadata.read,
}
"""Decoders of the records that a recording uses, besides chunks. All other records are skipped."""

OTHERS = frozenset(Opcode) - READ.keys() - {Opcode.CHUNK}


class Found(NamedTuple):
    """A record, a chunk or a damaged place of a file."""

    record: McapRecord | None
    """The record; None for a chunk and for damage."""
    chunk: ReadChunk | None
    """The readable part of a chunk; None for other records."""
    end: int
    """Offset of the end in the file, bytes. After a damaged place, the reader goes on there."""
    damaged: bool = False
    """True for a damaged place. The torn end of a file that was cut off is not a damaged place."""

    @property
    def messages(self) -> list[Message]:
        """Messages of the chunk; empty for other records."""
        return self.chunk.messages if self.chunk else []


def walk(data: bytes) -> Iterator[Found]:
    """Yield the records of a file up to the footer, or to the end of the file.

    If the damaged chunks need more than `MAX_EFFORT`, the rest of the file is one damaged place.
    """
    at, stream, chunks = len(MAGIC), io.BytesIO(data), _Chunks(data)
    # The first bytes of a finished file may be damaged too.
    if not (data.startswith(MAGIC) or data.endswith(MAGIC)):
        return
    while at + HEAD.size <= len(data):
        opcode, length = HEAD.unpack_from(data, at)
        claimed = at + HEAD.size + length
        chunk = chunks.read(at)
        found = _read(stream, at, opcode, claimed, len(data)) if chunk is None else None
        if chunk is not None and chunk.complete:
            found = Found(None, chunk, chunk.end)
        elif found is None and opcode in OTHERS and claimed <= len(data):
            at = claimed
            continue
        if found is None:
            after = chunks.later(at + 1)
            if claimed < (after or len(data)):
                following = chunks.read(claimed)
                # The next chunk is damaged as well, but its first messages can be read.
                if following is not None and following.messages:
                    after = claimed
            cut = after is None and not chunks.spent and (not opcode or claimed > len(data))
            end = len(data) if cut or chunks.spent else after or claimed
            found = Found(None, chunk, end, not cut)
        yield found
        if isinstance(found.record, Footer):
            return
        at = found.end


def _read(stream: io.BytesIO, at: int, opcode: int, claimed: int, size: int) -> Found | None:
    """Decode the record that begins at the offset `at`.

    `claimed` is the end of the record according to its length, and `size` the size of the file.
    Returns None if the record is not one of `READ`, is damaged or is cut off.
    """
    read = READ.get(opcode)
    if read is None:
        return None
    stream.seek(at + HEAD.size)
    try:
        record = read(ReadDataStream(stream))
    except DAMAGE:
        return None
    end = stream.tell()
    if isinstance(record, Attachment) and not _is_intact(stream, at, end):
        return None
    return Found(record, None, end) if end < size or end == claimed else None


def _is_intact(stream: io.BytesIO, at: int, end: int) -> bool:
    """Return whether the checksum of the attachment between two offsets is correct or absent."""
    stream.seek(at)
    record = stream.read(end - at)
    crc = int.from_bytes(record[-4:], "little")
    return crc in (0, zlib.crc32(record[HEAD.size : -4]))


class _Chunks:
    """Reads chunks, and searches for the next complete chunk without searching a place twice.

    A hostile file may have thousands of incomplete chunks that share their last blocks, so that
    each takes megabytes to unpack. Therefore the effort for incomplete chunks is limited in
    proportion to the size of the file.
    """

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._effort = MAX_CHUNK_BYTES + MAX_EFFORT * len(data)
        """Effort that is left for incomplete chunks."""
        self._searched = 0
        """Offset up to which `later` has searched."""
        self._found: int | None = None
        """Offset of the chunk that `later` found last."""

    @property
    def spent(self) -> bool:
        """True if no effort is left. Then `later` finds no chunk any more."""
        return self._effort < 0

    def read(self, begin: int) -> ReadChunk | None:
        """Read the chunk whose head begins at the offset `begin`, or return None.

        A chunk that is incomplete or empty reduces the effort that is left.
        """
        chunk = read_chunk(self._data, begin)
        if chunk is not None and not (chunk.complete and chunk.messages):
            self._effort -= chunk.effort
        return chunk

    def later(self, begin: int) -> int | None:
        """Return the offset of the first complete chunk from `begin` on, or None.

        `begin` must not decrease from call to call.
        """
        if self._found is not None and self._found >= begin:
            return self._found
        self._found = None
        for at in chunk_places(self._data, max(begin, self._searched)):
            if self.spent:
                return None
            self._searched = at + 1
            chunk = self.read(at)
            if chunk is not None and chunk.complete and chunk.messages:
                self._found = at
                return at
        self._searched = len(self._data)
        return None
