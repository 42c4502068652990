"""Encodes and decodes the attachment that rmw_zenoh_cpp adds to every sample and request.

It has a sequence number, a time and a GID, in 33 bytes. Both rmw_zenoh_cpp and acsard drop samples
and requests without it.
"""

from __future__ import annotations

from struct import Struct as Layout

from msgspec import Struct

from acsard.core.messages.encodings import DecodeError
from acsard.core.values import WallNs

GID_BYTES = 16
_LAYOUT = Layout(f"<qqB{GID_BYTES}s")


class Attachment(Struct, frozen=True):
    """Attachment of rmw_zenoh_cpp."""

    sequence: int  # from 1, for each publisher and each client
    stamp_ns: WallNs  # of sending
    gid: bytes  # of the publisher or client, 16 bytes

    def pack(self) -> bytes:
        return _LAYOUT.pack(self.sequence, self.stamp_ns, GID_BYTES, self.gid)


def unpack(data: bytes) -> Attachment:
    """Decode an attachment of rmw_zenoh_cpp. Raises `DecodeError`."""
    if not data:
        raise DecodeError(
            "no_attachment",
            "the message has no attachment, but rmw_zenoh adds one to every message",
        )
    if len(data) != _LAYOUT.size:
        raise DecodeError(
            "bad_attachment",
            f"the message has an attachment of {len(data)} bytes instead of {_LAYOUT.size}: "
            "is the sender's rmw_zenoh older than Jazzy 0.2.4?",
        )
    sequence, stamp_ns, length, gid = _LAYOUT.unpack(data)
    if length != GID_BYTES:
        raise DecodeError(
            "bad_attachment",
            f"the attachment has a GID of {length} bytes instead of {GID_BYTES}",
        )
    return Attachment(sequence, stamp_ns, gid)
