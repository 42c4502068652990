"""Reads the end record: the metadata record at the end of a finished recording.

The end record holds the times, a summary, and the cause if the recording was cut off. A program
that lists many recordings reads only this record of each file.
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

END_RECORD_NAME = "acsard end"
"""Name of the MCAP metadata record that holds the `EndRecord`."""

TAIL_BYTES = 1 << 16
"""Number of bytes at the end of a file in which `read_end` searches for the end record. The end
record typically begins 1960 bytes before the end of the file."""

_NAMED = struct.pack("<I", len(END_RECORD_NAME)) + END_RECORD_NAME.encode()
"""Bytes that follow the MCAP header of the end record: the length of the record's name, and the
name."""

_FOOTER = RECORD_HEAD.pack(Opcode.FOOTER, 20)
"""Header of the MCAP footer record, whose content has 20 bytes."""

_DATA_END = RECORD_HEAD.pack(Opcode.DATA_END, 4)
"""Header of the MCAP record `DataEnd`, which directly follows the end record."""

Ns = Annotated[int, Meta(ge=-(1 << 63), le=(1 << 63) - 1)]
"""Time in ns that fits in a signed 64-bit integer."""

CUT_TEXTS = {
    "bug": "cut: an internal error ended the daemon",
    "crash": "cut: the daemon or the computer stopped suddenly",
    "disk": "cut: the disk accepted no more data",
    "late": "cut: the daemon was asked to end, and the disk was too slow to write the last steps",
    "open": "cut off, or still being recorded, when `acsard recording recover` read it",
}
"""Description of each cause that cuts off a recording, by cause. After the cause `bug`, the failing
daemon still finishes its file. After any other cause, the file has no end record until it is
recovered."""


class EndRecord(Struct, frozen=True):
    """Content of the end record of a recording: times, summary, and the cause if it was cut off."""

    wall_ns: Ns
    """Wall-clock time at which the recording began, ns since 1970."""
    last_ns: Ns
    """Latest wall-clock time of any message, ns since 1970. The time of a message with several
    steps is the time of the first of these steps."""
    said: str
    """Summary of the events in a few words, from `timeline.summary`."""
    cut: str = ""
    """Cause that cut off the recording, a key of `CUT_TEXTS`; "" if the daemon ended normally."""
    why: str = ""
    """Text about the internal error that ended the daemon: the exception, and the number of the
    control step if a step failed. It is "" if `cut` is not "bug"."""
    earliest_ns: Ns | None = None
    """Earliest wall-clock time of any message, ns since 1970; None if the file does not contain
    this time. It is earlier than `wall_ns` if the clock was set back during the recording."""


CRASH_CUTS = frozenset({"bug", "crash"})
"""The keys of `CUT_TEXTS` that stand for a failure of the daemon or of its computer."""


def ending_text(cut: str, why: str = "") -> str:
    """Return a text that says how a recording was cut off; "" if the daemon ended normally.

    If another version of acsard recorded a cause that is not in `CUT_TEXTS`, the text contains only
    the word "cut" and `why`.

    Args:
        cut: the field `EndRecord.cut`; "" if the daemon ended normally.
        why: the field `EndRecord.why`.
    """
    if not cut:
        return ""
    words = CUT_TEXTS.get(cut, "cut")
    return f"{words}: {printable(why)}" if why else words


def as_metadata(last: EndRecord) -> dict[str, str]:
    """Return the end record `last` as MCAP metadata, which maps strings to strings."""
    fields = msgspec.to_builtins(last).items()
    return {key: str(value) for key, value in fields if value is not None}


def read_end(path: Path) -> EndRecord | None:
    """Read the end record of a recording file.

    Return None if the file cannot be read, or if no undamaged end record is found. The function is
    quick: it reads only the first bytes and the last `TAIL_BYTES` of the file.
    """
    # Do not follow the MCAP index or unpack chunks, because a forged file may claim lengths of
    # gigabytes.
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
    """Return the end record that is in `data`, the last bytes of a file.

    Return None if these bytes contain no valid end record.
    """
    try:
        metadata = _metadata_in(data[-TAIL_BYTES:])
        return msgspec.convert(metadata, EndRecord, strict=False) if metadata else None
    except DAMAGE_ERRORS:
        # A caller that reads the whole file reports the damage.
        return None


def _metadata_in(tail: bytes) -> dict[str, str] | None:
    """Return the metadata of the end record, or None if the file is not finished.

    `tail` contains the last bytes of the file.
    """
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
