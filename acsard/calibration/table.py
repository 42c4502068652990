"""The bytes of a CSV file -> columns of numbers and the runs they belong to.

The header names the columns, in any order. A cell may be empty, so that sensors of different
rates share a file. A row that cannot be read is left out, counted and told; a file with more than
a few of them is refused, since what is left would not be what was recorded.
"""

from __future__ import annotations

import math
from array import array
from collections.abc import Iterator, Sequence

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.config.nearest import nearest
from acsard.values import AcsardError

Floats = npt.NDArray[np.float64]

FOUR, TWO = ("fr", "fl", "rl", "rr"), ("left", "right")
"""Wheel speeds in rad/s: of each wheel, or the mean of each side."""

NUMBERS = ("t", *FOUR, *TWO, "yaw_rate", "x", "y", "yaw")
COLUMNS = (*NUMBERS, "run")

BOUNDS = dict.fromkeys((*FOUR, *TWO), 1e3) | {"t": 1e20, "yaw_rate": 1e4, "yaw": 1e7}
PLACE_BOUND = 1e9
"""Greater ones are no measurement (rad/s, s, rad, m); degrees and ns must come through to be
told."""

RATES = frozenset((*FOUR, *TWO, "yaw_rate"))
SPIKE, FEW_SPIKES, SLOW = 10.0, 0.02, 0.02
"""Times what all but this share of the rates over so many rad/s stay below: a misread number."""

MISSING = frozenset(("", "nan", "null", "none", "na", "n/a", "-"))

FEW, SHARE = 3, 0.01
"""Rows that may be unreadable: as many as this, or this share of all."""

EXAMPLE = '"t,left,right,yaw_rate" or "t,fr,fl,rl,rr,x,y"'


AS_CSV = f"export it as CSV, whose first line names the columns, like {EXAMPLE}"


class LogError(AcsardError):
    """The file cannot be used; the text says where, what was wrong and what to do."""


class Table(Struct, frozen=True):
    """Columns by name, NaN where a cell is empty; `runs` has the number of each row's run."""

    columns: dict[str, Floats]
    runs: npt.NDArray[np.int64]
    names: tuple[str, ...]
    """Of the runs, by number."""
    notes: tuple[str, ...]
    """What was left out, a sentence each."""


def read(data: bytes) -> Table:
    """The table in a file; raises `LogError`."""
    lines = _text(data).splitlines()
    number, header, separator = _header(lines)
    names = _columns(header, number)
    if separator != ",":
        lines = [line.replace(",", ".") for line in lines]
    reader = _Reader(names, separator)
    for at in range(number, len(lines)):
        reader.take(lines[at], at + 1)
    return reader.table(_ignored(header, names))


