"""Every speed and time the steps share: what the MCU contract says, and what follows from it.

What only one step counts or compares is named where it is used.
"""

from __future__ import annotations

# what the MCU contract says of silence

WATCHDOG_S = 0.3
"""The motors stop so long after the last valid line."""

WATCHDOG_LEAST_S, WATCHDOG_MOST_S = 0.1, 0.5
"""What is taken. A pause of ours as long as the least may have stopped them already."""

# speeds, rad/s

SPEED = 3.0
"""The fastest a motor is asked to turn: half a turn in a second."""

RUNAWAY = 2 * SPEED
"""A motor faster than this ends the check."""

MOVES = SPEED / 4
"""An encoder that shows this much of a command moves."""

STANDING = SPEED / 10
"""Slower than this is standing."""

PROBE_MOVES = SPEED / 40
"""The same over a short probe: a heavy wheel has hardly begun to turn by then."""

# times, s

PERIOD_S = 0.02
"""Between two lines, where the wire carries that."""

GLANCE_S = 0.2
"""A few replies, and some counts of a coarse encoder."""

MOTOR_S = 2.0
"""A lifted wheel has its speed or has lost it by then, unless it is seen to be on its way."""

PATIENCE_S = 3 * MOTOR_S
"""The longest wait for one that is: a heavy wheel, or a hub motor that coasts."""

CUT_S = WATCHDOG_MOST_S + GLANCE_S
"""After so long a silence any watchdog that is right has cut the motors, and it shows."""

STOOD_S = WATCHDOG_MOST_S + MOTOR_S
"""And after so long they stand; an MCU that drives on until then has no watchdog."""
