"""What a recording says of itself at its end, and what there is to say of one that was cut."""

from __future__ import annotations

import struct
from pathlib import Path
from typing import Annotated

import msgspec
import zstandard
from mcap.exceptions import McapError
from mcap.reader import make_reader
from msgspec import Meta, Struct

from acsard.messages.text import printable

END = "acsard end"
"""The metadata that is the closing."""

DAMAGE = (
    McapError, msgspec.MsgspecError, zstandard.ZstdError, struct.error,
    ValueError, OverflowError, EOFError, MemoryError,
)  # fmt: skip
"""All that the library raises for bytes that are no MCAP."""

Ns = Annotated[int, Meta(ge=-(1 << 63), le=(1 << 63) - 1)]
"""A time that calendars have."""

CUTS = {
    "bug": "cut: the daemon ended by a fault of its own",
    "crash": "cut: the daemon or the computer ended without a word",
    "disk": "cut: the disk took no more",
    "late": "cut: the daemon was told to end, and the disk was too slow for the rest",
    "open": "cut, or still being written, when it was recovered",
}
"""Why a file does not end as the daemon was told to: all but the first were finished later."""


class Closing(Struct, frozen=True):
    """What a finished file says of itself at its end, so that a list need not read all of it."""

    wall_ns: Ns
    """When it began."""
    last_ns: Ns
    """When its last message begins."""
    said: str
    """What happened, in a few words."""
    cut: str = ""
    """A word of `CUTS`; "" where the daemon ended as it was told to."""
    why: str = ""
    """Of a fault of its own: in which step, and what it says."""


def how_it_ends(cut: str, why: str = "") -> str:
    """In words; "" where there is nothing to say. A word of a later version is only a cut."""
    if not cut:
        return ""
    words = CUTS.get(cut, "cut")
    return f"{words}: {printable(why)}" if why else words


def fields(last: Closing) -> dict[str, str]:
    """As metadata have it."""
    return {key: str(value) for key, value in msgspec.to_builtins(last).items()}


def closing(path: Path) -> Closing | None:
    """What the file says of itself at its end; None where it has none, or it cannot be read."""
    try:
        with path.open("rb") as stream:
            for metadata in make_reader(stream).iter_metadata():
                if metadata.name == END:
                    return msgspec.convert(metadata.metadata, Closing, strict=False)
    except (OSError, *DAMAGE):
        pass  # who reads all of it will say what is wrong
    return None
