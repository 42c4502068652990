"""Writes MCAP chunks in small pieces, and reads the MCAP records of files that may be damaged.

The header of an MCAP chunk contains the chunk's length and checksum. Most programs therefore write
a chunk only when it is complete, so that a power cut destroys the whole chunk. The recorder instead
writes each chunk while the chunk grows:

1. First the recorder writes a header whose length field is larger than any file.
2. Once a second it appends a zstd block with the new messages.
3. When the chunk is complete, the recorder replaces the header with the true header.

The reader does not need the length and the checksum in the header. Each zstd block contains its own
length, and each message contains a checksum in the field for its sequence number. After a damaged
chunk or a record whose length is wrong, the reader searches for the next complete chunk.
"""

from __future__ import annotations

import io
import struct
import zlib
from collections.abc import Callable, Iterator
from typing import NamedTuple

import msgspec
import zstandard
from mcap.data_stream import ReadDataStream, RecordBuilder
from mcap.exceptions import McapError
from mcap.opcode import Opcode
from mcap.records import Attachment, DataEnd, Footer, Header, McapRecord, Metadata
from zstandard import COMPRESSOBJ_FLUSH_BLOCK, ZstdCompressionParameters

# At this level, ten seconds of steps are compressed in 2 to 8 ms. The result is 13 to 16 % smaller
# than at level 3.
ZSTD_PARAMETERS = ZstdCompressionParameters.from_level(
    9, source_size=1 << 18, write_content_size=False
)
"""Parameters of the zstd compressor for chunks of 256 KiB. The compressor then needs 3 MB of
memory."""

LAST_BLOCK = b"\x01\0\0"
"""Empty zstd block with the mark of a last block. It completes a chunk that was cut off."""

MAX_CHUNK_BYTES = 1 << 23
"""Largest uncompressed size of a chunk that is read, bytes. Recorders write at most 1 MiB plus one
message."""

MAX_MESSAGE_BYTES = 1 << 22
"""Largest size of a message that is read, bytes. A message with one second of steps and 20 commands
has 16 000 bytes."""

_HEAD = struct.Struct("<BQQQQII4sQ")
"""Layout of the header of an MCAP chunk record.

The fields are: opcode, length of the record, earliest time of a message, latest time of a message,
size of the uncompressed data, CRC-32 of the uncompressed data, length of the compression's name,
name of the compression, and size of the compressed data.
"""

_AFTER_LENGTH = _HEAD.size - 9
"""Number of bytes in a chunk's header after the field "length of the record". The value of that
field includes these bytes."""

_NAME_AT = 37
"""Offset of the bytes `ZSTD_NAME_FIELD` from the beginning of a chunk's header, bytes."""

ZSTD_NAME_FIELD = struct.pack("<I4s", 4, b"zstd")
"""Bytes that every chunk's header contains: the length of the compression's name, and the name."""

_ENDLESS = (1 << 63) - 1
"""Value of the length fields in the header of a growing chunk. No file is that long."""

_MESSAGE = struct.Struct("<BQHIQQ")
"""Layout of the header of an MCAP message record.

The fields are: opcode, length of the record, channel, sequence number, log time and publish time.
In a recording, the sequence number is a checksum, and the two times are equal.
"""

MAX_DATA_BYTES = MAX_MESSAGE_BYTES - _MESSAGE.size
"""Largest size of the data of a message that is read, bytes."""

_CHECKED = struct.Struct("<HQ")
"""Layout of a message's channel and time, which the checksum covers together with the data."""

_BESIDE_DATA = _MESSAGE.size - 9
"""Number of bytes in a message's header after the field "length of the record". The value of that
field includes these bytes."""

_LONGEST_FRAME_HEAD = 18
"""Largest size of the header of a zstd frame, bytes."""

_BLOCK_BYTES = 1 << 17
"""Largest size of a zstd block, compressed or uncompressed, bytes."""

_BLOCK_EFFORT = 1 << 10
"""Work that the reader counts for each zstd block in addition to the data of the block, in unpacked
bytes. Even an empty block takes about as long to read as 1 KiB of data."""

_REPEATED = 1
"""Type number of a zstd block that repeats one byte. Such a block stores the byte only once, and
its size field contains the number of repetitions."""


class Message(NamedTuple):
    """A message of a recording, as an MCAP chunk contains it."""

    channel: int
    """Number of the MCAP channel."""
    wall_ns: int
    """Wall-clock time of the message, ns since 1970, at least 0."""
    data: bytes


def _crc(message: Message) -> int:
    return zlib.crc32(message.data, zlib.crc32(_CHECKED.pack(message.channel, message.wall_ns)))


