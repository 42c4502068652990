"""The 33 bytes that go with every sample of rmw_zenoh_cpp: sequence, time and GID.

A sample or request without them is dropped by its receiver, there and here.
"""

from __future__ import annotations

from struct import Struct as Layout

from msgspec import Struct

from acsard.messages.encodings import DecodeError

GID_BYTES = 16
_LAYOUT = Layout(f"<qqB{GID_BYTES}s")


class Attachment(Struct, frozen=True):
    """`sequence` counts from 1 per publisher or client; `stamp_ns` is its wall clock."""

    sequence: int
    stamp_ns: int
    gid: bytes

    def pack(self) -> bytes:
        """As it goes over the wire."""
        return _LAYOUT.pack(self.sequence, self.stamp_ns, GID_BYTES, self.gid)


def unpack(data: bytes) -> Attachment:
    """The attachment in `data`; raises `DecodeError`."""
    if not data:
        raise DecodeError("no_attachment", "has no attachment, as rmw_zenoh gives every sample one")
    if len(data) != _LAYOUT.size:
        raise DecodeError(
            "bad_attachment",
            f"an attachment of {len(data)} bytes instead of {_LAYOUT.size}: "
            "is the sender's rmw_zenoh older than Jazzy 0.2.4?",
        )
    sequence, stamp_ns, length, gid = _LAYOUT.unpack(data)
    if length != GID_BYTES:
        raise DecodeError("bad_attachment", f"a GID of {length} bytes instead of {GID_BYTES}")
    return Attachment(sequence, stamp_ns, gid)
