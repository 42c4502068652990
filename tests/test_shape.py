"""The structure of the code follows rules: the core is pure, and imports point one way.

`lint-imports` checks the contracts in `pyproject.toml`. They say which package may import which
other one, and that `acsard/core/` imports no clock, socket, thread, asyncio or logging.
"""

from __future__ import annotations

import ast
import re
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

from tests.conftest import LIVE, LOUD
from tests.each import each

ROOT = Path(__file__).parents[1]
PACKAGE = ROOT / "acsard"

IMPURE_CALLS = {"open", "print", "input", "exec", "eval", "__import__"}

CLOCKS = {
    "time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns",
    "clock_gettime", "clock_gettime_ns",
}  # fmt: skip
"""The functions of module `time` that read a clock.

`time.sleep` is not among them. client/ and cli/ are tools for which a person waits, so they may use
`time.monotonic`.
"""

KINDS = {"CLOCK_MONOTONIC_RAW", "CLOCK_MONOTONIC", "CLOCK_BOOTTIME"}
"""The clocks that `clock_gettime_ns` may read. The last two reveal a suspend."""

MODULES = [str(path.relative_to(PACKAGE)) for path in sorted(PACKAGE.rglob("*.py"))]

DAEMON = [m for m in MODULES if m.partition("/")[0] in ("host", "daemon", "recording")]
"""The modules of the daemon. They share one clock."""


def tree_of(module: str) -> ast.Module:
    return ast.parse((PACKAGE / module).read_text(encoding="utf-8"), module)


def imported(tree: ast.Module) -> Iterator[str]:
    """Return the dotted names that a module imports anywhere, with `from a import b` as `a.b`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide where a name comes from"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_the_import_contracts_are_kept() -> None:
    command = [str(Path(sys.executable).parent / "lint-imports"), "--no-cache"]
    done = subprocess.run(command, capture_output=True, text=True, check=False, cwd=ROOT)
    assert done.returncode == 0, done.stdout + done.stderr


@each("module", [m for m in MODULES if m.startswith("core/")])
def test_a_module_of_the_core_neither_opens_nor_prints(module: str) -> None:
    called = {
        node.func.id
        for node in ast.walk(tree_of(module))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    assert not called & IMPURE_CALLS


def test_the_init_of_a_package_imports_nothing() -> None:
    for module in MODULES:
        package, _, name = module.rpartition("/")
        if name == "__init__.py" and package not in ("cli", "client"):
            assert list(imported(tree_of(module))) == [], module


@each("module", DAEMON)
def test_only_the_clock_reads_a_clock(module: str) -> None:
    tree = tree_of(module)
    read = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id == "time"
    }
    read |= {name.removeprefix("time.") for name in imported(tree) if name.startswith("time.")}
    roots = {name.partition(".")[0] for name in imported(tree)}
    if module == "host/clock.py":
        assert read == {"clock_gettime_ns", "time_ns", *KINDS}
    else:
        assert not read & CLOCKS
        assert "datetime" not in roots


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
    assert isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef)
    args = node.args
    found = [*args.posonlyargs, *args.args, args.vararg, *args.kwonlyargs, args.kwarg]
    return [arg.arg for arg in found if arg is not None]


@each("path", [str(path.relative_to(ROOT)) for path in sorted(PACKAGE.rglob("*.py"))])
def test_a_docstring_lists_the_arguments_that_the_function_has(path: str) -> None:
    for node in ast.walk(ast.parse((ROOT / path).read_text(encoding="utf-8"))):
        if not isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef | ast.ClassDef):
            continue
        if names := documented(ast.get_docstring(node) or ""):
            wanted = [name for name in parameters(node) if name not in ("self", "cls")]
            assert [name for name in names if name != "cls"] == wanted, (path, node.name)


def test_only_calibrate_needs_numpy() -> None:
    code = (
        "import sys; sys.modules['numpy'] = None; from acsard.cli import VERBS, main, parser; "
        "parser(set(VERBS) - {'calibrate'}); main(['calibrate'])"
    )
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, cwd=ROOT)
    assert done.stderr == (
        "acsard: this subcommand needs the library numpy: type `sudo apt install python3-numpy`\n"
    )


@each("name", LOUD)
def test_a_module_that_runs_serially_is_in_a_live_directory(name: str) -> None:
    assert [place for place in LIVE if (ROOT / "tests" / place / name).is_file()]