def _head(first_ns: int, last_ns: int, size: int, crc: int, length: int) -> bytes:
    whole = length if length == _ENDLESS else length + _AFTER_LENGTH
    return _HEAD.pack(Opcode.CHUNK, whole, first_ns, last_ns, size, crc, 4, b"zstd", length)


GROWING_HEAD = _head(0, 0, 0, 0, _ENDLESS)


class GrowingChunk:
    """A chunk that is being written. It compresses messages to bytes that the caller writes."""

    def __init__(self) -> None:
        self._compressor = zstandard.ZstdCompressor(
            compression_params=ZSTD_PARAMETERS
        ).compressobj()
        self.size = 0
        """Uncompressed size of the messages so far, in bytes."""
        self._crc = self._length = 0
        self.first_ns, self._last_ns = _ENDLESS, 0
        """Earliest and latest wall-clock time of the messages so far, ns since 1970."""
        self._out: list[bytes] = []

    @property
    def has_unwritten(self) -> bool:
        """True if a message was added since the last call of `take`."""
        return bool(self._out)

    def add(self, message: Message) -> None:
        channel, wall_ns, data = message
        length = _BESIDE_DATA + len(data)
        head = _MESSAGE.pack(Opcode.MESSAGE, length, channel, _crc(message), wall_ns, wall_ns)
        self.first_ns = min(self.first_ns, wall_ns)
        self._last_ns = max(self._last_ns, wall_ns)
        self.size += len(head) + len(data)
        self._crc = zlib.crc32(data, zlib.crc32(head, self._crc))
        self._out += [self._compressor.compress(head), self._compressor.compress(data)]

    def take(self) -> bytes:
        """Return the compressed bytes of the messages that were added since the last call."""
        self._out.append(self._compressor.flush(COMPRESSOBJ_FLUSH_BLOCK))
        return self._take_output()

    def end(self) -> tuple[bytes, bytes]:
        """End the chunk, and return a pair: the last bytes of the chunk, and its true header.

        The caller appends the last bytes to the file, and replaces the header at the beginning of
        the chunk with the true header.
        """
        self._out.append(self._compressor.flush())
        last = self._take_output()
        return last, _head(self.first_ns, self._last_ns, self.size, self._crc, self._length)

    def _take_output(self) -> bytes:
        out = b"".join(self._out)
        self._out.clear()
        self._length += len(out)
        return out


class ReadChunk(NamedTuple):
    """The readable part of a chunk."""

    begin: int
    """Offset in the file at which the chunk's header begins, bytes."""
    end: int
    """Offset in the file at which the readable part ends, bytes. The last zstd block of the
    readable part ends with a complete message."""
    messages: list[Message]
    complete: bool
    """True if the readable part includes the last zstd block of the chunk."""
    effort: int = 0
    """Work of reading the chunk: number of unpacked bytes, plus `_BLOCK_EFFORT` for each block."""

    def head(self, data: bytes) -> bytes:
        """Return a new chunk header that describes only the readable part of the chunk.

        `data` is the content of the whole file. If `complete` is false, the caller must also write
        `LAST_BLOCK` at the offset `self.end`. The sizes in the header then include this block.
        """
        times = [message.wall_ns for message in self.messages]
        blocks = _blocks(data[: self.end], self.begin + _HEAD.size)
        out = b"".join([out for _, out, _ in blocks])
        length = self.end - self.begin - _HEAD.size
        if not self.complete:
            length += len(LAST_BLOCK)
        return _head(min(times), max(times), len(out), zlib.crc32(out), length)


def chunk_places(data: bytes, begin: int) -> Iterator[int]:
    """Yield each offset in a file at which a chunk's header may begin, in increasing order.

    `data` is the content of the whole file. The offsets are at least `begin`.
    """
    at = data.find(ZSTD_NAME_FIELD, begin + _NAME_AT)
    while at >= 0:
        yield at - _NAME_AT
        at = data.find(ZSTD_NAME_FIELD, at + 1)


