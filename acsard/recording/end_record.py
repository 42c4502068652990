"""The metadata record at the end of a recording: its times, its summary and how it was cut off."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Annotated

import msgspec
import zstandard
from mcap.exceptions import McapError
from mcap.reader import make_reader
from msgspec import Meta, Struct

from acsard.core.formatting import printable

END = "acsard end"
"""Name of the MCAP metadata record that holds the `EndRecord`."""

DAMAGE = (
    McapError, msgspec.MsgspecError, zstandard.ZstdError, struct.error,
    ValueError, OverflowError, EOFError, MemoryError,
)  # fmt: skip
"""Exceptions that the MCAP library raises for bytes that are not valid MCAP."""

Ns = Annotated[int, Meta(ge=-(1 << 63), le=(1 << 63) - 1)]
"""Time in ns since 1970 that fits in a signed 64-bit integer."""

CUTS = {
    "bug": "cut: the daemon ended by a fault of its own",
    "crash": "cut: the daemon or the computer ended without a word",
    "disk": "cut: the disk took no more",
    "late": "cut: the daemon was told to end, and the disk was too slow for the rest",
    "open": "cut, or still being written, when it was recovered",
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
    """Read the closing of a file. Return None if it has no closing or cannot be read."""
    try:
        with path.open("rb") as stream:
            for metadata in make_reader(stream).iter_metadata():
                if metadata.name == END:
                    return msgspec.convert(metadata.metadata, EndRecord, strict=False)
    except (OSError, *DAMAGE):
        # A caller that reads the whole file reports the damage.
        pass
    return None
