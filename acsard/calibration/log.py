"""Reads a log, which is one CSV file, and splits it into runs.

The first line names the columns of `COLUMNS`, in any order. Every other line has a number in SI
units, or nothing, in each cell, so sensors of different rates share a file. The rows are in the
order of recording: where the time of the wheels jumps back, or pauses, a new run begins. A file in
another form is refused. Whatever is left out is counted and said.
"""

from __future__ import annotations

import math
import re
from array import array
from collections.abc import Mapping, Sequence
from pathlib import Path

import numpy as np
import numpy.typing as npt
from msgspec import Struct, field
from msgspec.structs import replace

from acsard.calibration.series import (
    MIN_ROWS,
    TINY,
    Complexes,
    Floats,
    Mask,
    apart,
    by_chance,
    by_turns,
)  # fmt: skip
from acsard.core.formatting import printable
from acsard.core.values import AcsardError, Metres, Seconds
from acsard.host.errors import MendableError, RecordingError
from acsard.recording.export import calibration_csv
from acsard.recording.file import MAGIC, Recording

FOUR, TWO = ("fr", "fl", "rl", "rr"), ("left", "right")
APPLIED = "applied_linear", "applied_angular"
SENSORS = TWO, ("yaw_rate",), ("x", "y"), ("yaw",), APPLIED  # by their columns
COLUMNS = {
    "t": "s", **dict.fromkeys((*FOUR, *TWO), "rad/s"), "yaw_rate": "rad/s", "x": "m", "y": "m",
    "yaw": "rad", "applied_linear": "m/s", "applied_angular": "rad/s", "run": "a name",
}  # fmt: skip

MIN_RUN_S = 1.5
MAX_STEP_S, MAX_SECONDS = 1.5, 6 * 3600.0  # between rows of the wheels, and of a log
BACK_S = 1.0  # a jump back of the time by which a new run begins
GAP_S, GAP_PERIODS = 1.0, 8.0  # a gap of the wheels that ends a run: longer than both
MAX_RUNS = 1000  # names in the column `run`

STANDSTILL_SPEED = 0.02  # rad/s, up to which a wheel stands
REST_S = 0.4  # over which the wheels must hardly roll: an encoder at rest may rock between counts
REST_ROLL = 0.03  # rad

STUCK_S, STUCK_TURN = 1.0, 0.3  # a gyro that repeats one value while the wheels' turn changes, rad

MAX_BYTES = 1 << 30  # a file is read into memory

TAPE_STD_M = 0.01  # of a distance, with the choice of the point on the robot
STRAIGHT, MIN_STRAIGHT = 0.9, 5.0  # share of the rolled angle, and this angle, rad

MAX_SIDE_DIFFERENCE = 0.15  # of front and rear wheel, as a share of the rolled angle

MIXED = (
    "in {}, two series of values alternate: the values jump to and fro, as if two programs or "
    "sensors wrote them (a joint_state_publisher beside the driver, or two IMUs on one topic). "
    "Record only one of them"
)
ADVICE = (
    "write a CSV file with commas, decimal points and SI units, whose first line names the columns "
    'like "t,left,right,yaw_rate" or "t,fr,fl,rl,rr,x,y" (page reference/csv of the manual explains'
    " the columns, and page howto/calibrate-log how to convert a ROS bag)"
)


class LogError(AcsardError):
    """A log cannot be used. The text says where and why, and what to do."""


class TapeReading(Struct, frozen=True):
    """What a person measured of a whole run: its `distance` from start to end, m, or its `turn`."""

    quantity: str  # "distance" or "turn", with whole turns
    value: float  # m or rad
    std: float


