"""Splits the table of a log into runs, and runs into blocks.

A run contains the samples of one drive. Its times begin at 0. A new run begins where the times of
the log jump back by a second or more, or where the wheels have no sample for a minute. Rows that
are out of order for another reason are sorted.

A block is a few seconds of driving. Every estimate of the calibration is a sum over blocks, and the
standard deviations come from the differences between blocks. The errors within a block are
correlated, because a wheel skids throughout a turn. The errors of different blocks are nearly
independent.
"""

from __future__ import annotations

from collections.abc import Collection, Iterable, Iterator, Sequence
from functools import cached_property
from itertools import pairwise
from typing import TypeVar

import numpy as np
import numpy.typing as npt
from msgspec import Struct

from acsard.calibration.log_table import APPLIED, FOUR, TWO, Floats, LogError, Table

Complexes = npt.NDArray[np.complex128]
Mask = npt.NDArray[np.bool_]
Rows = npt.NDArray[np.int64]
Number = TypeVar("Number", np.float64, np.complex128)

MIN_BACKWARD_STEP_S = 1.0
"""If the times in a log jump back by more than this time, s, the recording may have restarted."""

MAX_RESTARTS = 100
"""Maximum number of restarts in a log.

If the times jump back more often, the log counts as one recording whose rows are not sorted by
time.
"""

MAX_PERIOD_S = 0.7
"""Longest accepted median period of wheel samples, s.

If the period is longer, the times are probably not in seconds.
"""

MIN_ROWS = 20
"""Minimum number of wheel samples in a run."""

NEW_RUN_AFTER_S = 60.0
"""Time without a wheel sample, s, after which a new run begins."""

ROUNDED_S, REPEATED = 0.2, 4.0
"""Limits that show that the times in the column `t` were rounded.

The times were rounded if the median interval between different times exceeds `ROUNDED_S` s, and if
on average more than `REPEATED` rows have the same time.
"""

ROLLING, MAX_REPEATED_FRACTION = 0.2, 0.4
"""Limits that show that the logger repeated old positions or yaws. Such rows are removed.

The wheels roll if the absolute speeds of the left and the right side add up to more than `ROLLING`
rad/s. The logger repeats values if, while the wheels roll, more than the fraction
`MAX_REPEATED_FRACTION` of the rows have the same value as the row before.
"""

WHEEL_STREAM = "left right"
COMMANDS = " ".join(APPLIED)
SENSOR_NAMES = (WHEEL_STREAM, "yaw_rate", "yaw", "x y", COMMANDS)
"""Names of the sensors of a log. The commands count as a sensor.

A name consists of the columns of the sensor, separated by spaces.
"""

Streams = dict[str, tuple[Floats, ...]]
"""The times and the values of each sensor, by the name of the sensor in `SENSOR_NAMES`."""

MAX_RUNS = 1000
"""Maximum number of different values in the column `run`. A log with more values is refused."""

SUMMED_ROWS = 50
"""Number of rows over which wheel speeds are summed before two wheels are compared."""

REPORTED_DIFFERENCE, MAX_DIFFERENCE = 0.15, 0.8
"""Limits for the difference between the front and the rear wheel of a side.

The limits are fractions of the distance rolled. The report mentions a difference above
`REPORTED_DIFFERENCE`. A log with a difference above `MAX_DIFFERENCE` is refused.
"""

GAP_S, GAP_PERIODS = 0.3, 5.0
"""Limits for the interval between two samples.

An interval is a gap if it exceeds `GAP_S` s and also exceeds `GAP_PERIODS` times the median
interval.
"""

STANDSTILL_SPEED = 0.02
"""Largest speed at which a wheel is considered to stand still, rad/s."""

BLOCK_COUNT = 16
"""Number of blocks into which a log is divided, unless the blocks would be too short or too long.
"""

MAX_BLOCK_S = 12.0
"""Maximum length of a block, s, unless the caller of `blocks()` asks for longer blocks."""

