"""Makes the strict form of a message type, for what the daemon receives.

The message types themselves are lenient: a client ignores fields that it does not know, so that it
understands a newer daemon. A command with a misspelled axis must be refused, because otherwise the
speed on that axis would silently be zero. So the daemon decodes with the strict form.
"""

from __future__ import annotations

from functools import cache
from types import GenericAlias, UnionType
from typing import Annotated, Any, Union, get_args, get_origin

import msgspec
from msgspec import Struct
from msgspec.structs import fields


@cache
def strict(kind: type[Struct]) -> type[Struct]:
    """Return a subclass whose decoding refuses unknown fields, in all parts of the message too."""
    return msgspec.defstruct(
        kind.__name__,
        [(field.name, _strict_type(field.type), _default(field)) for field in fields(kind)],
        bases=(kind,),
        module=kind.__module__,
        namespace={"__doc__": kind.__doc__},
        frozen=True,
        kw_only=True,
        forbid_unknown_fields=True,
    )


def _default(field: msgspec.structs.FieldInfo) -> Any:
    if field.default_factory is not msgspec.NODEFAULT:
        return msgspec.field(default_factory=field.default_factory)
    return msgspec.field() if field.required else msgspec.field(default=field.default)


def _strict_type(kind: Any) -> Any:
    if isinstance(kind, type) and issubclass(kind, Struct):
        return strict(kind)
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Annotated:
        return Annotated[(_strict_type(parts[0]), *parts[1:])]
    if origin in (Union, UnionType):
        return Union[tuple(map(_strict_type, parts))]  # noqa: UP007
    if origin in (list, tuple, dict):
        return GenericAlias(origin, tuple(map(_strict_type, parts)))
    return kind