class Run(Struct, frozen=True):
    """The samples of one drive. The times of each sensor strictly increase, s."""

    name: str
    t: Floats  # of the wheels
    left: Floats  # angle that the left wheels have rolled, rad
    right: Floats
    gyro_t: Floats
    rate: Floats  # of the gyro, rad/s
    turned: Floats  # its integral, rad
    place_t: Floats
    place: Complexes  # x + iy, m
    yaw_t: Floats
    yaw: Floats  # may be wrapped, rad
    commands_t: Floats
    commands: Floats  # m/s and rad/s, shape (n, 2)
    mixed: str = ""  # columns of the wheels that may be two series, or coarse
    tape: tuple[TapeReading, ...] = ()

    @property
    def seconds(self) -> Seconds:
        return float(self.t[-1] - self.t[0])

    def edges(self, step: Seconds) -> Floats:
        return np.linspace(self.t[0], self.t[-1], max(1, round(self.seconds / step)) + 1)

    def rests(self, t: Floats) -> Mask:
        """Return a mask of the times around which the wheels stand still."""
        begin, end = t - REST_S / 2, t + REST_S / 2
        rolled = [
            np.abs(np.interp(end, self.t, side) - np.interp(begin, self.t, side))
            for side in (self.left, self.right)
        ]
        inside = (begin >= self.t[0]) & (end <= self.t[-1])
        return np.asarray(inside & (np.maximum(*rolled) < REST_ROLL))

    def part(self, begin: Seconds, end: Seconds) -> Run:
        """Return the samples from `begin` to `end`, with a margin for the sensors' delays."""
        wheels = (self.t >= begin) & (self.t <= end)
        kept = {"t": self.t[wheels], "left": self.left[wheels], "right": self.right[wheels]}
        for times, values in (("place_t", "place"), ("yaw_t", "yaw")):
            column = getattr(self, times)
            mask = (column >= begin) & (column <= end)
            kept |= {times: column[mask], values: getattr(self, values)[mask]}
        return replace(self, **kept)


class Log(Struct, frozen=True):
    runs: tuple[Run, ...]
    notes: tuple[str, ...]


class Notes:
    """Sentences about a log, each said once; "{}" is the sum of its counts."""

    def __init__(self) -> None:
        self._counts: dict[str, int] = {}

    def add(self, sentence: str, count: int = 1) -> None:
        if count:
            self._counts[sentence] = self._counts.get(sentence, 0) + count

    def sentences(self) -> tuple[str, ...]:
        return tuple(text.replace("{}", str(count)) for text, count in self._counts.items())


class _Table(Struct):
    columns: dict[str, Floats]  # NaN for an empty cell
    run: npt.NDArray[np.int64]  # of each row, the index of its name
    names: list[str]
    notes: Notes = field(default_factory=Notes)


def read_file(file: Path) -> Log:
    """Return the runs of a CSV file or a recording. Raises `LogError` and `MendableError`."""
    if file.is_dir():
        raise LogError(f"this is a directory: {ADVICE}")
    try:
        with file.open("rb") as stream:
            if stream.read(len(MAGIC)) != MAGIC:
                stream.seek(0)
                return read(stream.read(MAX_BYTES))
        return read(calibration_csv(Recording([file])))
    except RecordingError as error:
        raise LogError(str(error)) from None
    except OSError as error:
        raise MendableError(f"cannot read {file}: {error.strerror}; correct the path") from None


def with_distance(log: Log, name: str, metres: Metres) -> Log:
    """Return a log with a run of which a person measured the distance from start to end."""
    names = [run.name for run in log.runs]
    if name and name not in names:
        raise LogError(f'--distance: there is no run "{name}"; there are {", ".join(names[:10])}')
    runs = [run for run in log.runs if run.name == name or not name]
    run = max(runs, key=_straightness)
    if _straightness(run) < STRAIGHT:
        raise LogError(
            f"--distance: the wheels of run {run.name} do not roll alike, so it is not straight: "
            "drive straight ahead for 2 m or more in a separate run, and measure from start to end"
        )
    none = np.zeros(0)
    measured = replace(
        run, gyro_t=none, rate=none, turned=none, place_t=none, place=none + 0j, yaw_t=none,
        yaw=none, tape=(TapeReading("distance", metres, TAPE_STD_M),),
    )  # fmt: skip
    return replace(log, runs=(*log.runs, measured))


def _straightness(run: Run) -> float:
    left, right = float(run.left[-1]), float(run.right[-1])
    rolled = max(float(np.abs(np.diff(side)).sum()) for side in (run.left, run.right))
    alike = 1 - abs(left - right) / (abs(left) + abs(right) + TINY)
    return alike * min(abs(left), abs(right)) / rolled if rolled > MIN_STRAIGHT else 0.0


