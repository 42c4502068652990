"""Reads the bytes of a CSV file into columns of numbers, and finds the run of each row.

The header names the columns in any order, and may give units, such as "t [ms]" and "yaw_rate
(deg/s)". A cell may be empty, so that sensors of different rates share a file. Rows that cannot be
read and impossible values are left out, counted and reported. A file with more than a few
unreadable rows is refused.
"""

from __future__ import annotations

import csv
import math
import re
from array import array
from collections.abc import Iterable, Iterator, Mapping, Sequence

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.core.config.nearest import nearest
from acsard.core.formatting import many, printable
from acsard.core.messages.schema import Imu, JointState, Message, PoseStamped
from acsard.core.values import NS_PER_S, AcsardError

TIME = {"s": 1.0, "sec": 1.0, "seconds": 1.0, "ms": 1e-3, "us": 1e-6, "ns": 1e-9}
TIME |= {"\N{MICRO SIGN}s": 1e-6, "\N{GREEK SMALL LETTER MU}s": 1e-6}
LENGTH = {"m": 1.0, "cm": 1e-2, "mm": 1e-3, "km": 1e3}
ANGLE = {"rad": 1.0, "deg": math.radians(1.0), "°": math.radians(1.0), "mrad": 1e-3}
RATE = {f"{unit}/s": size for unit, size in ANGLE.items()}
RATE |= {"rpm": math.tau / 60, "rps": math.tau, "dps": math.radians(1.0)}

SPEED = {f"{unit}/s": size for unit, size in LENGTH.items()}
APPLIED = "applied_linear", "applied_angular"
"""Columns with the twist that the daemon commands to the wheels, in m/s and rad/s."""

UNITS = {"t": TIME, "x": LENGTH, "y": LENGTH, "yaw": ANGLE, APPLIED[0]: SPEED}
"""Units that each column can have, by the name of the column.

The table of a column maps the name of a unit to the factor that converts this unit to SI. Columns
that are not listed here have the units of `RATE`.
"""

SI = {"t": "s", "x": "m", "y": "m", "yaw": "rad", APPLIED[0]: "m/s"}

_NAME = re.compile(r"(?P<name>[^\[(]*)[\[(]?(?P<unit>[^\])]*)")


def parted(cell: str) -> tuple[str, str]:
    """Return the name and the unit of a column from its header cell, such as "t [ms]".

    The name is in snake case. The unit is the text in brackets up to a comma, or "" if the cell has
    no brackets.
    """
    match = _NAME.match(cell.strip().lower())
    assert match is not None
    name = re.sub(r"[\s-]+", "_", match["name"].strip())
    return name, re.sub(r"[\s^]", "", match["unit"].partition(",")[0])


def factor(name: str, unit: str) -> float | None:
    """Return the factor that converts `unit` to SI, or None if the unit is unknown.

    `name` is the name of the column. An empty unit means SI.
    """
    known = UNITS.get(name, RATE)
    return known.get(unit.replace("degrees", "deg").replace("/sec", "/s"), None if unit else 1.0)


Floats = npt.NDArray[np.float64]

WHEEL_COLUMNS = ("fr", "fl", "rl", "rr", "left", "right")

BOUNDS = dict.fromkeys(WHEEL_COLUMNS, 1e3) | {"t": 1e20, "yaw_rate": 1e4, "yaw": 1e7}
DEFAULT_BOUND = 1e9
"""Largest plausible absolute value in a column that `BOUNDS` does not list, in SI units.

This limit and those in `BOUNDS` also allow values in degrees or nanoseconds, so that later checks
can name the wrong unit.
"""

SPIKE_COLUMNS = frozenset((*WHEEL_COLUMNS, "yaw_rate"))
"""Columns of wheel speeds and turn rates. Spikes are removed only from these columns."""

SPIKE, FEW_VALUES, SLOW = 10.0, 0.02, 0.02
"""Definition of a spike, which is a rate that was recorded wrongly.

A spike is more than `SPIKE` times as large as each of the two neighboring samples. It is also more
than `SPIKE` times as large as the usual rate. The usual rate is the quantile 1 - `FEW_VALUES` of
all rates above `SLOW` rad/s.
"""


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
    """Return a mask of the spikes: values far above their neighbors, which were recorded wrongly.

    `values` is in the order of the file. `order` contains the indices of the values sorted by time.
    A spike is far above its neighbors in both orders. A correct value may be far above its
    neighbors in only one of them, for example if the rows of the file are shuffled.

    If fewer than 1 / `FEW_VALUES` values are above `SLOW`, no value counts as a spike.
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
    """Return a mask of the values that are far above `usual` and far above both neighbors.

    Far above means more than `SPIKE` times as large. NaN values do not count as neighbors.
    """
    indices = np.flatnonzero(np.isfinite(sizes))
    padded = np.concatenate([[0.0], sizes[indices], [0.0]])
    around = np.maximum(np.maximum(padded[:-2], padded[2:]), usual)
    mask = np.zeros(len(sizes), dtype=bool)
    mask[indices[padded[1:-1] > SPIKE * around]] = True
    return mask


FOUR, TWO = ("fr", "fl", "rl", "rr"), ("left", "right")
"""Columns of wheel speeds, rad/s.

