"""Reads the end record at the end of a finished recording: times, summary, cause of a cut.

A program that lists many recordings reads only this record of each file.
"""

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
from acsard.recording.mcap_records import DAMAGE_ERRORS, MAGIC, RECORD_HEAD

END_RECORD_NAME = "acsard end"  # of the metadata record

# Searched at the end of a file; the end record typically begins 1960 bytes before it.
TAIL_BYTES = 1 << 16

_NAMED = struct.pack("<I", len(END_RECORD_NAME)) + END_RECORD_NAME.encode()

_FOOTER = RECORD_HEAD.pack(Opcode.FOOTER, 20)

_DATA_END = RECORD_HEAD.pack(Opcode.DATA_END, 4)

Ns = Annotated[int, Meta(ge=-(1 << 63), le=(1 << 63) - 1)]  # fits in 64 bits

# Texts by cause. After `bug` the failing daemon still finishes its file; otherwise recovery does.
CUT_TEXTS = {
    "bug": "an internal error ended the daemon",
    "crash": "the daemon or the computer stopped suddenly",
    "disk": "the disk accepted no more data",
    "late": "the daemon was asked to end, and the disk was too slow to write the last steps",
    "open": "cut off, or still being recorded, when `acsard recording recover` read it",
}


class EndRecord(Struct, frozen=True):
    """The end record of a recording."""

    wall_ns: Ns  # wall-clock time at which it began
    last_ns: Ns  # latest of any message, by its first step
    said: str  # `timeline.summary`
    cut: str = ""  # key of `CUT_TEXTS`; "" if the daemon ended normally
    why: str = ""  # of `bug`: the exception, and the number of a failed step
    earliest_ns: Ns | None = None  # before `wall_ns` if the clock was set back
    serious: bool = False  # `timeline.is_serious`


CRASH_CUTS = frozenset({"bug", "crash"})  # a failure of the daemon or of its computer


def ending_text(cut: str, why: str = "") -> str:
    """Return how a recording was cut off, or "" for an ordinary end.

    A cause of another version is only "cut off" and `why`.
    """
    if not cut:
        return ""
    words = CUT_TEXTS.get(cut, "cut off")
    return f"{words}: {printable(why)}" if why else words


def as_metadata(last: EndRecord) -> dict[str, str]:
    fields = msgspec.to_builtins(last).items()
    return {key: str(value) for key, value in fields if value is not None}


def read_end(path: Path) -> EndRecord | None:
    """Return the end record of a file, or None; this reads only its first and last bytes."""
    # A forged file may claim lengths of gigabytes, so neither follow the index nor unpack chunks.
    try:
        with path.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                return None
            stream.seek(max(len(MAGIC), stream.seek(0, os.SEEK_END) - TAIL_BYTES))
            tail = stream.read(TAIL_BYTES)
    except OSError:
        # A caller that reads the whole file reports the error.
        return None
    return end_in(tail)


def end_in(data: bytes) -> EndRecord | None:
    """Return the end record in the last bytes of a file, or None."""
    try:
        metadata = _metadata_in(data[-TAIL_BYTES:])
        return msgspec.convert(metadata, EndRecord, strict=False) if metadata else None
    except DAMAGE_ERRORS:
        # A caller that reads the whole file reports the damage.
        return None


def _metadata_in(tail: bytes) -> dict[str, str] | None:
    # None: the file is not finished.
    footer_at = len(tail) - len(MAGIC) - 20 - RECORD_HEAD.size
    if footer_at < 0 or not (tail.startswith(_FOOTER, footer_at) and tail.endswith(MAGIC)):
        return None
    at = tail.rfind(_NAMED, RECORD_HEAD.size, footer_at)
    while at >= 0:
        begin = at - RECORD_HEAD.size
        opcode, length = RECORD_HEAD.unpack_from(tail, begin)
        if opcode == Opcode.METADATA and tail.startswith(_DATA_END, at + length):
            record: Metadata = Metadata.read(ReadDataStream(io.BytesIO(tail[at : at + length])))
            return record.metadata
        at = tail.rfind(_NAMED, RECORD_HEAD.size, at)
    return None
