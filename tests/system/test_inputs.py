"""Huge values, huge messages and floods disturb neither the robot nor other clients."""

from __future__ import annotations

import struct
import time
from collections.abc import Iterator
from pathlib import Path
from typing import get_args

import pytest

from acsard.core.codes import AgeCode
from tests.system.bystander import lost
from tests.system.harness import (
    Bus,
    Daemon,
    Periods,
    Program,
    kept_waiting,
    resident_kb,
    until,
    waited_for_a_core,
)
from tests.system.ros_clients import TWIST, WHEELS, rmw_key
from tests.system.ros_clients import twist as ros_twist
from tests.system.strangers import FLOOD, command_line

TICK_S = 0.01


def test_enormous_wheel_speeds_are_clamped_to_the_limits(bus: Bus) -> None:
    # The value is finite, so it is clamped instead of refused. 1e308 on every wheel must not become
    # NaN on the way.
    with bus.follow("cmd_vel_out") as applied:
        bus.at_rest()
        count = bus.count("commands")
        bus.put("wheel_cmd/app", {"name": WHEELS, "velocity": [0.0] * 4})
        # A message of an earlier test may still arrive after this point.
        until(lambda: bus.count("commands") >= count + 1, 5.0, "the zero was received")
        bus.put("wheel_cmd/app", {"name": WHEELS, "velocity": [1e300, 1e300, -1e300, -1e300]})
        until(lambda: bus.count("commands") >= count + 2, 5.0, "the speeds were received")
        until(lambda: bus.state()["mode"] == "ready", 5.0, "their timeout is over")
        until(lambda: bus.state()["linear"] == bus.state()["angular"] == 0, 5.0, "at rest")
    for entry in applied.seen:
        assert abs(entry.value["twist"]["linear"]["x"]) <= 1.0
        assert abs(entry.value["twist"]["angular"]["z"]) <= 4.0


def test_a_message_over_the_link_s_size_harms_only_its_sender(bus: Bus, shared: Daemon) -> None:
    with Bus(shared.endpoint) as sender:
        sender.session.put("acsard/acsar/cmd/app", b"{" + b" " * 1_000_000)
        lines = bus.count("lines_sent")
        until(lambda: bus.count("lines_sent") > lines + 50, 5.0, "it goes on")
    assert bus.comes_to("ready")["linear"] == 0.0
    with Bus(shared.endpoint) as another:
        another.linked()


@pytest.mark.slow
def test_a_flood_costs_no_periods_and_no_memory_and_a_stop_still_latches_immediately(
    tmp_path: Path,
) -> None:
    with Daemon(tmp_path) as daemon, Bus(daemon.endpoint) as bus, bus.follow("state") as states:
        bus.linked()
        before, memory = bus.state(), resident_kb(daemon.pid)
        waited = kept_waiting(daemon.pid)
        with Program(command_line(FLOOD, daemon.endpoint, 0.2, 2.0), tmp_path) as flood:
            flood.says("flooding")
            begun = time.monotonic()
            driving = states.find(
                lambda state: state["linear"] == pytest.approx(0.2, abs=0.01), 3.0, "0.2 m/s"
            )
            # Send most of the flood first, then the stop in the middle of it.
            states.find(lambda _: True, 3.0, "1.5 s of flood", after=begun + 1.5)
            sent = time.monotonic()
            bus.session.put("acsard/acsar/stop", b"")
            stopped = states.find(
                lambda state: state["mode"] == "stopped", 3.0, "stopped", after=sent
            )
            assert flood.process.poll() is None, "the flood was over too early"
            count = int(flood.says("flooded").split()[1])
            assert flood.ended(5.0) == 0
        after, grown = bus.state(), resident_kb(daemon.pid) - memory
        waited = kept_waiting(daemon.pid) - waited
        until(lambda: bus.state()["linear"] == 0.0, 3.0, "at rest")
    periods = Periods.between(before, after)
    counters = after["counters"]
    print(
        f"flood of {count} puts in 2 s: {periods.missed} of {periods.elapsed:.0f} periods missed, "
        f"{counters['commands']} commands taken, overrun {counters.get('bus_overrun', 0)}, "
        f"memory +{grown} kB, driving after {driving.at - begun:.3f} s, "
        f"stop latched after {stopped.at - sent:.4f} s"
    )
    assert count > 10_000
    assert periods.missed <= 0.03 * periods.elapsed + waited / TICK_S
    assert grown < 10_000
    assert stopped.at - sent < 0.2 + lost(sent, stopped.at)
    assert after["mode"] == "stopped"
    assert "Traceback" not in daemon.stderr


# the same commands over ROS


SESSION = """\
import struct, sys, time
import zenoh
from tests.system.harness import client_config

endpoint, key, seconds = sys.argv[1], sys.argv[2], float(sys.argv[3])
session = zenoh.open(client_config(endpoint))
"""

ROS_FLOOD = (
    SESSION
    + """
payload, by_rmw, count = bytes.fromhex(sys.argv[4]), sys.argv[5] == "rmw", 0
publisher = session.declare_publisher(key)
print("flooding", flush=True)
end = time.monotonic() + seconds
while time.monotonic() < end:
    count += 1
    attachment = struct.pack("<qqB16s", count, time.time_ns(), 16, b"g" * 16) if by_rmw else None
    publisher.put(payload, attachment=attachment)
print("flooded", count, flush=True)
session.close()
"""
)
"""Sends one payload on a key as fast as one process can for `seconds`, as a node or a bridge does.
"""

