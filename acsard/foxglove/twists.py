"""Decodes the twists that a viewer publishes. This module is pure.

It decodes them as the daemon decodes commands: a message is accepted or refused as a whole, with a
reason.
"""

from __future__ import annotations

from acsard.client.commander import Wish
from acsard.core.config.settings import DriveConfig, JointsConfig
from acsard.core.incoming.commands import STAMPED_TWISTS, TWISTS, Arrival, Receiver
from acsard.core.messages.encodings import DecodeError, encoding_name
from acsard.core.motion.kinematics import Kinematics

_receiver = Receiver(JointsConfig(), Kinematics(DriveConfig()))
"""Decoder for twists only. They depend on neither joints nor wheels, so the defaults are
sufficient."""


def encoding_of(encoding: str, schema_name: str) -> str:
    """Return the Zenoh encoding of a channel. Raises `DecodeError` if it cannot carry twists."""
    package, _, name = schema_name.partition("/")
    full = f"{package}/msg/{name.removeprefix('msg/')}"
    if full not in (TWISTS[0], STAMPED_TWISTS[0]):
        raise DecodeError("wrong_type", f"{schema_name or 'no type'}, but {TWISTS[0]} is needed")
    if encoding == "cdr":
        return f"{encoding_name('cdr')};{full}"
    if encoding == "json":
        return encoding_name("json")
    raise DecodeError("unknown_encoding", f"{encoding}, but json or cdr is needed")


def wish(encoding: str, payload: bytes) -> Wish:
    """Return the twist and the stamp of a message. Raises `DecodeError`."""
    found = _receiver.command(Arrival("cmd/app", True, payload, encoding, 0, None, ""))
    return Wish(found.twist, found.stamp_ns)