def read_chunk(data: bytes, begin: int) -> ReadChunk | None:
    """Read the chunk whose header begins at the offset `begin`, as far as it is readable.

    Return None if no chunk begins at this offset. `data` is the content of the whole file.
    """
    at = begin + _HEAD.size
    named = data.startswith(ZSTD_NAME_FIELD, begin + _NAME_AT)
    if at > len(data) or not (named or data[begin] == Opcode.CHUNK):
        return None
    messages: list[Message] = []
    whole = ReadChunk(begin, at, messages, False)
    rest, size, effort, wanted = bytearray(), 0, 0, _MESSAGE.size
    # Complete messages since the last block that ended with a complete message.
    waiting: list[Message] = []
    try:
        for end, out, last in _blocks(data, at):
            rest += out
            size += len(out)
            effort += len(out) + _BLOCK_EFFORT
            if size > MAX_CHUNK_BYTES:
                break
            if rest and len(rest) < wanted:
                continue
            new, used, wanted = _messages(rest)
            if wanted > MAX_MESSAGE_BYTES:
                break
            waiting += new
            del rest[:used]
            if not rest:
                messages += waiting
                waiting.clear()
                whole = ReadChunk(begin, end, messages, last)
    except zstandard.ZstdError:
        # A block is damaged. The next blocks refer to this block, so they cannot be read either.
        effort += _BLOCK_BYTES
    return whole._replace(effort=effort)


def _blocks(data: bytes, at: int) -> Iterator[tuple[int, bytes, bool]]:
    """Yield (end offset in the file, data, is last) for each block of the zstd frame at `at`.

    Raises `ZstdError` for a damaged block.
    """
    begin = at + zstandard.frame_header_size(data[at : at + _LONGEST_FRAME_HEAD])
    unpacker = zstandard.ZstdDecompressor(max_window_size=1 << ZSTD_PARAMETERS.window_log)
    stream = unpacker.decompressobj()
    stream.decompress(data[at:begin])
    last = False
    while not last and begin + 3 <= len(data):
        block = int.from_bytes(data[begin : begin + 3], "little")
        last, kind, size = bool(block & 1), block >> 1 & 3, block >> 3
        end = begin + 3 + (1 if kind == _REPEATED else size)
        # After a power cut, a file may end with zeros. They would be decoded as endless empty
        # blocks.
        if not block or size > _BLOCK_BYTES or end > len(data):
            return
        yield end, stream.decompress(data[begin:end]), last
        begin = end


def _messages(data: bytearray) -> tuple[list[Message], int, int]:
    """Decode the complete messages at the beginning of `data`.

    Returns:
        A triple: the messages, their total size in bytes, and the size of the next message in
        bytes. If the header of the next message is incomplete, the third value is the size of a
        header. If the next message is damaged, the third value exceeds `MAX_MESSAGE_BYTES`.
    """
    messages: list[Message] = []
    at = 0
    while at + _MESSAGE.size <= len(data):
        opcode, length, channel, crc, wall_ns, _ = _MESSAGE.unpack_from(data, at)
        wanted = _MESSAGE.size - _BESIDE_DATA + length
        if opcode != Opcode.MESSAGE or length < _BESIDE_DATA:
            return messages, at, MAX_MESSAGE_BYTES + 1
        if at + wanted > len(data):
            return messages, at, wanted
        message = Message(channel, wall_ns, bytes(data[at + _MESSAGE.size : at + wanted]))
        if _crc(message) != crc:
            return messages, at, MAX_MESSAGE_BYTES + 1
        messages.append(message)
        at += wanted
    return messages, at, _MESSAGE.size


DAMAGE_ERRORS = (
    McapError, msgspec.MsgspecError, zstandard.ZstdError, struct.error,
    ValueError, OverflowError, EOFError, MemoryError,
)  # fmt: skip
"""Exceptions that the decoders raise if the bytes of a file are damaged."""

MAGIC = b"\x89MCAP0\r\n"

# In the test recordings, each byte of a chunk unpacks to 5 to 13 bytes. The limit is larger,
# because a damaged chunk is read up to three times, and a damaged block counts as 128 KiB.
MAX_EFFORT = 256
"""Limit on the work for damaged chunks, in unpacked bytes for each byte of the file. The reader may
unpack `MAX_CHUNK_BYTES` in addition."""

RECORD_HEAD = struct.Struct("<BQ")
"""Layout of the header of an MCAP record: opcode, and number of bytes that follow the header."""

READ_RECORDS: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.DATA_END: DataEnd.read,
    Opcode.FOOTER: Footer.read,
    Opcode.HEADER: Header.read,
    Opcode.METADATA: Metadata.read,
}
"""Decoder of each kind of MCAP record that the reader decodes, by opcode. Chunks are an exception:
the function `read_chunk` decodes them."""

SKIPPED_RECORDS = frozenset(Opcode) - READ_RECORDS.keys() - {Opcode.CHUNK}
"""Opcodes of the MCAP records that the reader skips."""


def encoded(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())


