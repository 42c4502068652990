"""Struct <-> CDR, the encoding of ROS 2: derived from any msgspec struct, knows nothing of robots.

Plain CDR (XCDR1) behind its 4-byte header, aligned from the byte after it, little endian; both
byte orders are read. Each struct (`cdr_types.py`) is compiled once: runs of numbers are packed in
one call, so that a message costs a few steps and not one a field.
"""

from __future__ import annotations

import struct
from collections.abc import Callable
from functools import cache, lru_cache
from operator import attrgetter
from typing import Any, Generic, TypeVar, cast

from msgspec import inspect

from acsard.messages.cdr_types import (
    SIZES,
    Build,
    builder,
    leaves,
    limit,
    number_code,
    plain,
    struct_info,
)
from acsard.values import AcsardError

T = TypeVar("T")

HEADER = b"\x00\x01\x00\x00"
"""Encapsulation of plain CDR, little endian."""

_ORDERS = {b"\x00\x00": ">", b"\x00\x01": "<"}


class CdrError(AcsardError):
    """Bytes that are not the message they should be."""


class Cdr(Generic[T]):
    """Encodes and decodes one struct type; raises `TypeError` for a type CDR cannot tell."""

    def __init__(self, cls: type[T]) -> None:
        of_type: Any = cls  # to be hashed, which a type variable may not be
        self._parts, self._build = _compiled(of_type)

    def encode(self, message: T) -> bytes:
        """The message with its header, little endian, without trailing padding."""
        out = bytearray(HEADER)
        for part in self._parts:
            part.write(out, message)
        if not self._parts:
            out.append(0)  # a struct without fields has one byte all the same
        return bytes(out)

    def decode(self, payload: bytes) -> T:
        """The message; surplus bytes are padding. Raises `CdrError` and nothing else."""
        order = _ORDERS.get(payload[:2])
        if order is None or len(payload) < 4:
            raise CdrError(f"needs the header of plain CDR, has {payload[:4].hex(' ')}")
        source = _Source(payload, order)
        found: list[object] = []
        for part in self._parts:
            part.read(source, found)
        return cast(T, self._build(iter(found)))


class _Source:
    """Bytes being read, aligned from the end of the header; never beyond their end."""

    def __init__(self, data: bytes, order: str) -> None:
        self.data, self.order = data, order
        self.at = len(HEADER)

    def take(self, codes: str) -> tuple[Any, ...]:
        raw = codes.replace("?", "B")
        values = self._unpack(_layout(self.order, raw, (self.at - len(HEADER)) & 7))
        return tuple(map(_whole, codes, values)) if "?" in codes else values

    def take_many(self, code: str, count: int) -> list[Any]:
        self.at += -(self.at - len(HEADER)) % SIZES[code]
        # Not a layout to be kept: a stranger may send every length there is.
        values = self._unpack(struct.Struct(f"{self.order}{count}{code.replace('?', 'B')}"))
        return [_whole(code, value) for value in values] if code == "?" else list(values)

    def _unpack(self, layout: struct.Struct) -> tuple[Any, ...]:
        start, self.at = self.at, self.at + layout.size
        if self.at > len(self.data):
            raise CdrError(f"ends after {len(self.data)} bytes, in the middle of a field")
        return layout.unpack_from(self.data, start)

    def count(self, least: int) -> int:
        """The length of a sequence whose items take at least so many bytes each."""
        (count,) = self.take("I")
        if count * least > len(self.data) - self.at:
            raise CdrError(f"a length of {count} in {len(self.data)} bytes")
        return int(count)

    def text(self) -> str:
        count = self.count(1)
        raw = self.data[self.at : self.at + count]
        self.at += count
        if raw[-1:] not in (b"\0", b""):  # some writers give an empty string no byte at all
            raise CdrError("a string without its end")
        try:
            return raw[:-1].decode()
        except UnicodeDecodeError as error:
            raise CdrError(f"a string that is not UTF-8: {error.reason}") from None