def read(data: bytes) -> Log:
    """Return the runs of a CSV file. Raises `LogError`."""
    table = _parsed(data)
    try:
        columns = table.columns
        for name in [name for name in (*FOUR, *TWO, "yaw_rate") if name in columns]:
            rows = np.flatnonzero(np.isfinite(columns[name]))
            wild = rows[apart(columns[name][rows])]
            table.notes.add(f"cells of {name} left out, far from those beside them, such as "
                       f"{columns[name][wild[:1]].sum():g}: {{}}", len(wild))  # fmt: skip
            columns[name][wild] = math.nan
        wheels = [name for name in (*FOUR, *TWO) if name in columns]
        whole = np.isfinite([columns[name] for name in wheels]).all(axis=0)
        mixed = [name for name in wheels if by_turns(columns[name][whole])]
        values = [columns[name][whole] for name in wheels]
        if by_chance(np.array(values)) or (mixed and by_turns(*values)):
            raise LogError(MIXED.format(" and ".join(wheels)))
        columns["left"], columns["right"] = _sides(table)
        runs = []
        for number, name in enumerate(table.names):
            rows = np.flatnonzero((table.run == number) & np.isfinite(columns["t"]))
            parts = [run for part in _split(table, rows) if (run := _run(table, part)) is not None]
            runs += [
                replace(run, name=f"{name}.{at}" if name and at > 1 else name)
                for at, run in enumerate(parts, 1)
            ]
        if not runs:
            raise LogError(
                f"no run has {MIN_ROWS} rows and {MIN_RUN_S:g} s with the speeds of both sides: "
                "record the wheels while the robot drives, with t in seconds"
            )
    except LogError as error:
        for note in table.notes.sentences():
            error.add_note(note)
        raise
    seconds = sum(run.seconds for run in runs)
    if seconds > MAX_SECONDS:
        raise LogError(f"the drive lasts {seconds / 3600:.0f} h: is t in s, and not in ms?")
    named = tuple(
        replace(run, name=run.name or str(at), mixed=" and ".join(mixed))
        for at, run in enumerate(runs, 1)
    )
    return Log(named, table.notes.sentences())


def _parsed(data: bytes) -> _Table:
    try:
        lines = data.decode("utf-8-sig").splitlines()
    except UnicodeDecodeError:
        raise LogError(f"the file is not text: {ADVICE}") from None
    header = [name.strip() for name in lines[0].split(",")] if lines else []
    used = _used(header)
    picks = [header.index(name) for name in used]
    run = header.index("run") if "run" in header else None
    values, runs, labels = array("d"), array("q"), dict[str, int]()
    cut = False
    for number, line in enumerate(lines[1:], 2):
        if not line:
            continue
        cells = line.split(",")
        try:
            if len(cells) != len(header):
                raise ValueError
            values.extend([float(cells[i] or "nan") for i in picks])
        except ValueError:
            if number == len(lines) and runs:
                cut = True
                break
            raise LogError(
                f'line {number} is "{printable(line[:60])}", which is not a number or an empty '
                f"cell for each of the {len(header)} columns: {ADVICE}"
            ) from None
        runs.append(labels.setdefault("" if run is None else cells[run], len(labels)))
    if not runs:
        raise LogError("there are no rows below the header: record a drive")
    if len(labels) > MAX_RUNS:
        raise LogError(
            f"column run has {len(labels)} different names: each name must stand for a drive"
        )
    matrix = np.frombuffer(values).reshape(len(runs), len(picks))
    columns = {name: matrix[:, at].copy() for at, name in enumerate(used)}
    table = _Table(columns, np.frombuffer(runs, dtype=np.int64), list(labels))
    if cut:
        table.notes.add("the last line is cut off and left out")
    if others := [printable(name) for name in header if name not in (*used, "run")]:
        table.notes.add(f"columns not used: {', '.join(others)}")
    return table


def _used(header: Sequence[str]) -> list[str]:
    wheels = FOUR if set(FOUR) <= set(header) else TWO
    places = ("x", "y") if "x" in header and "y" in header else ()
    sensors = [name for name in ("yaw_rate", "yaw", *places) if name in header]
    missing = [name for name in ("t", *wheels) if name not in header]
    if not sensors:
        missing.append("yaw_rate (of a gyro) or x and y (positions)")
    for name in header:
        known = next((k for k in COLUMNS if re.match(rf"{k}[^a-z;]", name, re.IGNORECASE)), None)
        if known and name not in COLUMNS and known not in header:
            raise LogError(
                f'the column "{printable(name)}" is not one of {", ".join(COLUMNS)}: name it '
                f"{known}, and write its values in {COLUMNS[known]}. This file has no other units: "
                "divide the speed of a rim in m/s by the wheel radius in m (1 in/s is 0.0254 m/s), "
                "multiply rpm by 0.10472 and degrees by 0.017453"
            )
    if missing:
        raise LogError(f"the first line does not name {', '.join(missing)}: {ADVICE}")
    commands = APPLIED if set(APPLIED) <= set(header) else ()
    used = [name for name in header if name in ("t", *wheels, *sensors, *commands)]
    if len(set(used)) < len(used) or header.count("run") > 1:
        raise LogError(f"the first line names a column twice: {ADVICE}")
    return used


