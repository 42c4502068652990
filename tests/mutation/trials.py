"""Runs the tests of the core on one mutant at a time, each in a forked process.

The parent process imports all modules and collects the tests once, so a fork starts quickly. First
the tests run without a mutant, to measure which statements each test executes and how long it
takes. Then each mutant is run only with the tests that execute its statement. The tests of its own
module come first, then the others, the fastest first.

If the mutant is inside a function, the fork replaces the code object of that function. If the
mutant is in code that an import executes, the fork imports everything again, which takes a second
longer.
"""

from __future__ import annotations

import gc
import os
import pickle
import resource
import sys
import time
from collections.abc import Callable, Iterator, Sequence
from functools import partial
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import spec_from_file_location
from itertools import zip_longest
from pathlib import Path
from types import CodeType, FunctionType, ModuleType

import pytest
from hypothesis import Phase, settings

from tests.mutation.equivalent import EQUIVALENT
from tests.mutation.mutants import Mutant, traced

TESTS = [
    "tests/unit/core/motion",
    "tests/unit/core/link",
    "tests/unit/daemon/test_latch_rules.py",
    "tests/unit/daemon/test_latch_file.py",
    "tests/unit/core/test_guard.py",
]
TESTS += [
    "tests/unit/core/test_robot.py",
    "tests/unit/core/test_robot_machine.py",
    "tests/scenarios",
]
PYTEST = [
    "-n",
    "0",
    "-s",
    "-qq",
    "--disable-warnings",
    "-p",
    "no:cacheprovider",
    "--hypothesis-seed=0",
]
MOST_SECONDS = 10.0
"""CPU seconds of tests of other modules that a mutant meets at most, as measured without it. The
quickest come first: 10 s are 2,100 of 2,700."""
MOST_BYTES = 6 << 30
"""A mutant that allocates without end must not take the memory of the machine."""
NONE, OWN, OTHER, ENDLESS = range(4)
"""The verdicts: no test noticed the mutant, a test of its module did, another one did, or a test
did not end."""


def mirror(path: str) -> str:
    """Return the path of the test module that belongs to a module."""
    inside = Path(path).relative_to("acsard")
    return f"tests/unit/{inside.with_name('test_' + inside.name).as_posix()}"


def enter(root: Path) -> None:
    """Make later imports of acsard and tests read the copy of the project at `root`."""
    os.chdir(root)
    sys.path.insert(0, str(root))
    for module in [name for name in sys.modules if name.partition(".")[0] in ("acsard", "tests")]:
        del sys.modules[module]


class Planted:
    """An import finder that loads modules from the given sources instead of their files.

    Each loaded module has a variable `executed`, the set in which it records its executed lines.
    """

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


def codes(code: CodeType) -> Iterator[CodeType]:
    """Yield the code object of each function of a module, including methods but not lambdas."""
    for inner in code.co_consts:
        if isinstance(inner, CodeType) and not inner.co_name.startswith("<"):
            if inner.co_flags & 1:  # CO_OPTIMIZED: a function, not the body of a class
                yield inner
            else:
                yield from codes(inner)


