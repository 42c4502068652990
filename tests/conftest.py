"""What holds for every test: the hypothesis profile, and signals as at a terminal."""

from __future__ import annotations

import os
import signal
import sys
import tempfile
from pathlib import Path

import pytest
from hypothesis import settings

# No deadline: a slow machine must not fail a true sentence. The same examples every time: what a
# change is judged by must not be luck. `explore` looks for new ones.
settings.register_profile("default", deadline=None, max_examples=30, derandomize=True)
settings.register_profile("thorough", deadline=None, max_examples=300, derandomize=True)
"""`pytest --hypothesis-profile thorough`, as `.ci/run` does."""
settings.register_profile("explore", deadline=None, max_examples=3000)
"""`pytest --hypothesis-profile explore tests/unit`: 8 minutes, other examples each time."""
settings.load_profile("default")

# nohup and a script's `&` start a program with these ignored, and what a test starts inherits that.
# A handler is not inherited; one that does nothing ignores them as well.
for number in (signal.SIGINT, signal.SIGHUP):
    if signal.getsignal(number) is signal.SIG_IGN:
        signal.signal(number, lambda *_: None)

# Where bytecode may not be written, as in many containers, each of the hundreds of daemons here
# would compile all of acsard anew, and so would each worker the tests: it goes to pytest's cache, or
# where anybody may write.
if sys.dont_write_bytecode or not os.access(__file__, os.W_OK):
    place = Path(__file__).parent.parent
    if not os.access(place, os.W_OK):
        place = Path(tempfile.gettempdir()) / f"acsard-tests-{os.getuid()}"
    sys.pycache_prefix = str(place / ".pytest_cache" / "bytecode")
    sys.dont_write_bytecode = False
    os.environ["PYTHONPYCACHEPREFIX"] = sys.pycache_prefix
    os.environ.pop("PYTHONDONTWRITEBYTECODE", None)


TIMED = ("bench", "firmware", "system", "systemd")
"""Where real time passes: these run one after the other. All else is only computed beside them, or
says by a mark of its own that it does not mind."""


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Two processes for what `.ci/run` runs; one, which shows what is printed, for any other."""
    part = config.args_source is not pytest.Config.ArgsSource.TESTPATHS
    other = (
        config.option.capture == "no" or "soak" not in config.option.markexpr.partition("not")[2]
    )
    return 0 if part or other or len(os.sched_getaffinity(0)) < 2 else 2


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    here = Path(__file__).parent
    for item in items:
        timed = item.path.relative_to(here).parts[0] in TIMED
        if timed and not item.get_closest_marker("xdist_group"):
            item.add_marker(pytest.mark.xdist_group("timed"))