def _whole(code: str, value: Any) -> Any:
    if code == "?" and value > 1:
        raise CdrError(f"a boolean of {value}")
    return bool(value) if code == "?" else value


@cache
def _layout(order: str, codes: str, start: int) -> struct.Struct:
    """These numbers from `start` (mod 8) on, each aligned to its size."""
    text, at = order, start
    for code in codes:
        pad = -at % SIZES[code]
        text += f"{pad}x{code}"
        at += pad + SIZES[code]
    return struct.Struct(text)


def _packs(codes: str) -> tuple[Callable[..., bytes], ...]:
    """What writes these numbers, for each start (mod 8)."""
    return tuple(_layout("<", codes, start).pack for start in range(8))


_put_count = _packs("I")


@lru_cache(256)
def _text_bytes(text: str) -> bytes:
    """A string from its length on; kept, because a robot says the same few again and again."""
    raw = text.encode() + b"\0"
    return struct.pack("<I", len(raw)) + raw


def _put_text(out: bytearray, text: str) -> None:
    out += bytes(-len(out) & 3)
    out += _text_bytes(text)


Get = Callable[[Any], Any]


class _Numbers:
    """Neighbouring numbers, wherever in nested structs they live."""

    def __init__(self, run: list[tuple[str, inspect.Type]]) -> None:
        self._codes = "".join(number_code(kind) for _, kind in run)
        self._packs = _packs(self._codes)
        bounds = [(index, limit(kind)) for index, (_, kind) in enumerate(run)]
        self._limits = [(index, *bound) for index, bound in bounds if bound is not None]
        get = attrgetter(*[path for path, _ in run])
        self._get: Get = get if len(run) > 1 else lambda message: (get(message),)

    def write(self, out: bytearray, message: object) -> None:
        out += self._packs[(len(out) - len(HEADER)) & 7](*self._get(message))

    def read(self, source: _Source, found: list[object]) -> None:
        values = source.take(self._codes)
        for index, low, high in self._limits:
            if not low <= values[index] <= high:
                raise CdrError(f"{values[index]} where {low:g} to {high:g} may be")
        found += values


class _Text:
    """A string."""

    def __init__(self, get: Get) -> None:
        self._get = get

    def write(self, out: bytearray, message: object) -> None:
        _put_text(out, self._get(message))

    def read(self, source: _Source, found: list[object]) -> None:
        found.append(source.text())


class _List:
    """Many of one kind: a sequence of at most `most`, or an array of just as many."""

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
            raise TypeError(f"CDR has no sequence of {kind}")

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
            if items:  # no padding in front of nothing
                out += bytes(-(len(out) - len(HEADER)) % SIZES[self._code])
                out += struct.pack(f"<{len(items)}{self._code}", *items)
            return
        for item in items:
            if self._text:
                _put_text(out, item)
            for part in self._parts:
                part.write(out, item)

    def read(self, source: _Source, found: list[object]) -> None:
        least = SIZES[self._code] if self._code else 1
        count = source.count(least) if self._fixed is None else self._fixed
        if self._most is not None and count > self._most:
            raise CdrError(f"{count} items where {self._most} may be")
        if self._array:
            found.append(list(source.take(self._array)))
        elif self._code:
            found.append(source.take_many(self._code, count) if count else [])
        elif self._text:
            found.append([source.text() for _ in range(count)])
        else:
            found.append([self._item(source) for _ in range(count)])

    def _item(self, source: _Source) -> object:
        inner: list[object] = []
        for part in self._parts:
            part.read(source, inner)
        return self._build(iter(inner))


_Part = _Numbers | _Text | _List


@cache
def _compiled(cls: Any) -> tuple[tuple[_Part, ...], Build]:
    """The parts of a struct in order, and what makes one of the values read from them."""
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
                raise TypeError(f"CDR cannot tell {cls.__name__}.{path}")
    end_run()
    return tuple(parts), builder(info)
