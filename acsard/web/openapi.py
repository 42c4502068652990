"""The page's interface for programs as an OpenAPI 3.1 document. This module is pure.

The document is generated from the table of topics, from the schemas that `schema/<Type>` answers
with, and from the frames of the WebSocket. A new key or field there appears in the document by
itself.
"""

from __future__ import annotations

import re
from typing import Any

from acsard.bus.access import SERVICE_ROLES, least_role
from acsard.messages.json_schema import SCHEMAS
from acsard.messages.topics import SERVICES, TOPICS, Topic, service_key
from acsard.web import socket_schemas
from acsard.web.socket_schemas import FROM_ROBOT, TO_ROBOT

Described = dict[str, Any]

PLAIN = re.compile(r"[A-Za-z0-9_/-]{1,80}\Z")
"""Pattern of a key without wildcards."""

NOT_ASKED = ("alive", "json/<key>", "whoami/<role>")
"""Topics without a value that this interface can return."""

PAYLOADS = {"set": "Settings", "set_pose": "SetPose", "clear": "Release", "activate": "Release"}


def asked(topic: Topic) -> bool:
    """Return whether the topic has a value that a program may request."""
    return topic.direction in ("out", "query") and topic.key not in NOT_ASKED


def document(version: str) -> Described:
    """Return the document that `GET /api` answers."""
    paths: Described = {}
    for topic in TOPICS:
        if asked(topic):
            paths[f"/api/{topic.key.replace('<Type>', '{type}')}"] = {"get": _value(topic)}
    for verb in SERVICES:
        paths[f"/api/{service_key(verb)}"] = {"post": _service(verb)}
    paths |= _OTHERS
    return {
        "openapi": "3.1.0",
        "info": {
            "title": "acsard",
            "version": version,
            "description": "The robot's page, for programs. At the machine nothing is asked for; "
            "from elsewhere a token, as `Authorization: Bearer ...`.",
        },
        "paths": paths,
        "components": {
            "schemas": _keys() | socket_schemas.schemas(),
            "securitySchemes": {"token": {"type": "http", "scheme": "bearer"}},
        },
        "security": [{}, {"token": []}],
    }


def _keys() -> Described:
    """Return the schemas of all message types, with each nested type beside them as `Type.Part`.

    Most readers of OpenAPI documents cannot resolve a schema with `$defs` of its own.
    """
    found: Described = {}
    for name, schema in SCHEMAS.items():
        whole = _flat(schema, f"{name}.")
        parts = whole.pop("$defs")
        found[name] = {key: value for key, value in whole.items() if key[0] != "$"}
        found |= {f"{name}.{part}": value for part, value in parts.items()}
    return found


def _flat(node: Any, before: str) -> Any:
    """Return a schema with its `$defs` references pointed to the document's components."""
    if isinstance(node, list):
        return [_flat(one, before) for one in node]
    if not isinstance(node, dict):
        return node
    if isinstance(ref := node.get("$ref"), str):
        return {"$ref": ref.replace("#/$defs/", f"#/components/schemas/{before}")}
    return {key: _flat(value, before) for key, value in node.items()}


def _ref(name: str) -> Described:
    return {"$ref": f"#/components/schemas/{name}"} if name in SCHEMAS else {}


def _answer(what: str, schema: Described, kind: str = "application/json") -> Described:
    return {"description": what, "content": {kind: {"schema": schema}}}


_TROUBLE: Described = {
    "description": "Why not, in words.",
    "content": {
        "application/json": {
            "schema": {"type": "object", "properties": {"error": {"type": "string"}}}
        }
    },
}


def _value(topic: Topic) -> Described:
    about = f"{topic.note}; for who is at least {least_role(topic.key)}"
    told: Described = {
        "summary": about,
        "responses": {
            "200": _answer("The last value.", _ref(topic.type)),
            "default": _TROUBLE,
        },
    }
    if "<Type>" in topic.key:
        kind = {"name": "type", "in": "path", "required": True, "schema": {"type": "string"}}
        told["parameters"] = [kind]
    return told


def _service(verb: Any) -> Described:
    notes = {topic.key: topic.note for topic in TOPICS}
    told: Described = {
        "summary": f"{notes[service_key(verb)]}; for who is at least {SERVICE_ROLES[verb]}",
        "responses": {
            "200": _answer("It was done.", _ref("ServiceReply")),
            "409": _answer("It was not, and why.", _ref("ServiceReply")),
            "default": _TROUBLE,
        },
    }
    if verb in PAYLOADS:
        body = {"application/json": {"schema": _ref(PAYLOADS[verb])}}
        told["requestBody"] = {"required": PAYLOADS[verb] != "Release", "content": body}
    elif verb == "stop":
        told["requestBody"] = {"content": {"application/json": {"schema": _WHICH}}}
    return told


_WHICH: Described = {
    "type": "object",
    "properties": {"robot": {"type": "string", "description": "another one of the same router"}},
}


_NAME = {"name": "name", "in": "path", "required": True, "schema": {"type": "string"}}

