"""The deliberate differences between two checkouts, which a paired run does not report.

A change that is meant to alter what the daemon does names it here, and the entry goes when the
older checkout is compared no more. Each entry is a field of the step, a regular expression, its
replacement, and the reason. Both sides are rewritten by it before they are compared. Fields are
`mode`, `reason`, `lines` and `odometry`; for the last two the whole text of the step's is taken.
"""

from __future__ import annotations

DIFFERENCES: tuple[tuple[str, str, str, str], ...] = ()
