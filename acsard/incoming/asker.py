"""Who asked or stopped, in words for the log: the name he gives himself, and the way it came.

A claim, not a proof: Zenoh does not tell which connection a query came by, nor whose certificate
that shows. The name is the `sender` of the signature (`messages/signature.py`) on the call or put;
`client/` sets it. ROS has none: by rmw_zenoh it is the client's GID, and a bridge tells nothing.
"""

from __future__ import annotations

from acsard.incoming.commands import Via
from acsard.messages.signature import unpack
from acsard.ros.attachments import GID_BYTES

MAX_NAME = 40
"""Characters kept of a name that a stranger chooses."""

MARKS = " @._-:/+"
"""What a name may have beside letters and digits: nothing that the words around it use."""


def asker(via: Via, attachment: bytes, stamped_by: str = "") -> str:
    """The name, and in brackets the way; `stamped_by` is the session that stamped it, if any."""
    if via == "rmw":
        return f"unnamed (rmw {attachment[-GID_BYTES:].hex()})"
    if via == "bridge":
        return "unnamed (bridge)"
    session = f", session {stamped_by}" if stamped_by else ""
    return f"{_name(attachment)} (native{session})"


def _name(attachment: bytes) -> str:
    signature = unpack(attachment)
    text = signature.sender[:MAX_NAME] if signature else ""
    kept = (char if char.isalnum() or char in MARKS else "?" for char in text)
    return "".join(kept).strip() or "unnamed"
