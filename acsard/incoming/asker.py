"""Who asked or stopped, in words for the log: the name he gives himself, and the way it came.

A claim, not a proof: Zenoh does not tell which connection a query came by, nor whose certificate
that shows. The name is the `sender` of a map, JSON or msgpack, that is attached to the call or put;
`client.py` sets it. ROS has none: by rmw_zenoh it is the client's GID, and a bridge tells nothing.
"""

from __future__ import annotations

import msgspec
from msgspec import Struct

from acsard.incoming.commands import Via
from acsard.ros.attachments import GID_BYTES

MAX_NAME = 40
"""Characters kept of a name that a stranger chooses."""

MARKS = " @._-:/+"
"""What a name may have beside letters and digits: nothing that the words around it use."""


class _Signed(Struct, frozen=True):
    sender: str


_json = msgspec.json.Decoder(_Signed)
_msgpack = msgspec.msgpack.Decoder(_Signed)


def asker(via: Via, attachment: bytes, stamped_by: str = "") -> str:
    """The name, and in brackets the way; `stamped_by` is the session that stamped it, if any."""
    if via == "rmw":
        return f"unnamed (rmw {attachment[-GID_BYTES:].hex()})"
    if via == "bridge":
        return "unnamed (bridge)"
    session = f", session {stamped_by}" if stamped_by else ""
    return f"{_name(attachment)} (native{session})"


def _name(attachment: bytes) -> str:
    try:
        text = (_json if attachment[:1] == b"{" else _msgpack).decode(attachment).sender
    except (msgspec.DecodeError, UnicodeDecodeError):
        text = ""
    kept = (char if char.isalnum() or char in MARKS else "?" for char in text[:MAX_NAME])
    return "".join(kept).strip() or "unnamed"
