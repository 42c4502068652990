"""Decodes a TOML table to a frozen struct, or to mistakes: a line with key, value and fix."""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from contextlib import suppress
from functools import cache
from typing import Any, NamedTuple, TypeVar

import msgspec
from msgspec import inspect
from msgspec.structs import FieldInfo, fields

from acsard.core.config.nearest import nearest

T = TypeVar("T", bound=msgspec.Struct)


class Key(NamedTuple):
    """A key of a table, with the type of its value as msgspec describes it."""

    field: FieldInfo
    kind: inspect.Type


@cache  # msgspec takes 0.1 ms for a table, which is too long in a step of the control loop
def keys_of(cls: type[msgspec.Struct]) -> dict[str, Key]:
    """Return the keys of a table by their names in the file."""
    return {field.encode_name: Key(field, inspect.type_info(field.type)) for field in fields(cls)}


_BARE_KEY = re.compile(r"[A-Za-z0-9_-]{1,80}")


def build(cls: type[T], table: object, path: str, problems: list[str]) -> T | None:
    """Convert a TOML table to a struct, or return None and append its mistakes.

    `path` is the dotted name of the table, or "" for the whole document.
    """
    before = len(problems)
    made = build_partly(cls, table, path, problems, set())
    return made if len(problems) == before else None


def build_partly(
    cls: type[T], table: object, path: str, problems: list[str], invalid: set[str]
) -> T | None:
    """Convert a TOML table to a struct, with the default for each invalid value.

    Return None if `table` is not a table, or lacks a required key. `invalid` gets the dotted key of
    each, and for an unknown key the most similar one, which the user may have meant.
    """
    if not isinstance(table, Mapping):
        header = f"[[{path.partition('[')[0]}]]" if path.endswith("]") else f"[{path}]"
        problems.append(f"{path} = {show(table)}: expected a table; write it as {header}")
        return None
    known = keys_of(cls)
    prefix, complete = f"{path}." if path else "", True
    for key in table:
        if key not in known:
            near = nearest(key, known)
            problems.append(_unknown(key, table[key], path, near, list(known)))
            # The user may have meant the similar key, so treat the value of that key as invalid.
            invalid |= {prefix + name for name in near}
    values: dict[str, Any] = {}
    for name, key in known.items():
        where, field = prefix + name, key.field
        if name in table:
            value = build_value(key, table[name], where, problems, invalid)
            if value is not None:
                values[field.name] = value
            elif field.required:
                complete = False
            else:
                invalid.add(where)
        elif field.required:
            problems.append(f"{where}: missing; write {name} = {_example(field)}")
            complete = False
    return cls(**values) if complete else None


def known_part(cls: type[msgspec.Struct], table: object) -> object:
    """Return a TOML table without the keys that the struct and its parts do not have."""
    if not isinstance(table, Mapping):
        return table
    keys = keys_of(cls)
    return {name: _known(keys[name].kind, value) for name, value in table.items() if name in keys}


def _known(kind: inspect.Type, value: object) -> object:
    match kind:
        case inspect.StructType(cls=cls):
            return known_part(cls, value)
        case inspect.VarTupleType(item_type=inspect.StructType(cls=cls)) if isinstance(value, list):
            return [known_part(cls, item) for item in value]
    return value


def build_value(key: Key, raw: object, where: str, problems: list[str], invalid: set[str]) -> Any:
    """Convert the value of a key, or return None and append its mistakes."""
    field, kind = key
    if isinstance(kind, inspect.StructType):
        return build_partly(kind.cls, raw, where, problems, invalid)
    if isinstance(kind, inspect.VarTupleType) and isinstance(kind.item_type, inspect.StructType):
        if not isinstance(raw, list):
            problems.append(f"{where} = {show(raw)}: expected tables; write them as [[{where}]]")
            return None
        item = kind.item_type.cls
        made = [build(item, table, f"{where}[{i}]", problems) for i, table in enumerate(raw)]
        return None if None in made else tuple(made)
    value = None
    if finite(raw):
        with suppress(msgspec.ValidationError):
            value = msgspec.convert(raw, field.type)
    if value is None:
        problems.append(f"{where} = {show(raw)}: expected {expected(kind)}; {_fix(field, where)}")
    return value


def finite(raw: object) -> bool:
    """Return False for inf and nan, which TOML allows and msgspec accepts."""
    return not isinstance(raw, float) or math.isfinite(raw)


def _unknown(key: str, value: object, path: str, near: list[str], known: list[str]) -> str:
    name = key if _BARE_KEY.fullmatch(key) else show(key)
    where = f"{path}.{name}" if path else name
    hint = f"did you mean {near[0]}?" if near else f"known here: {', '.join(known)}"
    return f"{where} = {show(value)}: unknown key; {hint}"


def expected(kind: inspect.Type) -> str:
    """Return words for the valid values, such as "a number from 0 to 10 m/s"."""
    unit = ""
    if isinstance(kind, inspect.Metadata):
        unit = str((kind.extra or {}).get("unit", ""))
        kind = kind.type
    match kind:
        case inspect.FloatType(ge=low, le=high) | inspect.IntType(ge=low, le=high):
            noun = "a number" if isinstance(kind, inspect.FloatType) else "a whole number"
            span = f" from {low:g} to {high:g}" if low is not None and high is not None else ""
            return f"{noun}{span}{' ' + unit if unit else ''}"
        case inspect.BoolType():
            return "true or false"
        case inspect.StrType():
            return unit or "a text in quotes"
        case inspect.LiteralType(values=values):
            return "one of " + ", ".join(show(value) for value in values)
        case inspect.UnionType(types=types):
            return " or ".join(expected(type_) for type_ in types)
        case inspect.VarTupleType(item_type=item, min_length=least, max_length=most):
            return f"a list{_entries(least, most)}, each {expected(item)}"
        case _:
            return "another kind of value"


def _entries(least: int | None, most: int | None) -> str:
    if most is None:
        return "" if least is None else f" of {least} or more entries"
    return f" of at most {most} entries" if least is None else f" of {least} to {most} entries"


def _fix(field: FieldInfo, where: str) -> str:
    if field.required:
        return f"for example {_example(field)}"
    return f"the default is {where.rpartition('.')[2]} = {show(field.default)}"


def _example(field: FieldInfo) -> str:
    kind = inspect.type_info(field.type)
    extra = kind.extra if isinstance(kind, inspect.Metadata) else None
    return show((extra or {}).get("example", 1))


def show(value: object) -> str:
    """Return a value in TOML syntax, cut to at most 80 characters."""
    text = write(value)
    return text if len(text) <= 80 else text[:77] + "..."


def write(value: object) -> str:
    """Return a value in TOML syntax."""
    match value:
        case bool():
            return "true" if value else "false"
        case str():
            # JSON's escapes are valid in TOML, except that TOML also requires an escape for DEL.
            return msgspec.json.encode(value).decode().replace("\x7f", "\\u007f")
        case list() | tuple():
            return "[" + ", ".join(write(item) for item in value) + "]"
        case Mapping():
            return "{" + ", ".join(f"{key} = {write(item)}" for key, item in value.items()) + "}"
        case _:
            try:
                return str(value)
            except ValueError:
                return "a number with thousands of digits"
