"""Huge messages and floods disturb neither the robot nor other clients."""

from __future__ import annotations

import time
from pathlib import Path
from typing import get_args

import pytest

from acsard.core.tables.sender_codes import AgeCode
from tests.system.bystander import lost
from tests.system.harness import (
    Bus,
    Daemon,
    Periods,
    Program,
    kept_waiting,
    resident_kb,
    until,
)
from tests.system.ros_clients import TWIST, rmw_key
from tests.system.ros_clients import twist as ros_twist
from tests.system.strangers import FLOOD, command_line

TICK_S = 0.01


def test_a_message_over_the_link_s_size_harms_only_its_sender(bus: Bus, shared: Daemon) -> None:
    with Bus(shared.endpoint) as sender:
        sender.session.put("acsard/acsar/cmd/app", b"{" + b" " * 1_000_000)
        lines = bus.count("lines_sent")
        until(lambda: bus.count("lines_sent") > lines + 50, 5.0, "it goes on")
    assert bus.comes_to("ready")["linear"] == 0.0
    with Bus(shared.endpoint) as another:
        another.linked()


@pytest.mark.slow
@pytest.mark.parametrize("stopped", [True, False], ids=["with a stop", "to its end"])
def test_a_flood_costs_no_periods_and_no_memory_and_delays_neither_a_stop_nor_its_end(
    tmp_path: Path, stopped: bool
) -> None:
    with (
        Daemon(tmp_path) as daemon,
        Bus(daemon.endpoint) as bus,
        bus.follow("state") as states,
        bus.follow("cmd_vel_out") as applied,
    ):
        bus.linked()
        before, memory = bus.state(), resident_kb(daemon.pid)
        waited = kept_waiting(daemon.pid)
        with Program(command_line(FLOOD, daemon.endpoint, 0.2, 1.5), tmp_path) as flood:
            flood.says("flooding")
            begun = time.monotonic()
            moves = lambda state: state["linear"] == pytest.approx(0.2, abs=0.01)  # noqa: E731
            states.find(moves, 3.0, "0.2 m/s")
            # Most of the flood comes first, then the stop in the middle of it.
            states.find(lambda _: True, 3.0, "a second of flood", after=begun + 1.0)
            ended = time.monotonic()
            if stopped:
                bus.session.put("acsard/acsar/stop", b"")
                states.find(lambda s: s["mode"] == "stopped", 3.0, "stopped", after=ended)
                assert time.monotonic() - ended < 0.2 + lost(ended)
                assert flood.process.poll() is None, "the flood was over too early"
            count = int(flood.says("flooded").split()[1])
            if not stopped:
                ended = time.monotonic()
            assert flood.ended(5.0) == 0
        rest = applied.find(
            lambda step: step["twist"]["linear"]["x"] == 0.0, 5.0, "at rest", after=ended
        ).at
        # On a busy machine, these may be the zeros of a link that was lost, and comes back.
        mode = "stopped" if stopped else "ready"
        until(lambda: bus.state()["mode"] == mode, 2.0, mode)
        after, grown = bus.state(), resident_kb(daemon.pid) - memory
        waited = kept_waiting(daemon.pid) - waited
    periods = Periods.between(before, after)
    print(
        f"flood of {count} puts: {periods.missed} of {periods.elapsed:.0f} periods missed, memory "
        f"{grown:+d} kB, at rest {rest - ended:.3f} s after its end or the stop"
    )
    assert count > 8000
    assert periods.missed <= 0.03 * periods.elapsed + waited / TICK_S
    assert grown < 10_000
    # No backlog drives the robot on: the timeout of the last command, and a ramp of 0.2 s.
    assert rest - ended < 0.25 + 0.2 + 0.2 + waited + lost(ended, rest)
    assert "Traceback" not in daemon.stderr


ROS_FLOOD = """\
import struct, sys, time
import zenoh
from tests.system.harness import client_config

endpoint, key, payload, by_rmw, count = *sys.argv[1:3], bytes.fromhex(sys.argv[3]), sys.argv[4], 0
session = zenoh.open(client_config(endpoint))
publisher = session.declare_publisher(key)
print("flooding", flush=True)
end = time.monotonic() + 1.0
while time.monotonic() < end:
    count += 1
    attachment = struct.pack("<qqB16s", count, time.time_ns(), 16, b"g" * 16)
    publisher.put(payload, attachment=attachment if by_rmw == "rmw" else None)
print("flooded", count, flush=True)
session.close()
"""
"""Sends a payload on a key for a second, as fast as one process can, as a node or a bridge does."""


@pytest.mark.slow
@pytest.mark.parametrize("way", ["rmw", pytest.param("bridge", marks=pytest.mark.nightly)])
def test_a_flood_from_ros_is_limited_to_a_thousand_commands_a_second(
    shared: Daemon, bus: Bus, tmp_path: Path, way: str
) -> None:
    key = "cmd_vel" if way == "bridge" else rmw_key("cmd_vel", TWIST)
    program = command_line(ROS_FLOOD, shared.endpoint, key, ros_twist(0.0).hex(), way)
    before = bus.state()
    with Program(program, tmp_path) as flood:
        flood.says("flooding")
        begun = time.monotonic()
        count = int(flood.says("flooded").split()[1])
        assert flood.ended(5.0) == 0
        lasted = time.monotonic() - begun
    # After a tenth of a second of silence, all messages under way have arrived.
    lines = bus.count("lines_sent")
    until(lambda: bus.count("lines_sent") >= lines + 10, 3.0, "ten more lines")
    after = bus.state()

    def counted(*names: str) -> int:
        return sum(after["counters"].get(n, 0) - before["counters"].get(n, 0) for n in names)

    assert count > 5000
    assert counted("commands") > 100
    # Without the limit, the excess would be overrun, or would still be accepted.
    ages = [f"command_{code}" for code in get_args(AgeCode)]
    assert counted("commands", "bus_overrun", *ages) <= 1100 * lasted
