"""Units in the names of columns: "t [ms]", "yaw_rate (deg/s)"."""

from __future__ import annotations

import math
import re

TIME = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
TIME |= {"\N{MICRO SIGN}s": 1e-6, "\N{GREEK SMALL LETTER MU}s": 1e-6}
LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3}
ANGLE = {"rad": 1.0, "deg": math.radians(1.0), "°": math.radians(1.0), "mrad": 1e-3}
TURNS = {"rpm": math.tau / 60, "rps": math.tau, "dps": math.radians(1.0)}
RATE = {f"{unit}/s": size for unit, size in ANGLE.items()} | TURNS

UNITS = {"t": TIME, "x": LENGTH, "y": LENGTH, "yaw": ANGLE}
"""By column, in s, m and rad; all others are rates, in rad/s."""

SI = {"t": "s", "x": "m", "y": "m", "yaw": "rad"}

_NAME = re.compile(r"(?P<name>[^\[(]*)[\[(]?(?P<unit>[^\])]*)")


def parted(cell: str) -> tuple[str, str]:
    """The name of a column, in lower case with _ for what joins words, and the unit behind it in
    brackets, up to a comma; "" is none."""
    found = _NAME.match(cell.strip().lower())
    assert found is not None
    name = re.sub(r"[\s-]+", "_", found["name"].strip())
    return name, re.sub(r"[\s^]", "", found["unit"].partition(",")[0])


def factor(name: str, unit: str) -> float | None:
    """What a number in that unit is multiplied by; None for one that is not known."""
    known = UNITS.get(name, RATE)
    return known.get(unit.replace("degrees", "deg").replace("/sec", "/s"), None if unit else 1.0)
