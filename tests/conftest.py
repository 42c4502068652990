"""Set up every test run: the hypothesis profiles, and signals as a terminal delivers them."""

from __future__ import annotations

import atexit
import gc
import os
import shutil
import signal
import sys
import tempfile
from collections import Counter
from pathlib import Path

import pytest
from hypothesis import settings
from xdist.scheduler import LoadGroupScheduling

# There is no deadline, because a slow machine must not fail a property that holds. The examples are
# the same in every run, so that luck never decides how a change is judged. `explore` looks for new
# examples.
settings.register_profile("default", deadline=None, max_examples=10, derandomize=True)
settings.register_profile("thorough", deadline=None, max_examples=100, derandomize=True)
"""`pytest --hypothesis-profile thorough`, as `.ci/run` does."""
settings.register_profile("explore", deadline=None, max_examples=3000)
"""`pytest --hypothesis-profile explore tests/unit`: 8 minutes, other examples each time."""
settings.load_profile("default")

# nohup and a script's `&` start a program with these signals ignored, and the programs that a test
# starts inherit that. A handler is not inherited, and a handler that does nothing ignores the
# signals just as well.
for number in (signal.SIGINT, signal.SIGHUP):
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


TIMED = {"bench": "timed", "firmware": "timed", "system": "timed", "systemd": "systemd"}
"""Directories whose tests depend on real time, and the group of each.

The tests of one group run one after the other. Waiting for a container tolerates a busy machine as
well as pure computation does, so the systemd group runs in parallel with the others. A mark on a
single test puts that test into a group.
"""


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Use two processes for the suite that `.ci/run` runs, and one for any other call.

    A single process shows the output that tests print.
    """
    part = config.args_source is not pytest.Config.ArgsSource.TESTPATHS
    other = (
        config.option.capture == "no" or "soak" not in config.option.markexpr.partition("not")[2]
    )
    return 0 if part or other or len(os.sched_getaffinity(0)) < 2 else 2


class _ByFile(LoadGroupScheduling):  # type: ignore[misc]
    """Distribute groups, and every other test by whole files.

    After each test xdist counts every test that the worker was ever given. Handing out 10,000 tests
    one by one therefore costs as much time as many tests.
    """

    def _split_scope(self, nodeid: str) -> str:
        scope: str = super()._split_scope(nodeid)
        return nodeid.partition("::")[0] if scope == nodeid else scope


def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> _ByFile:
    config.option.loadscopereorder = False  # the longest group already comes first
    return _ByFile(config, log)


def _all_but_some_are_slow(items: list[pytest.Item]) -> None:
    seen = Counter[str]()
    for item in items:
        one_in = item.get_closest_marker("variations")
        if one_in is None:
            continue
        test = item.nodeid.partition("[")[0]
        if seen[test] % one_in.args[0]:
            item.add_marker(pytest.mark.slow)
        seen[test] += 1


@pytest.hookimpl(tryfirst=True)  # runs before `-m` selects tests
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    here = Path(__file__).parent
    _all_but_some_are_slow(items)
    for item in items:
        group = TIMED.get(item.path.relative_to(here).parts[0])
        if group and not item.get_closest_marker("xdist_group"):
            item.add_marker(pytest.mark.xdist_group(group))
    items.sort(key=lambda item: item.path.relative_to(here).parts[0] not in TIMED)


def pytest_collection_finish() -> None:
    """Exempt the collected tests from garbage collection.

    Scanning thousands of tests took a quarter of a second, and it could happen in the middle of a
    test that measures time.
    """
    gc.collect()
    gc.freeze()
