"""Set up every test run: the hypothesis profiles, and signals as a terminal delivers them."""

from __future__ import annotations

import atexit
import gc
import inspect
import os
import re
import shutil
import signal
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Callable, Generator
from pathlib import Path
from zlib import crc32

import pytest
from hypothesis import settings
from xdist.scheduler import LoadScopeScheduling

from tests.each import run

# A failed assertion in these helpers shows its values, as it does in a test.
pytest.register_assert_rewrite("tests.unit", "tests.scenarios", "tests.system", "tests.simulate")

# There is no deadline, because a slow machine must not fail a property that holds. The examples are
# the same for every change, so that luck never decides how it is judged. The nightly job and
# `explore` look for new examples.
settings.register_profile("default", deadline=None, max_examples=10, derandomize=True)
settings.register_profile("thorough", deadline=None, max_examples=100)
"""`pytest --hypothesis-profile thorough --hypothesis-seed N`, as the nightly job does."""
settings.register_profile("explore", deadline=None, max_examples=3000)
"""`pytest --hypothesis-profile explore tests/unit`: 8 minutes, other examples each time."""
settings.load_profile("default")

# nohup and a script's `&` start a program with these signals ignored, and the programs that a test
# starts inherit that. A handler is not inherited, and a handler that does nothing ignores the
# signals just as well.
for number in (signal.SIGINT, signal.SIGHUP, signal.SIGQUIT):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, lambda *_: None)

# In many containers, and for a user who does not own the clone, Python cannot write bytecode. Each
# of the hundreds of daemons here would then compile all of acsard again, and each worker would
# compile the tests again.
if sys.dont_write_bytecode or not os.access(__file__, os.W_OK):
    place = str(Path(__file__).parents[1] / ".pytest_cache" / "bytecode")
    if "PYTHONPYCACHEPREFIX" in os.environ:  # this is an xdist worker
        place = os.environ["PYTHONPYCACHEPREFIX"]
    elif not os.access(__file__, os.W_OK):
        place = tempfile.mkdtemp(prefix="acsard-")
        atexit.register(shutil.rmtree, place, ignore_errors=True)
    sys.pycache_prefix = os.environ["PYTHONPYCACHEPREFIX"] = place
    sys.dont_write_bytecode = False
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


gc.disable()  # until the tests are collected: nothing of what that makes is garbage

LIVE = ("bench", "firmware", "system", "systemd")
"""Directories whose tests run real processes in real time. They run before the computed tests."""

VARIATIONS_PER_CI_TEST = 10
"""`.ci/run` runs about one in this many slow variations. The nightly job runs the others."""

ANY_SPEED = "ACSARD_TEST_ANY_SPEED"  # set for the tests of installed files

LONGEST = 200
"""Processor time of this process in which a test without one of these marks must end.

Its unit is a loop of a million empty rounds, because computers differ: 18 ms where the longest of
2,300 such tests takes 1.5 s.
"""

MARKS = {"slow", "soak", "bench", "network", "systemd", "firmware", "languages", "bridge"}

LOUD = (
    "test_daemon.py", "test_link_faults.py", "test_bus_faults.py", "test_access_isolation.py",
    "test_page_attacks.py", "test_page_outage.py",
    "test_lateness_period.py", "test_recording_disks.py",
    "test_access_strangers.py",
)  # fmt: skip
"""Live modules that load the machine, or that count missed periods.

One worker runs all of them and `bench`, one after the other: they would disturb each other.
"""


pytest_plugins = ("tests.produced",)


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption("--approve", action="store_true", help="write the approved texts anew")