def _sides(table: _Table) -> tuple[Floats, Floats]:
    columns = table.columns
    if set(TWO) <= set(columns):
        return columns["left"], columns["right"]
    for front, rear in (("fl", "rl"), ("fr", "rr")):
        whole = np.isfinite(columns[front]) & np.isfinite(columns[rear])
        a, b = columns[front][whole], columns[rear][whole]
        kernel = np.ones(min(50, max(1, len(a))))
        difference, rolled = (
            float(np.abs(np.convolve(v, kernel, "valid")).sum()) if len(v) else 0.0
            for v in (a - b, np.maximum(np.abs(a), np.abs(b)))
        )
        share = difference / (rolled + TINY)
        if share > MAX_SIDE_DIFFERENCE:
            odd, alive = (front, rear) if np.abs(a).sum() < np.abs(b).sum() else (rear, front)
            low, high = (a, b) if odd == front else (b, a)
            still = np.abs(low) < STANDSTILL_SPEED
            cause = f"has it another unit or other counts than {alive}, or is it of the other side"
            if np.abs(high[still]).sum() > share / 2 * np.abs(high).sum():
                cause = "it stands still meanwhile: is its encoder dead, or its cable loose"
            elif float(low @ high) < 0.0:
                cause = "it turns against it: has it the wrong sign, or is it of the other side"
            raise LogError(
                f"{odd} rolls otherwise than {alive} by {share:.0%} of the way: {cause}? "
                "Rename the columns of the working wheels to left and right, and leave the others "
                "out"
            )
    fr, fl, rl, rr = (columns[name] for name in FOUR)
    return (fl + rl) / 2, (fr + rr) / 2


def _split(table: _Table, rows: npt.NDArray[np.int64]) -> list[npt.NDArray[np.int64]]:
    # Split the rows where the time of the wheels jumps back, and at its gaps.
    t, columns = table.columns["t"], table.columns
    wheels = rows[np.isfinite(columns["left"][rows]) & np.isfinite(columns["right"][rows])]
    if len(wheels) < MIN_ROWS:
        return []
    back = np.flatnonzero(np.diff(t[wheels]) < -BACK_S) + 1
    table.notes.add("a new run begins where the time jumps back; number of jumps: {}", len(back))
    parts = []
    for part in np.split(rows, np.searchsorted(rows, wheels[back])):
        own = np.isfinite(columns["left"][part]) & np.isfinite(columns["right"][part])
        times = np.unique(t[part[own]])
        if len(times) < MIN_ROWS:
            continue
        if own.sum() > 2 * len(times):
            raise LogError(
                f"{own.sum()} rows of wheel speeds have only {len(times)} different times: write t "
                "in seconds with 3 decimals"
            )
        steps = np.diff(times)
        if float(np.median(steps)) > MAX_STEP_S:
            raise LogError(
                f"the rows of the wheels are {float(np.median(steps)):g} s apart, but 1 Hz or more "
                "is needed: is t in s, and not in ms?"
            )
        gaps = np.flatnonzero(steps > max(GAP_S, GAP_PERIODS * float(np.median(steps))))
        table.notes.add("a new run begins after a gap in the wheel speeds; number of gaps: {}",
                   len(gaps))  # fmt: skip
        begins = np.concatenate((times[:1], times[gaps + 1]))
        ends = np.concatenate((times[gaps], times[-1:]))
        for begin, end in zip(begins, ends, strict=True):
            # The sensors may be recorded earlier or later than the wheels.
            margin = min(1.0, 0.1 * (end - begin))
            parts.append(part[(t[part] >= begin - margin) & (t[part] <= end + margin)])
    return parts


