"""The page's interface for programs as an OpenAPI 3.1 document. This module is pure.

The paths come from the table `app.ROUTES`, and the schemas from msgspec and `json_schema.SCHEMAS`.
So a new route, key or field appears in the document without a change here.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated, Any

import msgspec
from msgspec import Meta, Struct

from acsard.core.messages.json_schema import SCHEMAS
from acsard.core.messages.keys_and_roles import FOLLOWED
from acsard.terminal import json_prompt
from acsard.web import socket_messages
from acsard.web.routes import Body, Problem, Route
from acsard.web.socket_messages import KINDS

Described = dict[str, Any]

Refs = dict[Any, Described]
"""Maps each type to a reference to its schema."""

TO_ROBOT, FROM_ROBOT = "ToRobot", "FromRobot"
"""Names of two schemas: that of the WebSocket messages that clients send, and that of the messages
that the server sends."""

VALUE = "Value."
"""Prefix of the schema names for the messages of subscribed keys."""

GUIDED = "Guided"

SENT = (
    socket_messages.Hello, socket_messages.DrivenPath, socket_messages.LastMinute,
    socket_messages.Answer, socket_messages.Rows, socket_messages.Pong, socket_messages.Refused,
    socket_messages.Gone,
)  # fmt: skip

LINES = (
    socket_messages.Running, socket_messages.Ended, json_prompt.Subject,
    json_prompt.JobMessage, json_prompt.Doing, json_prompt.Progress, json_prompt.Question,
    json_prompt.Found, json_prompt.Result,
)  # fmt: skip
"""Types of the values that the field `guide` of a WebSocket message may have. The field reports on
a running check or calibration."""

KEYS = {topic.key: topic.type for topic in FOLLOWED}
"""Message type of each key to which a client can subscribe."""


def _ref(name: str) -> Described:
    return {"$ref": f"#/components/schemas/{name}"}


def _raw(schema: Described) -> Any:
    return Annotated[msgspec.Raw, Meta(extra_json_schema=schema)]


def _value(key: str, kind: str) -> type[Struct]:
    """Return the type of the WebSocket messages that contain the values of the key `key`.

    `kind` is the name of the schema of these values.
    """
    return msgspec.defstruct(
        VALUE + key.replace("/", "."),
        [
            ("value", _raw({"anyOf": [_ref(kind), {"type": "null"}]})),
            ("age", Annotated[float, Meta(ge=0, description="ms")]),
            ("robot", Annotated[str, Meta(description="only for another robot")], ""),
        ],
        namespace={
            "__doc__": "The newest message of this Zenoh key; null if the message is not readable."
        },
        tag_field="key",
        tag=key,
    )


VALUES = tuple(_value(key, kind) for key, kind in KEYS.items())

ERRORS = {
    "401": "The token is missing or not valid.",
    "403": (
        "The role of the token is too low, or the request came through a proxy or from another "
        "web page."
    ),
    "429": "Too many requests, or too many wrong tokens.",
    "default": "Any other failure.",
}
"""Descriptions of the errors that every path may return, by HTTP status."""


def document(version: str, routes: Sequence[Route]) -> Described:
    """Return the document that answers `GET /api`; `version` is the version of acsard."""
    described = [row for row in routes if row.summary]
    bodies = [body.kind for row in described for body in row.gives.values()]
    bodies += [row.takes for row in described if row.takes is not None]
    own = [kind for kind in bodies if not isinstance(kind, str)]
    schemas, refs = _components([Problem, *own, *KINDS.values(), *SENT, *VALUES, *LINES])
    for kind in KINDS.values():
        schemas[kind.__name__]["x-least-role"] = kind.least
    messages, of_the_socket = _messages(), _of_the_socket(refs)
    assert not (schemas | of_the_socket).keys() & messages.keys(), "two types have the same name"
    paths: Described = {}
    for row in described:
        paths.setdefault(row.path, {})[row.method.lower()] = _operation(row, refs)
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "acsard",
            "version": version,
            "description": "The interface of the robot's page for programs. A program on the "
            "robot needs no token. A program on another machine sends its token in the header "
            "`Authorization: Bearer ...`. `security` names the lowest role that may use a path.",
        },
        "paths": paths,
        "components": {
            "schemas": messages | schemas | of_the_socket,
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
    }


def _operation(row: Route, refs: Refs) -> Described:
    errors = {status: Body(what, Problem) for status, what in ERRORS.items()}
    answers = {str(status): body for status, body in row.gives.items()} | errors
    told: Described = {
        "summary": row.summary,
        # The first alternative is a client on the robot itself.
        "security": [{}] if row.least is None else [{}, {"token": [row.least]}],
        "responses": {status: _answer(body, refs) for status, body in answers.items()},
    }
    if row.parameters:
        told["parameters"] = [
            {"name": name, "in": "path", "required": True, "schema": {"type": "string"}}
            for name in row.parameters
        ]
    if row.takes is not None:
        content = {media: {"schema": _schema(row.takes, refs)} for media in row.forms}
        told["requestBody"] = {"required": _needed(row.takes), "content": content}
    if 101 in row.gives:
        told["x-messages"] = {"to": _ref(TO_ROBOT), "from": _ref(FROM_ROBOT)}
    return told


def _answer(body: Body, refs: Refs) -> Described:
    if not body.media:
        return {"description": body.what}
    content = {body.media: {"schema": _schema(body.kind, refs)}}
    return {"description": body.what, "content": content}


def _schema(kind: Any, refs: Refs) -> Described:
    if isinstance(kind, str):
        return _ref(kind) if kind else {}
    return refs[kind]


def _needed(kind: type | str) -> bool:
    if isinstance(kind, str):
        return bool(SCHEMAS[kind].get("required"))
    return any(field.required for field in msgspec.structs.fields(kind))


def _messages() -> Described:
    """Return the schemas of the bus messages, by name.

    The types in `$defs` become schemas of their own, because most programs
    that read the document cannot resolve `$defs`.
    """
    found: Described = {}
    for name, schema in SCHEMAS.items():
        whole = _flat(schema, f"{name}.")
        parts = whole.pop("$defs")
        found[name] = {key: value for key, value in whole.items() if key[0] != "$"}
        found |= {f"{name}.{part}": value for part, value in parts.items()}
    return found


def _flat(node: Any, before: str) -> Any:
    """Return a copy of `node` in which each reference to `$defs` is a reference to a component.

    `node` is a JSON Schema or a part of one. The component of the definition X is named
    `before` + X.
    """
    if isinstance(node, list):
        return [_flat(one, before) for one in node]
    if not isinstance(node, dict):
        return node
    if isinstance(ref := node.get("$ref"), str):
        return {"$ref": ref.replace("#/$defs/", f"#/components/schemas/{before}")}
    return {key: _flat(value, before) for key, value in node.items()}


def _components(kinds: Iterable[Any]) -> tuple[Described, Refs]:
    """Return a pair: schemas by name, and a reference to a schema for each type in `kinds`.

    The schemas are those of the types in `kinds` and of the types that are nested in them.
    """
    # In one call, msgspec gives different names to two types that have the same name.
    unique = list(dict.fromkeys(kinds))
    refs, parts = msgspec.json.schema_components(
        unique,
        ref_template=_ref("{name}")["$ref"],
        schema_hook=lambda _: {"description": "anything"},
    )
    plain: Described = msgspec.json.decode(msgspec.json.encode(parts))  # tuples become lists
    return plain, dict(zip(unique, refs, strict=True))


def _of_the_socket(refs: Refs) -> Described:
    """Return the schemas `ToRobot`, `FromRobot` and `Guided`, by name.

    Together they describe all WebSocket messages. `refs` maps the types of messages to references
    to their schemas.
    """
    guided = msgspec.defstruct(
        GUIDED,
        [("guide", _raw({"oneOf": [refs[kind] for kind in LINES]}))],
        namespace={"__doc__": socket_messages.Guided.__doc__},
    )
    found, own = _components([guided])
    from_robot = [*(refs[kind] for kind in (*SENT, *VALUES)), own[guided]]
    to_robot = [refs[kind] for kind in KINDS.values()]
    return found | {
        TO_ROBOT: {"title": TO_ROBOT, "oneOf": to_robot},
        FROM_ROBOT: {"title": FROM_ROBOT, "oneOf": from_robot},
    }