class FileItem(NamedTuple):
    """A record, a chunk or a damaged place of a file."""

    record: McapRecord | None
    """The decoded record; None for a chunk and for a damaged place."""
    chunk: ReadChunk | None
    """The readable part of a complete or damaged chunk; None if this is not a chunk."""
    end: int
    """Offset in the file at which the record, chunk or damaged place ends, bytes. The next item
    begins at this offset."""
    damaged: bool = False
    """True for a damaged place. The incomplete end of a file that was cut off does not count as
    damaged."""

    @property
    def messages(self) -> list[Message]:
        return self.chunk.messages if self.chunk else []


def walk(data: bytes) -> Iterator[FileItem]:
    """Yield the records, chunks and damaged places of a file in order, up to the MCAP footer.

    A file without a footer is read to its end. If the work for damaged chunks exceeds `MAX_EFFORT`,
    the rest of the file counts as one damaged place. `data` is the content of the file.
    """
    at, stream, chunks = len(MAGIC), io.BytesIO(data), _Chunks(data)
    # If the first bytes of a finished file are damaged, its last bytes still identify it.
    if not (data.startswith(MAGIC) or data.endswith(MAGIC)):
        return
    while at + RECORD_HEAD.size <= len(data):
        opcode, length = RECORD_HEAD.unpack_from(data, at)
        claimed = at + RECORD_HEAD.size + length
        chunk = chunks.read(at)
        item = _decode_record(stream, at, opcode, claimed, len(data)) if chunk is None else None
        if chunk is not None and chunk.complete:
            item = FileItem(None, chunk, chunk.end)
        elif item is None and opcode in SKIPPED_RECORDS and claimed <= len(data):
            at = claimed
            continue
        if item is None:
            after = chunks.later(at + 1)
            if claimed < (after or len(data)):
                following = chunks.read(claimed)
                # If the next chunk is damaged as well, its first messages can still be read.
                if following is not None and following.messages:
                    after = claimed
            cut = after is None and not chunks.spent and (not opcode or claimed > len(data))
            end = len(data) if cut or chunks.spent else after or claimed
            item = FileItem(None, chunk, end, not cut)
        yield item
        if isinstance(item.record, Footer):
            return
        at = item.end


def _decode_record(
    stream: io.BytesIO, at: int, opcode: int, claimed: int, size: int
) -> FileItem | None:
    """Decode the record at the offset `at`, or return None if it is damaged or cut off.

    `claimed` is the offset at which the record ends according to its length field. `size` is the
    size of the file, bytes.
    """
    read = READ_RECORDS.get(opcode)
    if read is None:
        return None
    stream.seek(at + RECORD_HEAD.size)
    try:
        record = read(ReadDataStream(stream))
    except DAMAGE_ERRORS:
        return None
    end = stream.tell()
    if isinstance(record, Attachment) and not _is_intact(stream, at, end):
        return None
    return FileItem(record, None, end) if end < size or end == claimed else None


def _is_intact(stream: io.BytesIO, at: int, end: int) -> bool:
    """Return whether the checksum of an attachment is correct.

    An attachment with the checksum 0 has no checksum, so the result is True. `at` and `end` are the
    offsets at which the attachment begins and ends.
    """
    stream.seek(at)
    record = stream.read(end - at)
    crc = int.from_bytes(record[-4:], "little")
    return crc in (0, zlib.crc32(record[RECORD_HEAD.size : -4]))


class _Chunks:
    """Reads chunks, and finds the next complete chunk.

    The work for incomplete chunks is limited, because a forged file may contain thousands of them.
    """

    # In a hostile file thousands of incomplete chunks may share the same blocks, and each chunk
    # unpacks to megabytes. So the limit on the work is proportional to the file's size, and no part
    # of the file is searched twice.

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._effort = MAX_CHUNK_BYTES + MAX_EFFORT * len(data)
        """Work that may still be spent on incomplete chunks, in unpacked bytes."""
        self._searched = 0
        """Offset up to which the file was searched for complete chunks, bytes."""
        self._last_complete: int | None = None
        """Offset of the complete chunk that the last search found, bytes, or None."""

    @property
    def spent(self) -> bool:
        return self._effort < 0

    def read(self, begin: int) -> ReadChunk | None:
        chunk = read_chunk(self._data, begin)
        if chunk is not None and not (chunk.complete and chunk.messages):
            self._effort -= chunk.effort
        return chunk

    def later(self, begin: int) -> int | None:
        """Return the offset of the next complete chunk. `begin` must not decrease between calls."""
        if self._last_complete is not None and self._last_complete >= begin:
            return self._last_complete
        self._last_complete = None
        for at in chunk_places(self._data, max(begin, self._searched)):
            if self.spent:
                return None
            self._searched = at + 1
            chunk = self.read(at)
            if chunk is not None and chunk.complete and chunk.messages:
                self._last_complete = at
                return at
        self._searched = len(self._data)
        return None
