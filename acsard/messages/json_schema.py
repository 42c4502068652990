"""The JSON Schemas that `schema/<Type>` answers with: what goes out, what comes in, `config`.

What goes out has all its fields, and in later versions more: all are required, others allowed.
What comes in may leave out what has a default, and an unknown field is refused. A type that goes
both ways has two schemas: by its name what goes out, with `In` behind it what comes in.
"""

from __future__ import annotations

from typing import Any

import msgspec

from acsard.config.settings import Config
from acsard.messages.schema import (
    MESSAGES,
    DoorState,
    Imu,
    JointState,
    Release,
    SetPose,
    Settings,
    Twist,
    TwistStamped,
)

DIALECT = "https://json-schema.org/draft/2020-12/schema"

ONLY_IN = (Twist, SetPose, Release, Settings, DoorState)
BOTH_WAYS = (TwistStamped, JointState, Imu)

ENOUGH: dict[type, list[str]] = {
    TwistStamped: ["twist"],
    JointState: ["name", "velocity"],
    Imu: ["angular_velocity"],
}
"""The fields that must come in, where those are not all that have no default."""

Schema = dict[str, Any]


def going_out(cls: type, name: str) -> Schema:
    """The schema of a type as the daemon writes it."""
    schema = _described(cls, name)
    for part in (schema, *schema["$defs"].values()):
        if "properties" in part:
            part.pop("additionalProperties", None)
            part["required"] = list(part["properties"])
            for field in part["properties"].values():
                field.pop("default", None)
    return schema


def coming_in(cls: type, name: str) -> Schema:
    """The schema of a type as the daemon takes it."""
    schema = _described(cls, name)
    return schema | {"required": ENOUGH[cls]} if cls in ENOUGH else schema


def _described(cls: type, name: str) -> Schema:
    # A pattern is ECMAScript's, which has no \Z and whose $ is just that.
    text = msgspec.json.encode(msgspec.json.schema(cls)).replace(rb'\\Z"', b'$"')
    whole: Schema = msgspec.json.decode(text)
    parts, own = whole["$defs"], whole["$ref"].rpartition("/")[2]
    top: Schema = parts.pop(own) | {"title": name}
    return {"$schema": DIALECT, "$id": f"urn:acsard:{name}.v1"} | top | {"$defs": parts}


SCHEMAS: dict[str, Schema] = {
    **{
        name: (coming_in if cls in ONLY_IN else going_out)(cls, name)
        for name, cls in MESSAGES.items()
    },
    **{f"{cls.__name__}In": coming_in(cls, f"{cls.__name__}In") for cls in BOTH_WAYS},
    "Config": going_out(Config, "Config"),
}
"""By the name that stands in the key."""