class Trials:
    """A pytest plugin that tries mutants instead of running each collected test once."""

    def __init__(self, root: Path, paths: list[str], work: Callable[[Trials], None]) -> None:
        """Store `work`, which `run` calls when the tests are collected.

        `work` must call `measure` first and then `verdicts`.
        """
        self.failed: set[str] = set()
        self._root, self._work = root, work
        self._seconds: dict[str, float] = {}
        self._reached: dict[tuple[str, int], set[str]] = {}
        self._functions: dict[tuple[str, str], list[FunctionType]] = {}
        self._failed_here: Callable[[str], None] = self.failed.add
        enter(root)
        self._planted = Planted({path: traced(root, path) for path in paths})
        self.items: dict[str, pytest.Item] = {}

    def run(self) -> None:
        """Collect the tests, and call `work`."""
        if pytest.main([*PYTEST, *TESTS], [self]) != 0:
            raise RuntimeError("the tests cannot be collected")

    @pytest.hookimpl(trylast=True)
    def pytest_configure(self) -> None:
        # A trial ends with its first failure, so nothing is to be shrunk.
        phases = (Phase.explicit, Phase.generate)
        settings.register_profile("mutation", settings.get_profile("default"), phases=phases)
        settings.load_profile("mutation")

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        self.items = {item.nodeid: item for item in session.items}
        self._record("import")
        gc.unfreeze()
        for function in gc.get_objects():
            if type(function) is FunctionType:
                code = function.__code__
                if code.co_filename in self._planted.executed:
                    place = code.co_filename, code.co_qualname
                    self._functions.setdefault(place, []).append(function)
        gc.freeze()
        self._work(self)
        return True

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self._failed_here(report.nodeid)

    def measure(self, parts: int) -> None:
        """Run all tests without a mutant, in `parts` processes at once.

        Stores each test's time and executed statements, and the names of tests that fail.
        """
        for part in range(parts):
            self._fork(partial(self._measure, list(self.items)[part::parts], part))
        for _ in range(parts):
            if os.wait()[1]:
                raise RuntimeError("the tests cannot run without a mutant")
        for part in range(parts):
            seconds, failed, reached = pickle.loads(self._file(part).read_bytes())
            self._seconds |= seconds
            self.failed |= failed
            for place, tests in reached.items():
                self._reached.setdefault(place, set()).update(tests)

    def verdicts(self, sample: list[Mutant], jobs: int) -> Iterator[tuple[Mutant, int]]:
        """Try the mutants in `jobs` processes. Yield each one with its verdict as it finishes."""
        left, running = iter(sample), dict[int, Mutant]()
        while True:
            while len(running) < jobs and (mutant := next(left, None)) is not None:
                running[self._fork(partial(self._try, mutant))] = mutant
            if not running:
                return
            pid, status = os.wait()
            code = os.WEXITSTATUS(status) if os.WIFEXITED(status) else ENDLESS
            mutant = running.pop(pid)
            if code > ENDLESS:
                raise RuntimeError(f"the trial ended with {code}: {mutant.key}")
            yield mutant, code

    def _fork(self, work: Callable[[], int]) -> int:
        sys.stdout.flush()
        pid = os.fork()
        if pid:
            return pid
        try:
            quiet = os.open(os.devnull, os.O_RDWR)
            for stream in (0, 1, 2):
                os.dup2(quiet, stream)
            resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))
            os._exit(work())
        finally:
            os._exit(70)

    def _record(self, test: str) -> None:
        for path, lines in self._planted.executed.items():
            for line in lines:
                self._reached.setdefault((path, line), set()).add(test)
            lines.clear()

    def _measure(self, tests: list[str], part: int) -> int:
        for test, following in zip_longest(tests, tests[1:]):
            began = time.process_time()
            self.run_test(test, following)
            self._seconds[test] = time.process_time() - began
            self._record(test)
        result = self._seconds, self.failed, self._reached
        self._file(part).write_bytes(pickle.dumps(result))
        return 0

    def _try(self, mutant: Mutant) -> int:
        own = mirror(mutant.path)

        def stop(test: str) -> None:
            os._exit(OWN if test.partition("::")[0] == own else OTHER)

        self._failed_here = stop
        reached = self._reached.get((mutant.path, mutant.statement), set())
        warm = mutant.statement and "import" not in reached and self._replace(mutant)
        chosen = (reached if warm else set(self._seconds)) - self.failed
        mine = {test for test in chosen if test.partition("::")[0] == own}
        if mutant.key in EQUIVALENT:
            chosen = mine
        left, tests = MOST_SECONDS, list[str]()
        for test in sorted(chosen, key=lambda t: (t not in mine, self._seconds[t], t)):
            left -= 0.0 if test in mine else self._seconds[test]
            tests += [test] if left > 0 else []
        if not warm:
            return self._afresh(mutant, tests)
        for test, following in zip_longest(tests, tests[1:]):
            self.run_test(test, following)
        return NONE

    def run_test(self, test: str, following: str | None) -> None:
        limit = int(time.process_time() + 10 * self._seconds.get(test, 60.0) + 20)
        resource.setrlimit(resource.RLIMIT_CPU, (limit, resource.RLIM_INFINITY))
        item = self.items[test]
        following_item = None if following is None else self.items[following]
        item.config.hook.pytest_runtest_protocol(item=item, nextitem=following_item)

    def _replace(self, mutant: Mutant) -> bool:
        """Replace the code objects of the module's functions by those of the mutant.

        Returns False if that is not possible, for example if a function has other free variables.
        """
        by_name: dict[str, list[CodeType]] = {}
        for code in codes(compile(mutant.text, mutant.path, "exec", dont_inherit=True)):
            by_name.setdefault(code.co_qualname, []).append(code)
        for name, several in by_name.items():
            functions = self._functions.get((mutant.path, name), [])
            # A property and its setter have one name.
            lines = sorted({function.__code__.co_firstlineno for function in functions})
            if len(lines) != len(several):
                return False
            for function in functions:
                code = several[lines.index(function.__code__.co_firstlineno)]
                if code.co_freevars != function.__code__.co_freevars:
                    return False
                function.__code__ = code
        return True

    def _afresh(self, mutant: Mutant, tests: list[str]) -> int:
        """Import the mutant and everything else again, and run these tests. Return the verdict."""
        enter(self._root)
        sys.meta_path.remove(self._planted)
        Planted({mutant.path: mutant.text})
        files = sorted({test.partition("::")[0] for test in tests})
        status = pytest.main([*PYTEST, *files], [_Afresh(self, tests)])
        return NONE if status == 0 else OWN

    def _file(self, part: int) -> Path:
        return self._root / f"measured-{part}"


class _Afresh:
    """A pytest plugin that runs only these tests, in this order."""

    def __init__(self, trials: Trials, tests: list[str]) -> None:
        self._trials, self._tests = trials, tests
        self.pytest_configure = trials.pytest_configure
        self.pytest_runtest_logreport = trials.pytest_runtest_logreport

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        self._trials.items = {item.nodeid: item for item in session.items}
        for test, following in zip_longest(self._tests, self._tests[1:]):
            self._trials.run_test(test, following)
        return True
