"""The messages of `/ws` in both directions as JSON Schemas for the OpenAPI document.

This module is pure. The value of a subscribed key refers to the schema of its message type.
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
"""Names of the schemas of all messages that the WebSocket accepts, and of all that it sends."""

VALUE = "Value."
"""Prefix of the schema name of a key's message."""

GUIDED = "Guided"

SENT = (
    told.Hello, told.Way, told.LastMinute, told.Answer, told.Rows, told.Pong, told.Refused,
    told.Gone,
)  # fmt: skip

LINES = (
    told.Running, told.Ended, lines.Subject, lines.Told, lines.Doing, lines.Progress,
    lines.Question, lines.Found, lines.Result,
)  # fmt: skip
"""Types of the content of `guide`."""

KEYS = {topic.key: topic.type for topic in PUBLISHED} | {IMU: "Imu"}
"""Type of each key that can be subscribed to."""


def schemas() -> Described:
    """Return the schemas by name."""
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
    """Return the schemas of `kinds` and their nested types, and references to `kinds`."""
    refs, parts = msgspec.json.schema_components(
        kinds,
        ref_template=_ref("{name}")["$ref"],
        schema_hook=lambda _: {"description": "anything"},
    )
    plain: Described = msgspec.json.decode(msgspec.json.encode(parts))  # tuples become lists
    return plain, list(refs)


def _value(key: str, kind: str) -> Described:
    """Return the schema of the message that `to_browser.Following` builds for a key."""
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
