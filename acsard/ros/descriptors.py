"""The descriptors for `describe_parameters`: description, range, and when a key may be set.

They are derived from the declarations that the configuration is checked with, so both agree.
"""

from __future__ import annotations

from functools import cache
from typing import Annotated

from msgspec import Meta, Struct, inspect
from msgspec.structs import fields

from acsard.config.live import WHEN, live
from acsard.config.settings import Config
from acsard.config.validation import expected

Unsigned8 = Annotated[int, Meta(extra={"cdr": "B"})]
Signed64 = Annotated[int, Meta(extra={"cdr": "q"})]
Unsigned64 = Annotated[int, Meta(extra={"cdr": "Q"})]


class FloatingPointRange(Struct, frozen=True):
    """Bounds of a float parameter."""

    from_value: float
    to_value: float
    step: float


class IntegerRange(Struct, frozen=True):
    """Bounds of an integer parameter."""

    from_value: Signed64
    to_value: Signed64
    step: Unsigned64


class ParameterDescriptor(Struct, frozen=True):
    """Descriptor of a parameter."""

    name: str
    type: Unsigned8
    description: str = ""
    additional_constraints: str = ""
    read_only: bool = True
    dynamic_typing: bool = False
    floating_point_range: list[FloatingPointRange] = []
    integer_range: list[IntegerRange] = []


def described(name: str, type_of: int) -> ParameterDescriptor:
    """Return a parameter's descriptor; `type_of` is its ROS type, 0 for an unknown parameter."""
    if not type_of:
        return ParameterDescriptor(name, type_of)
    return _described(name, type_of)


# The cache stays small: there are about a hundred known names.
@cache
def _described(name: str, type_of: int) -> ParameterDescriptor:
    kind, row = kind_of(name), live(name)
    words = expected(kind)
    bounds = kind.type if isinstance(kind, inspect.Metadata) else kind
    floats, whole = [], []
    match bounds:
        case inspect.FloatType(ge=float(low), le=float(high)):
            floats = [FloatingPointRange(low, high, 0.0)]
        case inspect.IntType(ge=int(low), le=int(high)):
            whole = [IntegerRange(low, high, 1)]
    return ParameterDescriptor(
        name,
        type_of,
        words if row is None else f"{row.what}: {words}",
        "acsard.toml and a start" if row is None else WHEN[row.when],
        read_only=row is None,
        floating_point_range=floats,
        integer_range=whole,
    )


def kind_of(name: str) -> inspect.Type:
    """Return the declared type of a key of `acsard.toml`.

    A source is named in place of its index. Raises `KeyError` if the key is a table.
    """
    cls: type[Struct] = Config
    parts = iter(name.split("."))
    for part in parts:
        (field,) = (one for one in fields(cls) if one.encode_name == part)
        kind = inspect.type_info(field.type)
        if isinstance(kind, inspect.VarTupleType) and isinstance(
            kind.item_type, inspect.StructType
        ):
            next(parts)
            kind = kind.item_type
        if not isinstance(kind, inspect.StructType):
            return kind
        cls = kind.cls
    raise KeyError(name)
