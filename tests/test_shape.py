"""The shape of the code is a law like any other: imports point one way, the core is pure.

`ORDER` is the list of DESIGN section 2: a module may import only from those before it. It is also
the list of all modules, so a new one has to be given its place here.
"""

from __future__ import annotations

import ast
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

PACKAGE = Path(__file__).parents[1] / "acsard"
UNIT = Path(__file__).parent / "unit"

ORDER = (
    # the core: pure
    "values",
    "mcu.wire",
    "mcu.pace",
    "mcu.roundtrip",
    "settings",
    "validation",
    "rules",
    "config",
    "histogram",
    "figures",
    "mcu.lines",
    "mcu.frames",
    "mcu.check",
    "mcu.encoders",
    "mcu.feedback",
    "mcu.negotiation",
    "mcu.session",
    "drive.kinematics",
    "drive.odometry",
    "drive.sanity",
    "drive.arbiter",
    "drive.limits",
    "drive.modes",
    "drive.lifecycle",
    "messages.schema",
    "messages.topics",
    "messages.cdr_types",
    "messages.cdr",
    "messages.encodings",
    "ros.names",
    "ros.tokens",
    "ros.attachments",
    "ros.trees",
    "ros.parameters",
    "access",
    "messages.incoming",
    "messages.queries",
    "messages.report",
    "robot",
    "guard",
    "checkup.findings",
    "checkup.ends",
    "checkup.outside",
    "checkup.motion",
    "checkup.bench",
    "checkup.dialect",
    "checkup.wheels",
    "checkup.turning",
    "checkup.counts",
    "checkup.silence",
    "checkup.watchdog",
    "checkup.damage",
    "checkup.procedure",
    "checkup.advice",
    "sim.vehicle",
    "sim.protocol",
    "sim.faults",
    "sim.fake_mcu",
    "sim.garble",
    "sim.virtual_wire",
    "matching",
    # the shell
    "runtime.exits",
    "runtime.clock",
    "runtime.threads",
    "runtime.real_time",
    "runtime.timerfd",
    "runtime.ticker",
    "runtime.wakeup",
    "runtime.journal",
    "runtime.logs",
    "runtime.systemd",
    "runtime.control_loop",
    "runtime.serial_device",
    "runtime.serial_port",
    "runtime.serial_wire",
    "runtime.sim_pty",
    "runtime.zenoh_session",
    "runtime.replies",
    "runtime.inbox",
    "runtime.outlets",
    "runtime.zenoh_bus",
    "runtime.certificates",
    "runtime.host",
    "runtime.daemon",
    "runtime.bench_child",
    "runtime.bench_record",
    "runtime.bench_wire",
    "runtime.bench_rig",
    "client",
    "cli.common",
    "cli.run",
    "cli.sim",
    "cli.check",
    "cli.topics",
    "cli.echo",
    "cli.hz",
    "cli.top_text",
    "cli.top_view",
    "cli.top_feed",
    "cli.top",
    "cli.drive",
    "cli.call",
    "cli.ports",
    "cli.service",
    "cli.doctor",
    "cli.config_file",
    "cli.person",
    "cli.mcu",
    "cli.certificates",
    "cli.lan",
    "cli.bench_table",
    "cli.bench",
    "cli",
    "__main__",
)
"""`cli` is its package's `__init__`, which holds the entry point; the others hold nothing."""

SHELL = ("runtime", "cli", "client", "__main__")
"""The only parts of acsard that may do I/O."""

PURE = tuple(module for module in ORDER if module.partition(".")[0] not in SHELL)

IMPURE_IMPORTS = {
    "time", "asyncio", "os", "socket", "threading", "random", "logging", "structlog", "zenoh",
    "serial", "serial_asyncio", "pathlib", "subprocess", "datetime", "signal", "select", "secrets",
    "concurrent", "importlib", "io", "multiprocessing", "queue", "shutil", "sys", "tempfile",
    "uuid",
}  # fmt: skip
IMPURE_CALLS = {"open", "print", "input", "exec", "eval", "__import__"}

CLOCKS = {
    "time", "time_ns", "monotonic", "monotonic_ns", "perf_counter", "perf_counter_ns",
    "clock_gettime", "clock_gettime_ns",
}  # fmt: skip
"""What reads a clock in module `time`. `time.sleep` is not among them, and client.py and cli/ are
tools that a person waits for: they may use `time.monotonic`."""

