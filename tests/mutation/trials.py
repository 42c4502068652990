"""Runs the tests of the core on one mutant at a time, in processes that are quick to start.

Python, pytest and the libraries are imported once, here. Each trial forks this process, so the
child only imports acsard and the tests. The tests run first without a mutant, to measure which
test executes which line and how long it takes. After that, a mutant meets only the tests that
execute its lines: those of its own module first, and of these the quickest first.
"""

from __future__ import annotations

import importlib
import os
import pickle
import resource
import sys
import time
from collections.abc import Callable, Generator, Sequence
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import spec_from_file_location
from pathlib import Path
from types import ModuleType

import pytest
from hypothesis import Phase, settings

from tests.mutation.equivalent import EQUIVALENT
from tests.mutation.mutants import Mutant, traced

for name in ("msgspec", "numpy", "rosbags", "structlog", "xdist", "xxhash", "zenoh"):
    importlib.import_module(name)

TESTS = ["tests/unit/drive", "tests/unit/mcu", "tests/unit/runtime", "tests/unit/test_guard.py"]
TESTS += ["tests/unit/test_robot.py", "tests/unit/test_robot_machine.py", "tests/scenarios"]
PYTEST = ["-n", "0", "-q", "-p", "no:cacheprovider", "--hypothesis-seed=0"]
OWN, OTHER, NONE = "own", "other", ""
"""The tests that noticed a mutant: those of its own module, others, or none."""
NEVER_ENDS = -1
IMPORT = "import"
MOST_SECONDS = 15.0
"""Seconds of other tests that a mutant meets at most: the quickest tests notice nearly as much."""
MOST_BYTES = 6 << 30
"""A mutant that allocates without end must not take the memory of the machine."""


def mirror(path: str) -> str:
    """Return the test module of a module."""
    inside = Path(path).relative_to("acsard")
    return f"tests/unit/{inside.with_name('test_' + inside.name).as_posix()}"


def fork(root: Path, work: Callable[[], int]) -> int:
    """Run `work` in a child in the copy at `root`; return its status, or NEVER_ENDS."""
    sys.stdout.flush()
    pid = os.fork()
    if not pid:
        status = 70
        try:
            os.chdir(root)
            sys.path.insert(0, str(root))
            quiet = os.open(os.devnull, os.O_RDWR)
            for stream in (0, 1, 2):
                os.dup2(quiet, stream)
            for module in [n for n in sys.modules if n.partition(".")[0] in ("acsard", "tests")]:
                del sys.modules[module]
            resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))
            resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
            status = work()
        finally:
            os._exit(status)
    status = os.waitpid(pid, 0)[1]
    return os.WEXITSTATUS(status) if os.WIFEXITED(status) else NEVER_ENDS


class Quick:
    """A pytest plugin: hypothesis does not shrink, because a trial ends with its first failure."""

    @pytest.hookimpl(trylast=True)
    def pytest_configure(self) -> None:
        phases = (Phase.explicit, Phase.generate)
        settings.register_profile("mutation", settings.get_profile("default"), phases=phases)
        settings.load_profile("mutation")


