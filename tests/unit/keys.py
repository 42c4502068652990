"""Every key of the configuration, found by walking the structs, so that tests miss no key."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import msgspec
from msgspec import inspect
from msgspec.structs import FieldInfo, fields

from acsard.core.config.settings import Config, Source

Bounded = inspect.FloatType | inspect.IntType


class Key(msgspec.Struct, frozen=True):
    """One key of the configuration: its path in TOML, its struct, and its field in that struct."""

    path: str
    table: type[msgspec.Struct]
    field: FieldInfo

    def numbers(self) -> list[Bounded]:
        """Return the number types that its value may have, also inside a union or a list."""
        return list(_numbers(inspect.type_info(self.field.type)))

    def document(self, text: str) -> str:
        """Return a TOML document that sets only this key, with the value written as `text`."""
        if self.table is Source:
            rest = {"name": '"x"', "priority": "1"} | {self.field.name: text}
            return "[[commands.sources]]\n" + "\n".join(f"{k} = {v}" for k, v in rest.items())
        return f"[{self.path.rpartition('.')[0]}]\n{self.field.name} = {text}"


def all_keys(table: type[msgspec.Struct] = Config, path: str = "") -> Iterator[Key]:
    """Yield every key that has a value. The keys of sources are `commands.sources[0].…`."""
    for field in fields(table):
        where = f"{path}.{field.name}" if path else field.name
        if isinstance(field.type, type) and issubclass(field.type, msgspec.Struct):
            yield from all_keys(field.type, where)
        elif field.type == tuple[Source, ...]:
            yield from all_keys(Source, f"{where}[0]")
        else:
            yield Key(where, table, field)


def _numbers(kind: Any) -> Iterator[Bounded]:
    match kind:
        case inspect.FloatType() | inspect.IntType():
            yield kind
        case inspect.Metadata(type=inner) | inspect.VarTupleType(item_type=inner):
            yield from _numbers(inner)
        case inspect.UnionType(types=types):
            for member in types:
                yield from _numbers(member)


KEYS = tuple(all_keys())
"""All keys in the order of the file."""