LONG_FILE, LONG_FUNCTION = 300, 50


def path_of(module: str) -> Path:
    file = PACKAGE.joinpath(*module.split("."))
    return file / "__init__.py" if file.is_dir() else file.with_suffix(".py")


def tree_of(path: Path) -> ast.Module:
    return ast.parse(path.read_text(encoding="utf-8"), str(path))


def all_modules() -> list[str]:
    """Every module of acsard below its root, without the `__init__` of packages but cli's."""
    names = []
    for path in sorted(PACKAGE.rglob("*.py")):
        parts = path.relative_to(PACKAGE).with_suffix("").parts
        if parts[-1] != "__init__":
            names.append(".".join(parts))
    return [*names, "cli"]


def imported(tree: ast.Module) -> Iterator[str]:
    """The dotted names a module imports, wherever in it, `from a import b` as `a.b`."""
    for node in ast.walk(tree):
        if isinstance(node, ast.Import):
            yield from (alias.name for alias in node.names)
        elif isinstance(node, ast.ImportFrom):
            assert node.level == 0, "relative imports hide where a name comes from"
            yield from (f"{node.module}.{alias.name}" for alias in node.names)


def imported_modules(tree: ast.Module) -> set[str]:
    """The modules of acsard that a module imports, as they are written in `ORDER`."""
    found = set()
    for name in imported(tree):
        root, _, rest = name.partition(".")
        while root == "acsard" and rest:
            if rest in ORDER:
                found.add(rest)
                break
            rest = rest.rpartition(".")[0]
    return found


def test_every_module_has_exactly_one_place_in_the_order() -> None:
    assert sorted(ORDER) == sorted(all_modules())


@pytest.mark.parametrize("module", ORDER)
def test_a_module_imports_only_from_those_above_it(module: str) -> None:
    above = set(ORDER[: ORDER.index(module)])
    assert imported_modules(tree_of(path_of(module))) <= above


def test_the_init_of_a_package_imports_nothing() -> None:
    for path in PACKAGE.rglob("__init__.py"):
        if path.parent.name != "cli":
            assert list(imported(tree_of(path))) == [], path


@pytest.mark.parametrize("module", PURE)
def test_a_pure_module_imports_nothing_that_does_io_or_knows_the_time(module: str) -> None:
    roots = {name.partition(".")[0] for name in imported(tree_of(path_of(module)))}
    assert not roots & IMPURE_IMPORTS


@pytest.mark.parametrize("module", PURE)
def test_a_pure_module_neither_opens_nor_prints(module: str) -> None:
    called = {
        node.func.id
        for node in ast.walk(tree_of(path_of(module)))
        if isinstance(node, ast.Call) and isinstance(node.func, ast.Name)
    }
    assert not called & IMPURE_CALLS


@pytest.mark.parametrize("module", [m for m in ORDER if m.startswith("runtime.")])
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
    if module == "runtime.clock":
        assert read == {"monotonic_ns", "time_ns"}
    else:
        assert not read & CLOCKS
        assert "datetime" not in roots


@pytest.mark.parametrize("module", PURE)
def test_a_pure_module_has_a_test_module_at_the_mirrored_path(module: str) -> None:
    *packages, name = module.split(".")
    path = UNIT.joinpath(*packages, f"test_{name}.py")
    assert path.is_file(), f"write {path}"
    tests = [n for n in ast.walk(tree_of(path)) if isinstance(n, ast.FunctionDef)]
    assert any(test.name.startswith("test_") for test in tests), path


def test_the_daemon_does_not_load_numpy() -> None:
    code = "import sys, acsard.runtime.daemon; print('numpy' in sys.modules)"
    done = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, check=True, cwd=PACKAGE.parent
    )
    assert done.stdout.strip() == "False"


def test_sizes_are_reported() -> None:
    """Sizes are targets, not laws: `pytest -s tests/test_shape.py -k sizes` prints what exceeds."""
    for path in sorted(PACKAGE.rglob("*.py")):
        where = path.relative_to(PACKAGE.parent)
        lines = len(path.read_text(encoding="utf-8").splitlines())
        if lines > LONG_FILE:
            print(f"{where}: {lines} lines")
        for node in ast.walk(tree_of(path)):
            if isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef):
                length = (node.end_lineno or 0) - node.lineno + 1
                if length > LONG_FUNCTION:
                    print(f"{where}:{node.lineno}: {node.name} has {length} lines")