`FOUR` has a column for each wheel. `TWO` has a column for the mean speed of each side.
"""

COLUMNS = ("t", *FOUR, *TWO, "yaw_rate", "x", "y", "yaw", *APPLIED, "run")
"""Columns that a log can have. The column `run` contains names, and the others contain numbers."""

EMPTY_CELLS = frozenset(("", "nan", "-nan(ind)", "null", "none", "na", "n/a", "#n/a", "-", "--"))
"""Contents of a cell without a value, in lower case."""

COUNT_COLUMN = re.compile(r"tick|count|(?:^|_)enc")
"""Pattern for names of columns with encoder counts, which the user must convert to speeds."""

TRAILING_COMMENT = re.compile(r"(?:^|\s)#")
"""Pattern for the start of a comment after a number.

It does not match the "#" in "1.#QNAN", which means NaN.
"""

MAX_BAD_ROWS, MAX_BAD_FRACTION = 3, 0.01
"""Limits for the number of unreadable rows in a log.

At most `MAX_BAD_ROWS` rows may be unreadable, or the fraction `MAX_BAD_FRACTION` of the readable
rows if that is more.
"""

EXAMPLE = '"t,left,right,yaw_rate" or "t,fr,fl,rl,rr,x,y"'

CSV_ADVICE = f"export the drive as a CSV file whose first line names the columns, like {EXAMPLE}"


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

    columns: dict[str, Floats]
    """Columns by name, in SI units, with NaN for an empty cell."""
    runs: npt.NDArray[np.int64]
    """For each row, the index of its run in `names`."""
    names: tuple[str, ...]
    notes: tuple[str, ...]
    """Sentences about data that was left out."""

    @classmethod
    def joined(cls, sensors: Sequence[Mapping[str, Floats]]) -> Table:
        """Return a table of one run with all samples of several sensors, sorted by time.

        Each element of `sensors` maps the column names of one sensor to values. Every sensor has
        the column "t". Any other column belongs to only one sensor. Each sample has its own row,
        in which the columns of the other sensors are NaN.
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
    """Parse the bytes of a CSV file. Raises `LogError` if the file cannot be used."""
    lines = _text(data).splitlines()
    number, header, separator = _header(lines)
    names = _columns([name for name, _ in header], number)
    if separator != ",":
        lines = [line.replace(",", ".") for line in lines]
    reader = _Reader(names, separator, [factor(name, unit) or 1.0 for name, unit in header])
    for at in range(number, len(lines)):
        reader.take(lines[at], at + 1)
    return reader.table([*_ignored(header, names), *_unknown_units(header, names)])


def _text(data: bytes) -> str:
    for mark, coding in ((b"\xff\xfe", "utf-16"), (b"\xfe\xff", "utf-16")):
        if data.startswith(mark):
            return data.decode(coding, errors="replace")
    if b"\0" in data[:4096]:
        raise LogError(f"the file is not text (perhaps a ROS bag): {CSV_ADVICE}")
    return data.decode("utf-8-sig", errors="replace")


def _header(lines: Sequence[str]) -> tuple[int, list[tuple[str, str]], str]:
    """Return the number of lines above the data, the (name, unit) pairs, and the separator."""
    comment = ""
    for at, line in enumerate(lines):
        text = line.strip()
        if text.startswith(("#", "%")):
            comment = text.strip("#% \t") or comment
        elif text and not text.lower().startswith("sep="):  # `sep=` is a hint for spreadsheets
            separator = _separator(text)
            cells = _cut(text, separator)
            if not all(_is_number(cell) for cell in cells):
                return at + 1, _names(text, separator), separator
            # numpy writes the header as the last comment above the numbers.
            separator = _separator(comment)
            names = _names(comment, separator)
            if 1 < len(names) == len(cells) or "t" in [name for name, _ in names]:
                return at, names, separator
            raise LogError(
                f"line {at + 1} contains numbers instead of the names of the columns: "
                f"write a first line like {EXAMPLE}"
            )
    raise LogError(f"the file is empty: its first line must name the columns, like {EXAMPLE}")


