"""Eleven former defects by which the robot moved, or did not stop, for `planted.py`.

Reviewers once found them by hand in the virtual world. Each edit restores the former code, or its
relevant part.
"""

from __future__ import annotations

from tests.simulate.planted_faults import (
    AGES,
    GUARD,
    LATCHES,
    LIFECYCLE,
    LIMITS,
    NEUTRAL,
    ROBOT,
    SESSION,
    WHEELS_LAW,
    Edit,
    fault,
)

CASES = (
    fault(
        "case 1",
        "a restart releases a stop, a fault and `inactive`",
        LATCHES,
        "[replace(cause, kept=True) for cause in latches.causes]",
        "[]",
    ),
    fault(
        "case 2",
        "the first zero of a shared sender arms it",
        NEUTRAL,
        "        if not (zero and self.shared):\n            self.armed = True",
        "        if True:\n            self.armed = True",
    ),
    fault(
        "case 3",
        "a congested link is taken for a clock that was adjusted",
        AGES,
        "        if least is None or delay < least - MARGIN_NS:\n",
        "        if least is None or abs(delay - least) > timeout_ns:\n",
    ),
    fault(
        "case 4",
        "the output was blocked for minutes, and then the robot drives on",
        SESSION,
        "            self.blocked = True\n",
        "            self.blocked = False\n",
    ),
    fault(
        "case 5",
        "an older command after a newer one is obeyed",
        AGES,
        "elif not verdict and stamp_ns <= self.accepted_ns:",
        "elif False:",
        Edit(AGES, "<= (self.beat_ns, self.sequence):", "<= (-1, -1):"),
    ),
    fault(
        "case 6",
        "the guard does not check that a stopped robot comes to rest, and it does not",
        GUARD,
        "if self._late(now_ns):",
        "if False:",
        Edit(
            LIMITS,
            "share = 1.0 - dt / seconds if seconds > dt else 0.0",
            "share = 1.0 if stop else 1.0 - dt / seconds if seconds > dt else 0.0",
        ),
    ),
    fault(
        "case 7",
        "a clear that was sent before a stop and arrives after it releases that stop",
        LIFECYCLE,
        "SHOWN_S = 2.0",
        "SHOWN_S = 0.0",
        Edit(
            LIFECYCLE,
            "for cause in causes if cause.number in numbers]",
            "for cause in causes]",
        ),
    ),
    fault(
        "case 8",
        "one plain clear releases a fault and the stop below it",
        LIFECYCLE,
        'self.latches.of("fault") or causes]',
        "causes]",
    ),
    fault(
        "case 9",
        "healthy motors that lag latch the fault `runaway`",
        WHEELS_LAW,
        "elif approaches:",
        "elif False:",
    ),
    fault(
        "case 10",
        "`state` keeps the last speed when the link is gone",
        ROBOT,
        "measured=None if silent else self._odometry.twist",
        "measured=self._odometry.twist",
    ),
    fault(
        "case 11",
        "TX joined to RX looks like a board, and the daemon drives it",
        "core/link/echo_check.py",
        "            self.due = True\n        elif",
        "            pass\n        elif",
    ),
)
