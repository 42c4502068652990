"""Logs of the drive of `calibration_bags` with planted faults, and their causes."""

from __future__ import annotations

import re
from collections.abc import Callable

import numpy as np

from tests.unit.calibration_bags import DRIVE, Floats, motion
from tests.unit.calibration_robots import wander

Columns = dict[str, Floats]
"""By name, in rows of 50 Hz; NaN is an empty cell."""

SENSORS = {"positions": ("x", "y"), "gyro": ("yaw_rate",), "both": ("yaw_rate", "x", "y")}
NOISE = {"x": 0.004, "y": 0.004, "yaw": 0.004, "yaw_rate": 0.004, "left": 0.0, "right": 0.0}


def sound(
    seed: int, names: tuple[str, ...], drive: Columns = DRIVE, late: float = 0.0,
    angles: bool = False,
) -> Columns:  # fmt: skip
    """Return the columns of one drive. The sensors may be late, s, and the wheels be angles."""
    rng, end = np.random.default_rng(seed), float(drive["t"][-1])
    t = np.arange(0.0, end, 0.02)
    rows = {"t": t}
    for name in ("left", "right", *names):
        source = {"yaw_rate": "w"}.get(name, f"{name}_angle" if angles and name in ("left", "right")
                                       else name)  # fmt: skip
        at = t if name in ("left", "right") else t - late
        rows[name] = np.interp(at, drive["t"], drive[source]) + rng.normal(0, NOISE[name], len(t))
    if "yaw_rate" in rows:
        rows["yaw_rate"] = rows["yaw_rate"] + 0.01
    if "x" in rows:
        for name in ("x", "y"):
            rows[name] = np.where(np.arange(len(t)) % 3, np.nan, rows[name])
    return rows


def coarse(
    counts: int, hz: int, names: tuple[str, ...], wheels: tuple[str, ...] = ("left", "right"),
    drive: Columns = DRIVE, filtered: float = 1.0,
) -> Columns:  # fmt: skip
    """Return a drive whose board counts edges, and samples them within a tenth of its period.

    It may filter its speeds: a new one counts by a share.
    """
    rng, step = np.random.default_rng(counts + hz), 2 * np.pi / counts
    t = np.arange(0.0, float(drive["t"][-1]), 1 / hz)
    at = np.sort(t + rng.normal(0, 0.1 / hz, len(t)))
    rows = {"t": (t[1:] + t[:-1]) / 2}
    for name in wheels:
        side = "left" if name in ("left", "fl", "rl") else "right"
        angle = np.interp(at, drive["t"], drive[f"{side}_angle"]) + rng.uniform(0, step)
        rows[name] = np.diff(np.floor(angle / step) * step) * hz
        for n in range(1, len(rows[name]) if filtered < 1.0 else 0):
            rows[name][n] = (1 - filtered) * rows[name][n - 1] + filtered * rows[name][n]
    return rows | {
        name: np.interp(rows["t"], drive["t"], drive["w" if name == "yaw_rate" else name])
        + rng.normal(0, NOISE[name], len(t) - 1)
        for name in names
    }  # fmt: skip


def csv(rows: Columns) -> bytes:
    cells = [[f"{v:.4f}" if np.isfinite(v) else "" for v in column] for column in rows.values()]
    lines = zip(*cells, strict=True)
    return "\n".join([",".join(rows), *map(",".join, lines), ""]).encode()


def times(factor: float, *names: str) -> Callable[[Columns], Columns]:
    return lambda rows: rows | {name: rows[name] * factor for name in names if name in rows}


def _dead(rows: Columns) -> Columns:
    return rows | {"left": np.where(rows["t"] > rows["t"][-1] / 2, 0.0, rows["left"])}


WHEELS = "left", "right"
FAULTS: dict[str, tuple[Callable[[Columns], Columns], str]] = {
    "swapped sides": (lambda r: r | {"left": r["right"], "right": r["left"]}, "are swapped"),
    "mirrored y": (times(-1.0, "y"), "y must point to the left"),
    "one sign": (times(-1.0, "left"), "one side has the wrong sign"),
    "both signs": (times(-1.0, *WHEELS), "both have the wrong sign"),
    "cm": (times(100.0, "x", "y"), "x, y are in cm"),
    "ft": (times(1 / 0.3048, "x", "y"), "x, y are in ft"),
    "counts x 4": (times(4.0, *WHEELS), "4 times the true ones"),
    "counts x 2": (times(2.0, *WHEELS), "twice the true ones"),
    "counts x 1/2": (times(0.5, *WHEELS), "half of the true ones"),
    "rpm": (times(60 / 2 / np.pi, *WHEELS), "in rpm"),
    "deg": (times(180 / np.pi, *WHEELS), "in deg/s"),
    "one side twice": (lambda r: r | {"left": r["right"]}, "has one side twice"),
    "no signs": (lambda r: r | {n: np.abs(r[n]) for n in WHEELS}, "a sign was lost"),
    "dead from half": (_dead, "is its encoder dead"),
    "2 s late": (lambda r: r, r"2\.0 s after those of the wheels"),
    "another drive": (lambda r: r, "of the same drive"),
}
NOT_SHOWN = {
    "gyro": {"mirrored y", "cm", "ft", "counts x 2"}, "positions": set[str](), "both": set[str](),
}  # fmt: skip
"""Faults that the sensors do not show: a gyro alone does not show a common scale."""


def planted(fault: str, way: str, seed: int, drive: Columns = DRIVE) -> bytes:
    late = 2.0 if fault == "2 s late" else 0.0
    rows = sound(seed, SENSORS[way], drive, late)
    if fault == "another drive":
        rng = np.random.default_rng(seed + 500)
        other = motion(wander(rng, float(drive["t"][-1]) + 3.0))
        other = {name: values[: len(drive["t"])] for name, values in other.items()}
        rows |= {n: v for n, v in sound(seed, SENSORS[way], other).items() if n not in WHEELS}
        rows = {n: v[: len(rows["left"])] for n, v in rows.items()}
    return csv(FAULTS[fault][0](rows))


def named(fault: str, text: str) -> bool:
    return bool(re.search(FAULTS[fault][1], " ".join(text.split())))