SMOOTH_S = 0.3
"""Time over which the difference of the wheel speeds is averaged before it is squared, s.

Without this average, the speeds of a coarse encoder would be 0 in some samples and far too large
in others.
"""

MIN_BLOCK_ROLL = 0.2
"""Minimum angle that the wheels of one side must roll in a block, rad.

A block in which neither side rolls this far is left out.
"""

MAX_JITTER_S = 5.0
"""Largest accepted variation of the delay from stamp to arrival, s.

If the delay varies by more, the stamps are not used.
"""


class Run(Struct, frozen=True, dict=True):
    """The samples of one drive.

    Times are in s since `start`. The times of each sensor strictly increase.
    """

    name: str
    start: float
    """Time of the first wheel sample of this drive, s, as the log gives it."""
    t: Floats
    """Times of the wheel speeds, s since `start`."""
    left: Floats
    """Mean speed of the left wheels, rad/s."""
    right: Floats
    gyro_t: Floats
    gyro: Floats
    """Yaw rate, rad/s."""
    yaw_t: Floats
    yaw: Floats
    """Yaw as recorded, rad. It may be wrapped."""
    place_t: Floats
    place: Complexes
    """Positions x + iy, m, relative to the first position."""
    commands_t: Floats
    linear: Floats
    """Commanded speed, m/s."""
    angular: Floats
    """Commanded turn rate, rad/s."""

    @cached_property
    def gaps(self) -> Floats:
        """Long intervals without a wheel sample, s: one row (begin, end) for each. See `gaps()`."""
        return gaps(self.t)

    @cached_property
    def rolled(self) -> tuple[Floats, Floats]:
        """Angles that the left and the right wheels have rolled since the start of the run, rad.

        The value is a pair of arrays with a number for each of the times `t`. The angles stay
        constant during a gap in the samples.
        """
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
        """Return the angles that the left and the right wheels have rolled at the times `t`, rad.

        Times and angles count from the start of the run. `t` is in s.
        """
        left, right = self.rolled
        return np.interp(t, self.t, left), np.interp(t, self.t, right)

    def speed_difference(self, t: Floats) -> Floats:
        """Return the speed of the right minus that of the left wheels at the times `t`, rad/s.

        The difference is averaged over `SMOOTH_S`.
        """
        begin, end = (np.clip(t + s / 2, self.t[0], self.t[-1]) for s in (-SMOOTH_S, SMOOTH_S))
        (left, right), (far_left, far_right) = self.angles(begin), self.angles(end)
        turned = far_right - right - (far_left - left)
        return np.asarray(turned / np.maximum(end - begin, 1e-9))


class Notes:
    """Sentences about a log. A sentence that applies to several runs is listed once.

    A "{}" in a sentence is replaced by a count, which is the sum over all runs.
    """

    def __init__(self, sentences: Iterable[str]) -> None:
        self._sentences = {sentence: [0, 0] for sentence in sentences}

    def add(self, sentence: str, count: int = 0) -> None:
        """Add a sentence about one run. `count` is added to the sum that replaces "{}".

        A sentence with "{}" and a count of 0 is ignored.
        """
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
    true_positions: bool = False
    """True if the positions are the true ones of the built-in simulator, which have no error."""


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
    """Return how much the front and the rear wheel of a side differ, as a fraction of their speed.

    Raises `LogError` if they differ by more than `MAX_DIFFERENCE`.
    """
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
    """Split `rows` into drives where the times of the wheel samples jump back."""
    # The times of rows without wheel speeds may jump back within a drive, because a file may list
    # all rows of one sensor after all rows of another.
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
    """Raise `LogError` if the times of a run are not in seconds or are too coarse."""
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
    # Without this split, one row with a time of another day would make the drive many hours long.
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
            # Remove the repetitions at rest as well, because a repeated value may be older than the
            # time of its row.
            streams[what] = tuple(column[~again] for column in streams[what])


