"""Units in the names of columns, such as "t [ms]" and "yaw_rate (deg/s)"."""

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
"""Known units by column, as factors to s, m and rad. All other columns are rates in rad/s."""

SI = {"t": "s", "x": "m", "y": "m", "yaw": "rad"}

_NAME = re.compile(r"(?P<name>[^\[(]*)[\[(]?(?P<unit>[^\])]*)")


def parted(cell: str) -> tuple[str, str]:
    """Return the name and the unit of a column from a header cell.

    The name is in lower case with "_" between words. The unit stands in brackets and ends at a
    comma; without brackets it is "".
    """
    found = _NAME.match(cell.strip().lower())
    assert found is not None
    name = re.sub(r"[\s-]+", "_", found["name"].strip())
    return name, re.sub(r"[\s^]", "", found["unit"].partition(",")[0])


def factor(name: str, unit: str) -> float | None:
    """Return the factor that converts this unit to SI, or None if the unit is unknown."""
    known = UNITS.get(name, RATE)
    return known.get(unit.replace("degrees", "deg").replace("/sec", "/s"), None if unit else 1.0)
