"""Encodes and decodes messages in msgpack, JSON and CDR.

The Zenoh Encoding names the format of a payload, or its first bytes: `{`, also after white space
(JSON), the header of a map (msgpack), `00 00` or `00 01` (CDR). Decoding raises only `DecodeError`.
"""

from __future__ import annotations

import re
from typing import Generic, Literal, TypeVar, get_args

import msgspec

from acsard.core.codes import RefusalCode
from acsard.core.messages.cdr import Cdr, CdrError
from acsard.core.messages.strict_types import strict
from acsard.core.values import AcsardError

Format = Literal["msgpack", "json", "cdr"]
FORMATS: tuple[Format, ...] = get_args(Format)

T = TypeVar("T")
M = TypeVar("M", bound=msgspec.Struct)

_FORM_OF: dict[str, Format] = {f"application/{form}": form for form in FORMATS}
_FORM_OF["text/json"] = "json"
_pack = msgspec.msgpack.Encoder()
_text = msgspec.json.Encoder()


class DecodeError(AcsardError):
    """The payload cannot be decoded. `reason` is the kind, such as "malformed", for counters."""

    def __init__(self, reason: RefusalCode, text: str) -> None:
        super().__init__(text)
        self.reason = reason


_AT_BYTE = re.compile(r"JSON is malformed: (.*) \(byte (\d+)\)")


def encoding_name(form: Format, type_name: str = "") -> str:
    """Return the Zenoh Encoding of a format, with the message's type if it is given."""
    return f"application/{form}" + (f";acsard.{type_name}.v1" if type_name else "")


def encode(message: object, form: Format) -> bytes:
    """Encode a message. Raises `DecodeError` if the type has no CDR form."""
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
    """Return the format by the Encoding or the first bytes. Raises `DecodeError`."""
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


def to_json(encoding: str, payload: bytes) -> bytes:
    """Return a payload of any type in JSON. Raises `DecodeError`, also for CDR."""
    form = detect(encoding, payload)
    if form == "cdr":
        raise DecodeError("unknown_encoding", "a CDR message does not contain its type")
    codec = msgspec.json if form == "json" else msgspec.msgpack
    try:
        return msgspec.json.encode(codec.decode(payload))
    except (msgspec.MsgspecError, ValueError, TypeError, RecursionError) as error:
        raise DecodeError("malformed", str(error)) from None


class Decoder(Generic[T]):
    """Decodes payloads of one message type in msgpack, JSON and, for ROS types, CDR.

    Fields that the type does not have are ignored: it is for what a client receives.
    """

    def __init__(self, cls: type[T]) -> None:
        self._cls = cls
        self._pack = msgspec.msgpack.Decoder(cls)
        self._text = msgspec.json.Decoder(cls)

    def decode(self, encoding: str, payload: bytes) -> T:
        """Decode a payload by its Encoding or its first bytes. Raises `DecodeError`."""
        return self.decode_as(detect(encoding, payload), payload)

    def decode_as(self, form: Format, payload: bytes) -> T:
        """Decode a payload of this format. Raises `DecodeError`."""
        if form == "cdr":
            return decode_cdr(self._cls, payload)
        try:
            return self._pack.decode(payload) if form == "msgpack" else self._text.decode(payload)
        except msgspec.ValidationError as error:
            raise DecodeError("wrong_shape", str(error)) from None
        except (msgspec.MsgspecError, ValueError, OverflowError, RecursionError) as error:
            words = _where(str(error), payload) if form == "json" else str(error)
            raise DecodeError("malformed", words) from None


class StrictDecoder(Decoder[M]):
    """Decodes what the daemon receives: a payload with an unknown field is an error."""

    def __init__(self, cls: type[M]) -> None:
        super().__init__(cls)
        kind = strict(cls)
        self._pack, self._text = msgspec.msgpack.Decoder(kind), msgspec.json.Decoder(kind)


def _where(words: str, payload: bytes) -> str:
    # A line and a column in place of msgspec's byte offset.
    match = _AT_BYTE.fullmatch(words)
    if match is None:
        return words
    before, what = payload[: int(match[2])], match[1]
    if payload[len(before) :].lower().startswith((b"nan", b"inf")):
        what, before = "JSON cannot contain NaN or infinity", before.removesuffix(b"-")
    line = before.rpartition(b"\n")[2].decode(errors="replace")
    return f"line {before.count(10) + 1}, column {len(line) + 1}: {what}"


def decode_cdr(cls: type[T], payload: bytes) -> T:
    """Decode a CDR payload. Raises `DecodeError`."""
    try:
        return _codec(cls).decode(payload)
    except CdrError as error:
        raise DecodeError("malformed", str(error)) from None