def _text(data: bytes) -> str:
    for mark, coding in ((b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16")):
        if data.startswith(mark):
            return data.decode(coding, errors="replace")
    if b"\0" in data[:4096]:
        raise LogError(f"it is not text (a recording of ROS, perhaps): {AS_CSV}")
    return data.decode("utf-8-sig", errors="replace")


def _header(lines: Sequence[str]) -> tuple[int, list[str], str]:
    """How many lines it ends after, its cells, and what separates them.

    numpy and others write it as a comment: then the last comment before the numbers is it.
    """
    comment = ""
    for at, line in enumerate(lines):
        text = line.strip()
        if text.startswith("#"):
            comment = text.strip("# \t")
        elif text:
            numeric = all(_is_number(cell) for cell in _split(text))
            if numeric and "t" in (names := _names(comment)):
                return at, names, _separator(comment)
            if numeric:
                raise LogError(
                    f"line {at + 1} is numbers where the names of the columns should be: "
                    f"write a first line like {EXAMPLE}"
                )
            return at + 1, _names(text), _separator(text)
    raise LogError(f"it is empty: its first line names the columns, like {EXAMPLE}")


def _separator(text: str) -> str:
    return next((mark for mark in (",", ";", "\t") if mark in text), ",")


def _split(text: str) -> list[str]:
    return [cell.strip().strip('"') for cell in text.split(_separator(text))]


def _names(text: str) -> list[str]:
    """Lower case, without a unit in brackets behind."""
    return [cell.partition("[")[0].partition("(")[0].strip().lower() for cell in _split(text)]


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return cell.lower() in MISSING
    return True


def _columns(header: list[str], number: int) -> list[str]:
    """What each cell of a row is, "" for what is not used; raises `LogError`."""
    where = f"line {number} (the header)"
    twice = {name for name in header if name in COLUMNS and header.count(name) > 1}
    if twice:
        raise LogError(f"{where}: column {min(twice)} is there twice; leave one out")
    wheels = FOUR if set(FOUR) <= set(header) else TWO
    wanted = ["t", *wheels]
    if len(header) == 1 and "t" in header[0].split():
        raise LogError(f"{where}: the names stand without commas between: write {EXAMPLE}")
    if missing := [name for name in wanted if name not in header]:
        raise LogError(
            f"{where}: no column {', '.join(missing)}{_near(missing, header)}; it must name t, "
            f"and fr, fl, rl, rr or left, right, for example {EXAMPLE}"
        )
    sensors: list[str] = [name for name in ("yaw_rate", "yaw") if name in header]
    if {"x", "y"} <= set(header):
        sensors += ["x", "y"]
    if not sensors:
        raise LogError(
            f"{where}: nothing to compare the wheels with: it must name yaw_rate (a gyro, rad/s), "
            f"or x and y (positions, m){_near(['yaw_rate', 'x', 'y'], header)}"
        )
    used = {*wanted, *sensors, "run"}
    return [name if name in used else "" for name in header]


def _near(names: Sequence[str], header: Sequence[str]) -> str:
    """What may have been meant."""
    others = [name for name in header if name and name not in COLUMNS]
    if "t" in names and (times := [name for name in others if "time" in name or "stamp" in name]):
        return f" (is {times[0][:40]} it? rename it t, in s)"
    near = [one for name in names for one in nearest(name, others)]
    return f" (is {near[0]} it? rename it)" if near else ""


def _ignored(header: list[str], names: list[str]) -> list[str]:
    left = [f'"{cell[:40]}"' for cell, name in zip(header, names, strict=True) if cell and not name]
    if not left:
        return []
    return [f"columns not used: {', '.join(left[:8])}{', ...' if len(left) > 8 else ''}"]


class _Reader:
    """Takes line by line; a million must be quick."""

    def __init__(self, names: list[str], separator: str) -> None:
        self._names, self._separator = names, separator
        self._run = names.index("run") if "run" in names else -1
        # What is neither a number of ours nor the run is not looked at.
        self._picks = [i for i, name in enumerate(names) if name and name != "run"]
        self._values = array("d")  # a list of lists takes ten times the memory
        self._runs: list[int] = []
        self._known: dict[str, int] = {}
        self._bad, self._first = 0, ""

    def take(self, line: str, number: int) -> None:
        if "#" in line:
            line = line.partition("#")[0]
        if not line or line.isspace():
            return
        cells = line.split(self._separator)
        short = len(self._names) - len(cells)
        if short > 0:
            cells += [""] * short
        elif short < 0 and any(cell.strip() for cell in cells[short:]):
            self._refuse(f"line {number} has {len(cells)} cells, the header {len(self._names)}")
            return
        try:
            row = [float(cells[i] or "nan") for i in self._picks]
        except ValueError:
            row = self._slowly(cells, number)
            if not row:
                return
        self._values.extend(row)
        name = cells[self._run].strip().strip('"') if self._run >= 0 else ""
        self._runs.append(self._known.setdefault(name, len(self._known)))

    def _slowly(self, cells: list[str], number: int) -> list[float]:
        row = []
        for i in self._picks:
            cell = cells[i].strip().strip('"')
            if cell.lower() in MISSING:
                row.append(math.nan)
                continue
            try:
                row.append(float(cell))
            except ValueError:
                shown = cell if len(cell) <= 30 else cell[:27] + "..."
                shown = "".join(c if c.isprintable() else "?" for c in shown)
                self._refuse(f'line {number}, column {self._names[i]}: "{shown}" is no number')
                return []
        return row

    def _refuse(self, why: str) -> None:
        self._bad += 1
        self._first = self._first or why

    def table(self, notes: list[str]) -> Table:
        """All of it; raises `LogError` when too much could not be read."""
        rows = len(self._runs)
        if self._bad > max(FEW, SHARE * rows) or (self._bad and not rows):
            raise LogError(
                f"{self._first}, and {self._bad} of {self._bad + rows} rows are so: "
                "write numbers with a point, or leave a cell empty where there is no value"
            )
        if not rows:
            raise LogError("there are no rows below the header: record a drive")
        if self._bad:
            notes = [*notes, f"{_rows(self._bad)} left out: {self._first}"]
        values = np.frombuffer(self._values).reshape(rows, len(self._picks))
        columns = {self._names[i]: values[:, at].copy() for at, i in enumerate(self._picks)}
        runs = np.array(self._runs, dtype=np.int64)
        return Table(columns, runs, tuple(self._known), (*notes, *_bounded(columns)))


def _bounded(columns: dict[str, Floats]) -> Iterator[str]:
    """Make what cannot be a measurement missing, in place; what was."""
    for name, values in columns.items():
        with np.errstate(invalid="ignore"):
            wild = np.abs(values) > min(BOUNDS.get(name, PLACE_BOUND), _spike(name, values))
        if wild.any():
            example = float(values[wild][0])
            values[wild] = math.nan
            yield f"{_cells(int(wild.sum()))} of {name} left out as impossible, like {example:g}"


def _spike(name: str, values: Floats) -> float:
    """What no rate is that all others are far below; rad/s."""
    sizes = np.abs(values[np.isfinite(values) & (np.abs(values) > SLOW)])
    if name not in RATES or len(sizes) < 1 / FEW_SPIKES:
        return math.inf
    return SPIKE * float(np.quantile(sizes, 1 - FEW_SPIKES))


def _rows(count: int) -> str:
    return f"{count} row{'s' if count > 1 else ''}"


def _cells(count: int) -> str:
    return f"{count} cell{'s' if count > 1 else ''}"
