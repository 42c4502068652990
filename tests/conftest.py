"""What holds for every test: the hypothesis profile, and signals as at a terminal."""

from __future__ import annotations

import os
import signal
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


TIMED = ("bench", "firmware", "system", "systemd")
"""Where real time passes: these run one after the other. All else is only computed beside them."""


def pytest_xdist_auto_num_workers(config: pytest.Config) -> int:
    """Two processes for the default run; one, which shows what is printed, for any other."""
    part = config.args_source is not pytest.Config.ArgsSource.TESTPATHS
    other = config.option.capture == "no" or "not (slow or soak" not in config.option.markexpr
    return 0 if part or other or len(os.sched_getaffinity(0)) < 2 else 2


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    here = Path(__file__).parent
    for item in items:
        if item.path.relative_to(here).parts[0] in TIMED:
            item.add_marker(pytest.mark.xdist_group("timed"))
