"""Reads the type of a struct for `cdr.py`: its fields in order, and how to build an instance.

A number declares its width with `Meta(extra={"cdr": code})`, a format character of Python's
`struct` (`B i I q Q`, or `f`); a `float` without one is a float64. None in a `float | None` is NaN.
A list whose `Meta` fixes its length is an array.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from typing import Any

from msgspec import inspect

# Bytes, also the alignment, by Python's `struct`.
SIZES = {"d": 8, "f": 4, "q": 8, "Q": 8, "i": 4, "I": 4, "B": 1, "?": 1}

# Builds a struct from the values of its fields in order, those of nested structs one by one.
Build = Callable[[Iterator[object]], object]

Limit = tuple[float, float]  # least and greatest value of a number


def struct_info(cls: Any) -> inspect.StructType:
    """Return the information of a struct type. Raises `TypeError` for any other type."""
    info = inspect.type_info(cls)
    if not isinstance(info, inspect.StructType):
        raise TypeError(f"{cls} is not a struct")
    return info


def leaves(info: inspect.StructType, path: str = "") -> Iterator[tuple[str, inspect.Type]]:
    """Yield the dotted path, after a prefix, and the type of each field that is no struct."""
    for field in info.fields:
        kind = plain(field.type)
        if isinstance(kind, inspect.StructType):
            yield from leaves(kind, f"{path}{field.name}.")
        else:
            yield path + field.name, field.type


def builder(info: inspect.StructType) -> Build:
    """Return a function that builds the struct from the values of its `leaves`."""
    kinds = [plain(field.type) for field in info.fields]
    children = [builder(kind) if isinstance(kind, inspect.StructType) else next for kind in kinds]
    names = [field.name for field in info.fields]
    return lambda values: info.cls(
        **{name: child(values) for name, child in zip(names, children, strict=True)}
    )


def plain(kind: inspect.Type) -> inspect.Type:
    """Return the type `kind` without its msgspec metadata."""
    return kind.type if isinstance(kind, inspect.Metadata) else kind


def number_code(kind: inspect.Type) -> str:
    """Return the character in Python's `struct` of a number type; "" for others.

    Raises `TypeError` for an int that does not declare its width.
    """
    extra = kind.extra if isinstance(kind, inspect.Metadata) else None
    code = str((extra or {}).get("cdr", ""))
    match plain(kind):
        case inspect.FloatType():
            return code or "d"
        case inspect.UnionType(types=(number, inspect.NoneType())) if _is_float(number):
            return number_code(number)
        case inspect.BoolType():
            return "?"
        case inspect.IntType():
            if not code:
                raise TypeError('an int needs its width: Meta(extra={"cdr": code})')
            return code
    return ""


def _is_float(kind: inspect.Type) -> bool:
    return isinstance(plain(kind), inspect.FloatType)


def nullable(kind: inspect.Type) -> bool:
    """Return whether the type allows None, which CDR encodes as NaN."""
    return isinstance(plain(kind), inspect.UnionType)


def limit(kind: inspect.Type) -> Limit | None:
    """Return the least and the greatest value of an int type with bounds, or None."""
    number = plain(kind)
    if not isinstance(number, inspect.IntType):
        return None
    low = [number.ge, None if number.gt is None else number.gt + 1]
    high = [number.le, None if number.lt is None else number.lt - 1]
    least = max((bound for bound in low if bound is not None), default=float("-inf"))
    most = min((bound for bound in high if bound is not None), default=float("inf"))
    return None if (least, most) == (float("-inf"), float("inf")) else (least, most)
