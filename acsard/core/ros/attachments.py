"""Encodes and decodes the attachment of rmw_zenoh_cpp: sequence number, time and GID in 33 bytes.

rmw_zenoh_cpp adds this attachment to every sample and request. Both rmw_zenoh_cpp and acsard drop
samples and requests without it.
"""

from __future__ import annotations

from struct import Struct as Layout

from msgspec import Struct

from acsard.core.messages.encodings import DecodeError

GID_BYTES = 16
_LAYOUT = Layout(f"<qqB{GID_BYTES}s")


class Attachment(Struct, frozen=True):
    """Attachment of a sample or a request."""

    sequence: int
    """Number of the sample or request. Each publisher and each client counts its own samples or
    requests from 1."""
    stamp_ns: int
    """Time of sending by the wall clock, ns since 1970."""
    gid: bytes
    """The 16 bytes that identify the publisher or client."""

    def pack(self) -> bytes:
        return _LAYOUT.pack(self.sequence, self.stamp_ns, GID_BYTES, self.gid)


def unpack(data: bytes) -> Attachment:
    """Decode an attachment. Raises `DecodeError` if `data` is empty or not a valid attachment."""
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
