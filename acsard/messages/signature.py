"""Who sent a command: the attachment that our client puts on it, and any other may.

A map, JSON or msgpack: `{"sender": "joystick-7", "stamp": 1795154884365624370, "sequence": 12}`.
An attachment that is none of these is somebody else's and says nothing to us.
"""

from __future__ import annotations

from typing import Annotated

import msgspec
from msgspec import Meta, Struct

MOST = (1 << 63) - 1


class Signature(Struct, frozen=True):
    """`sender` is one program's alone; `stamp` its wall clock in ns; `sequence` grows by 1."""

    sender: Annotated[str, Meta(min_length=1, max_length=64)]
    stamp: Annotated[int, Meta(gt=0, le=MOST)] | None = None
    sequence: Annotated[int, Meta(ge=0, le=MOST)] | None = None

    def pack(self) -> bytes:
        """As our client sends it."""
        return msgspec.msgpack.encode(self)


_json = msgspec.json.Decoder(Signature)
_msgpack = msgspec.msgpack.Decoder(Signature)


def unpack(attachment: bytes) -> Signature | None:
    """The signature in an attachment; None when it has none."""
    if not attachment:
        return None
    try:
        return (_json if attachment[:1] == b"{" else _msgpack).decode(attachment)
    except (msgspec.DecodeError, UnicodeDecodeError):
        return None