def _run(table: _Table, rows: npt.NDArray[np.int64]) -> Run | None:
    def stream(*names: str) -> tuple[Floats, ...]:
        columns = [table.columns.get(name) for name in names]
        if any(column is None for column in columns):
            return (np.zeros(0),) * (1 + len(names))
        picked = [table.columns["t"][rows], *(c[rows] for c in columns if c is not None)]
        whole = np.all(np.isfinite(picked), axis=0)
        t, first = np.unique(picked[0][whole], return_index=True)
        repeats = int(whole.sum()) - len(t)
        table.notes.add(f"rows of {' '.join(names)} left out, with the time of another row: {{}}",
                   repeats)  # fmt: skip
        return t, *(values[whole][first] for values in picked[1:])

    streams = {" ".join(names): stream(*names) for names in SENSORS}
    t = streams[" ".join(TWO)][0]
    if len(t) < MIN_ROWS or t[-1] - t[0] < MIN_RUN_S:
        table.notes.add("runs left out because they are too short: {}")
        return None
    return run_of(table.names[int(table.run[rows[0]])], streams, table.notes)


def run_of(name: str, streams: Mapping[str, tuple[Floats, ...]], notes: Notes) -> Run:
    """Return a run from the times and values of its sensors, by the names of their columns."""
    empty = np.zeros(0), np.zeros(0), np.zeros(0)
    (t, left, right), (gyro_t, rate, *_), (place_t, x, y), (yaw_t, yaw, *_), commands = (
        streams.get(" ".join(names), empty) for names in SENSORS
    )
    start = t[0]
    run = Run(
        name, t - start, integral(t, left), integral(t, right), gyro_t - start, rate,
        integral(gyro_t, rate), place_t - start, x + 1j * y, yaw_t - start, yaw,
        commands[0] - start, np.column_stack(commands[1:]),
    )  # fmt: skip
    run = _without_repeats(notes, _without_stuck(notes, run))
    for column, values in ("yaw_rate", rate), ("yaw", np.exp(1j * run.yaw)), ("x, y", run.place):
        if by_turns(values):
            raise LogError(MIXED.format(column))
    wild = apart(run.place)
    notes.add("rows of x, y left out, far from those beside them: {}", int(wild.sum()))
    return replace(run, place_t=run.place_t[~wild], place=run.place[~wild])


def integral(t: Floats, values: Floats) -> Floats:
    """Return the integral of `values` up to each time, by the trapezoidal rule."""
    if not len(t):
        return np.zeros(0)
    return np.concatenate(([0.0], np.cumsum((values[1:] + values[:-1]) / 2 * np.diff(t))))


def _without_stuck(notes: Notes, run: Run) -> Run:
    # Leave out a gyro that repeats one value to the last digit while the wheels' turn changes.
    rate = run.rate
    if not len(rate):
        return run
    begins = np.concatenate(([0], np.flatnonzero(np.diff(rate)) + 1))
    ends = np.concatenate((begins[1:], [len(rate)])) - 1
    long = run.gyro_t[ends] - run.gyro_t[begins] > STUCK_S
    kept = np.ones(len(rate), dtype=bool)
    for begin, end in zip(begins[long], ends[long], strict=True):
        t = np.arange(run.gyro_t[begin], run.gyro_t[end], REST_S)
        turn = np.diff(np.interp(t, run.t, run.right) - np.interp(t, run.t, run.left))
        if len(turn) and np.ptp(turn) > STUCK_TURN:
            kept[begin : end + 1] = False
            notes.add(
                f"yaw_rate repeats {rate[begin]:g} exactly from {run.gyro_t[begin]:.0f} s to "
                f"{run.gyro_t[end]:.0f} s of run {run.name or 1} ({end - begin + 1} samples), "
                "although the turn of the wheels changes: the gyro hung, and this part is left out"
            )
    return replace(run, gyro_t=run.gyro_t[kept], rate=rate[kept], turned=run.turned[kept])


def _without_repeats(notes: Notes, run: Run) -> Run:
    # Leave out positions and headings that only repeat the last value in later rows.
    new = np.concatenate(([True], np.diff(run.place) != 0))[: len(run.place)]
    turned = np.concatenate(([True], np.diff(run.yaw) != 0))[: len(run.yaw)]
    repeated = len(new) + len(turned) - int(new.sum()) - int(turned.sum())
    notes.add("rows of x y and yaw left out, because they repeat the row before: {}", repeated)
    return replace(run, place_t=run.place_t[new], place=run.place[new], yaw_t=run.yaw_t[turned],
                   yaw=run.yaw[turned])  # fmt: skip
