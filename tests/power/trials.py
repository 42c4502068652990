"""Runs tests on one changed module at a time, each in a forked process.

The parent process imports all modules and collects the tests once, so that a fork starts quickly.
All tests run once without a change, to measure which blocks of statements each test executes and
how long it takes. A trial then runs only the tests that reach its change, the fastest first.

If the change is inside of functions, the fork replaces their code objects. If the change is in code
that an import executes, the fork imports everything again, which takes some seconds longer. A test
that fails must then pass without the change, so that no flaky test notices anything.
"""

from __future__ import annotations

import ast
import contextlib
import gc
import hashlib
import math
import os
import pickle
import re
import resource
import shutil
import signal
import sys
import time
import traceback
from collections import Counter
from collections.abc import Callable, Container, Iterable, Iterator, Sequence
from functools import partial
from importlib.machinery import ModuleSpec, SourceFileLoader
from importlib.util import spec_from_file_location
from itertools import zip_longest
from pathlib import Path
from types import CodeType, FunctionType, ModuleType
from typing import NamedTuple

import pytest
from hypothesis import Phase, settings

from tests.conftest import ANY_SPEED

TESTS = ("tests/unit", "tests/scenarios", "tests/simulate", "tests/test_*.py")
PYTEST = ["-n", "0", "-s", "-qq", "--disable-warnings", "-p", "no:cacheprovider"]
PYTEST += ["--hypothesis-seed=0", "--timeout", "90"]
PARTS = 60
"""The measurement is stored after each of this many parts of the tests."""
MOST_FILES = 12
"""Test modules that a trial collects at most if it imports everything again."""
MOST_WAIT_S = 900.0
"""A trial that neither ends nor computes is ended after this time."""
MOST_BYTES = 6 << 30
"""A mutant that allocates without end must not take the memory of the machine."""
NOBODY, UNREACHED, IMPORT = "not noticed", "not reached", "import"
"""Verdicts beside the name of the test that noticed: no test failed, no test executes the change,
or the change prevents the import of the tests."""
UNDECIDED = "not by the first test"
"""The verdict before `measure`: the other tests remain to be tried."""


Replacement = list[tuple[FunctionType, CodeType]] | None


class Trial(NamedTuple):
    """A change of the product that tests should notice.

    Attributes:
        name: The name under which the result is stored.
        path: The changed module, relative to the project.
        lines: The changed lines of the unchanged module, if they are in functions.
        text: Returns the changed source.
        first: The test that noticed the change before.
    """

    name: str
    path: str
    lines: frozenset[int]
    text: Callable[[], str]
    first: str = ""


def short(test: str) -> str:
    """Return the name of a test without its parameters."""
    return test.partition("[")[0]


def digest(root: Path, tests: Iterable[str]) -> str:
    """Return a digest of the product, the files of its tests, and the collected tests."""
    files = (path for part in ("acsard", "tests") for path in (root / part).rglob("*.py"))
    kept = sorted(path for path in files if root / "tests" / "power" not in path.parents)
    texts = [path.read_bytes() for path in kept]
    return hashlib.sha256(b"".join([*texts, repr([*tests]).encode()])).hexdigest()[:12]


def enter(root: Path) -> None:
    """Make later imports of acsard and tests read the copy of the project at `root`."""
    os.chdir(root)
    sys.path.insert(0, str(root))
    for module in [name for name in sys.modules if name.partition(".")[0] in ("acsard", "tests")]:
        del sys.modules[module]


