"""The screens of `acsard drive`, `top`, `fleet` and `echo --short` in `screens/`, by their width.

To write these files anew, run `pytest --approve tests/unit/top/test_screens.py`, and then read
`git diff`.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace
from rich.cells import cell_len

from acsard.client.fleet import Row
from acsard.core.messages.schema import BatterySummary, SourceState
from acsard.core.messages.short_texts import short
from acsard.top import drive_screen
from acsard.top.drive_screen import Teleop
from acsard.top.fleet_table import table
from acsard.top.screen import ScreenData
from tests.unit.top.screens import INFO, SEEN, STATE, UNMEASURED, drawn, lines_of, of

REASON = "the microcontroller's lines come 0.50 s apart; set mcu.reply_period = 0.50 in acsard.toml"
MANY = [SourceState(f"source{n}", n, None, "a command", "command") for n in range(40)]

WAITING = replace(
    STATE, mode="waiting", code="reply_period", reason=REASON, linear=0.0, angular=0.0, source=""
)
WARNED = replace(
    WAITING,
    emergency_stop="released",
    bumpers=[False, True],
    battery=BatterySummary(22.41, 21.0, -1.2, "warning"),
    certificate="expires",
    certificate_days=10.0,
    certificate_expiry="expires in 10 days",
    recording_error="/var/lib/acsard/recordings: No space left on device",
    gyro="silent",
    refused="source nav: the twist contains NaN or infinity",
    counters=STATE.counters
    | {"lines_superseded": 12_345, "bus_overrun": 7, "line_malformed": 30, "line_implausible": 12}
    | {"command_stale": 4, "commands_of_new_senders": 40, "imu_second_sender": 1200},
)

TOP = {
    "a robot that drives": SEEN,
    "before the first state": ScreenData("acsar", "tcp/127.0.0.1:7448", None),
    "a silent robot": replace(SEEN, age=100.0, silent=True),
    "another version": replace(SEEN, age=3.0, undecodable=9, silent=True),
    "a robot with warnings": replace(SEEN, state=WARNED),
    "a stopped robot": of(mode="stopped", code="stopped", reason="stopped by ann; call srv/clear"),
    "a simulator without a link": replace(
        of(link="down"), info=replace(INFO, simulated=True), before=None, passed=0.0
    ),
    "many sources": of(sources=MANY),
    "without measurements": of(latencies=dict.fromkeys(STATE.latencies, UNMEASURED)),
}

TELEOP = Teleop("acsar", "tcp/127.0.0.1:7448", "teleop", 0.5, 1.0, WAITING, 0.1)
OBJECTED = replace(TELEOP, objection="app has the same priority and came first")
STILL = replace(STATE, linear=0.0, angular=0.0, wheels=[0.0] * 4)
DRIVE = {
    "the keys do not drive": OBJECTED,
    "before the first state": replace(TELEOP, state=None),
    "a silent robot": replace(TELEOP, age=7.0, silent=True),
}
ENDS = {
    "it stands": replace(TELEOP, state=STILL),
    "it moves": replace(TELEOP, state=STATE),
    "it reports no speed": replace(TELEOP, state=replace(STILL, linear=None, wheels=[])),
    "it is silent": replace(TELEOP, age=7.0, silent=True),
}

READY = replace(STATE, mode="ready", code="no_command", reason="waiting for a command", linear=0.0)
PRESSED = "emergency stop pressed at the robot; release it at the robot, then call srv/clear"
ROBOTS = {
    "driving": replace(STATE, speed_limit="0.3 m/s, set by x"),
    "ready": replace(READY, certificate="valid"),
    "no-speed": replace(READY, linear=None, battery=BatterySummary(24.56, None, None, "ok")),
    "warned": WARNED,
    "fault": replace(
        STATE, mode="fault", code="wheel_stuck", reason="a wheel is stuck",
        settings_differ="limits.linear_speed = 0.8, not 1.0",
    ),
    "pressed": replace(
        STATE, mode="stopped", code="emergency_stop", reason=PRESSED, emergency_stop="pressed"
    ),
    "no-estop": replace(READY, emergency_stop="silent"),
    "latch-file": replace(READY, latch_file_error="no room"),
    "wheel-fault": replace(READY, wheel_fault="rear left wheel is left out"),
    "empty": replace(READY, battery=BatterySummary(20.0, None, None, "stop")),
    "no-battery": replace(READY, battery=BatterySummary(None, None, None, "unknown")),
}  # fmt: skip
FLEET = [
    *(Row(name, True, state, 0.1) for name, state in ROBOTS.items()),
    Row("gone", False, replace(STATE, version="0.1.9"), 90.0),
    Row("silent", True, STATE, 7.0, silent=True),
    Row("new", True, None, 0.1),
    Row("not-there", False, None, 0.1),
]


def screens(width: int) -> dict[str, list[str]]:
    """Return the lines of all screens of this width, by the verb and the situation."""
    found = {f"top: {name}": lines_of(data, width) for name, data in TOP.items()}
    shown = {f"drive: {name}": drive_screen.screen(data) for name, data in DRIVE.items()}
    ends = {f"drive has ended: {name}": drive_screen.last_report(d) for name, d in ENDS.items()}
    for name, what in (shown | ends | {"fleet": table(FLEET, width)}).items():
        found[name] = drawn(what, width).splitlines()
    return found


@pytest.mark.parametrize("width", [40, 80, 160])
def test_each_screen_fits_its_width_and_is_the_approved_one(
    width: int, approved: Callable[[Path, str], None]
) -> None:
    found = screens(width)
    assert all(cell_len(line) <= width for lines in found.values() for line in lines)
    found["echo state --short"] = [short(state) for state in (STATE, WAITING, WARNED)]
    text = "".join(
        f"--- {name}\n" + "".join(f"{line.rstrip()}\n" for line in lines)
        for name, lines in found.items()
    )
    approved(Path(__file__).with_name("screens") / f"{width}-columns.txt", text)