@pytest.fixture
def approved(request: pytest.FixtureRequest) -> Callable[[Path, str], None]:
    """Return a function that compares a text with an approved file, or writes it (`--approve`)."""

    def compare(path: Path, text: str) -> None:
        if request.config.getoption("approve"):
            path.write_text(text, encoding="utf-8")
        before = path.read_text(encoding="utf-8")
        assert text == before, f"if this is intended: pytest --approve, then read git diff {path}"

    return compare


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Choose the number of test processes.

    Two run the whole suite: each takes 3 s to collect the tests, and more would use all the time of
    two cores, so that tests of real time would fail. Tests that print, and parts of the suite, run
    in this process only.
    """
    part = config.args_source is not pytest.Config.ArgsSource.TESTPATHS
    left_out = config.option.markexpr.partition("not")[2]
    other = config.option.capture == "no" or "soak" not in left_out
    return 0 if part or other or len(os.sched_getaffinity(0)) < 2 else 2


def _unit(nodeid: str) -> str:
    """Return the unit of work that contains a test: its file, or a group of files."""
    file = nodeid.partition("::")[0]
    directory, name = file.split("/")[-2:]
    if directory == "bench" or (directory in LIVE and name in LOUD):
        return "loud"
    # The tests of each of these directories share what takes long to make.
    return directory if directory in ("systemd", "firmware") else file


class _ByUnit(LoadScopeScheduling):  # type: ignore[misc]
    """Distributes whole units (files or groups of files) to the test processes.

    After each test xdist counts all the tests of the process, so handing out 7,000 tests one by one
    is slow. The path alone decides the unit, because with pytest 9.2 the main process no longer
    receives a test's mark `xdist_group`.
    """

    def _split_scope(self, nodeid: str) -> str:
        return _unit(nodeid)


def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> _ByUnit:
    config.option.loadscopereorder = False  # pytest_collection_modifyitems chose the order
    return _ByUnit(config, log)


def _is_other(nodeid: str) -> bool:
    """Return whether a usual run tries the other one of this test's two rows of wheels.

    A digest chooses: half of the tests have four wheels and half have two.
    """
    two = re.search(r"[\[-]two[\]-]", nodeid) is not None
    return two == bool(crc32(re.sub(r"\b(four|two)\b", "", nodeid).encode()) & 1)


def _all_but_some_are_slow(items: list[pytest.Item]) -> None:
    """Mark most variations of a test as slow, and most of these as nightly.

    A normal run then tries only a few variations. The nightly job tries all of them.
    """
    counts, left = Counter[str](), Counter[str]()
    for item in items:
        one_in = item.get_closest_marker("variations")
        if one_in is None:
            if item.get_closest_marker("one_of_both") and _is_other(item.nodeid):
                item.add_marker(pytest.mark.slow)
            continue
        test = item.nodeid.partition("[")[0]
        counts[test] += 1
        if (counts[test] - 1) % one_in.args[0] == 0:
            continue
        item.add_marker(pytest.mark.slow)
        if item.get_closest_marker("soak") or item.get_closest_marker("nightly"):
            continue
        left[test] += 1
        # A digest chooses, because a fixed step would fall on the same value of one parameter.
        if left[test] > 1 and crc32(item.nodeid.encode()) % VARIATIONS_PER_CI_TEST:
            item.add_marker(pytest.mark.nightly)


@pytest.hookimpl(tryfirst=True)  # runs before `-m` selects tests
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    _all_but_some_are_slow(items)
    items.sort(key=_rank)


def _rank(item: pytest.Item) -> int:
    """Return a sort key that puts the tests of the longest units first."""
    unit = _unit(item.nodeid)
    if unit in ("loud", "systemd"):
        return 0 if unit == "loud" else 1
    return 2 if item.nodeid.split("/")[1] in LIVE else 3


@pytest.hookimpl(tryfirst=True)
def pytest_pyfunc_call(pyfuncitem: pytest.Function) -> bool | None:
    """Run a test that is a coroutine function."""
    test, names = pyfuncitem.obj, inspect.signature(pyfuncitem.obj).parameters
    if not inspect.iscoroutinefunction(test):
        return None
    run(test(**{name: pyfuncitem.funcargs[name] for name in names}))
    return True


def _loop_s() -> float:
    began = time.process_time()
    for _ in range(200_000):
        pass
    return 5 * (time.process_time() - began)


@pytest.hookimpl(wrapper=True)
def pytest_runtest_call(item: pytest.Item) -> Generator[None, object, object]:
    """Fail a test without a mark that computes for too long.

    Coverage, the other profiles of hypothesis, and a Python with other libraries may take longer.
    """
    began = time.process_time()
    result = yield
    took = time.process_time() - began
    usual = settings().max_examples <= 10 and "coverage" not in sys.modules
    usual = usual and ANY_SPEED not in os.environ
    marked = MARKS & {mark.name for mark in item.iter_markers()}
    if took > 0.5 and usual and not marked and took / _loop_s() > LONGEST:
        pytest.fail(f"{took:.1f} s of processor time: make it smaller, or mark it `slow`")
    return result


def pytest_collection_finish() -> None:
    """Exempt the collected tests from garbage collection, and collect garbage seldom.

    Scanning thousands of tests took a quarter of a second, and it could happen in the middle of a
    test that measures time. With Python's own thresholds the collector takes 8 % of all tests.
    """
    gc.freeze()
    gc.set_threshold(100_000, 50, 50)
    gc.enable()
