"""Print the latencies on a busy machine and on a quiet one in one table.

    pytest -s -m bench tests/bench/test_busy.py

On the busy machine each core runs a busy loop at the daemon's normal priority. The measuring
process has a higher priority, because its own delays must not appear in the figures. The test runs
once with the real-time scheduling that the systemd unit permits to the daemon's loop, and once
without it.

Some cases add a flood: a client that sends commands as fast as it can. Other cases record the
drive, because the recorder's thread shares the Python interpreter with the loop.
"""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import NamedTuple

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config
from tests.bench.matching import staircase
from tests.bench.rigs import all_cores_busy, config, delays_us, rig, schedule, share, waits_us
from tests.system.strangers import FLOOD, command_line

pytestmark = [pytest.mark.bench, pytest.mark.timeout(300)]

SECONDS = 20.0

AHEAD = 60
"""SCHED_FIFO priority of the measuring process."""


@contextmanager
def ahead_of_all() -> Iterator[None]:
    """Give all threads of this process a real-time priority, or skip the test if not permitted."""
    try:
        schedule(os.getpid(), os.SCHED_FIFO, AHEAD)
    except PermissionError:
        pytest.skip("real-time scheduling is not permitted here")
    try:
        yield
    finally:
        schedule(os.getpid(), os.SCHED_OTHER)


@contextmanager
def flooded(settings: Config, wanted: bool) -> Iterator[None]:
    """Run a client that floods another command source with zeros while the body runs.

    If `wanted` is False, no client runs.
    """
    if not wanted:
        yield
        return
    text = FLOOD.replace("acsard/acsar/cmd/app", f"acsard/{settings.robot.id}/cmd/nav")
    flood = subprocess.Popen(
        command_line(text, settings.bus.listen[0], 0.0, 2 * SECONDS), stdout=subprocess.PIPE
    )
    try:
        yield
    finally:
        flood.kill()
        flood.communicate()


class Case(NamedTuple):
    busy: bool = False
    flood: bool = False
    record: bool = False


CASES = {
    "quiet": Case(),
    "quiet, recording": Case(record=True),
    "all cores busy": Case(busy=True),
    "all cores busy, recording": Case(busy=True, record=True),
    "flood": Case(flood=True),
    "all cores busy, flood": Case(busy=True, flood=True),
}


@pytest.mark.parametrize("real_time", [True, False], ids=["as the unit", "no real time"])
def test_a_busy_machine_beside_a_quiet_one(real_time: bool, tmp_path: Path) -> None:
    how = "as the unit may" if real_time else "without real-time scheduling"
    print(f"\n{SECONDS:g} s each, {how}, us{'command -> wire':>28}{'feedback -> odometry':>33}")
    print(f"{'':26}{'p50':>9}{'p99':>9}{'max':>9}   {'p50':>9}{'p99':>9}{'max':>9}")
    late = {}
    for name, (busy, flood, record_too) in CASES.items():
        settings = config()
        if record_too:
            settings = replace(
                settings, record=replace(settings.record, directory=str(tmp_path / name))
            )
        settings = replace(settings, control=replace(settings.control, real_time=real_time))
        with (
            rig(settings) as running,
            all_cores_busy(busy),
            flooded(settings, flood),
            ahead_of_all(),
        ):
            running.command(SECONDS, staircase, 1)
            record = running.end()
        assert any((tmp_path / name).glob("*.rec.zst")) == record_too
        waits, delays = waits_us(record), delays_us(settings, record)
        cells = [f"{share(values, p):9.0f}" for values in (waits, delays) for p in (0.5, 0.99, 1.0)]
        print(f"{name:26}{''.join(cells[:3])}   {''.join(cells[3:])}", flush=True)
        late[name] = sum(wait > 10_000 for wait in waits) / len(waits)
    if real_time:
        # The limit is one period, apart from the time that the machine itself loses. A flood has no
        # limit here, because it takes all the time it gets.
        assert max(late[name] for name, case in CASES.items() if not case.flood) < 0.05
