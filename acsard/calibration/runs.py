"""Splits the table of a log into runs. A run has the samples of one drive, sensor by sensor.

The times of a log may have any origin. Within a run they begin at 0. Rows that are out of order are
sorted. If the times start again, or the wheels have no sample for a minute, a new run begins.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from itertools import pairwise

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.log_table import FOUR, TWO, Floats, LogError, Table

Complexes = npt.NDArray[np.complex128]
Rows = npt.NDArray[np.int64]

RESTART_S = 1.0
"""Step back in time, s, above which the time may have started again."""

FEW_RESTARTS = 100
"""Largest number of restarts. With more of them, the rows are in no order at all."""

SLOWEST_S = 0.7
"""Longest period of wheel samples, s. If it is longer, the times are probably not in seconds."""

LEAST_ROWS = 20
"""Smallest number of wheel samples in a run, and in a log."""

PAUSE_S = 60.0
"""Time without a wheel sample after which a new drive begins, s."""

ROUNDED_S, REPEATED = 0.2, 4.0
"""Period of the times, s, and mean number of rows per time. If both are exceeded, t was rounded."""

ROLLING, AGAIN = 0.2, 0.4
"""Evidence for a logger that repeats a position until the next one arrives.

Above a speed of `ROLLING` rad/s, both sides together, a true position does not stay the same. The
logger repeats positions if it does stay the same in more than the fraction `AGAIN` of these rows of
the file. Positions of 10 Hz in rows of 20 Hz stay the same in about half of them.
"""

WHEELS = "left right"
STREAMS = (WHEELS, "yaw_rate", "yaw", "x y")
"""The columns of each sensor."""

Streams = dict[str, tuple[Floats, ...]]
"""The times and values of each sensor, by the names in `STREAMS`."""

MOST_RUNS = 1000
"""Largest number of runs in a log. With more of them, the column run does not name drives."""

TOGETHER = 50
"""Number of rows that are summed before the front and rear wheel of a side are compared."""

NOTED, APART = 0.15, 0.8
"""Difference of the front and rear wheel of a side, as a fraction of the distance they rolled.

