"""What `/ws` says, held against the OpenAPI document by a validator that is not ours."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from jsonschema import Draft202012Validator

from acsard.web.openapi import document
from acsard.web.socket_schemas import FROM_ROBOT, GUIDED

COMPONENTS = document("1")["components"]

SCHEMAS = COMPONENTS["schemas"]

NO_VALUE = {"of": "nothing"}
"""What no field may be."""


def _judge(schema: dict[str, Any]) -> Draft202012Validator:
    return Draft202012Validator({"components": COMPONENTS, **schema})


def _judges(kinds: Iterable[dict[str, Any]]) -> dict[str, Draft202012Validator]:
    return {one["$ref"].rpartition("/")[2]: _judge(one) for one in kinds}


FRAMES = _judges(SCHEMAS[FROM_ROBOT]["oneOf"])

GUIDES = _judges(SCHEMAS[GUIDED]["properties"]["guide"]["oneOf"])

_FRAME = _judge({"$ref": f"#/components/schemas/{FROM_ROBOT}"})


def kinds(frames: Iterable[Any]) -> set[str]:
    """What they are; fails for one that is described by none or by several."""
    found = set()
    for frame in frames:
        (kind,) = [name for name, judge in FRAMES.items() if judge.is_valid(frame)] or [frame]
        assert _FRAME.is_valid(frame), frame
        found.add(kind)
        if kind == GUIDED:
            (line,) = [name for name, judge in GUIDES.items() if judge.is_valid(frame["guide"])]
            found.add(line)
    return found


def spoilt(frame: dict[str, Any]) -> list[dict[str, Any]]:
    """The same with a field that is missing, or another thing than it has to be."""
    without = [{key: one for key, one in frame.items() if key != name} for name in frame]
    return without + [frame | {name: NO_VALUE} for name in frame]


def taken(frame: dict[str, Any]) -> bool:
    """It is as described."""
    return bool(_FRAME.is_valid(frame))
