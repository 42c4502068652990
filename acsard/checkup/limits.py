"""Every speed and time the steps share.

What only one step counts or compares is named where it is used. Speeds are rad/s, times s.
"""

from __future__ import annotations

# what is taken for the contract's `WATCHDOG_S`
WATCHDOG_LEAST_S = 0.1  # a pause of ours as long may have stopped the motors already
WATCHDOG_MOST_S = 0.5

# speeds
SPEED = 3.0  # the fastest a motor is asked to turn: half a turn in a second
RUNAWAY = 2 * SPEED  # a motor faster than this ends the check
MOVES = SPEED / 4  # an encoder that shows this much of a command moves
STANDING = SPEED / 10  # slower than this is standing
PROBE_MOVES = SPEED / 40  # moves, in a short probe: a heavy wheel has hardly begun by then

# times
PERIOD_S = 0.02  # between two lines, where the wire carries that
GLANCE_S = 0.2  # a few replies, and some counts of a coarse encoder
MOTOR_S = 2.0  # a lifted wheel has its speed or has lost it by then, unless it is on its way:
PATIENCE_S = 3 * MOTOR_S  # the longest wait for one that is, heavy or a hub motor that coasts
BOOT_S = 3.0  # a board that starts anew answers by then: many a bootloader waits two
CUT_S = WATCHDOG_MOST_S + GLANCE_S  # after such a silence any right watchdog has cut the motors
STOOD_S = WATCHDOG_MOST_S + MOTOR_S  # they stand by then, or the MCU has no watchdog