Above `NOTED` it is reported, above `APART` the log is refused.
"""


class Run(Struct, frozen=True):
    """The samples of one drive. Times are in s since `start`, in order, and each occurs once."""

    name: str
    start: float
    """Time of the first wheel sample in the log, s."""
    t: Floats
    """Times of the wheel speeds."""
    left: Floats
    """Mean speed of the left wheels, rad/s."""
    right: Floats
    gyro_t: Floats
    gyro: Floats
    """Yaw rate, rad/s."""
    yaw_t: Floats
    yaw: Floats
    """Yaw as recorded: rad, wrapped or not."""
    place_t: Floats
    place: Complexes
    """Positions x + iy in m, relative to the first one."""


class Notes:
    """Sentences about a log. A sentence that occurs in many runs is listed once.

    "{}" in a sentence stands for its count, summed over all runs.
    """

    def __init__(self, sentences: Iterable[str]) -> None:
        self._sentences = {sentence: [0, 0] for sentence in sentences}

    def add(self, sentence: str, count: int = 0) -> None:
        """Add a sentence. `count` is the count of one run; 0 adds nothing to a counted sentence."""
        if count or "{}" not in sentence:
            sums = self._sentences.setdefault(sentence, [0, 0])
            sums[0], sums[1] = sums[0] + count, sums[1] + 1

    def sentences(self) -> tuple[str, ...]:
        """Return each sentence once, in the order in which they were added."""
        return tuple(
            sentence.replace("{}", str(count)) + (f" (in {runs} runs)" if 1 < runs < count else "")
            for sentence, (count, runs) in self._sentences.items()
        )


class Log(Struct, frozen=True):
    """The runs of a log, and sentences about data that was left out or changed."""

    runs: tuple[Run, ...]
    notes: tuple[str, ...]


def runs(table: Table) -> Log:
    """Return the runs in a table. Raises `LogError` if it has no run that can be used."""
    notes = Notes(table.notes)
    columns = dict(table.columns)
    t = columns["t"]
    columns["left"], columns["right"] = _sides(columns, notes)
    if len(table.names) > MOST_RUNS:
        raise LogError(
            f"column run has {len(table.names)} different names: it must name drives, not rows"
        )
    timed = np.isfinite(t)
    notes.add(f"{{}} of {len(t)} rows have no time and are left out", int((~timed).sum()))
    drives: list[tuple[str, Streams]] = []
    for number, name in enumerate(table.names):
        rows = np.flatnonzero(timed & (table.runs == number))
        parts = _restarts(t, rows, columns)
        notes.add("each restart of the time begins a new run: {} of them", len(parts) - 1)
        _in_seconds(name, t, parts, columns)
        whole, parts = len(parts), [piece for part in parts for piece in _pauses(t, part, columns)]
        notes.add(
            f"each silence of the wheels of over {PAUSE_S:g} s begins a new run: {{}} of them",
            len(parts) - whole,
        )
        for at, part in enumerate(parts):
            label = name or str(len(drives) + 1)
            streams = _streams(columns, part, notes)
            if streams is not None:
                drives.append((label if at == 0 or not name else f"{name}.{at + 1}", streams))
    _remove_repeats(drives, notes)
    found = [_run(name, streams) for name, streams in drives]
    if not found:
        empty = [
            name for name in ("t", *FOUR, *TWO)
            if name in table.columns and not np.isfinite(table.columns[name]).any()
        ]  # fmt: skip
        raise LogError(
            f"column {empty[0]} has no number in any row: record the wheels while the robot drives"
            if empty
            else f"no run has {LEAST_ROWS} rows with a time and both sides' wheel speeds: "
            "record the wheels at 5 Hz or more while the robot drives"
        )
    return Log(tuple(found), notes.sentences())


def _sides(columns: dict[str, Floats], notes: Notes) -> tuple[Floats, Floats]:
    if set(TWO) <= set(columns):
        return columns["left"], columns["right"]
    for front, rear in (("fl", "rl"), ("fr", "rr")):
        apart = _apart(columns, front, rear)
        if apart > NOTED:
            notes.add(
                f"{front} and {rear} differ by {apart:.0%} of their distance: the tool uses their "
                "mean"
            )
    fr, fl, rl, rr = (columns[name] for name in FOUR)
    return (fl + rl) / 2, (fr + rr) / 2


def _apart(columns: dict[str, Floats], front: str, rear: str) -> float:
    """Return the difference of the wheels of a side, as a fraction of the distance they rolled.

    Both wheels roll over the same floor, so a large difference means an error. Raises `LogError` if
    it exceeds `APART`.
    """
    seen = np.isfinite(columns[front]) & np.isfinite(columns[rear])
    starts = np.arange(0, int(seen.sum()), TOGETHER)
    if not len(starts):
        return 0.0
    a, b = (np.add.reduceat(columns[name][seen], starts) for name in (front, rear))
    apart, rolled = np.abs(a - b).sum(), np.maximum(np.abs(a), np.abs(b)).sum()
    if apart <= APART * rolled:
        return float(apart / rolled) if rolled else 0.0
    least, most = (front, rear) if np.abs(a).sum() < np.abs(b).sum() else (rear, front)
    sizes = sorted(float(np.abs(speeds).sum()) for speeds in (a, b))
    raise LogError(
        f"{least} hardly turns while {most} does: name the wheels that work left and right, and "
        "omit the others"
        if sizes[0] < (1 - APART) * sizes[1]
        else f"{front} and {rear} turn in opposite directions: a sign is wrong, or columns are "
        "swapped"
    )


def _restarts(t: Floats, rows: Rows, columns: dict[str, Floats]) -> list[Rows]:
    """Return the rows of each drive, split where the times start again.

    Only rows with wheel speeds count: in a file, the rows of one sensor may all come after the rows
    of another, each in its own order.
    """
    wheels = rows[np.isfinite(columns["left"][rows]) & np.isfinite(columns["right"][rows])]
    back = np.flatnonzero(np.diff(t[wheels]) < -RESTART_S) + 1
    if not 0 < len(back) <= FEW_RESTARTS:
        return [rows]
    blocks = [part for part in np.split(wheels, back) if len(part) >= LEAST_ROWS]
    spans = sorted((float(np.min(t[part])), float(np.max(t[part]))) for part in blocks)
    if not any(a[1] > b[0] for a, b in pairwise(spans)):
        return [rows]  # these are blocks of a single drive in another order
    return list(np.split(rows, np.searchsorted(rows, wheels[back])))


def _wheel_times(t: Floats, rows: Rows, columns: dict[str, Floats]) -> Floats:
    """Return the sorted times of the rows with speeds of both sides. A time may occur twice."""
    held = np.isfinite(columns["left"][rows]) & np.isfinite(columns["right"][rows])
    return np.sort(t[rows[held]])


def _in_seconds(name: str, t: Floats, parts: list[Rows], columns: dict[str, Floats]) -> None:
    """Raise `LogError` if the times are not in seconds or too coarse."""
    for rows in parts:
        times = _wheel_times(t, rows, columns)
        if len(times) < LEAST_ROWS:
            continue
        once = np.unique(times)
        period = float(np.median(np.diff(once))) if len(once) > 1 else np.inf
        if len(times) > REPEATED * len(once) and period > ROUNDED_S:
            raise LogError(
                f"run {name or 1}: {len(times)} rows of wheel speeds have {len(once)} different "
                "times, because t was rounded: write it with 3 decimals of a second"
            )
        if period > SLOWEST_S:
            raise LogError(
                f"run {name or 1}: {period:g} s between two rows of wheel speeds: t must be in "
                "seconds (divide ms by 1000, ns by 1e9), and the wheels recorded at 5 Hz or more"
            )


def _pauses(t: Floats, rows: Rows, columns: dict[str, Floats]) -> list[Rows]:
    """Return the rows of each drive, split where the wheels have no sample for `PAUSE_S`.

    Without the split, a single stamp of another day would make one drive of many hours.
    """
    times = _wheel_times(t, rows, columns)
    ends = np.flatnonzero(np.diff(times) > PAUSE_S)
    if not len(ends):
        return [rows]
    drive = np.searchsorted((times[ends] + times[ends + 1]) / 2, t[rows])
    order = np.argsort(drive, kind="stable")
    begins = np.searchsorted(drive[order], np.arange(1, len(ends) + 1))
    return list(np.split(rows[order], begins))


def _streams(columns: dict[str, Floats], rows: Rows, notes: Notes) -> Streams | None:
    """Return the sensors of a drive, or None if it has too few rows of wheel speeds."""
    streams = {name: _stream(columns, rows, name.split(), notes) for name in STREAMS}
    if len(streams[WHEELS][0]) >= LEAST_ROWS:
        return streams
    notes.add(
        f"runs with fewer than {LEAST_ROWS} rows of wheel speeds are left out: {{}} of them",
        int(len(rows) > 0),
    )
    return None


def _run(name: str, streams: Streams) -> Run:
    wheels, gyro, yaw, place = (streams[stream] for stream in STREAMS)
    start = float(wheels[0][0])
    x, y = place[1:] if len(place[0]) else (np.zeros(0), np.zeros(0))
    points = (x - x[:1]) + 1j * (y - y[:1])
    return Run(
        name, start, wheels[0] - start, wheels[1], wheels[2], gyro[0] - start, gyro[1],
        yaw[0] - start, yaw[1], place[0] - start, points,
    )  # fmt: skip


def _remove_repeats(drives: Iterable[tuple[str, Streams]], notes: Notes) -> None:
    """Remove the values that a logger repeats until the next sample arrives, in place.

    The rows of all drives together show whether the logger repeats, because a short drive may not.
    """
    for what in ("yaw", "x y"):
        found = [(streams, *_repeats(streams, what)) for _, streams in drives]
        rolling = sum(int((again & rolls).sum()) for _, again, rolls in found)
        if rolling <= AGAIN * sum(int(rolls.sum()) for *_, rolls in found):
            continue
        notes.add(
            f"{what} repeat their value between samples: {{}} such rows while the wheels turn are "
            "left out",
            rolling,
        )
        for streams, again, _ in found:
            # Remove the repetitions at rest as well: a repeated value may be older than the time
            # of its row.
            streams[what] = tuple(column[~again] for column in streams[what])


Mask = npt.NDArray[np.bool_]


def _repeats(streams: Streams, what: str) -> tuple[Mask, Mask]:
    """Return masks of the rows that repeat the value above, and of those while the wheels turn."""
    t, *values = streams[what]
    if not len(t):
        return np.zeros(0, dtype=bool), np.zeros(0, dtype=bool)
    again = np.concatenate([[False], np.all(np.diff(values) == 0.0, axis=0)])
    wheels = streams[WHEELS]
    return again, np.interp(t, wheels[0], np.abs(wheels[1]) + np.abs(wheels[2])) > ROLLING


def _stream(
    columns: dict[str, Floats], rows: Rows, names: Iterable[str], notes: Notes
) -> tuple[Floats, ...]:
    """Return the times and values of a sensor, sorted, with one row for each time.

    Rows in which one of its columns is empty are left out.
    """
    held = [columns.get(name) for name in names]
    if any(values is None for values in held):
        return (np.zeros(0),) * (1 + len(held))
    stream = [columns["t"][rows], *(values[rows] for values in held if values is not None)]
    whole = np.all(np.isfinite(stream), axis=0)
    return tuple(_ordered([values[whole] for values in stream], " ".join(names), notes))


def _ordered(stream: list[Floats], what: str, notes: Notes) -> Iterator[Floats]:
    """Sort a stream by time. Of several samples with the same time, keep the first."""
    t = stream[0]
    notes.add(f"{{}} rows of {what} are out of order and were sorted", int((np.diff(t) < 0).sum()))
    order = np.argsort(t, kind="stable")
    times, first = np.unique(t[order], return_index=True)
    notes.add(
        f"{{}} rows of {what} repeat a time: the first row of each time is used",
        len(t) - len(times),
    )
    yield times
    for values in stream[1:]:
        yield values[order][first]
