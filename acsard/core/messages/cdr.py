"""Encodes msgspec structs as CDR, the encoding of ROS 2, and decodes them.

The codec follows from the struct's type. It writes plain CDR (XCDR1), little endian, after the
encapsulation header of 4 bytes, and reads both byte orders. Numbers are aligned relative to the
byte after the header, and neighbors are packed by one call, for speed.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable
from functools import cache, lru_cache
from operator import attrgetter
from typing import Any, Generic, TypeVar, cast

from msgspec import inspect

from acsard.core.messages.cdr_types import (
    SIZES,
    Build,
    builder,
    leaves,
    limit,
    nullable,
    number_code,
    plain,
    struct_info,
)
from acsard.core.values import AcsardError

T = TypeVar("T")

HEADER = b"\x00\x01\x00\x00"  # plain CDR, little endian

_ORDERS = {b"\x00\x00": ">", b"\x00\x01": "<"}


class CdrError(AcsardError):
    """The bytes are not a valid message of the expected type."""


class Cdr(Generic[T]):
    """Codec of one struct type. The constructor raises `TypeError` if CDR cannot represent it."""

    def __init__(self, cls: type[T]) -> None:
        # The cache of `_compiled` needs hashable arguments. mypy does not know that `cls` is
        # hashable.
        of_type: Any = cls
        self._parts, self._build = _compiled(of_type)

    def encode(self, message: T) -> bytes:
        """Encode a message as CDR with its header, without trailing padding."""
        out = bytearray(HEADER)
        for part in self._parts:
            part.write(out, message)
        if not self._parts:
            # In CDR a struct without fields takes one byte.
            out.append(0)
        return bytes(out)

    def decode(self, payload: bytes) -> T:
        """Decode a CDR payload, without trailing bytes. Raises only `CdrError`."""
        order = _ORDERS.get(payload[:2])
        if order is None or len(payload) < 4:
            raise CdrError(
                "the payload must begin with the header of plain CDR, not with "
                f"{payload[:4].hex(' ')}"
            )
        source = _Source(payload, order)
        fields: list[object] = []
        for part in self._parts:
            part.read(source, fields)
        return cast(T, self._build(iter(fields)))


class _Source:
    # Reads the values of a payload in order, and never beyond its end.
    def __init__(self, data: bytes, order: str) -> None:
        self.data, self.order = data, order
        self.at = len(HEADER)

    def take(self, codes: str) -> tuple[Any, ...]:
        raw = codes.replace("?", "B")
        values = self._unpack(_layout(self.order, raw, (self.at - len(HEADER)) & 7))
        return tuple(map(_whole, codes, values)) if "?" in codes else values

    def take_many(self, code: str, count: int) -> list[Any]:
        self.at += -(self.at - len(HEADER)) % SIZES[code]
        # Do not cache this layout: a client may send a sequence of any length, and fill the cache.
        values = self._unpack(struct.Struct(f"{self.order}{count}{code.replace('?', 'B')}"))
        return [_whole(code, value) for value in values] if code == "?" else list(values)

    def _unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        start, self.at = self.at, self.at + layout.size
        if self.at > len(self.data):
            raise CdrError(
                f"the CDR payload ends after {len(self.data)} bytes, in the middle of a field"
            )
        return layout.unpack_from(self.data, start)

    def count(self, least: int) -> int:
        """Read the number of items, of at least `least` bytes each. Raises `CdrError`."""
        (count,) = self.take("I")
        if count * least > len(self.data) - self.at:
            raise CdrError(
                f"the CDR payload is too short for its sequence of {count} items: it has only "
                f"{len(self.data)} bytes"
            )
        return int(count)

    def text(self) -> str:
        count = self.count(1)
        raw = self.data[self.at : self.at + count]
        self.at += count
        # Some writers encode an empty string as length 0, without the final zero byte.
        if raw[-1:] not in (b"\0", b""):
            raise CdrError("a string in the CDR payload does not end with a zero byte")
        try:
            return raw[:-1].decode()
        except UnicodeDecodeError as error:
            raise CdrError(f"a string in the CDR payload is not UTF-8: {error.reason}") from None


def _whole(code: str, value: Any) -> Any:
    if code == "?" and value > 1:
        raise CdrError(f"a boolean in the CDR payload must be 0 or 1, not {value}")
    return bool(value) if code == "?" else value


@cache
def _layout(order: str, codes: str, start: int) -> struct.Struct:
    # Numbers aligned to their size, from position `start` modulo 8 after the header.
    text, at = order, start
    for code in codes:
        pad = -at % SIZES[code]
        text += f"{pad}x{code}"
        at += pad + SIZES[code]
    return struct.Struct(text)


def _packs(codes: str) -> tuple[Callable[..., bytes], ...]:
    # One function for each start position modulo 8 after the header.
    return tuple(_layout("<", codes, start).pack for start in range(8))


_put_count = _packs("I")


# A robot sends few different strings, so a small cache saves most work.
@lru_cache(256)
def _text_bytes(text: str) -> bytes:
    raw = text.encode() + b"\0"
    return struct.pack("<I", len(raw)) + raw


def _put_text(out: bytearray, text: str) -> None:
    out += bytes(-len(out) & 3)
    out += _text_bytes(text)


Get = Callable[[Any], Any]


class _Numbers:
    # Neighboring numbers, maybe of different nested structs.
    def __init__(self, run: list[tuple[str, inspect.Type]]) -> None:
        self._codes = "".join(number_code(kind) for _, kind in run)
        self._packs = _packs(self._codes)
        bounds = [(index, limit(kind)) for index, (_, kind) in enumerate(run)]
        self._limits = [(index, *bound) for index, bound in bounds if bound is not None]
        self._nullable = [index for index, (_, kind) in enumerate(run) if nullable(kind)]
        get = attrgetter(*[path for path, _ in run])
        self._get: Get = get if len(run) > 1 else lambda message: (get(message),)

    def write(self, out: bytearray, message: object) -> None:
        values = self._get(message)
        if self._nullable:
            values = [math.nan if value is None else value for value in values]
        out += self._packs[(len(out) - len(HEADER)) & 7](*values)

    def read(self, source: _Source, fields: list[object]) -> None:
        values = source.take(self._codes)
        for index, low, high in self._limits:
            if not low <= values[index] <= high:
                raise CdrError(f"{values[index]} is outside the range from {low:g} to {high:g}")
        fields += values
        for index in self._nullable:
            if math.isnan(values[index]):
                fields[index - len(values)] = None


class _Text:
    def __init__(self, get: Get) -> None:
        self._get = get

    def write(self, out: bytearray, message: object) -> None:
        _put_text(out, self._get(message))

    def read(self, source: _Source, fields: list[object]) -> None:
        fields.append(source.text())


class _List:
    # An array if `fixed`, otherwise a sequence of up to `most` items (None: any number).
    def __init__(self, get: Get, kind: inspect.Type, most: int | None, fixed: bool) -> None:
        self._get, self._most = get, most
        self._fixed = most if fixed else None
        self._code = number_code(kind)
        self._array = self._code * (self._fixed or 0)
        self._packs = _packs(self._array) if self._array else None
        self._text = isinstance(plain(kind), inspect.StrType)
        self._parts: tuple[_Part, ...] = ()
        item = plain(kind)
        if isinstance(item, inspect.StructType):
            self._parts, self._build = _compiled(item.cls)
        elif not (self._code or self._text):
            raise TypeError(f"CDR cannot encode a sequence of {kind}")

    def write(self, out: bytearray, message: object) -> None:
        items = self._get(message)
        start = (len(out) - len(HEADER)) & 7
        if self._fixed is None:
            out += _put_count[start](len(items))
        elif len(items) != self._fixed:
            raise ValueError(f"{len(items)} items in an array of {self._fixed}")
        if self._packs is not None:
            out += self._packs[start](*items)
            return
        if self._code:
            # An empty sequence ends with its length, without padding for its items.
            if items:
                out += bytes(-(len(out) - len(HEADER)) % SIZES[self._code])
                out += struct.pack(f"<{len(items)}{self._code}", *items)
            return
        for item in items:
            if self._text:
                _put_text(out, item)
            for part in self._parts:
                part.write(out, item)

    def read(self, source: _Source, fields: list[object]) -> None:
        least = SIZES[self._code] if self._code else 1
        count = source.count(least) if self._fixed is None else self._fixed
        if self._most is not None and count > self._most:
            raise CdrError(f"{count} items, but at most {self._most} are allowed")
        if self._array:
            fields.append(list(source.take(self._array)))
        elif self._code:
            fields.append(source.take_many(self._code, count) if count else [])
        elif self._text:
            fields.append([source.text() for _ in range(count)])
        else:
            fields.append([self._item(source) for _ in range(count)])

    def _item(self, source: _Source) -> object:
        inner: list[object] = []
        for part in self._parts:
            part.read(source, inner)
        return self._build(iter(inner))


_Part = _Numbers | _Text | _List


@cache
def _compiled(cls: Any) -> tuple[tuple[_Part, ...], Build]:
    # The codecs of the parts, and a function that builds a `cls`.
    info = struct_info(cls)
    parts: list[_Part] = []
    run: list[tuple[str, inspect.Type]] = []

    def end_run() -> None:
        if run:
            parts.append(_Numbers(run))
            run.clear()

    for path, kind in leaves(info):
        if number_code(kind):
            run.append((path, kind))
            continue
        end_run()
        match plain(kind):
            case inspect.StrType():
                parts.append(_Text(attrgetter(path)))
            case inspect.ListType(item_type=item, min_length=least, max_length=most):
                parts.append(_List(attrgetter(path), item, most, fixed=most == least))
            case _:
                raise TypeError(f"CDR cannot encode {cls.__name__}.{path}")
    end_run()
    return tuple(parts), builder(info)
