"""Print how much processor time and lateness the recorder adds to the control loop.

    pytest -s -m bench tests/bench/test_record.py

Two daemons, one with and one without a recorder, receive 20 commands a second. For the lateness
they run one after the other, in ten rounds of alternating order. For the processor time they run at
the same time, in twenty pairs, so that other programs of the machine slow both equally. The kernel
counts the processor time of all their threads. A last measurement has a robot at rest. The
benchmark takes nine minutes.
"""

from __future__ import annotations

import time
from contextlib import ExitStack
from pathlib import Path
from statistics import mean, median, stdev
from typing import NamedTuple

import pytest

from tests.system.harness import Bus, Daemon, running

pytestmark = [pytest.mark.bench, pytest.mark.timeout(900)]

ROUNDS, SPAN_S, SETTLES_S, REST_S = 10, 9.0, 1.0, 30.0

PAIRS = 20

SHARE = 0.15
"""Share of the daemon's processor time without recording, on this machine as it is.

The median is reliable enough for that.
"""

MORE = 0.4
"""Points of a core that recording may take."""

DRIVING, IDLE = 400e6, 115e6
"""Bytes per day that the recorder may write."""


class Cost(NamedTuple):
    processor: float
    """Processor time, % of a core."""
    p50: float
    p99: float
    """Time from when a period was due to its step, us."""
    missed: int
    bytes_: float
    """Bytes of recordings per second."""


def processor_s(pid: int) -> float:
    """Return the processor time of all current threads of a process, s. Its resolution is 1 ns."""
    tasks = Path(f"/proc/{pid}/task").glob("*/schedstat")
    return sum(int(task.read_text().split()[0]) for task in tasks) / 1e9


def size(where: Path) -> int:
    return sum(path.stat().st_size for path in where.rglob("*.rec.zst"))


def cost(where: Path, records: bool) -> Cost:
    """Run a daemon that drives a simulated robot, and return what this costs."""
    where.mkdir(parents=True)
    words = ["--record", str(where / "record")] if records else []
    with running(where, words=words) as (daemon, bus), bus.commanding(0.3):
        time.sleep(SETTLES_S)
        used, written, began = processor_s(daemon.pid), size(where), time.monotonic()
        time.sleep(SPAN_S)
        used, span = processor_s(daemon.pid) - used, time.monotonic() - began
        written = size(where) - written
        state = bus.state()
    late = state["latencies"]["period_lateness"]["since_start"]
    missed = int(state["counters"].get("missed_periods", 0))
    return Cost(100 * used / span, late["p50"], late["p99"], missed, written / span)


def pair(where: Path, first: bool) -> tuple[float, float]:
    """Run two daemons at once, without and with recording. Return the % of a core of each."""
    with ExitStack() as stack:
        pids: dict[bool, int] = {}
        for records in (first, not first):
            (place := where / str(records)).mkdir(parents=True)
            words = ["--record", str(place / "record")] if records else []
            daemon = stack.enter_context(Daemon(place, words=words))
            bus = stack.enter_context(Bus(daemon.endpoint))
            bus.linked()
            stack.enter_context(bus.commanding(0.3))
            pids[records] = daemon.pid
        time.sleep(SETTLES_S)
        before = {records: processor_s(pid) for records, pid in pids.items()}
        began = time.monotonic()
        time.sleep(SPAN_S)
        used = {records: processor_s(pid) - before[records] for records, pid in pids.items()}
        span = time.monotonic() - began
        return 100 * used[False] / span, 100 * used[True] / span


def cost_text(name: str, costs: list[Cost]) -> str:
    middle = [median(column) for column in zip(*costs, strict=True)]
    return (
        f"{name}: {middle[0]:.2f} % of a core, late p50 {middle[1]:.0f} us, p99 {middle[2]:.0f} us "
        f"(from {min(c.p99 for c in costs):.0f} to {max(c.p99 for c in costs):.0f}), "
        f"{sum(c.missed for c in costs)} periods missed, {middle[4] * 0.0864:.0f} MB a day"
    )


def test_recording_makes_no_period_late(tmp_path: Path) -> None:
    costs: dict[bool, list[Cost]] = {False: [], True: []}
    for number in range(ROUNDS):
        for records in (False, True) if number % 2 else (True, False):
            costs[records].append(cost(tmp_path / f"{number}-{records}", records))
    off, on = costs[False], costs[True]
    print(f"\n{cost_text('without', off)}\n{cost_text('recording', on)}")
    # The bound is the difference between two equal daemons on this machine now.
    noise = max(run.p99 for run in off) - min(run.p99 for run in off)
    assert median(run.p99 for run in on) <= median(run.p99 for run in off) + noise
    assert 0 < median(run.bytes_ for run in on) * 86_400 < DRIVING


def test_recording_takes_little_of_the_processor(tmp_path: Path) -> None:
    pairs = [pair(tmp_path / str(number), bool(number % 2)) for number in range(PAIRS)]
    more = [on - off for off, on in pairs]
    error = stdev(more) / PAIRS**0.5
    print(f"\nrecording takes {mean(more):+.2f} +- {2 * error:.2f} points of a core", end=" ")
    print(f"(twice the standard error of {PAIRS} pairs; each +- {stdev(more):.2f}, ", end="")
    # A busy machine makes both slower. It is quiet if the daemon without recording takes 3 %.
    print(f"median {median(more):+.2f}) beside {mean(off for off, _ in pairs):.2f} without")
    assert mean(more) - 2 * error < MORE
    assert median(more) < SHARE * mean(off for off, _ in pairs)


def test_an_idle_day_is_less_than_90_mb(tmp_path: Path) -> None:
    words = ["--record", str(tmp_path / "record")]
    with running(tmp_path, words=words):
        time.sleep(SETTLES_S)
        written, began = size(tmp_path), time.monotonic()
        time.sleep(REST_S)
        rate = (size(tmp_path) - written) / (time.monotonic() - began)
    print(f"\nat rest: {rate:.0f} bytes a second, {rate * 0.0864:.0f} MB a day")
    assert rate * 86_400 < IDLE
