"""What every program may rely on: eleven rows, each tried through every door that offers it.

A row drives and asks through a `Door`, and judges the robot with a plain client on the robot's
machine. `python -m tests.system.contract` writes the matrix into `CONTRACT.md`.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from tests.system.bystander import lost
from tests.system.doors import Door
from tests.system.doors_of_programs import DOORS
from tests.system.harness import Bus, kept_waiting, until
from tests.system.ros_clients import changes

PAGE = Path(__file__).with_name("CONTRACT.md")

TIMEOUT_S = 0.25
"""After which a source without commands is gone."""

SHOWN_S = 2.0
"""So long must a cause have been published before a `clear` without numbers releases it."""

SPEED = "limits.linear_speed"


def units(door: Door) -> None:
    """It drives in m/s and rad/s."""
    linear, angular = door.speeds
    with door.bus.follow("state") as states, door.drive():
        states.find(
            lambda s: (
                s["linear"] == pytest.approx(linear, abs=0.01)
                and s["angular"] == pytest.approx(angular, abs=0.05)
                and s["source"] == door.source
            ),
            10.0,
            f"{linear} m/s and {angular} rad/s by {door.source}",
        )


def zero(door: Door) -> None:
    """No speed is followed before a zero of the same sender, and again after a stop."""
    if not door.zeroes:
        door.arm()
    disarm(door.bus)
    with door.bus.follow("cmd/**") as commands, door.bus.follow("cmd_vel_out") as applied:
        if door.zeroes:
            with door.drive():
                applied.find(moving, 10.0, "it drives")
            assert commands.seen[0].value["linear"]["x"] == 0.0
            return
        end = time.monotonic() + 0.5
        while time.monotonic() < end or door.waits() not in ("neutral", "zeros"):
            door.send(*door.speeds)
            time.sleep(0.05)
            assert time.monotonic() < end + 5.0, f"it waits for {door.waits()}, not for a zero"
    assert not any(moving(message.value) for message in applied.seen)


def stop(door: Door) -> None:
    """A stop is latched, whoever drives on."""
    bus = door.bus
    with bus.follow("state") as states, bus.commanding(0.3, source="dock"):
        states.find(lambda s: (s["linear"] or 0.0) > 0.2, 5.0, "it drives")
        asked = time.monotonic()
        door.stop()
        states.find(lambda s: s["mode"] == "stopped", 2.0, "stopped", after=asked)
        bus.stands()
        goes_on(bus, 30)
        assert bus.state()["mode"] == "stopped"
        assert not any(bus.state()["wheels"])


def clear(door: Door) -> None:
    """`clear` releases what it names, or what has been published for 2 s."""
    begun = time.monotonic()
    stopped(door.bus)
    if door.numbers is False:
        assert not door.clear()
        until(door.clear, 5.0, "a plain clear is obeyed")
        assert time.monotonic() - begun > SHOWN_S
    else:
        if door.numbers:
            assert not door.clear([1])
        assert door.bus.state()["mode"] == "stopped"
        assert door.clear()
    door.bus.comes_to("ready")


def silence(door: Door) -> None:
    """A program that falls silent lets the robot ramp down, and does not drive on."""
    with door.bus.follow("cmd_vel_out") as applied, door.drive():
        linear = door.speeds[0]
        applied.find(lambda m: speed(m) == pytest.approx(linear, abs=0.001), 10.0, "it drives")
        waited = kept_waiting(door.robot.daemon.pid)
        door.silence()
        silent = time.monotonic()
        rest = applied.find(lambda m: not moving(m), 5.0, "it stands", after=silent)
        seen = [m for m in applied.seen if m.at <= rest.at]
        top = max(m.at for m in seen if speed(m.value) >= linear - 0.001)
        late = lost(min(top, silent), rest.at) + kept_waiting(door.robot.daemon.pid) - waited
        assert rest.at - silent < TIMEOUT_S + linear / 1.0 + 0.15 + late
        # It ramps. The times are those of arrival here: a busy computer receives some together.
        assert rest.at - top > linear / 4 - late
        # A command that was still under way may be obeyed, and no other one.
        rises = [b.at - silent for a, b in pairwise(seen) if speed(b.value) > speed(a.value)]
        assert max(rises) < 0.1 + late, rises


def late(door: Door) -> None:
    """A command that was under way for a second is refused and counted."""
    code, send = door.late()
    refused(door, code, send)


def bad(door: Door) -> None:
    """A bad command is refused whole, and counted by its reason."""
    door.arm()
    for code, send in door.bad().items():
        time.sleep(0.003)  # a sample within 1 ms of another one on its key is dropped
        refused(door, code, send)


def set_(door: Door) -> None:
    """`set` changes a setting at once, and refuses what is out of range."""
    before = door.bus.get("config")["limits"]["linear_speed"]
    try:
        assert door.set(SPEED, 0.6)
        assert door.bus.get("config")["limits"]["linear_speed"] == 0.6
        assert not door.set(SPEED, 60.0)
        assert door.bus.get("config")["limits"]["linear_speed"] == 0.6
    finally:
        assert door.bus.get("srv/set", {"settings": {SPEED: before}})["success"]


def state(door: Door) -> None:
    """The mode and its reason arrive."""
    stopped(door.bus)
    reason = door.bus.state()["reason"].partition(" -> ")[0].partition(" (")[0]
    assert reason.startswith("stopped by ")
    until(lambda: reason in door.state(), 5.0, f"{reason!r} by {door.name}")
    assert door.bus.get("srv/clear")["success"]
    until(lambda: "ready" in door.state().lower(), 5.0, "ready")


def role(door: Door) -> None:
    """A viewer stops the robot, and neither drives nor releases it."""
    bus = door.for_viewer().bus
    before = bus.at_rest()
    try:
        assert door.viewer()
        after = until(lambda: (s := bus.state())["mode"] == "stopped" and s, 2.0, "stopped")
        assert (after["x"], changes(before, after)) == (before["x"], {})
    finally:
        assert bus.get("srv/clear")["success"]


def end(door: Door) -> None:
    """A program that ends leaves a zero, and not a silence."""
    with door.bus.follow("cmd/**") as commands, door.bus.follow("cmd_vel_out") as applied:
        with door.drive():
            applied.find(moving, 10.0, "it drives")
        until(lambda: commands.seen[-1].value["linear"]["x"] == 0.0, 1.0, "a last zero")
        last = max(c.at for c in commands.seen if c.value["linear"]["x"] != 0.0)
        rest = min(c.at for c in commands.seen if c.at > last)
        assert rest - last < TIMEOUT_S + lost(last, rest)


ROWS: dict[str, Callable[[Door], None]] = {
    "units": units, "zero": zero, "stop": stop, "clear": clear, "silence": silence, "late": late,
    "bad": bad, "set": set_, "state": state, "role": role, "end": end,
}  # fmt: skip


# what the rows look at


def speed(message: Any) -> float:
    return float(message["twist"]["linear"]["x"])


def moving(message: Any) -> bool:
    return speed(message) != 0.0


def stopped(bus: Bus) -> None:
    assert bus.get("srv/stop")["success"]
    bus.comes_to("stopped")


def disarm(bus: Bus) -> None:
    """Stop and release the robot: then every sender needs a zero."""
    stopped(bus)
    assert bus.get("srv/clear")["success"]


def goes_on(bus: Bus, lines: int) -> None:
    """Wait for this number of control periods."""
    sent = bus.count("lines_sent")
    time.sleep(lines / 100.0)
    until(lambda: bus.count("lines_sent") >= sent + lines, 5.0, f"{lines} lines")


def refused(door: Door, code: str, send: Callable[[], object]) -> None:
    """Check that a command is counted by its reason, and moves and refreshes nothing."""
    before, counted = door.bus.at_rest(), door.counted(code)
    send()
    until(lambda: door.counted(code) > counted, 3.0, f"counted as {code}")
    goes_on(door.bus, 5)
    after = door.bus.at_rest()  # on a busy machine the board may just be silent
    assert changes(before, after).keys() <= {f"command_{code}"}, code
    for part in ("x", "y", "yaw", "linear", "angular", "wheels"):
        assert after[part] == before[part], (code, part)


# the matrix


def matrix() -> str:
    """Return the page with the matrix."""
    heads = [f"[{number}]" for number in range(1, len(ROWS) + 1)]
    lines = [
        "# What every program may rely on, through every door",
        "",
        "`test_contract.py` tries each cell: `yes` holds, `-` is not offered through this door.",
        "A door that drives also stops (row 3).",
        "`python -m tests.system.contract` writes this page.",
        "",
        *(f"{number}. {row.__doc__}" for number, row in enumerate(ROWS.values(), 1)),
        "",
        f"| door | {' | '.join(heads)} | mark |",
        f"|---|{'---|' * len(ROWS)}---|",
    ]
    for door in DOORS:
        cells = ["-" if row in door.lacks else "yes" for row in ROWS]
        lines.append(f"| {door.name} | {' | '.join(cells)} | {', '.join(mark_names(door))} |")
    lines += ["", "Not offered, because:", ""]
    for door in DOORS:
        reasons: dict[str, list[str]] = {}
        for number, row in enumerate(ROWS, 1):
            if row in door.lacks:
                reasons.setdefault(door.lacks[row], []).append(str(number))
        for reason, numbers in reasons.items():
            lines.append(f"- {door.name}, {', '.join(numbers)}: {reason}")
    return "\n".join(lines) + "\n"


def mark_names(door: type[Door]) -> list[str]:
    return [mark.name for mark in marks(door) if mark.name != "timeout"]


def marks(door: type[Door]) -> tuple[Any, ...]:
    return door.marks if isinstance(door.marks, tuple) else (door.marks,)


if __name__ == "__main__":
    PAGE.write_text(matrix())
