"""The deliberate differences between two checkouts, which a paired run does not report.

A change that is meant to alter what the daemon does names it here, and the entry goes when the
older checkout is compared no more. Each entry is a field of the step, a regular expression, its
replacement, and the reason. Both sides are rewritten by it before they are compared. Fields are
`mode`, `reason`, `lines` and `odometry`; for the last two the whole text of the step's is taken.

A change that alters everything behind an event cannot be rewritten. `LEFT_OUT` takes such events
out of the plans: a field, its value and the reason. `DEFAULTS` does so for settings.
"""

from __future__ import annotations

DIFFERENCES: tuple[tuple[str, str, str, str], ...] = (
    (
        "reason",
        "; if this goes on, check the network, then restart the sender",
        "",
        "a late command says what to do",
    ),
    (
        "reason",
        r"switched off by .* at [^;]*;",
        "switched off;",
        "each deactivate is a new latch, so the reason names the last one and not the first",
    ),
)

LEFT_OUT: tuple[tuple[str, object, str], ...] = (
    ("verb", "activate", "an activate without the latch's number waits for 2 s"),
    ("verb", "deactivate", "without an activate behind it the robot would stand for the whole run"),
    ("do", "restart", "a clear without the latch's number waits for 2 s after a start"),
    ("fault", ["echo"], "an echo is found up to seven lines later"),
)

DEFAULTS: tuple[tuple[str, str, str], ...] = (
    (
        "odometry",
        "gyro",
        "the simulated robot moves in other steps, so its gyro's last bits differ",
    ),
)
