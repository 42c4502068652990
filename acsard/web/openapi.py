"""Describes the page's interface for programs as an OpenAPI 3.1 document. This module is pure.

The paths come from the table `app.ROUTES`. The schemas come from the msgspec types and from
`json_schema.SCHEMAS`. So a new route, key or field appears in the document without a change here.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import Annotated, Any

import msgspec
from msgspec import Meta, Struct

from acsard.core.messages.json_schema import SCHEMAS
from acsard.core.messages.keys_and_roles import FOLLOWED
from acsard.core.messages.schema import Beat
from acsard.web import socket_messages
from acsard.web.routes import JSON, Body, Problem, Route
from acsard.web.socket_messages import MESSAGE_TYPES

Described = dict[str, Any]

# References to the schemas, by type.
Refs = dict[Any, Described]

# Schemas of the messages of clients, and of those of the server.
TO_ROBOT, FROM_ROBOT = "ToRobot", "FromRobot"

# Prefix of the schemas of the values of subscribed keys.
VALUE_PREFIX = "Value."

SENT_MESSAGES = (
    socket_messages.Hello, socket_messages.DrivenPath, socket_messages.Answer,
    socket_messages.Pong, socket_messages.Refused, socket_messages.DaemonUnreachable,
)  # fmt: skip

# Message types of the keys to which clients can subscribe.
KEYS = {topic.key: topic.type for topic in FOLLOWED}


def _ref(name: str) -> Described:
    return {"$ref": f"#/components/schemas/{name}"}


def _raw(schema: Described) -> Any:
    return Annotated[msgspec.Raw, Meta(extra_json_schema=schema)]


def _value(key: str, kind: str) -> type[Struct]:
    return msgspec.defstruct(
        VALUE_PREFIX + key.replace("/", "."),
        [
            ("value", _raw({"anyOf": [_ref(kind), {"type": "null"}]})),
            ("age", Annotated[float, Meta(ge=0, description="ms")]),
        ],
        namespace={
            "__doc__": "The newest message of this Zenoh key; null if the message is not readable."
        },
        tag_field="key",
        tag=key,
    )


VALUE_MESSAGES = tuple(_value(key, kind) for key, kind in KEYS.items())

# Errors that any path may return, by HTTP status.
ERRORS = {
    "401": "The token is missing or not valid.",
    "403": (
        "The role of the token is too low, or the request came through a proxy or from another "
        "web page."
    ),
    "429": "Too many requests with this token.",
    "default": "Any other failure.",
}


def document(version: str, routes: Sequence[Route]) -> Described:
    """Return the OpenAPI document of the routes that have a summary."""
    described = [row for row in routes if row.summary]
    bodies = [body.kind for row in described for body in row.gives.values()]
    bodies += [row.takes for row in described if row.takes is not None]
    own = [kind for kind in bodies if not isinstance(kind, str)]
    schemas, refs = _components(
        [Problem, *own, *MESSAGE_TYPES.values(), *SENT_MESSAGES, *VALUE_MESSAGES]
    )
    for kind in MESSAGE_TYPES.values():
        schemas[kind.__name__]["x-least-role"] = kind.least
    messages, of_the_socket = _messages(), _of_the_socket(refs)
    del schemas[Beat.__name__]  # `messages` has it, too
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
    operation: Described = {
        "summary": row.summary,
        # The first alternative is a client on the robot itself.
        "security": [{}] if row.least is None else [{}, {"token": [row.least]}],
        "responses": {status: _answer(body, refs) for status, body in answers.items()},
    }
    if row.parameters:
        operation["parameters"] = [
            {"name": name, "in": "path", "required": True, "schema": {"type": "string"}}
            for name in row.parameters
        ]
    if row.takes is not None:
        content = {JSON: {"schema": _schema(row.takes, refs)}}
        operation["requestBody"] = {"required": _needed(row.takes), "content": content}
    if 101 in row.gives:
        operation["x-messages"] = {"to": _ref(TO_ROBOT), "from": _ref(FROM_ROBOT)}
    return operation


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
    # The types in `$defs` become schemas of their own, because most programs that read the document
    # cannot resolve `$defs`.
    schemas: Described = {}
    for name, schema in SCHEMAS.items():
        whole = _flat(schema, f"{name}.")
        parts = whole.pop("$defs")
        schemas[name] = {key: value for key, value in whole.items() if key[0] != "$"}
        schemas |= {f"{name}.{part}": value for part, value in parts.items()}
    return schemas


def _flat(node: Any, before: str) -> Any:
    if isinstance(node, list):
        return [_flat(item, before) for item in node]
    if not isinstance(node, dict):
        return node
    if isinstance(ref := node.get("$ref"), str):
        return {"$ref": ref.replace("#/$defs/", f"#/components/schemas/{before}")}
    return {key: _flat(value, before) for key, value in node.items()}


def _components(kinds: Iterable[Any]) -> tuple[Described, Refs]:
    # Pass all types to msgspec in one call. Only then does msgspec give different schema names to
    # two types with equal names.
    unique = list(dict.fromkeys(kinds))
    refs, parts = msgspec.json.schema_components(
        unique,
        ref_template=_ref("{name}")["$ref"],
        schema_hook=lambda _: {"description": "anything"},
    )
    plain: Described = msgspec.json.decode(msgspec.json.encode(parts))  # tuples become lists
    return plain, dict(zip(unique, refs, strict=True))


def _of_the_socket(refs: Refs) -> Described:
    from_robot = [refs[kind] for kind in (*SENT_MESSAGES, *VALUE_MESSAGES)]
    to_robot = [refs[kind] for kind in MESSAGE_TYPES.values()]
    return {
        TO_ROBOT: {"title": TO_ROBOT, "oneOf": to_robot},
        FROM_ROBOT: {"title": FROM_ROBOT, "oneOf": from_robot},
    }