class Measure(Quick):
    """A pytest plugin: runs one part of the tests and records their lines, times and failures."""

    def __init__(self, part: int, parts: int, executed: dict[str, set[int]]) -> None:
        self.seconds: dict[str, float] = {}
        self.failed: set[str] = set()
        self.reached: dict[tuple[str, int], set[str]] = {}
        self._part, self._parts, self._executed = part, parts, executed

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        items[:] = items[self._part :: self._parts]
        self._record(IMPORT)

    @pytest.hookimpl(wrapper=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> Generator[None, bool, bool]:
        began = time.process_time()
        result = yield
        self.seconds[item.nodeid] = time.process_time() - began
        self._record(item.nodeid)
        return result

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.failed.add(report.nodeid)

    def _record(self, test: str) -> None:
        for path, lines in self._executed.items():
            for line in lines:
                self.reached.setdefault((path, line), set()).add(test)
            lines.clear()


class Ordered(Quick):
    """A pytest plugin: runs these tests alone, in this order, and ends one that never ends."""

    def __init__(self, tests: dict[str, float]) -> None:
        self._tests = tests

    @pytest.hookimpl(trylast=True)
    def pytest_collection_modifyitems(self, items: list[pytest.Item]) -> None:
        place = {test: number for number, test in enumerate(self._tests)}
        items[:] = [item for item in items if item.nodeid in place]
        items.sort(key=lambda item: place[item.nodeid])

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtest_protocol(self, item: pytest.Item) -> None:
        limit = int(time.process_time() + 10 * self._tests[item.nodeid] + 20)
        resource.setrlimit(resource.RLIMIT_CPU, (limit, resource.RLIM_INFINITY))


class Planted:
    """An import finder: it gives modules other sources, and each a set `executed`."""

    def __init__(self, sources: dict[str, str]) -> None:
        self.executed: dict[str, set[int]] = {path: set() for path in sources}
        self._sources = sources
        sys.meta_path.insert(0, self)

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        file = name.replace(".", "/") + ".py"
        if file not in self._sources:
            return None
        source, executed = self._sources[file], self.executed[file]

        class Loader(SourceFileLoader):
            def exec_module(self, module: ModuleType) -> None:
                module.__dict__["executed"] = executed
                exec(compile(source, file, "exec", dont_inherit=True), module.__dict__)

        return spec_from_file_location(name, file, loader=Loader(name, file))


class Trials:
    """The verdicts on mutants; `measure` is first, and its parts go into `add`."""

    def __init__(self, root: Path, paths: list[str]) -> None:
        self.failed: set[str] = set()
        self._root, self._paths = root, paths
        self._seconds: dict[str, float] = {}
        self._reached: dict[tuple[str, int], set[str]] = {}

    def measure(self, part: int, parts: int) -> None:
        """Run one part of the tests without a mutant, and leave the result in a file."""

        def work() -> int:
            planted = Planted({path: traced(self._root, path) for path in self._paths})
            plugin = Measure(part, parts, planted.executed)
            status = int(pytest.main([*PYTEST, *TESTS], [plugin]))
            result = plugin.seconds, plugin.failed, plugin.reached
            self._file(part).write_bytes(pickle.dumps(result))
            return status

        if fork(self._root, work) not in (0, 1):
            raise RuntimeError("the tests cannot run without a mutant")

    def add(self, part: int) -> None:
        """Take the result of one part."""
        seconds, failed, reached = pickle.loads(self._file(part).read_bytes())
        self.failed |= failed
        self._seconds |= seconds
        for place, tests in reached.items():
            self._reached.setdefault(place, set()).update(tests)

    def verdict(self, mutant: Mutant) -> tuple[str, bool]:
        """Return which tests noticed this mutant, and whether it made one never end."""
        own = mirror(mutant.path)
        tests = self._tests(mutant)
        others, left = [], MOST_SECONDS
        for test in tests:
            if test.partition("::")[0] != own:
                left -= self._seconds[test]
                others += [test] if left > 0 else []
        stages = {OWN: [test for test in tests if test.partition("::")[0] == own], OTHER: others}
        if mutant.key in EQUIVALENT:
            del stages[OTHER]
        for stage, chosen in stages.items():
            if chosen and (status := self._run(mutant, chosen)):
                return stage, status == NEVER_ENDS
        return NONE, False

    def _tests(self, mutant: Mutant) -> list[str]:
        """Return the tests that execute the statement of the mutant, the quickest first."""
        tests = self._reached.get((mutant.path, mutant.statement), set())
        # A statement that an import executes may have an effect on any test.
        if not mutant.statement or IMPORT in tests:
            tests = set(self._seconds)
        return sorted(tests - self.failed, key=lambda test: (self._seconds[test], test))

    def _run(self, mutant: Mutant, tests: list[str]) -> int:
        """Run these tests on the mutant; return 0 if none of them fails."""

        def work() -> int:
            Planted({mutant.path: mutant.text})
            files = sorted({test.partition("::")[0] for test in tests})
            plugin = Ordered({test: self._seconds[test] for test in tests})
            return int(pytest.main([*PYTEST, "-x", *files], [plugin]))

        status = fork(self._root, work)
        # 0: all pass, 1: a test fails, 2: a module cannot be imported.
        if status not in (0, 1, 2, NEVER_ENDS):
            raise RuntimeError(f"pytest ended with {status} for {mutant.key}")
        return status

    def _file(self, part: int) -> Path:
        return self._root / f"measured-{part}"
