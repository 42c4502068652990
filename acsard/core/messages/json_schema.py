"""Makes the JSON Schemas of the message types and of `Config`, for the key `schema/<Type>`.

A published message has all fields, and a later version may add more: its schema requires all and
allows others. A received one may omit fields with a default and must not have unknown ones. A type
for both has two, such as `Imu` and `ImuIn` (to the daemon).
"""

from __future__ import annotations

from typing import Any

import msgspec

from acsard.core.config.settings import Config
from acsard.core.messages.keys_and_roles import SERVICES
from acsard.core.messages.schema import (
    BOTH_WAYS,
    MESSAGES,
    JointState,
    Message,
    TwistStamped,
)
from acsard.core.messages.strict_types import strict

INCOMING_ONLY = {
    "Twist",
    "SpeedLimit",
    "GatewayState",
    *(service.payload for service in SERVICES.values()),
}

# Fields of received messages; those of other types need all fields without a default.
REQUIRED_FIELDS: dict[type, list[str]] = {
    TwistStamped: ["twist"],
    JointState: ["name", "velocity"],
}

Schema = dict[str, Any]


def going_out(cls: type, name: str) -> Schema:
    """Return the schema of messages that the daemon publishes."""
    schema = _described(cls, name)
    for part in (schema, *schema["$defs"].values()):
        if "properties" in part:
            part.pop("additionalProperties", None)
            part["required"] = list(part["properties"])
            for field in part["properties"].values():
                field.pop("default", None)
    return schema


def coming_in(cls: type[Message], name: str) -> Schema:
    """Return the schema of messages that the daemon accepts from clients."""
    schema = _described(strict(cls), name)
    return schema | {"required": REQUIRED_FIELDS[cls]} if cls in REQUIRED_FIELDS else schema


def _described(cls: type, name: str) -> Schema:
    # A pattern is an ECMAScript expression. It has no \Z, but its $ matches only at the end.
    text = msgspec.json.encode(msgspec.json.schema(cls)).replace(rb"\\Z", b"$")
    whole: Schema = msgspec.json.decode(text)
    parts, own = whole["$defs"], whole["$ref"].rpartition("/")[2]
    top: Schema = parts.pop(own) | {"title": name}
    dialect = "https://json-schema.org/draft/2020-12/schema"
    return {"$schema": dialect, "$id": f"urn:acsard:{name}.v1"} | top | {"$defs": parts}


# Schemas by name, as in `schema/<Type>`.
SCHEMAS: dict[str, Schema] = {
    **{
        name: (coming_in if name in INCOMING_ONLY else going_out)(cls, name)
        for name, cls in MESSAGES.items()
    },
    **{name: coming_in(cls, name) for name, cls in BOTH_WAYS.items()},
    "Config": going_out(Config, "Config"),
}
