"""The daemon sends a hundred lines a second; its counters explain each period without a line."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.system.harness import (
    Bus,
    Daemon,
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
    counters must explain each period without a line, unless the link was lost.
    """
    least, most = periods.elapsed * 0.99 - 1, periods.elapsed * 1.01 + 1
    assert least - waited / TICK_S <= periods.sent <= most
    # A link that was lost may have periods without a line.
    assert periods.are_all_accounted_for() or not up


@pytest.mark.slow
def test_without_commands_a_second_is_a_hundred_lines_and_every_gap_is_accounted_for(
    tmp_path: Path,
) -> None:
    is_even(*undisturbed(tmp_path, 1.5))
