"""Only a short, fixed list of paths needs no token or has no limit."""

from __future__ import annotations

import re
from collections import Counter
from pathlib import Path

from acsard.core.messages.keys_and_roles import SERVICES, row_of
from acsard.core.messages.permissions import SERVICE_ROLES
from acsard.web.app import ROUTES

PAGE = (Path(__file__).parents[3] / "deploy/web/README.md").read_text()


def test_each_method_of_a_path_has_one_row() -> None:
    assert max(Counter((row.method, row.path) for row in ROUTES).values()) == 1


def test_only_the_page_s_own_files_and_the_token_are_open_to_strangers() -> None:
    is_open = {row.path for row in ROUTES if row.least is None}
    assert is_open == {"/", "/favicon.ico", "/page/{name}", "/token"}


def test_only_a_stop_is_served_beyond_the_limits_of_a_token() -> None:
    assert {row.path for row in ROUTES if row.always} == {"/api/srv/stop"}


def test_each_service_has_the_role_that_the_bus_asks_for() -> None:
    roles = {row.path: row.least for row in ROUTES if row.method == "POST"}
    assert {verb: roles[f"/api/srv/{verb}"] for verb in SERVICES} == SERVICE_ROLES


def test_a_parameter_is_one_part_of_a_path() -> None:
    for row in ROUTES:
        parts = [part for part in row.path.split("/") if "{" in part]
        assert parts == [f"{{{name}}}" for name in row.parameters], row.path


def named(cell: str) -> set[tuple[str, str]]:
    """Return the method with each path that the first cell of a table row on the page names."""
    method = re.search("GET|POST", cell)
    return {(method[0], path) for path in re.findall(r"(/\S+)`", cell)} if method else set()


def test_the_page_has_a_row_for_each_path_that_programs_may_use() -> None:
    table = PAGE.partition("| request | meaning |")[2].partition("Over the WebSocket")[0]
    routes = {
        route for line in table.splitlines() for route in named("".join(line.split("|")[1:2]))
    }
    rows = {(row.method, row.path.replace("{name}", "NAME")) for row in ROUTES if row.summary}
    of_the_bus = {route for route in rows if row_of(route[1].removeprefix("/api/")) is not None}
    elsewhere = {("GET", "/api")}  # in a sentence
    assert routes - of_the_bus - {("GET", "/api/schema/Twist")} == rows - of_the_bus - elsewhere
