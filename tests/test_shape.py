"""The structure of the code follows rules: the core is pure, imports point one way, words are few.

`lint-imports` checks the contracts in `pyproject.toml`. They say which package may import which
other one, and that `acsard/core/` imports no clock, socket, thread, asyncio or logging.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from functools import cache
from itertools import pairwise
from pathlib import Path
from typing import get_args

import pytest

from acsard.core.values import EventName, Verb

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "acsard"

IMPURE_CALLS = {"open", "print", "input", "exec", "eval", "__import__"}

# The functions of module `time` that read a clock. client/ and cli/ are tools for which a person
# waits, so they may use `time.monotonic`.
CLOCKS = {
    "time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns",
    "clock_gettime", "clock_gettime_ns",
}  # fmt: skip

# The clocks that `clock_gettime_ns` may read. The last two reveal a suspend.
KINDS = {"CLOCK_MONOTONIC_RAW", "CLOCK_MONOTONIC", "CLOCK_BOOTTIME"}

# Users see the fields of these types, so they may have a string below them.
TYPES_OF_USERS = ("core/config/settings.py", "core/messages/schema.py", "web/socket_messages.py")

FUNCTIONS = (ast.FunctionDef, ast.AsyncFunctionDef)


# Only the process that runs these tests parses the code.
@cache
def code() -> dict[str, str]:
    return {
        str(path.relative_to(PACKAGE)): path.read_text(encoding="utf-8")
        for path in sorted(PACKAGE.rglob("*.py"))
    }


@cache
def nodes() -> dict[str, list[ast.AST]]:
    return {module: list(ast.walk(ast.parse(text, module))) for module, text in code().items()}


@pytest.fixture(scope="module", autouse=True)
def _parsed() -> None:
    """No single test pays for the parsing of all code."""
    nodes()


@cache
def methods() -> dict[str, set[str]]:
    return {
        node.name: {item.name for item in node.body if isinstance(item, FUNCTIONS)}
        for all_nodes in nodes().values()
        for node in all_nodes
        if isinstance(node, ast.ClassDef)
    }


def imported(module: str) -> Iterator[str]:
    """Yield the dotted names that a module imports anywhere, with `from a import b` as `a.b`."""
    for node in nodes()[module]:
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide where a name comes from"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


# imports


def test_a_module_of_the_core_neither_opens_nor_prints() -> None:
    calls = {
        (module, node.func.id)
        for module in code()
        if module.startswith("core/")
        for node in nodes()[module]
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    assert len(calls) > 1000
    assert not {(module, name) for module, name in calls if name in IMPURE_CALLS}


def test_the_init_of_a_package_imports_nothing() -> None:
    for module in code():
        package, _, name = module.rpartition("/")
        if name == "__init__.py" and package not in ("cli", "client"):
            assert list(imported(module)) == [], module


def test_only_the_clock_reads_a_clock() -> None:
    """The modules of the daemon share one clock."""
    for module in code():
        if module.partition("/")[0] not in ("host", "daemon", "recording"):
            continue
        names = set(imported(module))
        read = {name.removeprefix("time.") for name in names if name.startswith("time.")}
        read |= {
            node.attr
            for node in nodes()[module]
            if isinstance(node, ast.Attribute) and ast.unparse(node.value) == "time"
        }
        if module == "host/clock.py":
            assert read == {"clock_gettime_ns", "time_ns", *KINDS}
        else:
            assert not read & CLOCKS, module
            assert "datetime" not in {name.partition(".")[0] for name in names}, module


def test_only_calibrate_needs_numpy() -> None:
    code = (
        "import sys; sys.modules['numpy'] = None; from acsard.cli import VERBS, main, parser; "
        "parser(set(VERBS) - {'calibrate'}); main(['calibrate'])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.stderr == (
        "acsard: this subcommand needs the library numpy: type `sudo apt install python3-numpy`\n"
    )


# docstrings


def documented(docstring: str) -> list[str]:
    """Return the names of the arguments in the section `Args:` of a docstring."""
    section = re.split(r"\n(?=\S)", docstring.partition("\nArgs:\n")[2])[0]
    lines = (re.match(r"    ([*\w]+(?:, [*\w]+)*):", line) for line in section.splitlines())
    return [name.strip().lstrip("*") for line in lines if line for name in line[1].split(",")]


def parameters(node: ast.AST) -> list[str]:
    """Return the parameters of a function, or of the `__init__` of a class."""
    if isinstance(node, ast.ClassDef):
        made = [item for item in node.body if getattr(item, "name", "") == "__init__"]
        return parameters(made[0]) if made else []
    assert isinstance(node, FUNCTIONS)
    args = node.args
    found = [*args.posonlyargs, *args.args, args.vararg, *args.kwonlyargs, args.kwarg]
    return [arg.arg for arg in found if arg is not None]


def test_a_docstring_lists_the_arguments_that_the_function_has() -> None:
    for module in code():
        for node in nodes()[module]:
            if not isinstance(node, (*FUNCTIONS, ast.ClassDef)):
                continue
            if names := documented(ast.get_docstring(node) or ""):
                wanted = [name for name in parameters(node) if name not in ("self", "cls")]
                assert [name for name in names if name != "cls"] == wanted, (module, node.name)


def is_string(node: ast.stmt) -> bool:
    return isinstance(node, ast.Expr) and isinstance(getattr(node.value, "value", None), str)


def superfluous(module: str) -> Iterator[str]:
    """Yield each docstring of a private name or an override, and each string of an assignment."""
    for node in nodes()[module]:
        body = getattr(node, "body", None)
        if not isinstance(body, list):
            continue
        bases = {ast.unparse(base).rpartition(".")[2] for base in getattr(node, "bases", ())}
        silent = set[str]().union(*(methods().get(base, ()) for base in bases))
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
    assert [text for module in code() for text in superfluous(module)] == []


# events


def logged() -> set[str]:
    """Return the name of each event and log line in the code."""
    names = set()
    for module, text in code().items():
        if "Event(" not in text and "log.info(" not in text:
            continue
        for node in nodes()[module]:
            if isinstance(node, ast.Call) and node.args and isinstance(node.args[0], ast.Constant):
                called = ast.unparse(node.func)
                if called.split(".")[-1] == "Event" or called.endswith("log.info"):
                    names.add(str(node.args[0].value))
    return names


def test_the_names_of_events_are_a_closed_set_that_the_manual_lists() -> None:
    events, names = get_args(EventName), logged()
    assert len(names) > 15
    assert names <= set(events)
    texts = "".join(text for module, text in code().items() if module != "core/values.py")
    assert not {n for n in {*events} - {*get_args(Verb)} if f'"{n}"' not in texts}
    page = (ROOT / "deploy/manual/pages/reference/events.md").read_text(encoding="utf-8")
    table = page.partition("| event | level | meaning |")[2].partition("\n\n")[0]
    cells = [row.split("|")[1] for row in table.splitlines()[2:]]
    assert re.findall(r"`(\w+)`", "".join(cells)) == list(events)
