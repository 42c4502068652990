"""The intended differences between two checkouts, which a paired run does not report.

A change that intentionally alters the daemon's behavior is listed here as long as an older checkout
is compared with newer ones, as `tests/simulate/README.md` explains.
"""

from __future__ import annotations

DIFFERENCES: tuple[tuple[str, str, str, str], ...] = ()
"""Replacements in the steps of both sides before the comparison.

Each entry is a field of the step, a regular expression, its replacement, and the reason. Fields are
`mode`, `reason`, `lines` and `odometry`; for `lines` and `odometry` the replacement is done in the
whole text of the step."""

LEFT_OUT: tuple[tuple[str, object, str], ...] = ()
"""Events that are taken out of the plans because no replacement makes both sides equal.

Each entry is a field of the event, its value, and the reason."""
