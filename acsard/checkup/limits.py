"""The speeds and times that several steps share, in rad/s and s.

A limit that only one step uses is defined there.
"""

from __future__ import annotations

# Bounds within which a measured time agrees with the contract's `WATCHDOG_S`.
WATCHDOG_LEAST_S = 0.1  # a pause of this host that is longer may already have stopped the motors
WATCHDOG_MOST_S = 0.5

# Speeds, rad/s
SPEED = 3.0  # the fastest speed that is commanded: half a turn per second
RUNAWAY = 2 * SPEED  # a faster motor ends the check
MOVES = SPEED / 4  # an encoder that shows at least this part of a command moves
STANDING = SPEED / 10  # a slower motor stands
# A motor that shows this in a short probe moves; a heavy wheel has hardly begun to turn by then.
PROBE_MOVES = SPEED / 40

# Times, s
PERIOD_S = 0.02  # between two lines, if the wire can carry that
GLANCE_S = 0.2  # enough for a few replies, and for some counts of a coarse encoder
MOTOR_S = 2.0  # by then a lifted wheel has its speed or has lost it, unless its speed still changes
# Longest wait for a speed that still changes: a heavy wheel, or a hub motor that coasts.
PATIENCE_S = 3 * MOTOR_S
BOOT_S = 3.0  # a restarted board answers by then; many bootloaders wait two seconds
CUT_S = WATCHDOG_MOST_S + GLANCE_S  # after such a silence every correct watchdog has cut the motors
STOOD_S = WATCHDOG_MOST_S + MOTOR_S  # the motors stand by then, or the MCU has no watchdog
