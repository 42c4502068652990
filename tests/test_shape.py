"""The structure of the code follows rules: the core is pure, and imports point one way.

A contract in `pyproject.toml`, checked by `lint-imports`, says which room may import which.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterable, Iterator
from pathlib import Path

import pytest

from tests.each import each

PACKAGE = Path(__file__).parents[1] / "acsard"

PURE_ROOMS = (
    "values", "formatting", "thinning", "config", "mcu", "drive", "messages", "ros", "incoming",
    "robot", "guard", "sim", "checkup", "calibration", "error_budget", "report",
)  # fmt: skip
"""Modules without a clock, I/O, asyncio, logging or randomness."""

PURE_AMONG_SHELLS = (
    "bus.access",
    "bus.quiet",
    "runtime.pacing",
    "runtime.latencies",
    "client.commander",
    "client.follower",
    "client.riding",
    "runtime.kept_latches",
    "bench.matching",
    "door.watch",
    "foxglove.commanders",
    "foxglove.news",
    "foxglove.objections",
    "foxglove.parameters",
    "foxglove.twists",
    "host.silence",
    "record.around",
    "record.bag",
    "record.batch",
    "record.columns",
    "record.layout",
    "record.merge",
    "record.plausible",
    "record.published",
    "record.replay",
    "record.room",
    "record.steps",
    "record.story",
    "record.table",
    "record.unpickling",
    "terminal.tables",
    "top.sections",
    "top.stacked",
    "top.roster",
    "top.seen",
    "top.teleop",
    "top.text",
    "top.view",
    "web.errands",
    "web.frames",
    "web.limits",
    "web.lines",
    "web.metrics",
    "web.minute",
    "web.openapi",
    "web.socket_schemas",
    "web.told",
    "web.who",
)
"""Pure modules in rooms that do I/O."""

PURE_IMPORTS = {
    "__future__", "array", "binascii", "bisect", "collections", "contextlib", "csv", "difflib",
    "enum", "functools", "hashlib", "heapq", "html", "ipaddress", "itertools", "math",
    "msgspec", "numpy", "operator", "pickletools", "re", "rich.cells", "rich.console.Group",
    "rich.console.RenderableType", "rich.table", "rich.text", "statistics", "struct", "textwrap",
    "tomlkit", "tomllib", "typing", "xxhash", "zlib",
}  # fmt: skip
"""All modules that a pure module may import apart from pure modules, with the allowed names.

None of them does I/O, reads a clock or uses randomness by itself.
"""

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

DAEMON_ROOMS = ("host", "serial", "bus", "door", "record", "runtime")
"""The rooms that form the daemon. They share one clock."""


def path_of(module: str) -> Path:
    file = PACKAGE.joinpath(*module.split("."))
    return file / "__init__.py" if file.is_dir() else file.with_suffix(".py")


def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def all_modules() -> list[str]:
    """Return every module of acsard below its root.

    The `__init__` of a package counts as the package.
    """
    names = []
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        names.append(".".join(parts[:-1] if parts[-1] == "__init__" else parts))
    return [name for name in names if name]


MODULES = all_modules()
PURE = tuple(
    module
    for module in MODULES
    if module.partition(".")[0] in PURE_ROOMS or module in PURE_AMONG_SHELLS
)


def imported(tree: ast.Module) -> Iterator[str]:
    """Return the dotted names that a module imports anywhere, with `from a import b` as `a.b`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide where a name comes from"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def test_the_law_of_imports_is_kept() -> None:
    linter = Path(sys.executable).parent / "lint-imports"
    done = subprocess.run(
        [linter, "--no-cache"], capture_output=True, text=True, check=False, cwd=PACKAGE.parent
    )
    assert done.returncode == 0, done.stdout + done.stderr


def test_every_pure_name_is_there() -> None:
    assert {*PURE_ROOMS, *PURE_AMONG_SHELLS} <= set(MODULES)


def test_the_init_of_a_package_imports_nothing() -> None:
    for path in PACKAGE.rglob("__init__.py"):
        if path.parent.name not in ("cli", "client"):
            assert list(imported(tree_of(path))) == [], path


def impure(names: Iterable[str]) -> set[str]:
    """Return those of the imported names that a pure module may not import."""
    allowed = PURE_IMPORTS | {f"acsard.{module}" for module in PURE}
    return {name for name in names if not allowed & {*prefixes(name)}}


def prefixes(name: str) -> Iterator[str]:
    """Yield `a`, `a.b` and `a.b.c` for `a.b.c`.

    For acsard, yield only the module, whatever its room.
    """
    parts = name.split(".")
    dotted = [".".join(parts[: n + 1]) for n in range(len(parts))]
    if parts[0] != "acsard":
        yield from dotted
        return
    modules = [one for one in dotted if one.removeprefix("acsard.") in MODULES]
    yield from modules[-1:]


@each("module", PURE)
def test_a_pure_module_imports_only_what_is_pure(module: str) -> None:
    assert impure(imported(tree_of(path_of(module)))) == set()


@pytest.mark.parametrize(
    "line",
    [
        "import acsard.host.clock",
        "from acsard.host.clock import now",
        "from acsard.runtime import wakeup",
        "from acsard.mcu import check, lines; from acsard.host import clock",
        "import acsard",
        "import time",
        "import os.path",
        "from pathlib import Path",
        "from rich.console import Console",
        "import getpass",
        "def f():\n    import glob",
    ],
)
def test_an_impure_import_is_seen_however_it_is_written(line: str) -> None:
    assert impure(imported(ast.parse(line))) != set()


@each("module", PURE)
def test_a_pure_module_neither_opens_nor_prints(module: str) -> None:
    called = {
        node.func.id
        for node in ast.walk(tree_of(path_of(module)))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    assert not called & IMPURE_CALLS


@each("module", [m for m in MODULES if m.partition(".")[0] in DAEMON_ROOMS])
def test_only_the_clock_reads_a_clock(module: str) -> None:
    tree = tree_of(path_of(module))
    read = {
        node.attr
        for node in ast.walk(tree)
        if isinstance(node, ast.Attribute)
        and isinstance(node.value, ast.Name)
        and node.value.id == "time"
    }
    read |= {name.removeprefix("time.") for name in imported(tree) if name.startswith("time.")}
    roots = {name.partition(".")[0] for name in imported(tree)}
    if module == "host.clock":
        assert read == {"clock_gettime_ns", "time_ns", *KINDS}
    else:
        assert not read & CLOCKS
        assert "datetime" not in roots


@pytest.mark.parametrize("library", ["numpy", "rich"])
def test_the_daemon_does_not_load_a_library_of_the_tools(library: str) -> None:
    code = f"import sys, acsard.runtime.daemon; print({library!r} in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=PACKAGE.parent
    )
    assert done.stdout.strip() == "False"