def _separator(text: str) -> str:
    return max(",;\t", key=text.count)


def _cut(line: str, separator: str) -> list[str]:
    try:
        cells = next(csv.reader([line], delimiter=separator, skipinitialspace=True), [])
    except csv.Error:
        return line.split(separator)
    return [cell.strip() for cell in cells]


def _names(text: str, separator: str) -> list[tuple[str, str]]:
    return [parted(cell) for cell in _cut(text, separator)]


def _is_number(cell: str) -> bool:
    try:
        float(cell)
    except ValueError:
        return cell.lower() in EMPTY_CELLS
    return True


def _columns(header: list[str], number: int) -> list[str]:
    where = f"line {number} (the header)"
    twice = {name for name in header if name in COLUMNS and header.count(name) > 1}
    if twice:
        raise LogError(f"{where}: column {min(twice)} exists twice; leave one out")
    wheels = FOUR if set(FOUR) <= set(header) else TWO
    wanted = ["t", *wheels]
    if len(header) == 1 and "t" in header[0].split("_"):
        raise LogError(f"{where}: there are no commas between the names: write {EXAMPLE}")
    if missing := [name for name in wanted if name not in header]:
        raise LogError(
            f"{where}: no column {', '.join(missing)}{_column_hint(missing, header)}; the header "
            f"must name t, and either fr, fl, rl and rr, or left and right, for example {EXAMPLE}"
        )
    sensors: list[str] = [name for name in ("yaw_rate", "yaw") if name in header]
    if {"x", "y"} <= set(header):
        sensors += ["x", "y"]
    if not sensors:
        raise LogError(
            f"{where}: no column with which to compare the wheels: the header must name yaw_rate "
            "(a gyro, rad/s), or x and y (positions, m)"
            f"{_column_hint(['yaw_rate', 'x', 'y'], header)}"
        )
    commands = APPLIED if set(APPLIED) <= set(header) else ()
    used = {*wanted, *sensors, *commands, "run"}
    return [name if name in used else "" for name in header]


def _column_hint(names: Sequence[str], header: Sequence[str]) -> str:
    others = [name for name in header if name and name not in COLUMNS]
    if "t" in names and (times := [name for name in others if "time" in name or "stamp" in name]):
        return f" (if column {times[0][:40]} is the time, rename it to t and convert it to seconds)"
    if counts := [name for name in others if COUNT_COLUMN.search(name)]:
        return (
            f" (column {counts[0][:40]} has counts, not speeds: convert the counts of each row to "
            "rad/s with 2 pi x counts / (counts per turn x seconds))"
        )
    near = [other for name in names for other in nearest(name, others)]
    return f" (if column {near[0]} is the missing one, rename it)" if near else ""


def _ignored(header: list[tuple[str, str]], names: list[str]) -> list[str]:
    left = [
        f'"{cell[:40]}"' for (cell, _), name in zip(header, names, strict=True) if cell and not name
    ]
    if not left:
        return []
    return [f"columns not used: {', '.join(left[:8])}{', ...' if len(left) > 8 else ''}"]


def _unknown_units(header: list[tuple[str, str]], names: list[str]) -> list[str]:
    return [
        f"column {name} has the unknown unit ({unit[:20]}): the values were read as "
        f"{SI.get(name, 'rad/s')}; correct the header if they have another unit"
        for (_, unit), name in zip(header, names, strict=True)
        if name and name != "run" and factor(name, unit) is None
    ]


