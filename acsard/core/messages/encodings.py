"""Encodes and decodes messages in msgpack, JSON and CDR.

The Zenoh Encoding of an incoming payload names its format. If it names none of the three formats,
the first bytes of the payload decide:

- JSON: `{`, also after white space
- msgpack: the header of a map
- CDR: `00 00` or `00 01`

Decoding raises `DecodeError` and no other exception.
"""

from __future__ import annotations

import re
from typing import Generic, Literal, TypeVar, get_args

import msgspec

from acsard.core.codes import RefusalCode
from acsard.core.messages.cdr import Cdr, CdrError
from acsard.core.values import AcsardError

Format = Literal["msgpack", "json", "cdr"]
FORMATS: tuple[Format, ...] = get_args(Format)

T = TypeVar("T")

_FORM_OF: dict[str, Format] = {f"application/{form}": form for form in FORMATS}
_FORM_OF["text/json"] = "json"
_pack = msgspec.msgpack.Encoder()
_text = msgspec.json.Encoder()


class DecodeError(AcsardError):
    """Error for a payload that cannot be decoded.

    `reason` is the kind of the error, such as "malformed". The daemon counts these errors by
    reason. For example, an error with the reason "malformed" adds 1 to the counter
    `command_malformed`.
    """

    def __init__(self, reason: RefusalCode, text: str) -> None:
        super().__init__(text)
        self.reason = reason


_AT_BYTE = re.compile(r"JSON is malformed: (.*) \(byte (\d+)\)")


def encoding_name(form: Format, type_name: str = "") -> str:
    """Return the Zenoh Encoding for an outgoing payload in the format `form`.

    If `type_name` is not "", the Encoding also contains this type of the message.
    """
    return f"application/{form}" + (f";acsard.{type_name}.v1" if type_name else "")


def encode(message: object, form: Format) -> bytes:
    """Encode a message in the format `form`. Raises `DecodeError` if the type has no CDR form."""
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
    """Return the format of a received payload: "json", "msgpack" or "cdr".

    `encoding` is the Zenoh Encoding of the payload. If it does not name the format, the first
    bytes of the payload decide. Raises `DecodeError` if the payload has none of the formats.
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
    """Decodes payloads of one message type in msgpack, JSON and, for ROS types, CDR."""

    def __init__(self, cls: type[T]) -> None:
        self._cls = cls
        self._pack = msgspec.msgpack.Decoder(cls)
        self._text = msgspec.json.Decoder(cls)

    def decode(self, encoding: str, payload: bytes) -> T:
        """Decode a payload, or raise `DecodeError`.

        `encoding` is the Zenoh Encoding of the payload. If it does not name the format, the first
        bytes of the payload decide.
        """
        return self.decode_as(detect(encoding, payload), payload)

    def decode_as(self, form: Format, payload: bytes) -> T:
        """Decode a payload in the format `form`, or raise `DecodeError`."""
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
    """Put a line and a column in place of the byte offset in an error text of msgspec."""
    match = _AT_BYTE.fullmatch(words)
    if match is None:
        return words
    before, what = payload[: int(match[2])], match[1]
    if payload[len(before) :].lower().startswith((b"nan", b"inf")):
        what, before = "JSON cannot contain NaN or infinity", before.removesuffix(b"-")
    line = before.rpartition(b"\n")[2].decode(errors="replace")
    return f"line {before.count(10) + 1}, column {len(line) + 1}: {what}"


def decode_cdr(cls: type[T], payload: bytes) -> T:
    """Decode a CDR payload to a message of type `cls`. Raises `DecodeError` if it is not valid."""
    try:
        return _codec(cls).decode(payload)
    except CdrError as error:
        raise DecodeError("malformed", str(error)) from None
