"""What holds for every test: the hypothesis profile, and signals as at a terminal."""

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

# No deadline: a slow machine must not fail a true sentence. The same examples every time: what a
# change is judged by must not be luck. `explore` looks for new ones.
settings.register_profile("default", deadline=None, max_examples=10, derandomize=True)
settings.register_profile("thorough", deadline=None, max_examples=100, derandomize=True)
"""`pytest --hypothesis-profile thorough`, as `.ci/run` does."""
settings.register_profile("explore", deadline=None, max_examples=3000)
"""`pytest --hypothesis-profile explore tests/unit`: 8 minutes, other examples each time."""
settings.load_profile("default")

# nohup and a script's `&` start a program with these ignored, and what a test starts inherits that.
# A handler is not inherited; one that does nothing ignores them as well.
for number in (signal.SIGINT, signal.SIGHUP):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, lambda *_: None)

# Where bytecode may not be written, as in many containers, or by a user who does not own the clone,
# each of the hundreds of daemons here would compile all of acsard anew, and each worker the tests.
if sys.dont_write_bytecode or not os.access(__file__, os.W_OK):
    place = str(Path(__file__).parents[1] / ".pytest_cache" / "bytecode")
    if "PYTHONPYCACHEPREFIX" in os.environ:  # a worker's
        place = os.environ["PYTHONPYCACHEPREFIX"]
    elif not os.access(__file__, os.W_OK):
        place = tempfile.mkdtemp(prefix="acsard-")
        atexit.register(shutil.rmtree, place, ignore_errors=True)
    sys.pycache_prefix = os.environ["PYTHONPYCACHEPREFIX"] = place
    sys.dont_write_bytecode = False
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


TIMED = {"bench": "timed", "firmware": "timed", "system": "timed", "systemd": "systemd"}
"""Where real time passes, and its group: those of one run one after the other. What a container
waits for minds company as little as what is only computed, so it goes on beside the others; a mark
of its own says the same of a single test."""


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Two processes for what `.ci/run` runs; one, which shows what is printed, for any other."""
    part = config.args_source is not pytest.Config.ArgsSource.TESTPATHS
    other = (
        config.option.capture == "no" or "soak" not in config.option.markexpr.partition("not")[2]
    )
    return 0 if part or other or len(os.sched_getaffinity(0)) < 2 else 2


class _ByFile(LoadGroupScheduling):  # type: ignore[misc]
    """Groups, and of all else whole files: after each test all that its worker was ever given is
    counted anew, so 10,000 handed out one by one take the time of many tests."""

    def _split_scope(self, nodeid: str) -> str:
        scope: str = super()._split_scope(nodeid)
        return nodeid.partition("::")[0] if scope == nodeid else scope


def pytest_xdist_make_scheduler(config: pytest.Config, log: object) -> _ByFile:
    config.option.loadscopereorder = False  # the longest group is first as it is
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


@pytest.hookimpl(tryfirst=True)  # before `-m` chooses
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    here = Path(__file__).parent
    _all_but_some_are_slow(items)
    for item in items:
        group = TIMED.get(item.path.relative_to(here).parts[0])
        if group and not item.get_closest_marker("xdist_group"):
            item.add_marker(pytest.mark.xdist_group(group))
    items.sort(key=lambda item: item.path.relative_to(here).parts[0] not in TIMED)


def pytest_collection_finish() -> None:
    """To look through thousands of tests for what nobody holds took a quarter of a second: in the
    middle of a test that times something."""
    gc.collect()
    gc.freeze()