class Planted:
    """An import finder that loads modules from the given syntax trees instead of their files.

    Each loaded module has a variable `executed`, the set in which it records its executed lines.
    """

    def __init__(self, trees: dict[str, ast.Module]) -> None:
        self.executed: dict[str, set[int]] = {path: set() for path in trees}
        self._trees = trees
        sys.meta_path.insert(0, self)

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> ModuleSpec | None:
        base = name.replace(".", "/")
        file = next((f for f in (f"{base}.py", f"{base}/__init__.py") if f in self._trees), None)
        if not file:
            return None
        tree, executed = self._trees[file], self.executed[file]

        class Loader(SourceFileLoader):
            def exec_module(self, module: ModuleType) -> None:
                module.__dict__["executed"] = executed
                exec(compile(tree, str(file), "exec", dont_inherit=True), module.__dict__)

        place = str(Path(file).absolute())
        inside = [str(Path(place).parent)] if file.endswith("__init__.py") else None
        return spec_from_file_location(
            name, place, loader=Loader(name, place), submodule_search_locations=inside
        )


def traced(tree: ast.Module) -> dict[int, int]:
    """Make each block of statements inside a function record its first line in `executed`.

    Returns the first line of the block for each line inside a function.
    """
    blocks: dict[int, int] = {}
    functions = [n for n in ast.walk(tree) if isinstance(n, ast.FunctionDef | ast.AsyncFunctionDef)]
    for function in functions:  # the outer ones come first
        for node in ast.walk(function):
            for field in ("body", "orelse", "finalbody"):
                block = getattr(node, field, None)
                if isinstance(block, list) and block and not isinstance(node, ast.ClassDef):
                    for statement in block:
                        inside = range(statement.lineno, (statement.end_lineno or 0) + 1)
                        blocks.update(dict.fromkeys(inside, block[0].lineno))
    for node in ast.walk(tree):
        for field in ("body", "orelse", "finalbody"):
            block = getattr(node, field, None)
            if isinstance(block, list) and block and blocks.get(block[0].lineno) == block[0].lineno:
                record = ast.parse(f"executed.add({block[0].lineno})").body[0]
                has_docstring = isinstance(node, ast.FunctionDef | ast.AsyncFunctionDef) and (
                    ast.get_docstring(node, clean=False) is not None
                )
                block.insert(has_docstring, ast.copy_location(record, block[0]))
    ast.fix_missing_locations(tree)
    return blocks


def bodies(tree: ast.Module) -> tuple[str, dict[tuple[str, int], str]]:
    """Return what an import of the module executes, and the bodies of its functions."""
    seen: Counter[str] = Counter()
    found: dict[tuple[str, int], str] = {}

    def search(node: ast.AST, scope: str) -> None:
        for child in ast.iter_child_nodes(node):
            if isinstance(child, ast.FunctionDef | ast.AsyncFunctionDef):
                name = scope + child.name
                found[name, seen[name]] = "".join(ast.dump(part) for part in child.body)
                seen[name] += 1
                child.body = []
            else:
                search(child, f"{scope}{child.name}." if isinstance(child, ast.ClassDef) else scope)

    search(tree, "")
    return ast.dump(tree), found


def codes(code: CodeType) -> Iterator[CodeType]:
    """Yield the code object of each function of a module, including methods but not lambdas."""
    for inner in code.co_consts:
        if isinstance(inner, CodeType) and not inner.co_name.startswith("<"):
            if inner.co_flags & 1:  # CO_OPTIMIZED: a function, not the body of a class
                yield inner
            else:
                yield from codes(inner)


