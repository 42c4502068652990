"""Writes MCAP chunks in small pieces, and reads the MCAP records of files that may be damaged.

A power cut destroys a chunk that is written when it is complete, as its header has its length. So
the recorder first writes a header with a length that no file has, once a second appends a zstd
block of messages, and at the end replaces the header. The reader needs neither length nor checksum:
a zstd block has its own length, and a message a checksum as its sequence number. After damage it
searches for the next complete chunk.
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

from acsard.core.values import Ns, WallNs

# Parameters for chunks of 256 KiB, with which the compressor needs 3 MB.
ZSTD_PARAMETERS = ZstdCompressionParameters.from_level(
    9, source_size=1 << 18, write_content_size=False
)

LAST_BLOCK = b"\x01\0\0"  # empty last zstd block, which completes a chunk that was cut off

MAX_CHUNK_BYTES = 1 << 23  # uncompressed, read at most; recorders write 1 MiB plus one message

MAX_MESSAGE_BYTES = 1 << 22  # read at most; one second of steps and 20 commands has 16 000

# Chunk header: opcode, length, first and last time, uncompressed size and CRC-32, length and name
# of the compression, compressed size.
_HEAD = struct.Struct("<BQQQQII4sQ")

_AFTER_LENGTH = _HEAD.size - 9  # counted in the record's length

_NAME_AT = 37  # offset of `ZSTD_NAME_FIELD` in a chunk's header

ZSTD_NAME_FIELD = struct.pack("<I4s", 4, b"zstd")  # length and name of the compression

_ENDLESS = (1 << 63) - 1  # lengths in the header of a growing chunk

# Message header: opcode, length, channel, sequence number (here a checksum), log time, publish
# time.
_MESSAGE = struct.Struct("<BQHIQQ")

MAX_DATA_BYTES = MAX_MESSAGE_BYTES - _MESSAGE.size

_CHECKED = struct.Struct("<HQ")  # channel and time, which the checksum covers too

_BESIDE_DATA = _MESSAGE.size - 9  # counted in the record's length

_LONGEST_FRAME_HEAD = 18  # of a zstd frame

_BLOCK_BYTES = 1 << 17  # of a zstd block

_BLOCK_EFFORT = 1 << 10  # bytes of work for each zstd block: even an empty one takes as long

_REPEATED = 1  # type of a zstd block that repeats one byte


class Message(NamedTuple):
    channel: int  # number of the MCAP channel
    wall_ns: WallNs  # at least 0
    data: bytes


def _crc(message: Message) -> int:
    return zlib.crc32(message.data, zlib.crc32(_CHECKED.pack(message.channel, message.wall_ns)))


def _head(first_ns: Ns, last_ns: Ns, size: int, crc: int, length: int) -> bytes:
    whole = length if length == _ENDLESS else length + _AFTER_LENGTH
    return _HEAD.pack(Opcode.CHUNK, whole, first_ns, last_ns, size, crc, 4, b"zstd", length)


GROWING_HEAD = _head(0, 0, 0, 0, _ENDLESS)


class GrowingChunk:
    """A chunk that is being written: it compresses messages to bytes that the caller writes."""

    def __init__(self) -> None:
        self._compressor = zstandard.ZstdCompressor(
            compression_params=ZSTD_PARAMETERS
        ).compressobj()
        self.size = 0  # uncompressed
        self._crc = self._length = 0
        self.first_ns, self._last_ns = _ENDLESS, 0  # of the messages so far
        self._out: list[bytes] = []

    @property
    def has_unwritten(self) -> bool:
        """Whether a message was added since the last `take`."""
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
        """Return the compressed messages since the last call."""
        self._out.append(self._compressor.flush(COMPRESSOBJ_FLUSH_BLOCK))
        return self._take_output()

    def end(self) -> tuple[bytes, bytes]:
        """End the chunk; return its last bytes, and the header that replaces the first one."""
        self._out.append(self._compressor.flush())
        last = self._take_output()
        return last, _head(self.first_ns, self._last_ns, self.size, self._crc, self._length)

    def _take_output(self) -> bytes:
        out = b"".join(self._out)
        self._out.clear()
        self._length += len(out)
        return out


class ReadChunk(NamedTuple):
    begin: int  # offset of its header
    end: int  # offset of the end of its last block that ends with a complete message
    messages: list[Message]
    complete: bool  # with the last zstd block
    effort: int = 0  # unpacked bytes, plus `_BLOCK_EFFORT` for each block

    def head(self, data: bytes) -> bytes:
        """Return a header for the readable part; `LAST_BLOCK` completes one that is cut."""
        times = [message.wall_ns for message in self.messages]
        blocks = _blocks(data[: self.end], self.begin + _HEAD.size)
        out = b"".join([out for _, out, _ in blocks])
        length = self.end - self.begin - _HEAD.size
        if not self.complete:
            length += len(LAST_BLOCK)
        return _head(min(times), max(times), len(out), zlib.crc32(out), length)


def chunk_places(data: bytes, begin: int) -> Iterator[int]:
    """Yield the offsets in a file, from `begin` on, at which a chunk's header may begin."""
    at = data.find(ZSTD_NAME_FIELD, begin + _NAME_AT)
    while at >= 0:
        yield at - _NAME_AT
        at = data.find(ZSTD_NAME_FIELD, at + 1)