_RECORDING: Described = {
    "type": "object",
    "properties": {
        "name": {"type": "string"},
        "begin": {"type": ["number", "null"], "description": "s since 1970"},
        "seconds": {"type": ["number", "null"]},
        "bytes": {"type": "integer"},
        "events": {"type": "string", "description": "what happened, in a few words"},
    },
}

_REPORT: Described = {
    "type": "object",
    "required": ["report"],
    "properties": {
        "report": {"type": "string", "enum": ["drawing", "busy", "ready", "failed"]},
        "text": {"type": "string", "description": "why it failed, or what to wait for"},
        "percent": {"type": "integer"},
        "seconds": {"type": "number", "description": "since it was begun"},
        "href": {"type": "string", "description": "where it is, from the page on"},
    },
}

_SETTING: Described = {
    "type": "object",
    "required": ["key", "value", "what", "when"],
    "properties": {
        "key": {"type": "string"},
        "value": {},
        "what": {"type": "string"},
        "when": {"type": "string"},
        "low": {"type": "number"},
        "high": {"type": "number"},
        "choices": {"type": "array", "items": {"type": "string"}},
    },
}

_CHOICES: Described = {
    "type": "object",
    "properties": {
        "ways": {
            "type": "object",
            "description": "of calibrating, and what each needs",
            "additionalProperties": {"type": "string"},
        },
        "way": {"type": "string", "description": "the one to begin with; none is the usual one"},
        "advice": {"type": "string", "description": "why that one, where it is not the usual"},
        "ports": {
            "type": "array",
            "items": {
                "type": "object",
                "properties": {"port": {"type": "string"}, "what": {"type": "string"}},
            },
        },
        "note": {"type": "string", "description": "what cannot be done here, and what to type"},
    },
}

_WHO = "Role and name, and `full`: why there is no room for one more WebSocket, or nothing."

_TOKEN: Described = {
    "type": "object",
    "required": ["token"],
    "properties": {"token": {"type": "string"}},
}

_OTHERS: Described = {
    "/ws": {
        "get": {
            "summary": "a WebSocket, JSON as text both ways: follows, drives, stops",
            "description": f"Each message to the robot is a `{TO_ROBOT}`, each from it a "
            f"`{FROM_ROBOT}`.",
            "x-messages": {
                "to": {"$ref": f"#/components/schemas/{TO_ROBOT}"},
                "from": {"$ref": f"#/components/schemas/{FROM_ROBOT}"},
            },
            "responses": {"101": {"description": "It is open."}, "default": _TROUBLE},
        }
    },
    "/token": {
        "post": {
            "summary": "a token becomes the cookie of a browser, which no script reads; by HTTPS",
            "security": [{}],
            "requestBody": {
                "required": True,
                "content": {
                    "application/json": {"schema": _TOKEN},
                    "application/x-www-form-urlencoded": {"schema": _TOKEN},
                },
            },
            "responses": {
                "303": {
                    "description": "It counts; the page is there.",
                    "headers": {
                        "Set-Cookie": {"schema": {"type": "string"}},
                        "Location": {"schema": {"type": "string"}},
                    },
                },
                "401": _TROUBLE,
                "429": _TROUBLE,
                "default": _TROUBLE,
            },
        }
    },
    "/api/whoami": {
        "get": {
            "summary": "who you are here",
            "responses": {"200": _answer(_WHO, {"type": "object"})},
        }
    },
    "/api/settings": {
        "get": {
            "summary": "what srv/set takes: values, ranges, when; for a maintainer",
            "responses": {
                "200": _answer("A list.", {"type": "array", "items": _SETTING}),
                "default": _TROUBLE,
            },
        }
    },
    "/api/guide": {
        "get": {
            "summary": "what the WebSocket takes to begin: ways to calibrate, ports to check; for "
            "a maintainer",
            "responses": {"200": _answer("Choices.", _CHOICES), "default": _TROUBLE},
        }
    },
    "/api/recordings": {
        "get": {
            "summary": "the recordings of the black box, oldest first",
            "responses": {
                "200": _answer("A list.", {"type": "array", "items": _RECORDING}),
                "default": _TROUBLE,
            },
        }
    },
    "/api/recordings/{name}": {
        "get": {
            "summary": "one of them as a file; for who is at least operator",
            "parameters": [_NAME],
            "responses": {
                "200": _answer("MCAP.", {}, "application/octet-stream"),
                "default": _TROUBLE,
            },
        }
    },
    "/api/recordings/{name}/report": {
        "post": {
            "summary": "draws its report, or says how far that is: ask again; for who is at least "
            "operator",
            "parameters": [_NAME],
            "responses": {
                "200": _answer("It is at `href`.", _REPORT),
                "202": _answer("It is being drawn, or another one is.", _REPORT),
                "503": _answer("It cannot be drawn, and why.", _REPORT),
                "default": _TROUBLE,
            },
        }
    },
    "/report/{name}": {
        "get": {
            "summary": "the report, once it is drawn; for who is at least operator",
            "parameters": [_NAME],
            "responses": {
                "200": _answer("A page.", {"type": "string"}, "text/html"),
                "default": _TROUBLE,
            },
        }
    },
    "/metrics": {
        "get": {
            "summary": "for Prometheus",
            "responses": {"200": _answer("Text.", {"type": "string"}, "text/plain")},
        }
    },
}
