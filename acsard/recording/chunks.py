"""One MCAP chunk of a recording: compressed second by second, and read as far as it is whole.

An MCAP chunk has its length and its checksum in its head, so it is usually written when it is
complete. A power cut would then cost all that the chunk holds. A recording writes its chunk as it
grows: first a head with a length that no file has, then once a second a zstd block with the new
messages, and over the first head the true one when the chunk is complete.

The reader does not need the head. The blocks of zstd say where they end, and each message has a
checksum of itself as its sequence number, so the seconds before a cut or a damaged place are read.
"""

from __future__ import annotations

import struct
import zlib
from collections.abc import Iterator
from typing import NamedTuple

import zstandard
from mcap.opcode import Opcode
from zstandard import COMPRESSOBJ_FLUSH_BLOCK, ZstdCompressionParameters

LEVEL = 9
"""Level of zstd. Rows of ten seconds take 13 to 16 % less than with level 3, and 2 to 8 ms."""

PARAMETERS = ZstdCompressionParameters.from_level(
    LEVEL, source_size=1 << 18, write_content_size=False
)
"""Parameters for a chunk of 256 KiB, with which the compressor takes 3 MB of memory."""

LAST_BLOCK = b"\x01\0\0"
"""The empty zstd block that ends a chunk which was cut behind a whole block."""

MOST_BYTES = 1 << 23
"""Largest uncompressed size of a chunk that is read. A written one has 1 MiB and a message."""

MOST_IN_MESSAGE = 1 << 22
"""Largest size of a message that is read, in bytes. A second with 20 commands has 16 000."""

_HEAD = struct.Struct("<BQQQQII4sQ")
"""Head of a chunk's record: opcode, length, first and last time, uncompressed size, its CRC-32,
length and name of the compression, compressed size.
"""

_AFTER_LENGTH = _HEAD.size - 9
"""Number of bytes of the head that the record's length counts."""

_NAME_AT = 37
"""Offset in the head of the length of the compression's name."""

ZSTD = struct.pack("<I4s", 4, b"zstd")
"""The compression's name with its length, as every chunk has it."""

_ENDLESS = (1 << 63) - 1
"""Length in the head of a chunk that still grows."""

_MESSAGE = struct.Struct("<BQHIQQ")
"""Head of a message's record: opcode, length, channel, sequence, and the time twice."""

MOST_DATA = MOST_IN_MESSAGE - _MESSAGE.size
"""Largest size of the data of a message that is read, in bytes."""

_CHECKED = struct.Struct("<HQ")

_BESIDE_DATA = _MESSAGE.size - 9
"""Number of bytes of a message's head that the record's length counts."""

_LONGEST_FRAME_HEAD = 18

_BLOCK_BYTES = 1 << 17
"""Largest size of a zstd block, compressed and uncompressed."""

_BLOCK_EFFORT = 1 << 10
"""Effort of unpacking a block of no bytes: it takes about as long as 1 KiB of a large one."""

_REPEATED = 1
"""Kind of a zstd block that is one byte, repeated."""


class Message(NamedTuple):
    """A message of a chunk. `wall_ns` is its wall-clock time in ns since 1970, at least 0."""

    channel: int
    wall_ns: int
    data: bytes


def _crc(message: Message) -> int:
    return zlib.crc32(message.data, zlib.crc32(_CHECKED.pack(message.channel, message.wall_ns)))


def _head(first_ns: int, last_ns: int, size: int, crc: int, length: int) -> bytes:
    whole = length if length == _ENDLESS else length + _AFTER_LENGTH
    return _HEAD.pack(Opcode.CHUNK, whole, first_ns, last_ns, size, crc, 4, b"zstd", length)


GROWING = _head(0, 0, 0, 0, _ENDLESS)
"""Head of a chunk that still grows."""


class Growing:
    """A chunk that is being written: messages come in, compressed bytes go out."""

    def __init__(self) -> None:
        self._compressor = zstandard.ZstdCompressor(compression_params=PARAMETERS).compressobj()
        self.size = 0
        """Uncompressed size of the messages so far, in bytes."""
        self._crc = self._length = 0
        self.first_ns, self._last_ns = _ENDLESS, 0
        """Earliest and latest time of a message, ns since 1970."""
        self._out: list[bytes] = []

    @property
    def waits(self) -> bool:
        """True if a message was added since `take`."""
        return bool(self._out)

    def add(self, message: Message) -> None:
        """Add a message."""
        channel, wall_ns, data = message
        length = _BESIDE_DATA + len(data)
        head = _MESSAGE.pack(Opcode.MESSAGE, length, channel, _crc(message), wall_ns, wall_ns)
        self.first_ns = min(self.first_ns, wall_ns)
        self._last_ns = max(self._last_ns, wall_ns)
        self.size += len(head) + len(data)
        self._crc = zlib.crc32(data, zlib.crc32(head, self._crc))
        self._out += [self._compressor.compress(head), self._compressor.compress(data)]

    def take(self) -> bytes:
        """Return the compressed bytes since the last call. All messages so far can be read."""
        self._out.append(self._compressor.flush(COMPRESSOBJ_FLUSH_BLOCK))
        return self._taken()

    def end(self) -> tuple[bytes, bytes]:
        """Return the last compressed bytes, and the head that belongs before all of them."""
        self._out.append(self._compressor.flush())
        last = self._taken()
        return last, _head(self.first_ns, self._last_ns, self.size, self._crc, self._length)

    def _taken(self) -> bytes:
        out = b"".join(self._out)
        self._out.clear()
        self._length += len(out)
        return out


