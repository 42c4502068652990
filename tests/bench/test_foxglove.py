"""Print the processor time that a viewer of all topics costs `acsard foxglove` and the daemon.

    pytest -s -m bench tests/bench/test_foxglove.py

Measurements with and without a viewer alternate on one daemon. The kernel counts the processor
time.
"""

from __future__ import annotations

import time
from pathlib import Path
from statistics import median
from typing import NamedTuple

import pytest

from tests.system.harness import Bus, Daemon, Periods, cpu_seconds, waited_for_a_core
from tests.system.test_foxglove import Shows
from tests.system.viewer import Viewer

pytestmark = pytest.mark.bench

ROUNDS, SPAN_S = 5, 3.0


class Cost(NamedTuple):
    """Processor time of both processes during a measurement, % of a core, and the periods."""

    bridge: float
    daemon: float
    periods: Periods
    waited_s: float
    """Time for which the control loop was ready but had no core."""


def cost(daemon: Daemon, bridge: Shows, bus: Bus) -> Cost:
    """Wait for `SPAN_S` seconds, and return the cost of this time."""
    pids = bridge.pid, daemon.pid
    first, before = bus.state(), [cpu_seconds(pid) for pid in pids]
    waited = waited_for_a_core(daemon.pid)
    begun = time.monotonic()
    time.sleep(SPAN_S)
    span = time.monotonic() - begun
    used = [100 * (cpu_seconds(pid) - b) / span for pid, b in zip(pids, before, strict=True)]
    waited = waited_for_a_core(daemon.pid) - waited
    return Cost(used[0], used[1], Periods.between(first, bus.state()), waited)


def test_a_viewer_of_all_topics(tmp_path: Path) -> None:
    alone, watched, messages = [], [], 0
    with Daemon(tmp_path) as daemon, Bus(daemon.endpoint) as bus, Shows(daemon) as bridge:
        bus.linked()
        for _ in range(ROUNDS):
            alone.append(cost(daemon, bridge, bus))
            with Viewer(bridge.port) as viewer:
                looked = [viewer.show(topic) for topic in viewer.channels]
                next(item for item in looked if item.channel["topic"] == "/odom").first(10)
                before = sum(len(item.came) for item in looked)
                watched.append(cost(daemon, bridge, bus))
                messages += sum(len(item.came) for item in looked) - before
    rate = messages / ROUNDS / SPAN_S
    bridge_s = sum(item.bridge for item in watched) / 100 * SPAN_S
    print(f"\n{rate:.0f} messages a second, {1e6 * bridge_s / messages:.0f} us each, all told")
    for name, costs in (("no viewer", alone), ("a viewer", watched)):
        missed = sum(item.periods.missed for item in costs)
        print(
            f"{name}: acsard foxglove {median(item.bridge for item in costs):.1f} % of a core, "
            f"daemon {median(item.daemon for item in costs):.1f} %, missed periods {missed} of "
            f"{sum(item.periods.elapsed for item in costs):.0f}, "
            f"loop without a core {sum(item.waited_s for item in costs) * 1000:.0f} ms"
        )
    assert rate > 0.9 * 4 * 100
    assert median(item.bridge for item in alone) < 0.2 * median(item.bridge for item in watched)
    # Each missed period is one in which the machine had no core for the loop.
    missed, waited = sum(item.periods.missed for item in watched), sum(o.waited_s for o in watched)
    assert missed <= sum(item.periods.missed for item in alone) + 2 + waited / 0.01