class Trials:
    """A pytest plugin that makes trials instead of running each collected test once."""

    def __init__(
        self, root: Path, tests: Sequence[str], seconds: float, work: Callable[[Trials], None]
    ) -> None:
        """Store `work`, which `run` calls when the tests are collected.

        A trial begins no further test after this many CPU seconds.
        """
        self.seconds = seconds
        self.failed: set[str] = set()
        self.items: dict[str, pytest.Item] = {}
        self.fails: Callable[[str], None] = self.failed.add
        self.until = math.inf
        self._root, self._tests, self._work = root, tests, work
        self._seconds: dict[str, float] = {}
        self._reached: dict[tuple[str, int], int] = {}
        """The tests that execute a block, as a mask of bits."""
        self._at_import: set[tuple[str, int]] = set()
        self._functions: dict[tuple[str, str], list[FunctionType]] = {}
        enter(root)
        self._texts = {
            path.relative_to(root).as_posix(): path.read_text(encoding="utf-8")
            for path in sorted((root / "acsard").rglob("*.py"))
        }
        trees = {path: ast.parse(text) for path, text in self._texts.items()}
        self._blocks = {path: traced(tree) for path, tree in trees.items()}
        self._planted = Planted(trees)

    def run(self) -> None:
        """Collect the tests, and call `work`."""
        os.environ[ANY_SPEED] = "1"  # the recorded lines take time
        tests = [path for name in self._tests for path in sorted(self._root.glob(name))]
        if pytest.main([*PYTEST, *map(str, tests)], [self]) != 0:
            raise RuntimeError("the tests cannot be collected")

    @pytest.hookimpl(trylast=True)
    def pytest_configure(self) -> None:
        # A trial ends with its first failure, so nothing is to be shrunk.
        phases = (Phase.explicit, Phase.generate)
        settings.register_profile("power", settings.get_profile("default"), phases=phases)
        settings.load_profile("power")

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        self.items = {item.nodeid: item for item in session.items}
        for path, lines in self._planted.executed.items():
            self._at_import |= {(path, line) for line in lines}
            lines.clear()
        gc.unfreeze()
        for function in gc.get_objects():
            if type(function) is FunctionType:
                code = function.__code__
                if code.co_filename in self._texts:
                    place = code.co_filename, code.co_qualname
                    self._functions.setdefault(place, []).append(function)
        gc.collect()
        gc.freeze()
        self._work(self)
        return True

    def pytest_runtest_logreport(self, report: pytest.TestReport) -> None:
        if report.failed:
            self.fails(report.nodeid)

    def measure(self, jobs: int, cache: Path) -> None:
        """Run all tests without a change. What `cache` has of the same tree is not measured again.

        Stores each test's time and executed blocks, and the names of tests that fail.
        """
        tests, running = list(self.items), dict[int, tuple[int, Path]]()
        size = -(-len(tests) // PARTS)
        made = digest(self._root, tests)
        files = [cache / f"reach-{made}-{part}" for part in range(PARTS)]
        left = [(part, file) for part, file in enumerate(files) if not file.exists()]
        cache.mkdir(parents=True, exist_ok=True)
        while left or running:
            while left and len(running) < jobs:
                part, file = left.pop(0)
                some = set(tests[part * size : (part + 1) * size]) - self.failed
                running[self._fork(partial(self._measure, some, file))] = part, file
            pid, status = self._ended(running)
            if status:
                test = self._said(pid)
                if test not in self.items:
                    raise RuntimeError(test)
                self.failed.add(test)  # it ended the process
                left.insert(0, running[pid])
            del running[pid]
        for file in files:
            seconds, failed, masks = pickle.loads(file.read_bytes())
            self._seconds |= seconds
            self.failed |= failed
            for place, mask in masks.items():
                self._reached[place] = self._reached.get(place, 0) | mask

    def verdicts(self, trials: Iterable[Trial], jobs: int) -> Iterator[tuple[Trial, str]]:
        """Make the trials in `jobs` processes. Yield each with its verdict as it finishes."""
        left, running = iter(trials), dict[int, Trial]()
        while True:
            while len(running) < jobs and (trial := next(left, None)) is not None:
                running[self._fork(partial(self._judge, trial))] = trial
            if not running:
                return
            pid, status = self._ended(running)
            trial, said = running.pop(pid), self._said(pid)
            if status:
                print(f"not tried: {trial.name}\n{said}", file=sys.stderr)
            else:
                yield trial, said

    def _ended(self, running: Container[int]) -> tuple[int, int]:
        """Wait for one of these processes. The first process of a container gets others too."""
        while (ended := os.wait())[0] not in running:
            pass
        return ended

    def _file(self, pid: int) -> Path:
        return self._root / f"trial-{pid}" / "said"

    def _said(self, pid: int) -> str:
        """Return what an ended process wrote, and delete its files."""
        with contextlib.suppress(ProcessLookupError):
            os.killpg(pid, signal.SIGKILL)  # what it started and did not end
        said = self._file(pid).read_text() if self._file(pid).exists() else ""
        shutil.rmtree(self._file(pid).parent, ignore_errors=True)
        return said.strip()

    def _fork(self, work: Callable[[], int]) -> int:
        """Call `work` in a process with a group and temporary files of its own."""
        sys.stdout.flush()
        pid = os.fork()
        if pid:
            return pid
        try:
            os.setpgid(0, 0)
            quiet = os.open(os.devnull, os.O_RDWR)
            for stream in (0, 1, 2):
                os.dup2(quiet, stream)
            folder = self._file(os.getpid()).parent
            folder.mkdir()
            os.environ["PYTEST_DEBUG_TEMPROOT"] = str(folder)
            os._exit(work())
        except BaseException:  # noqa: BLE001 - the parent raises it
            self._file(os.getpid()).write_text(traceback.format_exc())
        finally:
            os._exit(70)

    def _measure(self, tests: set[str], file: Path) -> int:
        numbers = {test: number for number, test in enumerate(self.items)}
        reached: dict[tuple[str, int], int] = {}
        failed, began = set(self.failed), time.process_time()
        for test in self.run_tests([test for test in self.items if test in tests]):
            self._seconds[test] = time.process_time() - began
            for path, lines in self._planted.executed.items():
                for line in lines:
                    place = path, line
                    reached[place] = reached.get(place, 0) | 1 << numbers[test]
                lines.clear()
            began = time.process_time()
        part = file.with_suffix(".part")
        part.write_bytes(pickle.dumps((self._seconds, self.failed | failed, reached)))
        part.replace(file)
        return 0

    def _judge(self, trial: Trial) -> int:
        verdict = self._noticed(trial)
        self._file(os.getpid()).write_text(verdict)
        return 0

    def _noticed(self, trial: Trial) -> str:
        """Return the name of a test that fails only with the change, or another verdict."""
        functions = self._replacement(trial)
        tests, flaky = self._chosen(trial, cold=not functions), set[str]()
        if not tests:
            return UNREACHED if self._seconds else UNDECIDED
        while test := self._failing(trial, functions, [t for t in tests if t not in flaky]):
            if test == IMPORT or not self._failing(None, None, [test]):
                return short(test)
            flaky.add(test)
        return NOBODY if self._seconds else UNDECIDED

    def _chosen(self, trial: Trial, cold: bool) -> list[str]:
        """Return the tests to run, in their order. Before `measure`, only the first is known."""
        first = [test for test in self.items if short(test) == trial.first]
        if not self._seconds:
            return first
        name = trial.path.removesuffix(".py").replace("/", ".")
        blocks = {self._blocks[trial.path].get(line, 0) for line in trial.lines} - {0}
        places = {(trial.path, block) for block in blocks}
        cold = cold or not places or not places.isdisjoint(self._at_import)
        if cold:
            importers = [p for p, t in self._texts.items() if re.search(rf"\b{name}\b", t)]
            for modules in ([trial.path], importers):
                places = {place for place in self._reached if place[0] in modules}
                if places:
                    break
        mask = 0
        for place in places:
            mask |= self._reached.get(place, 0)
        reached = [test for number, test in enumerate(self.items) if mask >> number & 1]
        if cold:
            counts = Counter(test.partition("::")[0] for test in reached)
            files = {file for file, _ in counts.most_common(MOST_FILES)}
            reached = [test for test in reached if test.partition("::")[0] in files]
        others = {*reached} - self.failed - {*first}
        return first + sorted(others, key=self._seconds.__getitem__)

    def _failing(self, trial: Trial | None, functions: Replacement, tests: list[str]) -> str:
        """Run these tests in another process, until one fails. Return its name, or ""."""
        pid = self._fork(partial(self._attempt, trial, functions, tests))
        until = time.monotonic() + MOST_WAIT_S
        while not (ended := os.waitpid(pid, os.WNOHANG))[0] and time.monotonic() < until:
            time.sleep(0.01)
        if not ended[0]:
            os.kill(pid, signal.SIGKILL)
            ended = os.waitpid(pid, 0)
        said = self._said(pid)
        if os.WIFEXITED(ended[1]) and os.WEXITSTATUS(ended[1]) == 70:
            raise RuntimeError(said)
        return said if ended[1] else ""

    def _attempt(self, trial: Trial | None, functions: Replacement, tests: list[str]) -> int:
        resource.setrlimit(resource.RLIMIT_AS, (MOST_BYTES, MOST_BYTES))
        self.fails = lambda test: os._exit(1)
        for function, code in functions or ():
            function.__code__ = code
        if trial and not functions:
            self._file(os.getpid()).write_text(IMPORT)
            enter(self._root)
            sys.meta_path.remove(self._planted)
            Planted({trial.path: ast.parse(trial.text())})
            files = sorted({test.partition("::")[0] for test in tests})
            return int(pytest.main([*PYTEST, *files], [_Afresh(self, tests)]))
        self.until = time.process_time() + self.seconds
        for _ in self.run_tests(tests):
            pass
        return 0

    def run_tests(self, tests: list[str]) -> Iterator[str]:
        """Run tests, and yield the name of each after it. Its name is in the process's file."""
        said = os.open(self._file(os.getpid()), os.O_WRONLY | os.O_CREAT)
        for test, following in zip_longest(tests, tests[1:]):
            os.pwrite(said, f"{test:999}".encode(), 0)
            limit = int(time.process_time() + 10 * self._seconds.get(test, 2.0) + 20)
            resource.setrlimit(resource.RLIMIT_CPU, (limit, resource.RLIM_INFINITY))
            item = self.items[test]
            following_item = None if following is None else self.items[following]
            item.config.hook.pytest_runtest_protocol(item=item, nextitem=following_item)
            yield test
            if time.process_time() > self.until:
                return

    def _replacement(self, trial: Trial) -> Replacement:
        """Return the functions that the trial changes, with their new code.

        Returns None if an import must execute the change, for example if a function has other free
        variables or parameters.
        """
        text = trial.text()
        outside, before = bodies(ast.parse(self._texts[trial.path]))
        new_outside, after = bodies(ast.parse(text))
        if outside != new_outside:
            return None
        by_name: dict[str, list[CodeType]] = {}
        for code in codes(compile(text, trial.path, "exec", dont_inherit=True)):
            by_name.setdefault(code.co_qualname, []).append(code)
        replaced: list[tuple[FunctionType, CodeType]] = []
        for name, number in [place for place in after if after[place] != before[place]]:
            functions = self._functions.get((trial.path, name), [])
            # A property and its setter have one name.
            lines = sorted({function.__code__.co_firstlineno for function in functions})
            if len(lines) != len(by_name.get(name, ())):
                return None
            code = by_name[name][number]
            here = [f for f in functions if f.__code__.co_firstlineno == lines[number]]
            if any(function.__code__.co_freevars != code.co_freevars for function in here):
                return None
            replaced += [(function, code) for function in here]
        return replaced or None


class _Afresh:
    """A pytest plugin that runs only these tests, in this order."""

    def __init__(self, trials: Trials, tests: list[str]) -> None:
        self._trials, self._tests = trials, tests
        self.pytest_configure = trials.pytest_configure
        self.pytest_runtest_logreport = trials.pytest_runtest_logreport

    @pytest.hookimpl(tryfirst=True)
    def pytest_runtestloop(self, session: pytest.Session) -> bool:
        self._trials.items = {item.nodeid: item for item in session.items}
        tests = [test for test in self._tests if test in self._trials.items]
        self._trials.until = time.process_time() + self._trials.seconds
        for _ in self._trials.run_tests(tests):
            pass
        return True