def _repeats(streams: Streams, what: str) -> tuple[Mask, Mask]:
    """Return two masks of the samples in the columns `what`.

    The first mask selects samples that repeat the previous sample. The second mask selects samples
    at times at which the wheels roll.
    """
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
    """A few seconds of a run.

    To compute uncertainties, the fit leaves out one block at a time.
    """

    run: int
    begin: float
    """Start of the block, s since the start of the run."""
    end: float
    """End of the block, s since the start of the run."""


def gaps(t: Floats) -> Floats:
    """Return the gaps in the samples of a sensor, s: one row (begin, end) for each gap.

    `t` contains the times of the samples, s. A gap is an interval between two samples that is much
    longer than usual (`GAP_S`, `GAP_PERIODS`).
    """
    steps = np.diff(t)
    if not len(steps):
        return np.zeros((0, 2))
    wide = steps > max(GAP_S, GAP_PERIODS * float(np.median(steps)))
    return np.column_stack((t[:-1][wide], t[1:][wide]))


def inside(begin: Floats, end: Floats, holes: Floats) -> Mask:
    """Return a mask of the intervals that do not overlap a gap.

    `begin` and `end` contain the limits of the intervals. `holes` contains the gaps, as `gaps()`
    returns them.
    """
    after = np.searchsorted(holes[:, 1], begin, side="right")
    before = np.searchsorted(holes[:, 0], end, side="left")
    return np.asarray(after == before)


def cumulative(steps: npt.NDArray[Number]) -> npt.NDArray[Number]:
    """Return 0, followed by the cumulative sums of `steps`. The result is one element longer."""
    return np.concatenate((np.zeros(1, steps.dtype), np.cumsum(steps)))


def integral(values: Floats, steps: Floats) -> Floats:
    """Return the integral of `values` from the first sample to each sample (trapezoidal rule).

    `steps` contains the times from each sample to the next. The result is empty without samples.
    """
    return cumulative((values[1:] + values[:-1]) / 2 * steps) if len(values) else values


def rest_intervals(run: Run, least_s: float, edge_s: float) -> Floats:
    """Return the intervals in which all wheels stand still, s: one row (begin, end) for each.

    Each interval is shortened by `edge_s` s at each end. It is left out if it is then shorter than
    `least_s` s.
    """
    moving = np.concatenate(([True], run.moving, [True])).astype(np.int8)
    changes = np.flatnonzero(np.diff(moving))
    spans = [(run.t[a], run.t[b - 1]) for a, b in changes.reshape(-1, 2)]
    intervals = [(a + edge_s, b - edge_s) for a, b in spans if b - a >= least_s + 2 * edge_s]
    return np.array(intervals, dtype=np.float64).reshape(-1, 2)


def blocks(driven: Sequence[Run], shortest_s: float) -> list[Block]:
    """Return the blocks of all runs, without the blocks in which the robot hardly moved.

    The blocks are about `shortest_s` s long. If the log would then have more than `BLOCK_COUNT`
    blocks, the blocks are longer, up to `MAX_BLOCK_S`.
    """
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
    """Return whether the wheels of one side rolled by `MIN_BLOCK_ROLL` or more, in any direction.

    Motion to and fro does not cancel.
    """
    if max(abs(left[1] - left[0]), abs(right[1] - right[0])) >= MIN_BLOCK_ROLL:
        return True
    a, b = np.searchsorted(run.t, (begin, end))
    speed = max(float(np.sum(np.abs(v[a:b]))) for v in (run.left, run.right))
    return bool(speed * (end - begin) / max(1, b - a) >= MIN_BLOCK_ROLL)


def on_arrival_clock(arrivals: Floats, stamps: Floats) -> Floats:
    """Return the times at which a sender made its samples, s, on the receiver's clock.

    The times are the stamps plus the smallest delay from stamp to arrival. If the delays of the
    samples vary by more than `MAX_JITTER_S`, the times are the times of arrival.

    Args:
        arrivals: the times of arrival on the receiver's clock, s.
        stamps: the stamps of the sender's clock, s.
    """
    delay = arrivals - stamps
    if float(np.ptp(delay)) > MAX_JITTER_S:
        return arrivals
    return np.asarray(stamps + float(delay.min()))
