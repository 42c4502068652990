"""A hundred lines a second, and every period that did not send one is accounted for."""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.system.harness import Bus, Daemon, Periods, cpu_seconds, resident_kb, seconds


def undisturbed(tmp_path: Path, length: float) -> Periods:
    """So many seconds on the simulator without commands."""
    with Daemon(tmp_path) as daemon, Bus(daemon.endpoint) as bus, bus.follow("state") as states:
        first = states.find(lambda state: state["link"] == "up", 5.0, "link up").value
        cpu = cpu_seconds(daemon.pid)
        end = seconds(first["stamp"]) + length
        last = states.find(
            lambda state: seconds(state["stamp"]) >= end, length + 10.0, f"a state {length:g} s on"
        ).value
        used, memory = cpu_seconds(daemon.pid) - cpu, resident_kb(daemon.pid)
        late = bus.get("state")["figures"]["period_lateness"]["since_start"]
    periods = Periods.between(first, last)
    print(
        f"{periods.elapsed / 100:.2f} s: {periods.sent} lines sent "
        f"({100 * periods.sent / periods.elapsed:.2f} % of 100/s), "
        f"{periods.superseded} superseded, {periods.missed} missed, "
        f"{periods.elapsed - periods.accounted:+.1f} unaccounted; "
        f"CPU {10_000 * used / periods.elapsed:.1f} % (simulator included), "
        f"memory {memory / 1024:.1f} MB, lateness {late}"
    )
    return periods


def is_even(periods: Periods) -> None:
    """Within 1 % of the rate, every gap counted."""
    assert periods.sent == pytest.approx(periods.elapsed, rel=0.01)
    # A state falls anywhere within a period, at either end.
    assert periods.accounted == pytest.approx(periods.elapsed, abs=2)


def test_5_s_without_commands_are_500_lines_and_every_gap_is_accounted_for(
    tmp_path: Path,
) -> None:
    is_even(undisturbed(tmp_path, 5.0))


@pytest.mark.soak
def test_60_s_without_commands_are_6000_lines_and_every_gap_is_accounted_for(
    tmp_path: Path,
) -> None:
    is_even(undisturbed(tmp_path, 60.0))
