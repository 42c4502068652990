"""The attachment that names the sender of a command or a call, and the sender's public name.

An attachment is a map in JSON or msgpack:

    {"sender": "joystick/8Xg2kq0vRw-1yEJc7hPzUA", "stamp": 1795154884365624370, "sequence": 12}

The sender id is `NAME/SECRET`. Only the program and the daemon know it, because it proves which
program sends. The daemon keeps and publishes its `public_name`, from which no program can construct
an attachment that counts as the same sender. Any other attachment is ignored.
"""

from __future__ import annotations

from functools import lru_cache
from hashlib import sha256
from typing import Annotated

import msgspec
from msgspec import Meta, Struct

MOST = (1 << 63) - 1

MAX_SENDER = 64
"""Largest number of characters in a sender id."""

MAX_NAME = 40
"""Characters of a sender's name that are shown. The rest of a sender id is room for the secret."""

DIGITS = 16
"""Hexadecimal digits of the hash that are shown: 64 bits, too many to find a second id for."""

MARKS = " @._-:/+"
"""Characters besides letters and digits that a name may contain. The texts that the daemon puts
around a name use none of them as a delimiter.
"""


class Signature(Struct, frozen=True, omit_defaults=True):
    """The sender's id, the stamp of the command in ns since 1970, and a number that grows by 1."""

    sender: Annotated[str, Meta(min_length=1, max_length=MAX_SENDER)]
    stamp: Annotated[int, Meta(gt=0, le=MOST)] | None = None
    sequence: Annotated[int, Meta(ge=0, le=MOST)] | None = None
    steady: bool = False
    """True if the clock of `stamp` is never adjusted while this sender runs, so a late stamp
    means a late command.
    """

    def pack(self) -> bytes:
        """Encode the attachment as acsard's own client sends it."""
        return msgspec.msgpack.encode(self)


_json = msgspec.json.Decoder(Signature)
_msgpack = msgspec.msgpack.Decoder(Signature)


def unpack(attachment: bytes) -> Signature | None:
    """Return the signature in an attachment, or None if the attachment holds something else."""
    if not attachment:
        return None
    try:
        return (_json if attachment[:1] == b"{" else _msgpack).decode(attachment)
    except (msgspec.DecodeError, UnicodeDecodeError):
        return None


# Every command needs the name: hashing takes 7 us, a cache look-up 0.15 us.
@lru_cache(maxsize=1024)
def public_name(sender: str, certificate: str = "") -> str:
    """Return the name that the daemon uses and publishes for a sender id.

    It is the name before the last "/" and the first 16 hexadecimal digits of the SHA-256 of the
    whole id: "joystick/0b5d6c1f22a94e37". Without a name it is the digits alone. The id of a Zenoh
    session, which signs that session's timestamps, gets its public name by the same rule.

    `certificate` is the common name of the certificate under which the sender commands over TLS. It
    stands in square brackets, which a name cannot contain: "joystick/0b5d6c1f22a94e37 [laptop]".
    """
    digits = sha256(sender.encode("utf-8", "surrogatepass")).hexdigest()[:DIGITS]
    name = _cleaned(sender.rpartition("/")[0][:MAX_NAME]).strip()
    shown = f"{name}/{digits}" if name else digits
    return f"{shown} [{_cleaned(certificate[:MAX_SENDER])}]" if certificate else shown


def _cleaned(text: str) -> str:
    return "".join(char if char.isalnum() or char in MARKS else "?" for char in text)
