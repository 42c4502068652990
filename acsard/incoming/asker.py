"""Names for the log the program that called a service or sent a stop.

The name is the public name of the sender id in the attachment (`messages/signature.py`), followed
by the transport in brackets. The name itself is a claim: Zenoh does not say which connection a
query came by. The digits behind it are the same for as long as the program keeps its secret. A
call over rmw_zenoh has the client's GID, which ROS discovery publishes; a bridge says nothing.
"""

from __future__ import annotations

from acsard.incoming.commands import Via
from acsard.messages.signature import public_name, unpack
from acsard.ros.attachments import GID_BYTES


def asker(via: Via, attachment: bytes, stamped_by: str = "") -> str:
    """Return the caller's public name and its transport.

    `stamped_by` is the id of the Zenoh session that stamped the sample, "" for none.
    """
    if via == "rmw":
        return f"unnamed (rmw {attachment[-GID_BYTES:].hex()})"
    if via == "bridge":
        return "unnamed (bridge)"
    session = f", session {public_name(stamped_by)}" if stamped_by else ""
    signature = unpack(attachment)
    name = public_name(signature.sender) if signature else "unnamed"
    return f"{name} (native{session})"
