"""Check the messages of `/ws` against the OpenAPI document with an independent validator."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from jsonschema import Draft202012Validator

from acsard.web.app import ROUTES
from acsard.web.openapi import FROM_ROBOT, document

DOCUMENT = document("1", ROUTES)

COMPONENTS = DOCUMENT["components"]

SCHEMAS = COMPONENTS["schemas"]

NO_VALUE = {"of": "nothing"}
"""A value that is not valid for any field."""


def _judge(schema: dict[str, Any]) -> Draft202012Validator:
    return Draft202012Validator({"components": COMPONENTS, **schema})


def _judges(kinds: Iterable[dict[str, Any]]) -> dict[str, Draft202012Validator]:
    return {kind["$ref"].rpartition("/")[2]: _judge(kind) for kind in kinds}


FRAMES = _judges(SCHEMAS[FROM_ROBOT]["oneOf"])

_FRAME = _judge({"$ref": f"#/components/schemas/{FROM_ROBOT}"})


def answers(path: str, method: str, status: int, media: str, body: Any) -> bool:
    """Return whether the document describes this answer of a path."""
    described = DOCUMENT["paths"][path][method]["responses"]
    content = described.get(str(status), described["default"])["content"]
    if media not in content:
        return False
    return media != "application/json" or bool(_judge(content[media]["schema"]).is_valid(body))


def kinds(frames: Iterable[Any]) -> set[str]:
    """Return the kinds of these frames. Fails unless exactly one description matches each frame."""
    names = set()
    for frame in frames:
        (kind,) = [name for name, judge in FRAMES.items() if judge.is_valid(frame)] or [frame]
        assert _FRAME.is_valid(frame), frame
        names.add(kind)
    return names


def spoilt(frame: dict[str, Any]) -> list[dict[str, Any]]:
    """Return invalid copies of the frame: each lacks one field or has a wrong value in it."""
    without = [{key: value for key, value in frame.items() if key != name} for name in frame]
    return without + [frame | {name: NO_VALUE} for name in frame]


def is_described_frame(frame: dict[str, Any]) -> bool:
    """Return whether the frame matches the document's description of frames."""
    return bool(_FRAME.is_valid(frame))
