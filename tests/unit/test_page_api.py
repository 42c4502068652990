"""The OpenAPI description has every path, key and message, and each reference leads to a schema."""

from __future__ import annotations

import json
import re
from collections.abc import Hashable
from functools import cache
from pathlib import Path
from typing import Any

import pytest
from jsonschema import Draft202012Validator
from openapi_spec_validator import OpenAPIV31SpecValidator

from acsard.core.messages.keys_and_roles import SERVICES, TOPICS
from acsard.core.messages.permissions import SERVICE_ROLES
from acsard.web.app import ROUTES
from acsard.web.openapi import TO_ROBOT, document
from acsard.web.routes import is_queryable
from acsard.web.socket_messages import MESSAGE_TYPES, FrameError, decode
from tests.each import each


@cache
def whole() -> dict[str, Any]:
    return document("1.2.3", ROUTES)


def test_every_key_that_answers_and_every_service_is_described() -> None:
    paths = whole()["paths"]
    for topic in TOPICS:
        path = f"/api/{topic.key.replace('<Type>', '{type}')}"
        assert (path in paths and "get" in paths[path]) == is_queryable(topic), path
    assert all("post" in paths[f"/api/srv/{verb}"] for verb in SERVICES)
    bodies = {verb: paths[f"/api/srv/{verb}"]["post"].get("requestBody") for verb in SERVICES}
    assert bodies["stop"] is None
    needed = {verb: body["required"] for verb, body in bodies.items() if body is not None}
    assert (needed["set"], needed["set_pose"], needed["clear"]) == (True, True, False)
    assert paths["/token"]["post"]["requestBody"]["required"] is True


@pytest.mark.slow
def test_the_description_is_valid_openapi() -> None:
    described: dict[Hashable, Any] = dict(whole().items())
    assert [error.message for error in OpenAPIV31SpecValidator(described).iter_errors()] == []


MANUAL = Path(__file__).parents[2] / "deploy/manual/pages"

SOCKET = (MANUAL / "reference/websocket.md").read_text()

TO_IT = SOCKET.partition("| message to the robot |")[2].partition("| message from the robot |")[0]

MESSAGES = [one for one in re.findall(r"`(\{.*?\})`", TO_IT) if "..." not in one]


def test_the_page_has_a_message_of_each_kind() -> None:
    assert {type(decode(message)) for message in MESSAGES} == set(MESSAGE_TYPES.values())


@each("message", [*MESSAGES, "{}", '{"ping": 1, "call": "stop"}', '{"cmd": {}}'])
def test_the_socket_accepts_exactly_the_messages_that_its_schema_allows(message: str) -> None:
    schema = {"components": whole()["components"], "$ref": f"#/components/schemas/{TO_ROBOT}"}
    try:
        decode(message)
        valid = True
    except FrameError:
        valid = False
    assert Draft202012Validator(schema).is_valid(json.loads(message)) == valid


def test_only_the_files_of_page_and_manual_and_the_token_are_open_to_strangers() -> None:
    is_open = {row.path for row in ROUTES if row.least is None}
    assert is_open == {
        "/", "/favicon.ico", "/page/{name}", "/docs", "/docs/{file}", "/token",
    }  # fmt: skip


def test_only_a_stop_is_served_beyond_the_limits_of_a_token() -> None:
    assert {row.path for row in ROUTES if row.always} == {"/api/srv/stop"}


def test_each_service_has_the_role_that_the_bus_asks_for() -> None:
    roles = {row.path: row.least for row in ROUTES if row.method == "POST"}
    assert {verb: roles[f"/api/srv/{verb}"] for verb in SERVICES} == SERVICE_ROLES
