"""The metadata record at the end of a recording: its times, its summary and how it was cut off."""

from __future__ import annotations

import io
import os
import struct
from pathlib import Path
from typing import Annotated

import msgspec
from mcap.data_stream import ReadDataStream
from mcap.opcode import Opcode
from mcap.records import Metadata
from msgspec import Meta, Struct

from acsard.core.formatting import printable
from acsard.recording.mcap_records import DAMAGE, HEAD, MAGIC

END = "acsard end"
"""Name of the MCAP metadata record that holds the `EndRecord`."""

TAIL_BYTES = 1 << 16
"""Number of bytes at the end of a file in which its end record is searched for. The recordings
of the tests have 1141 bytes from the record to the end of the file, and long names take some more.
"""

_NAMED = struct.pack("<I", len(END)) + END.encode()
"""Name of the record with its length, as it follows the record's head."""

_FOOTER = HEAD.pack(Opcode.FOOTER, 20)
"""Head of the MCAP footer, which has 20 bytes."""

_DATA_END = HEAD.pack(Opcode.DATA_END, 4)
"""Head of the record that follows the end record."""

Ns = Annotated[int, Meta(ge=-(1 << 63), le=(1 << 63) - 1)]
"""Time in ns since 1970 that fits in a signed 64-bit integer."""

CUTS = {
    "bug": "cut: an internal error ended the daemon",
    "crash": "cut: the daemon or the computer ended without notice",
    "disk": "cut: the disk accepted no more data",
    "late": "cut: the daemon was asked to end, and the disk was too slow for the rest",
    "open": "cut, or still being recorded, when it was recovered",
}
"""Causes for a file that does not end with the daemon's ordinary end, each with its words.

The daemon itself writes only the end of a `bug`; a file with another cause is finished later.
"""


class EndRecord(Struct, frozen=True):
    """Content of the last metadata record, so that a list need not read the whole file."""

    wall_ns: Ns
    """Wall-clock time at which the recording began, ns since 1970."""
    last_ns: Ns
    """Wall-clock time of the last message, ns since 1970. For steps it is that of the first one."""
    said: str
    """Summary of the events in a few words, as from `story.summary`."""
    cut: str = ""
    """Key of `CUTS`, or "" if the daemon ended in the ordinary way."""
    why: str = ""
    """For the cause `bug`: the step in which the daemon failed, and the exception."""


def how_it_ends(cut: str, why: str = "") -> str:
    """Describe how the recording ends; "" if it ended in the ordinary way.

    A key that only a later version knows is described as "cut".
    """
    if not cut:
        return ""
    words = CUTS.get(cut, "cut")
    return f"{words}: {printable(why)}" if why else words


def fields(last: EndRecord) -> dict[str, str]:
    """Return the closing as MCAP metadata, which holds strings only."""
    return {key: str(value) for key, value in msgspec.to_builtins(last).items()}


def closing(path: Path) -> EndRecord | None:
    """Read the closing of a file. Return None if it has no closing or cannot be read.

    Only the last `TAIL_BYTES` are read. The index of the file is not followed, and no chunk is
    unpacked, because a file from a stranger may claim gigabytes.
    """
    try:
        with path.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                return None
            stream.seek(max(len(MAGIC), stream.seek(0, os.SEEK_END) - TAIL_BYTES))
            found = _last(stream.read(TAIL_BYTES))
            return msgspec.convert(found, EndRecord, strict=False) if found else None
    except (OSError, *DAMAGE):
        # A caller that reads the whole file reports the damage.
        return None


def _last(tail: bytes) -> dict[str, str] | None:
    """Return the content of the last end record in the last bytes of a file that is finished."""
    footer_at = len(tail) - len(MAGIC) - 20 - HEAD.size
    if footer_at < 0 or not (tail.startswith(_FOOTER, footer_at) and tail.endswith(MAGIC)):
        return None
    at = tail.rfind(_NAMED, HEAD.size, footer_at)
    while at >= 0:
        begin = at - HEAD.size
        opcode, length = HEAD.unpack_from(tail, begin)
        if opcode == Opcode.METADATA and tail.startswith(_DATA_END, at + length):
            record: Metadata = Metadata.read(ReadDataStream(io.BytesIO(tail[at : at + length])))
            return record.metadata
        at = tail.rfind(_NAMED, HEAD.size, at)
    return None
