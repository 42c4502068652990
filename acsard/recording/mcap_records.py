"""Yields the records of an MCAP file one after the other, and skips damaged places.

If a chunk is damaged, or a record's length leads nowhere, the reader takes the chunk's first
messages as far as they are whole, and searches for the next complete chunk.
"""

from __future__ import annotations

import io
import struct
from collections.abc import Callable, Iterator
from typing import NamedTuple

import msgspec
import zstandard
from mcap.data_stream import ReadDataStream
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, DataEnd, Footer, Header, McapRecord, Metadata

from acsard.recording.chunks import MOST_BYTES, Content, Message, content, places

DAMAGE = (
    McapError, msgspec.MsgspecError, zstandard.ZstdError, struct.error,
    ValueError, OverflowError, EOFError, MemoryError,
)  # fmt: skip
"""Exceptions that the MCAP library raises for bytes that are not valid MCAP."""

MAGIC = b"\x89MCAP0\r\n"
"""Magic bytes at the start of every MCAP file."""

MOST_EFFORT = 256
"""Number of bytes that may be unpacked without a complete chunk, for each byte of the file. The
chunks of the recordings of the tests take 5 to 13. A damaged chunk is read up to three times, and
a damaged block in it counts as 128 KiB.
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
"""Readers of the records that are used here, besides chunks. All other records are skipped."""

OTHERS = frozenset(Opcode) - READ.keys() - {Opcode.CHUNK}


class Found(NamedTuple):
    """A record that is used, or a damaged place."""

    record: McapRecord | None
    """The record; None for a chunk and for damage."""
    chunk: Content | None
    """The chunk, as far as it is whole, or None."""
    end: int
    """Offset of the record's end in the file, bytes. After damage, reading goes on there."""
    damaged: bool = False
    """True for damage before other records. The end of a file that was cut is not damage."""

    @property
    def messages(self) -> list[Message]:
        """Messages of the chunk; empty for other records."""
        return self.chunk.messages if self.chunk else []


def walk(data: bytes) -> Iterator[Found]:
    """Yield the records up to the footer, or to the end of the data.

    If the damaged chunks take more time than those of any recording, all after them is damage.
    """
    at, stream, chunks = len(MAGIC), io.BytesIO(data), _Chunks(data)
    if not data.startswith(MAGIC):
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
                beside = chunks.read(claimed)
                # The next chunk is damaged as well, and its beginning can be read.
                if beside is not None and beside.messages:
                    after = claimed
            cut = after is None and not chunks.spent and (not opcode or claimed > len(data))
            end = len(data) if cut or chunks.spent else after or claimed
            found = Found(None, chunk, end, not cut)
        yield found
        if isinstance(found.record, Footer):
            return
        at = found.end


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
    return Found(record, None, end) if end < size or end == claimed else None


class _Chunks:
    """Reader of chunks, and search for the next complete one. No place is searched twice.

    A hostile file may have thousands of chunks that share their last blocks, so that each takes
    megabytes to unpack. The chunks that are not complete must not take more than an effort in
    proportion to the file.
    """

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._effort = MOST_BYTES + MOST_EFFORT * len(data)
        """Effort that is left for chunks that are not complete."""
        self._searched = 0
        """Offset up to which no complete chunk begins, apart from those that were passed."""
        self._found: int | None = None

    @property
    def spent(self) -> bool:
        """True if no effort is left; then the search finds nothing more."""
        return self._effort < 0

    def read(self, begin: int) -> Content | None:
        """Read the chunk whose head begins at that offset; return None if there is none."""
        chunk = content(self._data, begin)
        if chunk is not None and not (chunk.complete and chunk.messages):
            self._effort -= chunk.effort
        return chunk

    def later(self, begin: int) -> int | None:
        """Return the offset of the next complete chunk from `begin` on, or None.

        `begin` never decreases.
        """
        if self._found is not None and self._found >= begin:
            return self._found
        self._found = None
        for at in places(self._data, max(begin, self._searched)):
            if self.spent:
                return None
            self._searched = at + 1
            chunk = self.read(at)
            if chunk is not None and chunk.complete and chunk.messages:
                self._found = at
                return at
        self._searched = len(self._data)
        return None
