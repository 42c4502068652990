"""Decodes the attachment of a command or a service call, which names the sending program.

    {"sender": "joystick/8Xg2kq0vRw-1yEJc7hPzUA", "stamp": 1795154884365624370, "sequence": 12,
     "echo": {"run": 181349028416577, "boot_us": 83214500123}}

It is a map in JSON or msgpack. Only the program and the daemon know the sender id `NAME/SECRET`, so
it proves which program sends. Only the `public_name` is published, from which nobody can compute
it. `echo` is a copy of the message on the key `beat` that the program received last. An attachment
of any other form is ignored, but a command with a wrong `echo` is refused.
"""

from __future__ import annotations

from functools import lru_cache
from typing import Annotated

import msgspec
from msgspec import Meta, Struct

from acsard.core.messages.schema import Beat

MAX_INT64 = (1 << 63) - 1

MAX_SENDER_LENGTH = 64  # characters of a sender id

MAX_NAME_LENGTH = 40  # characters of NAME in a public name

# Digits of the hash in a public name: 64 bits, so nobody finds a second id with the same hash.
HASH_DIGITS = 16

# Others become "?" in a public name. The log puts brackets around a certificate's name, and commas
# between senders.
ALLOWED_PUNCTUATION = " @._-:/+"


class Signature(Struct, frozen=True, omit_defaults=True):
    sender: Annotated[str, Meta(min_length=1, max_length=MAX_SENDER_LENGTH)]
    # Time of sending, ns since 1970 by the sender's clock.
    stamp: Annotated[int, Meta(gt=0, le=MAX_INT64)] | None = None
    sequence: Annotated[int, Meta(ge=0, le=MAX_INT64)] | None = None  # grows by 1 with each command
    echo: Beat | None = None

    def pack(self) -> bytes:
        """Encode the attachment in msgpack."""
        return msgspec.msgpack.encode(self)


_json = msgspec.json.Decoder(Signature)
_msgpack = msgspec.msgpack.Decoder(Signature)
_UNREADABLE = (msgspec.DecodeError, UnicodeDecodeError, RecursionError)


def unpack(attachment: bytes) -> Signature | None:
    """Decode an attachment, or return None if it is not a valid signature."""
    if not attachment:
        return None
    try:
        return (_json if attachment[:1] == b"{" else _msgpack).decode(attachment)
    except _UNREADABLE:
        # An unknown field may be nested too deeply.
        return None


def claims_echo(attachment: bytes) -> bool:
    """Return whether an attachment, maybe not a valid signature, is a map with the field `echo`."""
    try:
        fields = (msgspec.json if attachment[:1] == b"{" else msgspec.msgpack).decode(attachment)
    except _UNREADABLE:
        return False
    return isinstance(fields, dict) and "echo" in fields


# Each command needs the public name. Hashing takes 7 us, and a look-up in the cache 0.15 us.
@lru_cache(maxsize=1024)
def public_name(sender: str, certificate: str = "") -> str:
    """Return the public name of a sender, such as "joystick/0b5d6c1f22a94e37 [laptop]".

    That is the id before its last "/", the first 16 digits of the SHA-256 of all of it, and the
    certificate's common name. Without an id, pass that of the Zenoh session of the timestamp.
    """
    from hashlib import sha256  # it loads OpenSSL for 2 ms, and `acsard call stop` hashes nothing

    digits = sha256(sender.encode("utf-8", "surrogatepass")).hexdigest()[:HASH_DIGITS]
    name = _cleaned(sender.rpartition("/")[0][:MAX_NAME_LENGTH]).strip()
    label = f"{name}/{digits}" if name else digits
    return f"{label} [{_cleaned(certificate[:MAX_SENDER_LENGTH])}]" if certificate else label


def _cleaned(text: str) -> str:
    return "".join(char if char.isalnum() or char in ALLOWED_PUNCTUATION else "?" for char in text)
