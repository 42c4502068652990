"""Encodes and decodes messages in msgpack, JSON and CDR.

The encoding of an incoming payload is the one that its Zenoh Encoding names. If the Zenoh Encoding
names none of the three, the first bytes of the payload decide:

- JSON: `{`, also after white space
- msgpack: the header of a map
- CDR: `00 00` or `00 01`

Decoding raises `DecodeError` and no other exception.
"""

from __future__ import annotations

import re
from typing import Generic, Literal, TypeVar

import msgspec

from acsard.core.messages.cdr import Cdr, CdrError
from acsard.core.values import AcsardError

Format = Literal["msgpack", "json", "cdr"]
FORMATS: tuple[Format, ...] = ("msgpack", "json", "cdr")

T = TypeVar("T")

_MIME: dict[Format, str] = {
    "msgpack": "application/msgpack",
    "json": "application/json",
    "cdr": "application/cdr",
}
_FORM_OF: dict[str, Format] = {mime: form for form, mime in _MIME.items()} | {"text/json": "json"}
_pack = msgspec.msgpack.Encoder()
_text = msgspec.json.Encoder()


class DecodeError(AcsardError):
    """Error for a payload that cannot be decoded.

    `reason` is the kind of the error. It is also the end of the name of the counter for such
    errors: the reason "malformed" is counted as `command_malformed`.
    """

    def __init__(self, reason: str, text: str) -> None:
        super().__init__(text)
        self.reason = reason


_AT_BYTE = re.compile(r"JSON is malformed: (.*) \(byte (\d+)\)")


def encoding_name(form: Format, type_name: str = "") -> str:
    """Return the Zenoh Encoding of a payload to send.

    `type_name` is the type of the message, which the Encoding then contains; "" leaves it out.
    """
    return f"{_MIME[form]};acsard.{type_name}.v1" if type_name else _MIME[form]


def encode(message: object, form: Format) -> bytes:
    """Return the encoded message. Raises `DecodeError` if CDR cannot represent the type."""
    if form == "cdr":
        return _codec(type(message)).encode(message)
    return _pack.encode(message) if form == "msgpack" else _text.encode(message)


def _codec(cls: type[T]) -> Cdr[T]:
    try:
        return Cdr(cls)
    except TypeError:
        raise DecodeError(
            "unknown_format", f"{cls.__name__} is not a ROS message and has no CDR form: use JSON"
        ) from None


def detect(encoding: str, payload: bytes) -> Format:
    """Return the format of a received payload: JSON, msgpack or CDR.

    Raises `DecodeError` if it is none of them. `encoding` is the Zenoh Encoding of the payload. If
    it does not name the format, the first bytes of the payload decide.
    """
    form = _FORM_OF.get(encoding.partition(";")[0])
    if form is not None:
        return form
    first = payload.lstrip(b" \t\r\n")[:1]
    if first == b"{":
        return "json"
    if first and (0x80 <= first[0] <= 0x8F or first[0] in (0xDE, 0xDF)):
        return "msgpack"
    if payload[:2] in (b"\x00\x00", b"\x00\x01"):
        return "cdr"
    raise DecodeError(
        "unknown_encoding",
        f"the payload is not a JSON object, a msgpack map or CDR: {payload[:16]!r}",
    )


class Decoder(Generic[T]):
    """Decodes payloads of one type in any of the encodings."""

    def __init__(self, cls: type[T]) -> None:
        self._cls = cls
        self._pack = msgspec.msgpack.Decoder(cls)
        self._text = msgspec.json.Decoder(cls)

    def decode(self, encoding: str, payload: bytes) -> T:
        """Return the message in a payload, or raise `DecodeError`.

        `encoding` is the Zenoh Encoding of the payload. If it does not name the format, the first
        bytes of the payload decide.
        """
        return self.decode_as(detect(encoding, payload), payload)

    def decode_as(self, form: Format, payload: bytes) -> T:
        """Return the message in a payload whose format is `form`, or raise `DecodeError`."""
        if form == "cdr":
            return decode_cdr(self._cls, payload)
        try:
            return self._pack.decode(payload) if form == "msgpack" else self._text.decode(payload)
        except msgspec.ValidationError as error:
            raise DecodeError("wrong_shape", str(error)) from None
        except (msgspec.MsgspecError, ValueError, OverflowError, RecursionError) as error:
            words = _where(str(error), payload) if form == "json" else str(error)
            raise DecodeError("malformed", words) from None


def _where(words: str, payload: bytes) -> str:
    """Return a JSON error with the line and the column of the mistake in place of its byte offset.

    `words` is the text of the error from msgspec, and `payload` is the JSON text.
    """
    match = _AT_BYTE.fullmatch(words)
    if match is None:
        return words
    before, what = payload[: int(match[2])], match[1]
    if payload[len(before) :].lower().startswith((b"nan", b"inf")):
        what, before = "JSON cannot contain NaN or infinity", before.removesuffix(b"-")
    line = before.rpartition(b"\n")[2].decode(errors="replace")
    return f"line {before.count(10) + 1}, column {len(line) + 1}: {what}"


def decode_cdr(cls: type[T], payload: bytes) -> T:
    """Return the message in a CDR payload. Raises `DecodeError` if the payload is not valid."""
    try:
        return _codec(cls).decode(payload)
    except CdrError as error:
        raise DecodeError("malformed", str(error)) from None
