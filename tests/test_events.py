"""The names of events form a closed set, and the service's page lists all of them."""

from __future__ import annotations

import ast
import re
from pathlib import Path
from typing import get_args

import pytest

from acsard.core.values import EventName, Verb

ROOT = Path(__file__).parents[1]
NAMES = get_args(EventName)


def named() -> set[str]:
    """Return the name of each event and log line in the code of acsard."""
    names = set()
    for path in (ROOT / "acsard").rglob("*.py"):
        code = path.read_text(encoding="utf-8")
        if "Event(" not in code and "log.info(" not in code:
            continue
        for node in ast.walk(ast.parse(code)):
            if not (isinstance(node, ast.Call) and node.args):
                continue
            first = node.args[0]
            if isinstance(first, ast.Constant) and isinstance(first.value, str):
                last = node.func.attr if isinstance(node.func, ast.Attribute) else ""
                called = ast.unparse(node.func) if last in ("", "info") else last
                if called == "Event" or called.endswith("log.info"):
                    names.add(first.value)
    return names


@pytest.mark.slow
def test_each_event_name_in_the_code_is_in_the_set() -> None:
    names = named()
    assert len(names) > 15
    assert names <= set(NAMES)


def test_each_event_name_of_the_set_is_in_the_code() -> None:
    code = "".join(
        path.read_text(encoding="utf-8")
        for path in (ROOT / "acsard").rglob("*.py")
        if path.name != "values.py"
    )
    plain = set(NAMES) - set(get_args(Verb))
    assert not {name for name in plain if f'"{name}"' not in code}


def test_the_page_lists_exactly_the_event_names_of_the_set() -> None:
    page = (ROOT / "deploy/systemd/README.md").read_text(encoding="utf-8")
    table = page.partition("| meaning | event |")[2].partition("\n\n")[0]
    cells = [row.split("|")[2] for row in table.splitlines()[2:]]
    assert re.findall(r"`(\w+)`", "".join(cells)) == list(NAMES)