SLOW_WORK = (
    SESSION
    + """
service, joints, names = sys.argv[4], *map(bytes.fromhex, sys.argv[5:])
publisher, called, count = session.declare_publisher(key), 0, 0
print("flooding", flush=True)
start = time.monotonic()
while (now := time.monotonic()) < start + seconds:
    publisher.put(joints)
    count += 1
    while called < min(1000, 2000 * (now - start) / seconds):
        called += 1
        session.get(service, lambda reply: None, payload=names, attachment=b"rqh" + bytes(17))
print("flooded", count, called, flush=True)
session.close()
"""
)
"""The same flood, with 1000 calls of a service in the first half of the time."""

HALF = b"\0\1\0\0"

EMPTY_JOINTS = HALF + struct.pack("<iIIB3xI", 0, 0, 1, 0, 1017)
EMPTY_JOINTS += bytes(4096 - len(EMPTY_JOINTS))
EMPTY_NAMES = HALF + struct.pack("<I", 1022) + bytes(4088)
"""4096 bytes with as many names without a letter as fit."""


@pytest.fixture(scope="module")
def flooded(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    """A separate daemon for the tests that flood it with ROS messages."""
    with Daemon(tmp_path_factory.mktemp("flooded")) as daemon:
        yield daemon


@pytest.mark.parametrize("way", ["bridge", "rmw"])
@pytest.mark.slow
def test_a_flood_from_ros_is_limited_to_a_thousand_commands_a_second(
    flooded: Daemon, tmp_path: Path, way: str
) -> None:
    key = "cmd_vel" if way == "bridge" else rmw_key("cmd_vel", TWIST)
    program = command_line(ROS_FLOOD, flooded.endpoint, key, 1.0, ros_twist(0.0).hex(), way)
    with Bus(flooded.endpoint) as bus:
        bus.linked()
        before = bus.state()
        with Program(program, tmp_path) as flood:
            flood.says("flooding")
            begun = time.monotonic()
            count = int(flood.says("flooded").split()[1])
            assert flood.ended(5.0) == 0
            lasted = time.monotonic() - begun
        # Wait for a tenth of a second of silence. All messages under way have then arrived.
        lines = bus.count("lines_sent")
        until(lambda: bus.count("lines_sent") >= lines + 10, 3.0, "ten more lines")
        after = bus.state()

    def counted(*names: str) -> int:
        return sum(after["counters"].get(n, 0) - before["counters"].get(n, 0) for n in names)

    commands, overrun = counted("commands"), counted("bus_overrun")
    print(f"flood of {count} puts in {lasted:.2f} s by {way}: {commands} taken, overrun {overrun}")
    assert count > 5000
    assert commands > 100
    # Without the limit, the excess would be overrun, or would still be accepted.
    assert (
        commands + overrun + counted(*(f"command_{code}" for code in get_args(AgeCode)))
        <= 1100 * lasted
    )


@pytest.mark.slow
def test_messages_that_are_slow_to_decode_cost_no_periods_and_a_stop_still_latches(
    flooded: Daemon, tmp_path: Path
) -> None:
    assert len(EMPTY_JOINTS) == len(EMPTY_NAMES) == 4096
    program = command_line(
        SLOW_WORK, flooded.endpoint, "joint_commands", 2.0, "acsard/describe_parameters",
        EMPTY_JOINTS.hex(), EMPTY_NAMES.hex(),
    )  # fmt: skip
    with Bus(flooded.endpoint) as bus, bus.follow("state") as states:
        bus.linked()
        before, began = bus.state(), time.monotonic()
        waited = waited_for_a_core(flooded.pid)
        with Program(program, tmp_path) as flood:
            flood.says("flooding")
            begun = time.monotonic()
            states.find(lambda _: True, 3.0, "0.7 s of it", after=begun + 0.7)
            sent = time.monotonic()
            bus.session.put("acsard/acsar/stop", b"")
            stopped = states.find(
                lambda state: state["mode"] == "stopped", 3.0, "stopped", after=sent
            )
            assert flood.process.poll() is None, "it was over too early"
            count, called = map(int, flood.says("flooded").split()[1:])
            assert flood.ended(5.0) == 0
        after, waited = bus.state(), waited_for_a_core(flooded.pid) - waited
        waited = max(waited, lost(began))
        assert bus.get("srv/clear")["success"]
    periods = Periods.between(before, after)
    refused = after["counters"]["command_malformed"]
    print(
        f"{count} puts of 1017 names and {called} calls with 1022: {refused} refused, "
        f"{periods.missed} of {periods.elapsed:.0f} periods missed, "
        f"stop latched after {stopped.at - sent:.4f} s"
    )
    assert called == 1000
    assert refused > 100
    # A step answers one call, so the last ones may be refused after the last put.
    texts = " ".join({entry.value.get("refused", "") for entry in states.seen})
    assert "at most 64 are" in texts
    assert "at most 256 are" in texts
    assert periods.missed <= 0.03 * periods.elapsed + waited / TICK_S
    assert stopped.at - sent < 0.2 + lost(sent, stopped.at)
    assert flooded.process.poll() is None
    assert "Traceback" not in flooded.stderr
