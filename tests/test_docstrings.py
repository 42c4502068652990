"""Private names, `__init__` and overrides have no docstring, and no string follows an assignment.

Users see the fields of the types in `TYPES_OF_USERS`, so these may have a string below them.
"""

from __future__ import annotations

import ast
from collections.abc import Iterator
from itertools import pairwise
from pathlib import Path

PACKAGE = Path(__file__).parents[1] / "acsard"

TYPES_OF_USERS = ("core/config/settings.py", "core/messages/schema.py", "web/socket_messages.py")

FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)

TREES = {
    str(path.relative_to(PACKAGE)): ast.parse(path.read_text(encoding="utf-8"))
    for path in sorted(PACKAGE.rglob("*.py"))
}
METHODS = {
    node.name: {item.name for item in node.body if isinstance(item, FUNCTIONS)}
    for tree in TREES.values()
    for node in ast.walk(tree)
    if isinstance(node, ast.ClassDef)
}


def is_string(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(getattr(node.value, "value", None), str)


def findings(module: str) -> Iterator[str]:
    """Yield the place of each string of a module that the rules forbid."""
    for node in ast.walk(TREES[module]):
        body = getattr(node, "body", None)
        if not isinstance(body, list):
            continue
        bases = {ast.unparse(base).rpartition(".")[2] for base in getattr(node, "bases", ())}
        silent = set[str]().union(*(METHODS.get(base, ()) for base in bases))
        for item in body:
            if not isinstance(item, (*FUNCTIONS, ast.ClassDef)) or not is_string(item.body[0]):
                continue
            if item.name[0] == "_" or item.name in silent:
                yield f"{module}:{item.lineno} a docstring of {item.name}"
        if module not in TYPES_OF_USERS:
            for before, item in pairwise(body):
                if is_string(item) and isinstance(before, ast.Assign | ast.AnnAssign):
                    yield f"{module}:{item.lineno} a string below an assignment"


def test_a_docstring_stands_only_where_it_says_more_than_the_name() -> None:
    assert [text for module in TREES for text in findings(module)] == []
