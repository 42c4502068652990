"""The daemon sends a hundred lines a second; its counters explain each period without a line."""

from __future__ import annotations

import random
import time
from pathlib import Path

import pytest

from tests.system.bystander import lost
from tests.system.harness import (
    Bus,
    Daemon,
    FarPeer,
    Periods,
    broken,
    cpu_seconds,
    resident_kb,
    seconds,
    waited_for_a_core,
)

TICK_S = 0.01


def undisturbed(tmp_path: Path, length: float) -> tuple[Periods, float, bool]:
    """Run the daemon with the simulator and without commands for `length` seconds.

    Returns the counted periods, the time in which the daemon waited for a core (s), and whether the
    link was always up.
    """
    with Daemon(tmp_path) as daemon, Bus(daemon.endpoint) as bus, bus.follow("state") as states:
        begun = states.find(lambda state: state["link"] == "up", 5.0, "link up")
        first = begun.value
        cpu, waited = cpu_seconds(daemon.pid), waited_for_a_core(daemon.pid)
        end = seconds(first["stamp"]) + length
        last = states.find(
            lambda state: seconds(state["stamp"]) >= end, length + 10.0, f"a state {length:g} s on"
        ).value
        used, memory = cpu_seconds(daemon.pid) - cpu, resident_kb(daemon.pid)
        waited = waited_for_a_core(daemon.pid) - waited
        up = not broken(states, begun.at)
        late = bus.get("state")["latencies"]["period_lateness"]["since_start"]
    periods = Periods.between(first, last)
    print(
        f"{periods.elapsed / 100:.2f} s: {periods.sent} lines sent "
        f"({100 * periods.sent / periods.elapsed:.2f} % of 100/s), "
        f"{periods.superseded} superseded, {periods.missed} missed, "
        f"{periods.elapsed - periods.accounted:+.1f} unaccounted; "
        f"CPU {10_000 * used / periods.elapsed:.1f} % (simulator included), "
        f"memory {memory / 1024:.1f} MB, lateness {late}; {waited:.3f} s without a core"
    )
    return periods, waited, up


def is_even(periods: Periods, waited: float, up: bool) -> None:
    """Check that the number of sent lines is within 1 % of the rate.

    One line more at either end is allowed, and fewer lines for the time without a core. The
    counters must explain each period without a line. A link that was lost may have some.
    """
    least, most = periods.elapsed * 0.99 - 1, periods.elapsed * 1.01 + 1
    assert periods.sent <= most
    assert least - waited / TICK_S <= periods.sent or not up
    assert periods.are_all_accounted_for() or not up


@pytest.mark.slow
def test_without_commands_a_second_is_a_hundred_lines_and_every_gap_is_accounted_for(
    tmp_path: Path,
) -> None:
    is_even(*undisturbed(tmp_path, 1.5))


def off_the_tick(times: list[float]) -> int:
    """Return how many of these times are more than 2 ms away from the usual phase of a period."""

    def apart(a: float, b: float) -> float:
        return abs((a - b + TICK_S / 2) % TICK_S - TICK_S / 2)

    usual = max(times, key=lambda phase: sum(apart(at, phase) < 0.001 for at in times))
    return sum(apart(at, usual) > 0.002 for at in times)


@pytest.mark.slow
def test_a_sender_that_repeats_its_speed_has_the_lines_of_the_periods(tmp_path: Path) -> None:
    with (
        FarPeer(tmp_path) as board,
        Daemon(tmp_path, board.path) as daemon,
        Bus(daemon.endpoint) as bus,
    ):
        bus.linked()
        with bus.commanding(0.4) as commander:
            time.sleep(1.0)
            commander.silence()
            begun, waited = time.monotonic(), waited_for_a_core(daemon.pid)
            dice = random.Random(1)
            for number in range(80):
                # Every 50 ms, each command would come at the same moment of a period.
                time.sleep(dice.uniform(0.045, 0.055))
                # An echo or a stamp makes other bytes each time. The same bytes wait for the tick.
                bus.put(commander.key, commander.wish, commander.sender, indent=number % 2)
            ended, waited = time.monotonic(), waited_for_a_core(daemon.pid) - waited
            assert bus.state()["mode"] == "driving"
        times = [line.at for line in board.since(begun) if line.at < ended]
    off = off_the_tick(times)
    print(
        f"{len(times) / (ended - begun):.1f} lines/s, {100 * off / len(times):.1f} % off the tick"
    )
    assert len(times) <= 1.01 * (ended - begun) / TICK_S + 1
    assert len(times) >= 0.97 * (ended - begun - waited) / TICK_S - 1
    # Each wait of the daemon for a core may move some lines, and so may each wait of the kernel's
    # thread for the pty, which has no priority.
    assert off <= len(times) / 10 + (waited + lost(begun, ended)) / 0.002
