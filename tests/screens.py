"""`python -m tests.screens`: print the terminal screens at 40, 80 and 160 columns, as text.

The screens are those of `acsard drive`, `top`, `fleet` and `echo --short`.
"""

from __future__ import annotations

import sys

from msgspec.structs import replace

from acsard.core.messages.schema import BatterySummary
from acsard.core.messages.short_texts import short
from acsard.core.motion.arbiter import Choice
from acsard.core.motion.arbiter_text import chosen
from acsard.top.drive_screen import lines
from acsard.top.fleet_table import table
from tests.unit.top import test_drive_screen, test_fleet_table
from tests.unit.top.screens import BEFORE, SEEN, STATE, lines_of

WIDTHS = (40, 80, 160)

WAITING = replace(
    STATE, mode="ready", reason=f"ready: {chosen(Choice())}", linear=0.0, angular=0.0, source=""
)
"""The same robot while no client drives it."""


WARNED = replace(
    WAITING,
    emergency_stop="released",
    bumpers=[False, False],
    battery=BatterySummary(22.41, 21.0, -1.2, "warning"),
    certificate_expiry="expires in 10 days",
    recording_error="/var/lib/acsard/recordings: No space left on device",
)
"""The same robot with what ends its work later."""


def screens(width: int) -> dict[str, list[str]]:
    """Return the lines of each screen, by the name of the command."""
    states = {"robot2": WAITING, "robot3": WARNED}
    robots = [
        replace(test_fleet_table.ROW, robot_id=name, state=item) for name, item in states.items()
    ]
    return {
        "drive": [
            item.plain for item in lines(replace(test_drive_screen.SEEN, state=WAITING), width)
        ],
        "top": lines_of(replace(SEEN, state=WARNED, before=BEFORE), width),
        "fleet": table([test_fleet_table.ROW, *robots], width),
        "echo state --short": [short(STATE), short(WAITING), short(WARNED)],
    }


if __name__ == "__main__":
    for width in WIDTHS:
        for verb, shown in screens(width).items():
            sys.stdout.write("\n".join([f"--- acsard {verb}, {width} columns", *shown, ""]))
