"""Splits the table of a log into runs, and runs into blocks.

A run contains the samples of one drive. A new run begins where the times jump back by a second or
more, or where the wheels have no sample for a minute. A block is a few seconds of a run. Errors
within a block are correlated, because a wheel skids throughout a turn; those of different blocks
are nearly independent, so deviations come from the differences between blocks.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from functools import cached_property
from itertools import pairwise
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.log_rows import FOUR
from acsard.calibration.log_table import APPLIED, TWO, Floats, LogError, Table
from acsard.core.values import Seconds

Complexes = npt.NDArray[np.complex128]
Mask = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]
Number = TypeVar("Number", np.float64, np.complex128)

MIN_BACKWARD_STEP_S = 1.0  # if the times jump back by more, the recording may have restarted

MAX_RESTARTS = 100  # with more jumps back, the rows of one recording are unsorted

MAX_PERIOD_S = 0.7  # median of the wheels; with a longer one, the times are probably not in s

MIN_ROWS = 20  # wheel samples in a run

NEW_RUN_AFTER_S = 60.0  # without a wheel sample

# Times are rounded if they are `ROUNDED_S` apart and `REPEATED` rows have the same time on average.
ROUNDED_S, REPEATED = 0.2, 4.0

# Rows with the values of the row before are removed if they are this fraction of those in which the
# wheels roll at `ROLLING` rad/s (sum of both sides).
ROLLING, MAX_REPEATED_FRACTION = 0.2, 0.4

WHEEL_STREAM = "left right"
COMMANDS = " ".join(APPLIED)
# Names of the sensors, which are their columns. The commands count as a sensor.
SENSOR_NAMES = (WHEEL_STREAM, "yaw_rate", "yaw", "x y", COMMANDS)

Streams = dict[str, tuple[Floats, ...]]  # times and values, by `SENSOR_NAMES`

MAX_RUNS = 1000  # values in the column `run`

SUMMED_ROWS = 50  # over which wheel speeds are summed before two wheels are compared

# Difference of front and rear wheel as a fraction of the distance: reported, refused.
REPORTED_DIFFERENCE, MAX_DIFFERENCE = 0.15, 0.8

# A gap is longer than `GAP_S` and than `GAP_PERIODS` median intervals.
GAP_S, GAP_PERIODS = 0.3, 5.0

STANDSTILL_SPEED = 0.02  # rad/s, up to which a wheel stands still

BLOCK_COUNT = 16  # of a log, unless the blocks would be too short or too long

MAX_BLOCK_S = 12.0  # unless the caller of `blocks()` asks for longer ones

SMOOTH_S = 0.3  # for coarse encoders, of whose speeds some are 0 and some far too large

MIN_BLOCK_ROLL = 0.2  # rad, of at least one side

MAX_JITTER_S = 5.0  # of the delay from stamp to arrival; above it, the stamps are not used


class Run(Struct, frozen=True, dict=True):
    """The samples of one drive. The times of each sensor, s since `start`, strictly increase."""

    name: str
    start: Seconds  # time of the first wheel sample of this drive, as the log gives it
    t: Floats  # times of the wheel speeds, s since `start`
    left: Floats  # mean speed of the left wheels, rad/s
    right: Floats
    gyro_t: Floats
    gyro: Floats  # yaw rate, rad/s
    yaw_t: Floats
    yaw: Floats  # as recorded, rad; it may be wrapped
    place_t: Floats
    place: Complexes  # positions x + iy, m, relative to the first position
    commands_t: Floats
    linear: Floats  # commanded speed, m/s
    angular: Floats  # commanded turn rate, rad/s

    @cached_property
    def gaps(self) -> Floats:
        """Return the gaps between the times of samples, s: one row (begin, end) for each.

        A gap is much longer than the usual interval (`GAP_S`, `GAP_PERIODS`).
        """
        return gaps(self.t)

    @cached_property
    def rolled(self) -> tuple[Floats, Floats]:
        """Angles that left and right wheels have rolled at the times `t`, rad; constant in gaps."""
        steps = np.diff(self.t)
        steps[np.isin(self.t[:-1], self.gaps[:, 0])] = 0.0
        return integral(self.left, steps), integral(self.right, steps)

    @cached_property
    def moving(self) -> Mask:
        """Mask of the wheel samples in which the wheels of at least one side turn."""
        return np.asarray(
            (np.abs(self.left) > STANDSTILL_SPEED) | (np.abs(self.right) > STANDSTILL_SPEED)
        )

    def angles(self, t: Floats) -> tuple[Floats, Floats]:
        """Return the angles that left and right wheels have rolled at the times `t`, rad."""
        left, right = self.rolled
        return np.interp(t, self.t, left), np.interp(t, self.t, right)

    def speed_difference(self, t: Floats) -> Floats:
        """Return the speed of right minus left wheels, rad/s, averaged over `SMOOTH_S`."""
        begin, end = (np.clip(t + s / 2, self.t[0], self.t[-1]) for s in (-SMOOTH_S, SMOOTH_S))
        (left, right), (far_left, far_right) = self.angles(begin), self.angles(end)
        turned = far_right - right - (far_left - left)
        return np.asarray(turned / np.maximum(end - begin, 1e-9))


class Notes:
    """Sentences about a log, each listed once for all its runs; "{}" is the sum of their counts."""

    def __init__(self, sentences: Iterable[str]) -> None:
        self._sentences = {sentence: [0, 0] for sentence in sentences}

    def add(self, sentence: str, count: int = 0) -> None:
        """Add a sentence about one run. A sentence with "{}" and a count of 0 is ignored."""
        if count or "{}" not in sentence:
            sums = self._sentences.setdefault(sentence, [0, 0])
            sums[0], sums[1] = sums[0] + count, sums[1] + 1

    def sentences(self) -> tuple[str, ...]:
        """Return each sentence once, with its count, in the order in which it was added."""
        return tuple(
            sentence.replace("{}", str(count)) + (f" (in {runs} runs)" if 1 < runs < count else "")
            for sentence, (count, runs) in self._sentences.items()
        )


class Log(Struct, frozen=True):
    """The runs of a log, and sentences about the data that were left out or changed."""

    runs: tuple[Run, ...]
    notes: tuple[str, ...]
    # True if the positions are the true ones of the built-in simulator, which have no error.
    true_positions: bool = False


def runs(table: Table) -> Log:
    """Split a table into runs. Raises `LogError` if the table has no run that can be used."""
    notes = Notes(table.notes)
    columns = dict(table.columns)
    t = columns["t"]
    columns["left"], columns["right"] = _sides(columns, notes)
    if len(table.names) > MAX_RUNS:
        raise LogError(
            f"column run has {len(table.names)} different names, which is too many: each name must "
            "stand for a drive, not for a row"
        )
    timed = np.isfinite(t)
    notes.add(f"{{}} of {len(t)} rows have no time and are left out", int((~timed).sum()))
    drives: list[tuple[str, Streams]] = []
    labels = set(table.names)
    for number, name in enumerate(table.names):
        rows = np.flatnonzero(timed & (table.runs == number))
        parts = _restarts(t, rows, columns)
        notes.add(
            "a new run begins wherever the time in the log jumps back; number of jumps: {}",
            len(parts) - 1,
        )
        _in_seconds(name, t, parts, columns)
        whole, parts = len(parts), [piece for part in parts for piece in _pauses(t, part, columns)]
        notes.add(
            f"a new run begins after each gap of over {NEW_RUN_AFTER_S:g} s in the wheel speeds; "
            "number of gaps: {}",
            len(parts) - whole,
        )
        for at, part in enumerate(parts):
            streams = _streams(columns, part, notes)
            if streams is None:
                continue
            if not name:
                label = _numbered("", len(drives) + 1, labels)
            else:
                label = name if at == 0 else _numbered(f"{name}.", at + 1, labels)
            labels.add(label)
            drives.append((label, streams))
    _remove_repeats(drives, notes)
    usable_runs = [_run(name, streams) for name, streams in drives]
    if not usable_runs:
        empty = [
            name for name in ("t", *FOUR, *TWO)
            if name in table.columns and not np.isfinite(table.columns[name]).any()
        ]  # fmt: skip
        raise LogError(
            f"column {empty[0]} has no number in any row: record the wheels while the robot drives"
            if empty
            else f"no run has {MIN_ROWS} rows with a time and both sides' wheel speeds: "
            "record the wheels at 5 Hz or more while the robot drives"
        )
    return Log(tuple(usable_runs), notes.sentences())


def _numbered(prefix: str, number: int, labels: Collection[str]) -> str:
    while f"{prefix}{number}" in labels:
        number += 1
    return f"{prefix}{number}"


def _sides(columns: dict[str, Floats], notes: Notes) -> tuple[Floats, Floats]:
    if set(TWO) <= set(columns):
        return columns["left"], columns["right"]
    for front, rear in (("fl", "rl"), ("fr", "rr")):
        apart = _apart(columns, front, rear)
        if apart > REPORTED_DIFFERENCE:
            notes.add(
                f"{front} and {rear} differ by {apart:.0%} of the distance driven: the tool uses "
                "their mean"
            )
    fr, fl, rl, rr = (columns[name] for name in FOUR)
    return (fl + rl) / 2, (fr + rr) / 2


def _apart(columns: dict[str, Floats], front: str, rear: str) -> float:
    finite = np.isfinite(columns[front]) & np.isfinite(columns[rear])
    starts = np.arange(0, int(finite.sum()), SUMMED_ROWS)
    if not len(starts):
        return 0.0
    a, b = (np.add.reduceat(columns[name][finite], starts) for name in (front, rear))
    apart, rolled = np.abs(a - b).sum(), np.maximum(np.abs(a), np.abs(b)).sum()
    if apart <= MAX_DIFFERENCE * rolled:
        return float(apart / rolled) if rolled else 0.0
    least, most = (front, rear) if np.abs(a).sum() < np.abs(b).sum() else (rear, front)
    sizes = sorted(float(np.abs(speeds).sum()) for speeds in (a, b))
    raise LogError(
        f"{least} hardly turns while {most} does: rename the columns of the working wheels to "
        "left and right, and omit the others"
        if sizes[0] < (1 - MAX_DIFFERENCE) * sizes[1]
        else f"{front} and {rear} turn in opposite directions: a sign is wrong, or columns are "
        "swapped"
    )


def _restarts(t: Floats, rows: Rows, columns: dict[str, Floats]) -> list[Rows]:
    # A file may list all rows of one sensor after all rows of another.
    wheels = _wheel_rows(rows, columns)
    back = np.flatnonzero(np.diff(t[wheels]) < -MIN_BACKWARD_STEP_S) + 1
    if not 0 < len(back) <= MAX_RESTARTS:
        return [rows]
    blocks = [part for part in np.split(wheels, back) if len(part) >= MIN_ROWS]
    spans = sorted((float(np.min(t[part])), float(np.max(t[part]))) for part in blocks)
    # Parts that do not overlap in time are unsorted rows of one drive.
    if not any(a[1] > b[0] for a, b in pairwise(spans)):
        return [rows]
    return list(np.split(rows, np.searchsorted(rows, wheels[back])))


def _wheel_rows(rows: Rows, columns: dict[str, Floats]) -> Rows:
    return rows[np.isfinite(columns["left"][rows]) & np.isfinite(columns["right"][rows])]


def _in_seconds(name: str, t: Floats, parts: list[Rows], columns: dict[str, Floats]) -> None:
    for rows in parts:
        times = np.sort(t[_wheel_rows(rows, columns)])
        if len(times) < MIN_ROWS:
            continue
        once = np.unique(times)
        period = float(np.median(np.diff(once))) if len(once) > 1 else np.inf
        if len(times) > REPEATED * len(once) and period > ROUNDED_S:
            raise LogError(
                f"run {name or 1}: {len(times)} rows of wheel speeds have only {len(once)} "
                "different times, because t was rounded: write t in seconds with 3 decimals"
            )
        if period > MAX_PERIOD_S:
            raise LogError(
                f"run {name or 1}: {period:g} s pass between two rows of wheel speeds: t must be "
                "in seconds (divide ms by 1000, ns by 1e9), and the wheel speeds must be recorded "
                "at 5 Hz or more"
            )


def _pauses(t: Floats, rows: Rows, columns: dict[str, Floats]) -> list[Rows]:
    # A row with a time of another day would make the drive many hours long.
    times = np.sort(t[_wheel_rows(rows, columns)])
    ends = np.flatnonzero(np.diff(times) > NEW_RUN_AFTER_S)
    if not len(ends):
        return [rows]
    drive = np.searchsorted((times[ends] + times[ends + 1]) / 2, t[rows])
    order = np.argsort(drive, kind="stable")
    begins = np.searchsorted(drive[order], np.arange(1, len(ends) + 1))
    return list(np.split(rows[order], begins))


def _streams(columns: dict[str, Floats], rows: Rows, notes: Notes) -> Streams | None:
    streams = {name: _stream(columns, rows, name.split(), notes) for name in SENSOR_NAMES}
    if len(streams[WHEEL_STREAM][0]) >= MIN_ROWS:
        return streams
    notes.add(
        f"runs left out because they have fewer than {MIN_ROWS} rows of wheel speeds: {{}}",
        int(len(rows) > 0),
    )
    return None


def _run(name: str, streams: Streams) -> Run:
    wheels, gyro, yaw, place, commands = (streams[stream] for stream in SENSOR_NAMES)
    start = float(wheels[0][0])
    _, x, y = place
    points = (x - x[:1]) + 1j * (y - y[:1])
    return Run(
        name, start, wheels[0] - start, wheels[1], wheels[2], gyro[0] - start, gyro[1],
        yaw[0] - start, yaw[1], place[0] - start, points, commands[0] - start, *commands[1:],
    )  # fmt: skip


def _remove_repeats(drives: Iterable[tuple[str, Streams]], notes: Notes) -> None:
    # A short drive may not show the repetition, so all drives are evaluated together.
    for what in ("yaw", "x y"):
        repeats = [(streams, *_repeats(streams, what)) for _, streams in drives]
        rolling = sum(int((again & rolls).sum()) for _, again, rolls in repeats)
        if rolling <= MAX_REPEATED_FRACTION * sum(int(rolls.sum()) for *_, rolls in repeats):
            continue
        notes.add(
            f"the columns {what} repeat their last value between samples: such rows are left out "
            "({} of them while the wheels turn)",
            rolling,
        )
        for streams, again, _ in repeats:
            # At rest too: a repeated value may be older than the time of its row.
            streams[what] = tuple(column[~again] for column in streams[what])


def _repeats(streams: Streams, what: str) -> tuple[Mask, Mask]:
    t, *values = streams[what]
    if not len(t):
        return np.zeros(0, dtype=bool), np.zeros(0, dtype=bool)
    again = np.concatenate([[False], np.all(np.diff(values) == 0.0, axis=0)])
    wheels = streams[WHEEL_STREAM]
    return again, np.interp(t, wheels[0], np.abs(wheels[1]) + np.abs(wheels[2])) > ROLLING


def _stream(
    columns: dict[str, Floats], rows: Rows, names: Iterable[str], notes: Notes
) -> tuple[Floats, ...]:
    arrays = [columns.get(name) for name in names]
    if any(values is None for values in arrays):
        return (np.zeros(0),) * (1 + len(arrays))
    stream = [columns["t"][rows], *(values[rows] for values in arrays if values is not None)]
    whole = np.all(np.isfinite(stream), axis=0)
    return tuple(_ordered([values[whole] for values in stream], " ".join(names), notes))


def _ordered(stream: list[Floats], what: str, notes: Notes) -> Iterator[Floats]:
    t = stream[0]
    notes.add(f"{{}} rows of {what} are out of order and were sorted", int((np.diff(t) < 0).sum()))
    order = np.argsort(t, kind="stable")
    times, first = np.unique(t[order], return_index=True)
    notes.add(
        f"{{}} rows of {what} are left out, because an earlier row has the same time",
        len(t) - len(times),
    )
    yield times
    for values in stream[1:]:
        yield values[order][first]


class Block(Struct, frozen=True):
    """A few seconds of a run. To compute uncertainties, the fit leaves out one block at a time."""

    run: int
    begin: float  # s since the start of the run
    end: float


def gaps(t: Floats) -> Floats:
    """Return the gaps between the times of samples, s: one row (begin, end) for each.

    A gap is much longer than the usual interval (`GAP_S`, `GAP_PERIODS`).
    """
    steps = np.diff(t)
    if not len(steps):
        return np.zeros((0, 2))
    wide = steps > max(GAP_S, GAP_PERIODS * float(np.median(steps)))
    return np.column_stack((t[:-1][wide], t[1:][wide]))


def inside(begin: Floats, end: Floats, holes: Floats) -> Mask:
    """Return a mask of the intervals that do not overlap one of the gaps `holes`."""
    after = np.searchsorted(holes[:, 1], begin, side="right")
    before = np.searchsorted(holes[:, 0], end, side="left")
    return np.asarray(after == before)


def cumulative(steps: npt.NDArray[Number]) -> npt.NDArray[Number]:
    """Return 0, followed by the cumulative sums of `steps`. The result is one element longer."""
    return np.concatenate((np.zeros(1, steps.dtype), np.cumsum(steps)))


def integral(values: Floats, steps: Floats) -> Floats:
    """Return the integral of `values` from the first sample to each sample (trapezoidal rule)."""
    return cumulative((values[1:] + values[:-1]) / 2 * steps) if len(values) else values


def rest_intervals(run: Run, least_s: float, edge_s: float) -> Floats:
    """Return the intervals in which all wheels stand still, s, without `edge_s` at each end."""
    moving = np.concatenate(([True], run.moving, [True])).astype(np.int8)
    changes = np.flatnonzero(np.diff(moving))
    spans = [(run.t[a], run.t[b - 1]) for a, b in changes.reshape(-1, 2)]
    intervals = [(a + edge_s, b - edge_s) for a, b in spans if b - a >= least_s + 2 * edge_s]
    return np.array(intervals, dtype=np.float64).reshape(-1, 2)


def blocks(driven: Sequence[Run], shortest_s: float) -> list[Block]:
    """Return the blocks of all runs in which the robot moves, of `shortest_s` s or longer."""
    moved = sum(float(np.minimum(np.diff(r.t), GAP_S) @ r.moving[1:]) for r in driven)
    length = float(np.clip(moved / BLOCK_COUNT, shortest_s, max(MAX_BLOCK_S, shortest_s)))
    result = []
    for number, run in enumerate(driven):
        ends = np.concatenate((run.gaps[:, 0], run.t[-1:]))
        begins = np.concatenate((run.t[:1], run.gaps[:, 1]))
        for begin, end in zip(begins, ends, strict=True):
            count = max(1, round((end - begin) / length))
            edges = np.linspace(begin, end, count + 1)
            left, right = run.angles(edges)
            for at in range(count):
                a, b = edges[at], edges[at + 1]
                if b > a and _turned(run, a, b, left[at : at + 2], right[at : at + 2]):
                    result.append(Block(number, float(a), float(b)))
    return result


def _turned(run: Run, begin: float, end: float, left: Floats, right: Floats) -> bool:
    if max(abs(left[1] - left[0]), abs(right[1] - right[0])) >= MIN_BLOCK_ROLL:
        return True
    a, b = np.searchsorted(run.t, (begin, end))
    speed = max(float(np.sum(np.abs(v[a:b]))) for v in (run.left, run.right))
    return bool(speed * (end - begin) / max(1, b - a) >= MIN_BLOCK_ROLL)


def on_arrival_clock(arrivals: Floats, stamps: Floats) -> Floats:
    """Return the times at which a sender made its samples, s, on the receiver's clock.

    They are the stamps plus the smallest delay from stamp to arrival, or the arrivals if the delays
    vary by more than `MAX_JITTER_S`.
    """
    delay = arrivals - stamps
    if float(np.ptp(delay)) > MAX_JITTER_S:
        return arrivals
    return np.asarray(stamps + float(delay.min()))
