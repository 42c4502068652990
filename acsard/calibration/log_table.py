"""Reads the one CSV format of a log into columns of numbers, and finds the run of each row.

The first line names the columns. Every other line has a cell for each of them, with numbers in SI
units, and a cell may be empty, so that sensors of different rates share a file. A file in another
format is refused. Impossible values are left out, counted and reported.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.log_rows import FOUR
from acsard.core.formatting import many, printable
from acsard.core.values import AcsardError

Floats = npt.NDArray[np.float64]

# The mean wheel speeds of the sides, rad/s.
TWO = "left", "right"

# The twist that the daemon commands to the wheels, m/s and rad/s.
APPLIED = "applied_linear", "applied_angular"

BOUNDS = dict.fromkeys((*FOUR, *TWO), 1e3) | {"t": 1e20, "yaw_rate": 1e4, "yaw": 1e7}
DEFAULT_BOUND = 1e9  # allows degrees and ns, so that later checks can name the unit

# Spikes are removed only from these columns.
SPIKE_COLUMNS = frozenset((*FOUR, *TWO, "yaw_rate"))

# A spike is `SPIKE` times its neighbors and the quantile 1 - `FEW_VALUES` of the rates above `SLOW`
# rad/s.
SPIKE, FEW_VALUES, SLOW = 10.0, 0.02, 0.02


def bounded(columns: dict[str, Floats]) -> Iterator[str]:
    """Replace impossible values in `columns` by NaN, and yield a sentence for each changed column.

    The arrays are changed in place.
    """
    order = np.argsort(columns["t"], kind="stable")
    for name, values in columns.items():
        with np.errstate(invalid="ignore"):
            wild = np.abs(values) > BOUNDS.get(name, DEFAULT_BOUND)
        if name in SPIKE_COLUMNS:
            wild |= spikes(np.where(wild, math.nan, values), order)
        if wild.any():
            example = float(values[wild][0])
            values[wild] = math.nan
            cells = many(int(wild.sum()), "cell")
            yield f"{cells} of {name} left out: no robot has a value like {example:g}"


def spikes(values: Floats, order: npt.NDArray[np.int64]) -> npt.NDArray[np.bool_]:
    """Return a mask of the values far above their neighbors, which were recorded wrongly.

    A spike is far above its neighbors both in the order of the file and in `order`, the order of
    time: rows may be shuffled. Logs with little motion have none.
    """
    sizes = np.abs(values)
    moving = sizes[sizes > SLOW]
    if len(moving) < 1 / FEW_VALUES:
        return np.zeros(len(values), dtype=bool)
    usual = float(np.quantile(moving, 1 - FEW_VALUES))
    wild = _alone(sizes, usual)
    wild[order] &= _alone(sizes[order], usual)
    return wild


def _alone(sizes: Floats, usual: float) -> npt.NDArray[np.bool_]:
    indices = np.flatnonzero(np.isfinite(sizes))
    padded = np.concatenate([[0.0], sizes[indices], [0.0]])
    around = np.maximum(np.maximum(padded[:-2], padded[2:]), usual)
    mask = np.zeros(len(sizes), dtype=bool)
    mask[indices[padded[1:-1] > SPIKE * around]] = True
    return mask


CSV_ADVICE = (
    "write a CSV file with commas, decimal points and SI units, whose first line names the columns "
    'like "t,left,right,yaw_rate" or "t,fr,fl,rl,rr,x,y" (deploy/calibration/README.md explains '
    "the columns, and bag_to_csv.py there converts a ROS bag)"
)


class LogError(AcsardError):
    """The data of a log is unreadable, incomplete or wrong. The text says where, and what to do."""


class NoCalibrationError(AcsardError):
    """The data is readable, but gives no useful calibration. The text says why and what to do."""


def attach_notes(error: Exception, notes: Iterable[str]) -> None:
    """Attach the notes about a log to an error, because they may explain the error."""
    for note in notes:
        error.add_note(note)


class Table(Struct, frozen=True):
    """The content of a log: columns of numbers, and the run of each row."""

    columns: dict[str, Floats]  # columns by name, in SI units, with NaN for an empty cell
    runs: npt.NDArray[np.int64]  # for each row, the index of its run in `names`
    names: tuple[str, ...]
    notes: tuple[str, ...]  # sentences about data that was left out

    @classmethod
    def joined(cls, sensors: Sequence[Mapping[str, Floats]]) -> Table:
        """Return a table of one run with all samples of several sensors, sorted by time.

        Every sensor has the column "t". Any other column belongs to only one sensor, and is NaN in
        the rows of the others.
        """
        ends = np.cumsum([0, *(len(sensor["t"]) for sensor in sensors)])
        columns = {name: np.full(ends[-1], math.nan) for sensor in sensors for name in sensor}
        for begin, sensor in zip(ends, sensors, strict=False):
            for name, values in sensor.items():
                columns[name][begin : begin + len(values)] = values
        order = np.argsort(columns["t"], kind="stable")
        columns = {name: values[order] for name, values in columns.items()}
        return cls(columns, np.zeros(len(order), dtype=np.int64), ("",), ())


def read(data: bytes) -> Table:
    """Parse the bytes of a CSV file. Raises `LogError` if the file has another format."""
    try:
        lines = data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise LogError(f"the file is not text: {CSV_ADVICE}") from None
    header = lines[0].split(",") if lines else []
    names = _used(header)
    picks = [header.index(name) for name in names]
    run = header.index("run") if "run" in header else -1
    values, runs = array("d"), array("q")  # lists would take ten times the memory
    labels: dict[str, int] = {}
    for number, line in enumerate(lines[1:], 2):
        if not line:
            continue
        cells = line.split(",")
        try:
            if len(cells) != len(header):
                raise ValueError
            values.extend(float(cells[i] or "nan") for i in picks)
        except ValueError:
            raise LogError(
                f'line {number} is "{printable(line[:60])}", which is not a number or an empty '
                f"cell for each of the {len(header)} columns: {CSV_ADVICE}"
            ) from None
        runs.append(labels.setdefault(cells[run] if run >= 0 else "", len(labels)))
    if not runs:
        raise LogError("there are no rows below the header: record a drive")
    matrix = np.frombuffer(values).reshape(len(runs), len(picks))
    columns = {name: matrix[:, at].copy() for at, name in enumerate(names)}
    others = [printable(name) for name in header if name not in (*names, "run")]
    notes = [f"columns not used: {', '.join(others)}"] if others else []
    return Table(
        columns, np.frombuffer(runs, dtype=np.int64), tuple(labels), (*notes, *bounded(columns))
    )


def _used(header: Sequence[str]) -> list[str]:
    wheels = FOUR if set(FOUR) <= set(header) else TWO
    places = ("x", "y") if {"x", "y"} <= set(header) else ()
    sensors = [name for name in ("yaw_rate", "yaw") if name in header] + [*places]
    missing = [name for name in ("t", *wheels) if name not in header]
    if not sensors:
        missing.append("yaw_rate (of a gyro) or x and y (positions)")
    if missing:
        raise LogError(f"the first line does not name {', '.join(missing)}: {CSV_ADVICE}")
    commands = APPLIED if set(APPLIED) <= set(header) else ()
    used = [name for name in header if name in ("t", *wheels, *sensors, *commands)]
    if len(set(used)) < len(used) or header.count("run") > 1:
        raise LogError(f"the first line names a column twice: {CSV_ADVICE}")
    return used
