"""The description has every key, and every reference in it leads somewhere."""

from __future__ import annotations

from typing import Any

from jsonschema import Draft202012Validator

from acsard.messages.topics import SERVICES, TOPICS
from acsard.web.openapi import PLAIN, asked, document

WHOLE = document("1.2.3")


def references(node: Any) -> list[str]:
    """Those outside the schemas, which are documents of their own."""
    if isinstance(node, dict):
        own = [node["$ref"]] if "$ref" in node else []
        return own + [one for value in node.values() for one in references(value)]
    if isinstance(node, list):
        return [one for value in node for one in references(value)]
    return []


def test_every_key_to_ask_for_and_every_service_is_described() -> None:
    paths = WHOLE["paths"]
    for topic in TOPICS:
        path = f"/api/{topic.key.replace('<Type>', '{type}')}"
        assert (path in paths and "get" in paths[path]) == asked(topic), path
    assert all("post" in paths[f"/api/srv/{verb}"] for verb in SERVICES)
    assert "requestBody" in paths["/api/srv/set"]["post"]


def test_every_reference_leads_to_a_schema() -> None:
    told = references(WHOLE["paths"])
    assert len(told) > 10
    for one in told:
        name = one.removeprefix("#/components/schemas/")
        assert name in WHOLE["components"]["schemas"], one


def test_every_schema_is_one_with_an_identity_of_its_own() -> None:
    for schema in WHOLE["components"]["schemas"].values():
        Draft202012Validator.check_schema(schema)
        assert schema["$id"].startswith("urn:acsard:")


def test_parameters_in_a_path_are_declared() -> None:
    for path, item in WHOLE["paths"].items():
        for action in item.values():
            names = {one["name"] for one in action.get("parameters", ())}
            assert names == {part[1:-1] for part in path.split("/") if part.startswith("{")}


def test_no_wildcard_is_a_plain_key() -> None:
    assert PLAIN.match("schema/Twist")
    assert not any(PLAIN.match(key) for key in ("schema/*", "**", "a$*", "x?fmt=cdr", "", "a" * 99))
