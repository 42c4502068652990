"""The messages of `/ws`, both ways, as JSON Schemas for the OpenAPI document; pure.

What a key's message holds is the schema of its type, which stands beside them and is referred to.
"""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import msgspec

from acsard.messages.topics import IMU, PUBLISHED
from acsard.web import lines, told
from acsard.web.frames import KINDS

Described = dict[str, Any]

TO_ROBOT, FROM_ROBOT = "ToRobot", "FromRobot"
"""Any message that the WebSocket takes, and any that it sends."""

VALUE = "Value."
"""Before the name of a key: its message as it is sent."""

GUIDED = "Guided"

SENT = (
    told.Hello, told.Way, told.LastMinute, told.Answer, told.Rows, told.Pong, told.Refused,
    told.Gone,
)  # fmt: skip

LINES = (
    told.Running, told.Ended, lines.Subject, lines.Told, lines.Doing, lines.Progress,
    lines.Question, lines.Found, lines.Result,
)  # fmt: skip
"""What stands in `guide`."""

KEYS = {topic.key: topic.type for topic in PUBLISHED} | {IMU: "Imu"}
"""What may be subscribed to, and its type."""


def schemas() -> Described:
    """By name."""
    taken, to_robot = _components(KINDS.values())
    sent, from_robot = _components(SENT)
    said, guided = _components(LINES)
    values = {VALUE + key.replace("/", "."): _value(key, kind) for key, kind in KEYS.items()}
    from_robot += [*map(_ref, values), _ref(GUIDED)]
    guide = {"type": "object", "required": ["guide"], "properties": {"guide": {"oneOf": guided}}}
    return {
        **taken,
        **sent,
        **said,
        **values,
        GUIDED: {"title": GUIDED, "description": _words(told.Guided), **guide},
        TO_ROBOT: {"title": TO_ROBOT, "oneOf": to_robot},
        FROM_ROBOT: {"title": FROM_ROBOT, "oneOf": from_robot},
    }


def _components(kinds: Iterable[type]) -> tuple[Described, list[Described]]:
    """The schemas of these and their parts; references to these."""
    refs, parts = msgspec.json.schema_components(
        kinds,
        ref_template=_ref("{name}")["$ref"],
        schema_hook=lambda _: {"description": "anything"},
    )
    plain: Described = msgspec.json.decode(msgspec.json.encode(parts))  # lists, where it has tuples
    return plain, list(refs)


def _value(key: str, kind: str) -> Described:
    """As `to_browser.Following` puts it together."""
    return {
        "title": f"{VALUE}{key}",
        "description": "The newest message of this key; null for what cannot be read.",
        "type": "object",
        "required": ["key", "value", "age"],
        "properties": {
            "key": {"const": key},
            "robot": {"type": "string", "description": "where it is not the page's own"},
            "value": {"anyOf": [_ref(kind), {"type": "null"}]},
            "age": {"type": "number", "minimum": 0, "description": "ms"},
        },
    }


def _ref(name: str) -> Described:
    return {"$ref": f"#/components/schemas/{name}"}


def _words(kind: type) -> str:
    return (kind.__doc__ or "").strip()
