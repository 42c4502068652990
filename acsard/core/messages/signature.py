"""Decodes the attachment of a command or a service call, which names the sending program.

An attachment is a map in JSON or msgpack:

    {"sender": "joystick/8Xg2kq0vRw-1yEJc7hPzUA", "stamp": 1795154884365624370, "sequence": 12}

The sender id is `NAME/SECRET`. Only the program and the daemon know the id, so it proves which
program sends. The daemon publishes only the `public_name` of the sender, from which nobody can
compute the id. An attachment of any other form is ignored.
"""

from __future__ import annotations

from functools import lru_cache
from hashlib import sha256
from typing import Annotated

import msgspec
from msgspec import Meta, Struct

MAX_INT64 = (1 << 63) - 1

MAX_SENDER_LENGTH = 64
"""Largest number of characters in a sender id."""

MAX_NAME_LENGTH = 40
"""Largest number of characters that a public name takes from NAME in the sender id
`NAME/SECRET`."""

HASH_DIGITS = 16
"""Number of hexadecimal digits of the hash in a public name. 16 digits encode 64 bits, so nobody
can find a second sender id with the same hash."""

ALLOWED_PUNCTUATION = " @._-:/+"
"""Characters besides letters and digits that a public name may contain. All others become "?".
Brackets and commas are not allowed, because the log puts brackets around the name of a certificate
and commas between the names of senders."""


class Signature(Struct, frozen=True, omit_defaults=True):
    """The attachment of one command or service call. It names the sending program."""

    sender: Annotated[str, Meta(min_length=1, max_length=MAX_SENDER_LENGTH)]
    """The sender id, such as "joystick/8Xg2kq0vRw-1yEJc7hPzUA"."""
    stamp: Annotated[int, Meta(gt=0, le=MAX_INT64)] | None = None
    """Time at which the command was sent, by the sender's clock, ns since 1970. None if the sender
    sends no time."""
    sequence: Annotated[int, Meta(ge=0, le=MAX_INT64)] | None = None
    """Number of the command, which grows by 1 with each command of this sender. None if the sender
    does not number its commands."""
    steady: bool = False
    """True if the clock that gives `stamp` is never adjusted while the sender runs. An old stamp
    then proves that the command was delayed."""

    def pack(self) -> bytes:
        """Encode the attachment in msgpack."""
        return msgspec.msgpack.encode(self)


_json = msgspec.json.Decoder(Signature)
_msgpack = msgspec.msgpack.Decoder(Signature)


def unpack(attachment: bytes) -> Signature | None:
    """Decode an attachment in JSON or msgpack. Return None if it is not a valid signature."""
    if not attachment:
        return None
    try:
        return (_json if attachment[:1] == b"{" else _msgpack).decode(attachment)
    except (msgspec.DecodeError, UnicodeDecodeError):
        return None


# Each command needs the public name. Hashing takes 7 us, and a look-up in the cache 0.15 us.
@lru_cache(maxsize=1024)
def public_name(sender: str, certificate: str = "") -> str:
    """Return the public name of a sender, such as "joystick/0b5d6c1f22a94e37 [laptop]".

    It has up to three parts, and parts that do not exist are left out:

    - the text of the id before its last "/"
    - the first 16 hexadecimal digits of the SHA-256 of the complete id
    - the common name of the certificate, in brackets

    Args:
        sender: the sender id. If the message has no sender id, pass the id of the Zenoh session
            that set the timestamp of the message.
        certificate: the common name of the sender's TLS certificate, or "".
    """
    digits = sha256(sender.encode("utf-8", "surrogatepass")).hexdigest()[:HASH_DIGITS]
    name = _cleaned(sender.rpartition("/")[0][:MAX_NAME_LENGTH]).strip()
    label = f"{name}/{digits}" if name else digits
    return f"{label} [{_cleaned(certificate[:MAX_SENDER_LENGTH])}]" if certificate else label


def _cleaned(text: str) -> str:
    return "".join(char if char.isalnum() or char in ALLOWED_PUNCTUATION else "?" for char in text)
