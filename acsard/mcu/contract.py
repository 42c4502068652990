"""What the contract with the microcontroller says beyond the lines themselves."""

from __future__ import annotations

WATCHDOG_S = 0.3
"""It stops the motors by itself so long after the last valid line, s."""
