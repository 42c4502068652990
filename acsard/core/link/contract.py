"""Constants of the contract with the microcontroller, apart from the form of its lines."""

from __future__ import annotations

WATCHDOG_S = 0.3
"""Seconds after the last valid line at which the board stops the motors by itself."""
