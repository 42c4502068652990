"""What `describe_parameters` says of each key: what it is, its range and unit, when it can be set.

Taken from where the configuration is checked, so that both say the same.
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
    """Bounds of a float."""

    from_value: float
    to_value: float
    step: float


class IntegerRange(Struct, frozen=True):
    """Bounds of an integer."""

    from_value: Signed64
    to_value: Signed64
    step: Unsigned64


class ParameterDescriptor(Struct, frozen=True):
    """What a parameter is."""

    name: str
    type: Unsigned8
    description: str = ""
    additional_constraints: str = ""
    read_only: bool = True
    dynamic_typing: bool = False
    floating_point_range: list[FloatingPointRange] = []
    integer_range: list[IntegerRange] = []


def described(name: str, type_of: int) -> ParameterDescriptor:
    """The descriptor of a parameter whose value has this type; 0 is one that is not there."""
    if not type_of:
        return ParameterDescriptor(name, type_of)
    return _described(name, type_of)


@cache  # names that are there: some hundred
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
    """The type of a key of `acsard.toml`, as it is checked by; a source counts by its name."""
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