class Content(NamedTuple):
    """A chunk as far as it can be read."""

    begin: int
    """Offset of its head in the file."""
    end: int
    """Offset behind the last block of which every message is whole."""
    messages: list[Message]
    complete: bool
    """True if the chunk is read to its end."""
    effort: int = 0
    """Number of bytes that were unpacked to read it, with an allowance for each block."""

    def head(self, data: bytes) -> bytes:
        """Return the head of a chunk that consists of this content.

        If the content is not complete, `LAST_BLOCK` belongs behind it.
        """
        times = [message.wall_ns for message in self.messages]
        blocks = _blocks(data[: self.end], self.begin + _HEAD.size)
        out = b"".join([out for _, out, _ in blocks])
        length = self.end - self.begin - _HEAD.size
        if not self.complete:
            length += len(LAST_BLOCK)
        return _head(min(times), max(times), len(out), zlib.crc32(out), length)


def places(data: bytes, begin: int) -> Iterator[int]:
    """Yield the offsets from `begin` on at which a chunk may begin."""
    at = data.find(ZSTD, begin + _NAME_AT)
    while at >= 0:
        yield at - _NAME_AT
        at = data.find(ZSTD, at + 1)


def content(data: bytes, begin: int) -> Content | None:
    """Read the chunk whose head begins at that offset; return None if there is none."""
    at = begin + _HEAD.size
    named = data.startswith(ZSTD, begin + _NAME_AT)
    if at > len(data) or not (named or data[begin] == Opcode.CHUNK):
        return None
    messages: list[Message] = []
    whole = Content(begin, at, messages, False)
    rest, size, effort, wanted = bytearray(), 0, 0, _MESSAGE.size
    # Messages of which the last one ends in a block to come.
    waiting: list[Message] = []
    try:
        for end, out, last in _blocks(data, at):
            rest += out
            size += len(out)
            effort += len(out) + _BLOCK_EFFORT
            if size > MOST_BYTES:
                break
            if rest and len(rest) < wanted:
                continue
            found, used, wanted = _messages(rest)
            if wanted > MOST_IN_MESSAGE:
                break
            waiting += found
            del rest[:used]
            if not rest:
                messages += waiting
                waiting.clear()
                whole = Content(begin, end, messages, last)
    except zstandard.ZstdError:
        # A damaged block, and with it all that was compressed after it.
        effort += _BLOCK_BYTES
    return whole._replace(effort=effort)


def _blocks(data: bytes, at: int) -> Iterator[tuple[int, bytes, bool]]:
    """Yield each zstd block: the offset of its end, its uncompressed bytes, whether it is the last.

    Raises `ZstdError` for a damaged block.
    """
    begin = at + zstandard.frame_header_size(data[at : at + _LONGEST_FRAME_HEAD])
    unpacker = zstandard.ZstdDecompressor(max_window_size=1 << PARAMETERS.window_log)
    stream = unpacker.decompressobj()
    stream.decompress(data[at:begin])
    last = False
    while not last and begin + 3 <= len(data):
        block = int.from_bytes(data[begin : begin + 3], "little")
        last, kind, size = bool(block & 1), block >> 1 & 3, block >> 3
        end = begin + 3 + (1 if kind == _REPEATED else size)
        # The zeros behind a torn place of a disk are empty blocks without end.
        if not block or size > _BLOCK_BYTES or end > len(data):
            return
        yield end, stream.decompress(data[begin:end]), last
        begin = end


def _messages(data: bytearray) -> tuple[list[Message], int, int]:
    """Return the messages at the beginning of the data, and the number of bytes that they take.

    The last number is that of the bytes which the next message needs. It is above
    `MOST_IN_MESSAGE` if that message is not what was written.
    """
    found: list[Message] = []
    at = 0
    while at + _MESSAGE.size <= len(data):
        opcode, length, channel, crc, wall_ns, _ = _MESSAGE.unpack_from(data, at)
        wanted = _MESSAGE.size - _BESIDE_DATA + length
        if opcode != Opcode.MESSAGE or length < _BESIDE_DATA:
            return found, at, MOST_IN_MESSAGE + 1
        if at + wanted > len(data):
            return found, at, wanted
        message = Message(channel, wall_ns, bytes(data[at + _MESSAGE.size : at + wanted]))
        if _crc(message) != crc:
            return found, at, MOST_IN_MESSAGE + 1
        found.append(message)
        at += wanted
    return found, at, _MESSAGE.size