class _Reader:
    """Parser of the lines below the header. It must be fast: a log may have a million lines."""

    def __init__(self, names: list[str], separator: str, factors: list[float]) -> None:
        self._names, self._separator, self._factors = names, separator, factors
        self._run = names.index("run") if "run" in names else -1
        # Parse as numbers only the columns that the calibration uses, without the name of the run.
        self._picks = [i for i, name in enumerate(names) if name and name != "run"]
        self._last = max(*self._picks, self._run)
        self._values = array("d")  # a list of lists would take ten times the memory
        self._runs: list[int] = []
        self._known: dict[str, int] = {}
        self._bad, self._first = 0, ""

    def take(self, line: str, number: int) -> None:
        if not line or line.isspace():
            return
        special = "#" in line or '"' in line
        cells = self._cells(line) if special else line.split(self._separator)
        short = len(self._names) - len(cells)
        if short > 0:
            if not cells:
                return
            cells += [""] * short
        elif short < 0 and any(cell.strip() for cell in cells[short:]):
            self._refuse(
                f"line {number} has {len(cells)} cells, but the header has {len(self._names)}"
            )
            return
        try:
            row = [float(cells[i] or "nan") for i in self._picks]
        except ValueError:
            row = self._slowly(cells, number)
            if not row:
                return
        self._values.extend(row)
        name = cells[self._run].strip() if self._run >= 0 else ""
        self._runs.append(self._known.setdefault(name, len(self._known)))

    def _cells(self, line: str) -> list[str]:
        """Return the cells of a line without its comment; [] if the line is only a comment."""
        cells = _cut(line, self._separator)
        if line.lstrip().startswith("#") and not self._begins_with_its_run(cells):
            return []
        for i, cell in enumerate(cells):
            # The name of a run, or an unused column, may contain a "#".
            if i == self._run or (i < self._last and i not in self._picks):
                continue
            if cell.lower() not in EMPTY_CELLS and (comment := TRAILING_COMMENT.search(cell)):
                return [*cells[:i], cell[: comment.start()]]
        return cells

    def _begins_with_its_run(self, cells: list[str]) -> bool:
        return (
            self._run == 0
            and len(cells) > self._last
            and all(_is_number(cells[i]) for i in self._picks)
        )

    def _slowly(self, cells: list[str], number: int) -> list[float]:
        row = []
        for i in self._picks:
            cell = cells[i].strip()
            if cell.lower() in EMPTY_CELLS:
                row.append(math.nan)
                continue
            try:
                row.append(float(cell))
            except ValueError:
                if parted(cell)[0] == self._names[i]:
                    return []  # the line repeats the header, because several logs were concatenated
                text = printable(cell if len(cell) <= 30 else cell[:27] + "...")
                date = self._names[i] == "t" and ":" in cell
                why = "a date, but t must be in seconds" if date else "not a number"
                self._refuse(f'line {number}, column {self._names[i]}: "{text}" is {why}')
                return []
        return row

    def _refuse(self, why: str) -> None:
        self._bad += 1
        self._first = self._first or why

    def table(self, notes: list[str]) -> Table:
        rows = len(self._runs)
        if self._bad > max(MAX_BAD_ROWS, MAX_BAD_FRACTION * rows) or (self._bad and not rows):
            raise LogError(
                f"{self._first}, and {self._bad} of {self._bad + rows} rows have such errors: "
                "write numbers with a decimal point, or leave a cell empty if it has no value"
            )
        if not rows:
            raise LogError("there are no rows below the header: record a drive")
        if self._bad:
            notes = [*notes, f"{many(self._bad, 'row')} left out: {self._first}"]
        values = np.frombuffer(self._values).reshape(rows, len(self._picks))
        columns = {
            self._names[i]: values[:, at] * self._factors[i] for at, i in enumerate(self._picks)
        }
        runs = np.array(self._runs, dtype=np.int64)
        return Table(columns, runs, tuple(self._known), (*notes, *bounded(columns)))


HEADER = f"t,{','.join(FOUR)},yaw_rate,x,y,yaw"

KEYS = ("wheel_states", "imu", "sim/pose")
"""Zenoh keys whose messages `row()` converts to rows of a log."""


def row(message: Message, arrived_ns: int) -> str:
    """Return the CSV row of a message on one of `KEYS`. Raises `ValueError` for other messages.

    The time of the row is the stamp of the message. If the message has no stamp, the time is
    `arrived_ns`, the wall-clock time of its arrival, ns since 1970.
    """
    if isinstance(message, JointState) and len(message.velocity) == len(FOUR):
        cells = [*(f"{speed:.6g}" for speed in message.velocity), "", "", "", ""]
    elif isinstance(message, Imu):
        cells = ["", "", "", "", f"{message.angular_velocity.z:.6g}", "", "", ""]
    elif isinstance(message, PoseStamped):
        where, turn = message.pose.position, message.pose.orientation
        yaw = 2 * math.atan2(turn.z, turn.w)
        cells = ["", "", "", "", "", f"{where.x:.4f}", f"{where.y:.4f}", f"{yaw:.5f}"]
    else:
        raise ValueError(f"{type(message).__name__} cannot be in a log")
    stamp_ns = message.header.stamp.to_ns() or arrived_ns
    return ",".join([f"{stamp_ns // NS_PER_S}.{stamp_ns % NS_PER_S // 1000:06d}", *cells])