def read_chunk(data: bytes, begin: int) -> ReadChunk | None:
    """Read the chunk at this offset of a file as far as possible, or return None."""
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
        # The next blocks refer to a damaged one, so they cannot be read either.
        effort += _BLOCK_BYTES
    return whole._replace(effort=effort)


def _blocks(data: bytes, at: int) -> Iterator[tuple[int, bytes, bool]]:
    # End offset, data, and whether it is the last. Raises `ZstdError`.
    begin = at + zstandard.frame_header_size(data[at : at + _LONGEST_FRAME_HEAD])
    unpacker = zstandard.ZstdDecompressor(max_window_size=1 << ZSTD_PARAMETERS.window_log)
    stream = unpacker.decompressobj()
    stream.decompress(data[at:begin])
    last = False
    while not last and begin + 3 <= len(data):
        block = int.from_bytes(data[begin : begin + 3], "little")
        last, kind, size = bool(block & 1), block >> 1 & 3, block >> 3
        end = begin + 3 + (1 if kind == _REPEATED else size)
        # After a power cut, a file may end with zeros, which would be endless empty blocks.
        if not block or size > _BLOCK_BYTES or end > len(data):
            return
        yield end, stream.decompress(data[begin:end]), last
        begin = end


def _messages(data: bytearray) -> tuple[list[Message], int, int]:
    # The messages, their size, and that of the next one: of its header if that is incomplete, and
    # above `MAX_MESSAGE_BYTES` if it is damaged.
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


# Raised by the decoders for damaged bytes.
DAMAGE_ERRORS = (
    McapError, msgspec.MsgspecError, zstandard.ZstdError, struct.error,
    ValueError, OverflowError, EOFError, MemoryError,
)  # fmt: skip

MAGIC = b"\x89MCAP0\r\n"

# Unpacked bytes of damaged chunks for each byte of the file, plus `MAX_CHUNK_BYTES`. Recordings
# have 5 to 13; damaged chunks are read up to three times, and a damaged block counts as 128 KiB.
MAX_EFFORT = 256

RECORD_HEAD = struct.Struct("<BQ")  # opcode, and bytes that follow

# Decoders by opcode; `read_chunk` decodes chunks.
READ_RECORDS: dict[int, Callable[[ReadDataStream], McapRecord]] = {
    Opcode.ATTACHMENT: Attachment.read,
    Opcode.DATA_END: DataEnd.read,
    Opcode.FOOTER: Footer.read,
    Opcode.HEADER: Header.read,
    Opcode.METADATA: Metadata.read,
}

SKIPPED_RECORDS = frozenset(Opcode) - READ_RECORDS.keys() - {Opcode.CHUNK}


def encoded(*records: McapRecord) -> bytes:
    builder = RecordBuilder()
    for record in records:
        record.write(builder)
    return bytes(builder.end())


class FileItem(NamedTuple):
    """A record, a chunk or a damaged place of a file."""

    record: McapRecord | None
    chunk: ReadChunk | None
    end: int  # offset of the next item
    damaged: bool = False  # not the incomplete end of a file that was cut off

    @property
    def messages(self) -> list[Message]:
        return self.chunk.messages if self.chunk else []


def walk(data: bytes) -> Iterator[FileItem]:
    """Yield the items of a file in order, up to the MCAP footer or its end.

    Beyond `MAX_EFFORT` for damaged chunks, the rest is one damaged place.
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
    # `claimed` is its end by its length field.
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
    # A checksum of 0 is none.
    stream.seek(at)
    record = stream.read(end - at)
    crc = int.from_bytes(record[-4:], "little")
    return crc in (0, zlib.crc32(record[RECORD_HEAD.size : -4]))


class _Chunks:
    # In a forged file thousands of incomplete chunks may share the same blocks, each of megabytes.
    # So the work is proportional to the file's size, and no part is searched twice.

    def __init__(self, data: bytes) -> None:
        self._data = data
        self._effort = MAX_CHUNK_BYTES + MAX_EFFORT * len(data)  # left for incomplete chunks
        self._searched = 0  # up to this offset
        self._last_complete: int | None = None  # found by the last search

    @property
    def spent(self) -> bool:
        return self._effort < 0

    def read(self, begin: int) -> ReadChunk | None:
        chunk = read_chunk(self._data, begin)
        if chunk is not None and not (chunk.complete and chunk.messages):
            self._effort -= chunk.effort
        return chunk

    def later(self, begin: int) -> int | None:
        """Return the offset of the next complete chunk; `begin` must not decrease."""
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
