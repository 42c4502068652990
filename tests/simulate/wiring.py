"""The driven wheels of a configuration, and the lines of their motors.

Judges have four speeds in any case: if two wheels are driven, a rear one is the front one.
"""

from __future__ import annotations

import re
from typing import Any

FOUR = {"front_right": "+a", "front_left": "+b", "rear_left": "+c", "rear_right": "+d"}
"""The wheels of a configuration that names none, with the sign and the letter of each motor."""

TWO = ("right", "left")

LETTERS = "abcdefghijklmoqrstuvwxyz"
"""The letters that a motor may have: `n` and `p` are the signs of a line."""


def wheels(config: dict[str, Any]) -> dict[str, str]:
    """Return the sign and the letter of the motor of each driven wheel, in the order of `state`."""
    declared = config["mcu"].get("wheels") or FOUR
    return {name: declared[name] for name in (TWO if "left" in declared else FOUR)}


def letters(config: dict[str, Any]) -> str:
    """Return the letters of the motors in the order of a line, by which motors are numbered."""
    return "".join(sorted(motor[1] for motor in wheels(config).values()))


def line_pattern(config: dict[str, Any]) -> re.Pattern[bytes]:
    """Return a pattern of the speeds of a line, with a group for each motor."""
    values = ",".join([rf"{letter}([pn]\d\d\.\d\d)" for letter in letters(config)])
    return re.compile(values.encode())
