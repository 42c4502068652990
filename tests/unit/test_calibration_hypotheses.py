"""A log whose parts contradict each other is refused with the cause, or used without them.

`python -m tests.unit.planted_logs` prints the table of the planted faults.
"""

from __future__ import annotations

import re
import time
from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from acsard.calibration.geometry import path
from acsard.calibration.log import Log, LogError, Notes, read, run_of
from acsard.calibration.result import Result, calibrate
from acsard.calibration.series import Mask
from acsard.core.config.settings import Config, DriveConfig
from tests.unit import planted_logs
from tests.unit.calibration_bags import DRIVE, END, motion
from tests.unit.calibration_faults import (
    FAULTS,
    NOT_SHOWN,
    SENSORS,
    Columns,
    coarse,
    csv,
    named,
    planted,
    sound,
    times,
)
from tests.unit.calibration_logs import run, runs, usual
from tests.unit.calibration_robots import Robot, drive

BY_GYRO, BY_POSES = (1.4925, 0.9950, 1.0050), (1.500, 1.000, 1.010)
GYRO, HEADING, PLACES = ("yaw_rate",), ("yaw",), ("x", "y")


def result(data: bytes) -> Result:
    return calibrate(read(data), Config(), "drive.csv")


def refusal(data: bytes) -> str:
    with pytest.raises(LogError) as refused:
        result(data)
    assert "agrees" not in str(refused.value)
    return str(refused.value)


def right(data: bytes, truth: tuple[float, ...], note: str) -> None:
    found = result(data)
    assert found.better
    assert list(found.found.values()) == pytest.approx(truth, abs=0.01)
    assert any(re.search(note, text) for text in found.notes) == bool(note), found.notes


# two IMUs on one topic

OTHER_IMU: dict[str, Callable[[Columns], Columns]] = {
    "other axis": times(0.02, "yaw_rate"), "upside down": times(-1.0, "yaw_rate"),
    "half": times(0.5, "yaw_rate"), "twice": times(2.0, "yaw_rate"),
}  # fmt: skip


def in_blocks(kind: str, names: tuple[str, ...], block_s: float) -> bytes:
    rows = sound(1, names)
    other = OTHER_IMU[kind](rows)["yaw_rate"]
    first = rows["t"] // block_s % 2 < 1
    return csv(rows | {"yaw_rate": np.where(first, rows["yaw_rate"], other)})


@pytest.mark.slow
@pytest.mark.parametrize("block_s", [0.5, 1.0, 3.0, 10.0])
@pytest.mark.parametrize("kind", OTHER_IMU)
def test_two_imus_that_alternate_in_blocks_are_named(kind: str, block_s: float) -> None:
    assert re.search(r"yaw_rate is now .* by turns", refusal(in_blocks(kind, GYRO, block_s)))


@pytest.mark.slow
@pytest.mark.parametrize("kind", OTHER_IMU)
def test_two_imus_that_alternate_in_blocks_are_left_out_beside_positions(kind: str) -> None:
    right(in_blocks(kind, (*GYRO, *PLACES), 1.0), BY_POSES, "yaw_rate is left out: .* by turns")


# planted faults

EVERY = [(way, fault) for way in SENSORS for fault in FAULTS if fault not in NOT_SHOWN[way]]
QUICK = ["one sign", "counts x 1/2", "one side twice", "no signs", "2 s late", "another drive"]


@pytest.mark.parametrize("fault", QUICK)
def test_a_planted_fault_is_named(fault: str) -> None:
    assert named(fault, refusal(planted(fault, "gyro", 3)))


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.parametrize(("way", "fault"), EVERY)
def test_each_planted_fault_is_named(way: str, fault: str) -> None:
    assert named(fault, refusal(planted(fault, way, 4)))


@pytest.mark.soak
@pytest.mark.timeout(3600)
def test_planted_faults_are_never_written_and_named_in_80_percent() -> None:
    assert planted_logs.main() == 0


@pytest.mark.slow
@pytest.mark.parametrize("seed", [8200, 8202])
def test_radii_that_are_1_percent_apart_are_written_although_positions_gain_little(
    seed: int,
) -> None:
    assert planted_logs.outcome(planted_logs.log("", "positions", seed), seed) == "right"


# coarse encoders

FOUR = ("fl", "fr", "rl", "rr")
SLOW = motion([(2, 0, 0), *[(6, v, w) for v, w in ((0.1, 0), (0, 0.4), (-0.1, 0), (0, -0.4))] * 3])


@pytest.mark.variations(3)
@pytest.mark.parametrize("wheels", [("left", "right"), FOUR])
@pytest.mark.parametrize(
    "counts", [16, 360, *[pytest.param(n, marks=pytest.mark.slow) for n in (32, 96, 3200)]]
)
def test_coarse_encoders_are_no_two_series(counts: int, wheels: tuple[str, ...]) -> None:
    for hz in (10, 20, 30, 50, 100):
        for driven in (DRIVE, SLOW):
            for filtered in (1.0, 0.5):
                rows = coarse(counts, hz, GYRO, wheels, driven, filtered)
                assert len(read(csv(rows)).runs) == 1


@pytest.mark.slow
@pytest.mark.parametrize(("counts", "hz"), [(96, 50), (20, 100), (48, 30), (360, 10)])
@pytest.mark.parametrize("names", [GYRO, PLACES, (*PLACES, *HEADING)])
def test_a_sound_log_of_coarse_encoders_is_accepted(
    names: tuple[str, ...], counts: int, hz: int
) -> None:
    found = result(csv(coarse(counts, hz, names, FOUR)))
    assert found.better
    for value, truth in zip(found.found.values(), BY_GYRO if names == GYRO else BY_POSES,
                            strict=True):  # fmt: skip
        assert value == pytest.approx(truth, abs=0.015)


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.0, 2.0])
@pytest.mark.parametrize("other", [[1], [2, 3], [4]])
def test_two_drivers_of_all_wheels_are_named_although_the_gyro_shows_no_size(
    other: list[int], factor: float
) -> None:
    rows = sound(3, GYRO)
    second = np.isin(np.arange(len(rows["t"])) % (max(other) + 1), other)
    mixed = times(factor, "left", "right")(rows)
    rows |= {name: np.where(second, mixed[name], rows[name]) for name in ("left", "right")}
    assert f"left and right, {MIXED}" in refusal(csv(rows))


def of_two_writers(names: tuple[str, ...], factor: float, second: Mask) -> bytes:
    """Return a log of whose wheel speeds some rows are those of another program."""
    rows = sound(3, names)
    mixed = times(factor, "left", "right")(rows)
    return csv(rows | {n: np.where(second, mixed[n], rows[n]) for n in ("left", "right")})


@pytest.mark.parametrize("factor", [0.0, 0.5, 2.0, -1.0])
@pytest.mark.parametrize("share", [0.05, 0.2, 0.5])
def test_two_writers_of_the_wheels_by_chance_are_named(share: float, factor: float) -> None:
    second = np.random.default_rng(3).random(len(sound(3, ())["t"])) < share
    with pytest.raises(LogError, match=f"left and right, {MIXED}"):
        read(of_two_writers(GYRO if factor > 0.0 else PLACES, factor, second))


@pytest.mark.slow
@pytest.mark.parametrize("factor", [0.0, 0.5, 2.0, -1.0])
@pytest.mark.parametrize("block_s", [0.5, 1.0, 3.0, 10.0])
def test_two_writers_of_the_wheels_in_blocks_are_named(block_s: float, factor: float) -> None:
    second = sound(3, ())["t"] // block_s % 2 < 1
    words = refusal(of_two_writers(GYRO, factor, second))
    assert re.search("the turn rate of the wheels is now .* by turns", words)


# situations of real logs, and their siblings


def with_time(unit: float, names: tuple[str, ...] = GYRO) -> bytes:
    return csv(times(unit, "t")(sound(1, names)))


def at_rate(hz: int, unit: float) -> bytes:
    """Return a log by gyro with this rate, whose t has another unit."""
    rows, t = sound(1, GYRO), np.arange(0.0, END, 1 / hz)
    return csv(
        {"t": unit * t} | {n: np.interp(t, rows["t"], v) for n, v in rows.items() if n != "t"}
    )


def thinned(rows: Columns, every: int) -> Columns:
    return {name: values[::every] for name, values in rows.items()}


def alternating(names: tuple[str, ...], column: str, other: float, every: int) -> bytes:
    """Return a log of which every some values of a column are of another sensor at rest."""
    rows = sound(2, names)
    rng = np.random.default_rng(2)
    known = np.flatnonzero(np.isfinite(rows[column]))[::every]
    rows[column][known] = other + rng.normal(0, 0.004, len(known))
    return csv(rows)


def carried(names: tuple[str, ...], begin: float, seconds: float = 20.0) -> bytes:
    """Return a log during which the robot is carried, from a time on, while its wheels rest."""
    rows = sound(5, names)
    n = int(begin / 0.02)
    t = np.arange(0, seconds, 0.02)
    rng = np.random.default_rng(5)
    rate = 0.8 * np.sin(t) + 0.5
    more = {"left": 0 * t, "right": 0 * t, "yaw_rate": 0.01 + rate + rng.normal(0, 0.004, len(t)),
            "x": 1.5 * np.sin(t / 3), "y": 0.2 * t}  # fmt: skip
    made: Columns = {"t": np.linspace(0.0, 0.02, len(rows["t"]) + len(t))}
    made["t"] *= len(made["t"]) - 1
    for name in ("left", "right", *names):
        if name in PLACES:  # it is put down elsewhere
            last = rows[name][:n][np.isfinite(rows[name][:n])][-1]
            tail = rows[name][n:] + more[name][-1]
            made[name] = np.concatenate((rows[name][:n], last + more[name], tail))
        else:
            made[name] = np.concatenate((rows[name][:n], more[name], rows[name][n:]))
    return csv(made)


def gps(seed: int, hz: float = 1) -> bytes:
    """Return a log with a sound gyro beside a cheap GPS receiver."""
    rows, rng = sound(seed, ("yaw_rate", *PLACES)), np.random.default_rng(seed)
    drift = np.zeros((2, int(END) + 3))
    for n in range(1, drift.shape[1]):
        drift[:, n] = drift[:, n - 1] * (1 - 1 / 60) + rng.normal(0, 1.5 * np.sqrt(2 / 60), 2)
    t = rows["t"]
    for k, name in enumerate(PLACES):
        place = np.interp(t, DRIVE["t"], DRIVE[name]) + drift[k][t.astype(int)]
        place += rng.normal(0, 0.1, len(t))
        rows[name] = np.where(np.arange(len(t)) % int(50 / hz), np.nan, place)
    return csv(rows)


def changed(names: tuple[str, ...], seed: int, change: Callable[[Columns], Columns]) -> bytes:
    return csv(change(sound(seed, names)))


def plane(rows: Columns, **places: float | str) -> Columns:
    """Replace each position by a constant, or by the other column."""
    rng, made = np.random.default_rng(9), dict(rows)
    for name, value in places.items():
        level = value + rng.normal(0, 0.004, len(rows["t"])) if isinstance(value, float) else None
        source = rows[str(value)] if level is None else level
        made[name] = np.where(np.isfinite(rows[name]), source, np.nan)
    return made


def noisy(rows: Columns, std: float, *names: str) -> Columns:
    rng = np.random.default_rng(1)
    return rows | {name: rows[name] + rng.normal(0.3, std, len(rows["t"])) for name in names}


def degrees(rows: Columns) -> Columns:
    return rows | {"yaw": np.degrees(np.angle(np.exp(1j * rows["yaw"])))}


def on_earth() -> bytes:
    """Return a log with positions in degrees, which need seven decimals."""
    rows = sound(3, PLACES)
    cells = [[f"{v:.8f}" if np.isfinite(v) else "" for v in column]
             for column in degrees_on_earth(rows).values()]  # fmt: skip
    return "\n".join([",".join(rows), *map(",".join, zip(*cells, strict=True)), ""]).encode()


SPOT = motion([(3, 0, 0), *[(8, 0, w) for w in (0.8, -0.8, 1.2, -1.2)] * 2, (4, 0.3, 0), (3, 0, 0)])


def angles(factor: float, names: tuple[str, ...] = GYRO) -> bytes:
    return csv(times(factor, "left", "right")(sound(3, names, angles=True)))


def between(rows: Columns, begin: float, end: float, value: float, *names: str) -> Columns:
    """Replace what the columns say in a part of the drive, with the noise of a sensor."""
    part = (rows["t"] >= begin * END) & (rows["t"] < end * END)
    noise = np.random.default_rng(8).normal(0.0, 0.004, len(part))
    return rows | {n: np.where(part, value + noise + 0 * rows[n], rows[n]) for n in names}


def groups(rows: Columns, count: int, of: int) -> Columns:
    """Replace `count` of every `of` samples of the gyro by those of one that rests."""
    other = np.arange(len(rows["t"])) % of < count
    return rows | {"yaw_rate": np.where(other, 0.0, rows["yaw_rate"])}


def overflowing(names: tuple[str, ...]) -> bytes:
    """Return a log with the 16 bits of the counts of 4096 a turn."""
    rows = sound(3, names)
    counts = times(4096 / 2 / np.pi, "left", "right")(sound(3, (), angles=True))
    return csv(rows | {name: np.round(counts[name]) % 65536 for name in ("left", "right")})


def two_rates(hz: int, other_hz: int, factor: float) -> bytes:
    """Return a log with rows of two IMUs with their own rates, of which one shows another rate."""
    rows, rng = sound(3, GYRO), np.random.default_rng(3)
    parts = [rows["t"], np.arange(0, END, 1 / hz), np.arange(0.003, END, 1 / other_hz)]
    t = np.concatenate(parts)
    made: Columns = {"t": t} | {name: np.full(len(t), np.nan) for name in rows if name != "t"}
    first, second = (slice(sum(map(len, parts[:n])), sum(map(len, parts[: n + 1]))) for n in (1, 2))
    for name in ("left", "right"):
        made[name][: len(parts[0])] = rows[name]
    made["yaw_rate"][first] = np.interp(parts[1], rows["t"], rows["yaw_rate"])
    rate = factor * np.interp(parts[2], rows["t"], rows["yaw_rate"])
    made["yaw_rate"][second] = rate + rng.normal(0, 0.004, len(rate))
    order = np.argsort(t, kind="stable")
    return csv({name: column[order] for name, column in made.items()})


def by_chance(rows: Columns, factor: float) -> Columns:
    """Replace the gyro in half of the rows, by chance, by another one."""
    other = np.random.default_rng(3).random(len(rows["t"])) < 0.5
    rate = np.where(other, factor * rows["yaw_rate"], rows["yaw_rate"])
    return rows | {"yaw_rate": rate}


def moved(rows: Columns, by: float) -> Columns:
    """Move all positions of the second half of the drive."""
    return rows | {n: rows[n] + by * (rows["t"] > END / 2) for n in PLACES}


def degrees_on_earth(rows: Columns) -> Columns:
    return rows | {"x": 11.5 + rows["x"] / 74_000, "y": 48.1 + rows["y"] / 111_300}


MIXED = "two series of values alternate"
MIRRORED = "x, y are mirrored"
ADD_UP = "left and right are angles or running counts"
BOTH = ("yaw_rate", *PLACES)
CAUSES: dict[str, tuple[Callable[[], bytes], str]] = {
    "t in ms": (lambda: with_time(1000.0), "is t in s, and not in ms"),
    "t in ms at 10 Hz": (
        lambda: csv(thinned(times(1000.0, "t")(sound(1, GYRO)), 5)), "is t in s, and not in ms"),
    "t in us": (lambda: with_time(1e6), "is t in s"),
    "t in 1/100 s": (lambda: with_time(100.0, PLACES), "is t in s"),
    "two IMUs": (lambda: alternating(GYRO, "yaw_rate", 0.0, 2), f"yaw_rate, {MIXED}"),
    "IMUs of other rates": (lambda: alternating(GYRO, "yaw_rate", 0.0, 3), f"yaw_rate, {MIXED}"),
    "two robots seen": (lambda: alternating(PLACES, "x", 5.0, 2), f"x, y, {MIXED}"),
    "two drivers": (lambda: alternating(GYRO, "left", 0.0, 2), f"left, {MIXED}"),
    "y points down": (lambda: changed((*PLACES, *HEADING), 3, times(-1.0, "y")), MIRRORED),
    "x, y swapped": (lambda: changed(BOTH, 3, lambda r: r | {"x": r["y"], "y": r["x"]}), MIRRORED),
    "x mirrored": (lambda: changed(BOTH, 3, times(-1.0, "x")), MIRRORED),
    "compass": (lambda: changed((*PLACES, *HEADING), 3, times(-1.0, "yaw")), "yaw must grow"),
    "gyro upside down": (lambda: changed(BOTH, 3, times(-1.0, "yaw_rate")), "yaw_rate must grow"),
    "gyro in deg/s": (lambda: changed(BOTH, 3, times(57.29578, "yaw_rate")), "yaw_rate is in deg"),
    "yaw in deg": (lambda: changed((*PLACES, *HEADING), 3, degrees), "yaw is in deg"),
    "gyro at 3/4": (lambda: changed(BOTH, 3, times(0.75, "yaw_rate")), "contradict each other"),
    "counts": (lambda: angles(720 / np.pi), ADD_UP),
    "angles": (lambda: angles(1.0), ADD_UP),
    "ways in m": (lambda: angles(0.05), ADD_UP),
    "angles, by positions": (lambda: angles(1.0, PLACES), ADD_UP),
    "m/s": (lambda: changed(PLACES, 3, times(0.05, "left", "right")), "in m/s at the rim"),
    "turns/s": (lambda: changed(BOTH, 3, times(0.5 / np.pi, "left", "right")), "in turns/s"),
    "longitude and latitude": (on_earth, "degrees of longitude and latitude"),
    "left x 2": (lambda: changed(GYRO, 3, times(2.0, "left")), "multiplied by 0.5: has one side"),
    "left x 1.4, hardly straight": (
        lambda: csv(times(1.4, "left")(sound(3, GYRO, SPOT))), "multiplied by 0.71: has one side"),
    "right x 4": (lambda: changed(BOTH, 3, times(4.0, "right")), "multiplied by 4: has one side"),
    "left in rpm": (lambda: changed(GYRO, 3, times(9.549, "left")), "multiplied by 0.1: has one"),
    "IMUs in pairs": (lambda: changed(GYRO, 2, lambda r: groups(r, 2, 4)), f"yaw_rate, {MIXED}"),
    "one IMU in five": (lambda: changed(GYRO, 2, lambda r: groups(r, 1, 5)), f"yaw_rate, {MIXED}"),
    "receivers 0.5 m apart": (lambda: alternating(PLACES, "x", 0.5, 2), f"x, y, {MIXED}"),
    "turns on the spot": (
        lambda: changed(PLACES, 3, lambda r: between(r, 0.69, 1.1, np.nan, *PLACES)),
        "other tracks fit x, y as well"),
    "counts of 16 bits": (lambda: overflowing(GYRO), ADD_UP),
    "counts of 16 bits, by headings": (lambda: overflowing((*PLACES, *HEADING)), ADD_UP),
    "counts of one side": (
        lambda: changed(GYRO, 3, lambda r: r | {"left": sound(3, (), angles=True)["left"] * 229}),
        "times as far as right, against yaw_rate: is left a running count"),
    "deg/s of one side": (lambda: changed(BOTH, 3, times(57.3, "right")), "rolls 57 times"),
    "IMUs at 100 and 40 Hz": (lambda: two_rates(100, 40, -1.0), f"yaw_rate, {MIXED}"),
    "IMUs at 100 and 33 Hz": (lambda: two_rates(100, 33, 0.0), f"yaw_rate, {MIXED}"),
    "IMUs by chance": (lambda: changed(GYRO, 2, lambda r: by_chance(r, 0.5)), "by turns"),
    "IMUs by chance, other axis": (
        lambda: changed(GYRO, 2, lambda r: by_chance(r, 0.02)), "by turns"),
    "t in 1/100 s, by gyro": (lambda: with_time(100.0), "is t in s"),
    "t in 1/100 s at 100 Hz": (lambda: at_rate(100, 100.0), "is t in s"),
    "t in ms at 1000 Hz": (lambda: at_rate(1000, 1000.0), "is t in s"),
    "t in ns": (lambda: with_time(1e9, BOTH), "is t in s"),
    "swapped, by all": (
        lambda: changed((*BOTH, *HEADING), 3, lambda r: r | {"left": r["right"],
                                                            "right": r["left"]}), "are swapped"),
    "swapped, by headings": (
        lambda: changed((*PLACES, *HEADING), 6, lambda r: r | {"left": r["right"],
                                                              "right": r["left"]}), "are swapped"),
    "rpm, by headings": (
        lambda: changed((*PLACES, *HEADING), 3, times(9.549, "left", "right")), "in rpm"),
    "counts x 2, by headings": (
        lambda: changed((*PLACES, *HEADING), 3, times(2.0, "left", "right")), "twice the true"),
    "ft, by headings": (lambda: changed((*PLACES, *HEADING), 3, times(3.2808, *PLACES)), "in ft"),
    "inches": (lambda: changed(PLACES, 3, times(39.37, *PLACES)), "in inches"),
    "one side twice, nearly": (
        lambda: changed(BOTH, 3, lambda r: r | {"right": 1.01 * r["left"]}), "one side twice"),
    "mm": (lambda: changed(BOTH, 3, times(1000.0, *PLACES)), "in mm"),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", CAUSES)
def test_the_cause_is_named(kind: str) -> None:
    data, words = CAUSES[kind]
    assert words in refusal(data())


LEFT_OUT = "left out"
RIGHT: dict[str, tuple[Callable[[], bytes], tuple[float, ...], str]] = {
    "another plane": (lambda: changed((*PLACES, *HEADING), 4, lambda r: plane(r, x=0.02, y="x")),
                      BY_GYRO, "x, y is left out"),
    "another plane, 2": (lambda: changed((*PLACES, *HEADING), 5, lambda r: plane(r, x=0.02, y="x")),
                         BY_GYRO, "x, y is left out"),
    "another plane, 3": (lambda: changed(BOTH, 6, lambda r: plane(r, x="y", y=0.3)),
                         BY_GYRO, "x, y is left out"),
    "carried after": (lambda: carried(GYRO, END - 0.1), BY_GYRO, LEFT_OUT),
    "carried before": (lambda: carried(GYRO, 1.0), BY_GYRO, LEFT_OUT),
    "carried, by positions": (lambda: carried(PLACES, END - 4.0), BY_POSES, LEFT_OUT),
    "carried, by both": (lambda: carried(BOTH, 60.0), BY_POSES, LEFT_OUT),
    "gps": (lambda: gps(3), BY_GYRO, "x, y is left out"),
    "gps, 2": (lambda: gps(4), BY_GYRO, "x, y is left out"),
    "turned map": (lambda: changed(BOTH, 3, times(-1.0, *PLACES)), BY_POSES, ""),
    "map with y to the north": (
        lambda: changed(BOTH, 3, lambda r: r | {"x": -r["y"], "y": r["x"]}), BY_POSES, ""),
    "carried, by gyro": (lambda: carried(GYRO, 40.0), BY_GYRO, LEFT_OUT),
    "gps at 1 Hz, by chance near the wheels": (lambda: gps(20), BY_GYRO, "x, y is left out"),
    "gps at 0.5 Hz": (lambda: gps(4, 0.5), BY_GYRO, "x, y is left out"),
    "gps at 0.2 Hz": (lambda: gps(22, 0.2), BY_GYRO, "x, y is left out"),
    "gps at 2 Hz": (lambda: gps(7, 2), BY_GYRO, "x, y is left out"),
    "gps at 5 Hz": (lambda: gps(5, 5), BY_GYRO, "x, y is left out"),
    "gyro about another axis": (
        lambda: changed(BOTH, 6, lambda r: noisy(times(0.0, "yaw_rate")(r), 0.2, "yaw_rate")),
        BY_POSES, "yaw_rate is left out"),
    "places stay for the first third": (
        lambda: changed(BOTH, 6, lambda r: between(r, 0.0, 0.33, 0.0, *PLACES)), BY_POSES,
        LEFT_OUT),
    "wheels stand in the log": (
        lambda: changed(GYRO, 6, lambda r: between(r, 0.4, 0.6, 0.0, "left", "right")), BY_GYRO,
        LEFT_OUT),
    "map jumps by 10 m": (lambda: changed(PLACES, 6, lambda r: moved(r, 10.0)), BY_POSES, ""),
    "no curves by positions": (
        lambda: changed(BOTH, 6, lambda r: between(r, 0.69, 1.1, np.nan, *PLACES)), BY_POSES, ""),
    "places +- 10 cm": (lambda: changed(BOTH, 6, lambda r: noisy(r, 0.1, *PLACES)), BY_POSES, ""),
}  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("kind", RIGHT)
def test_what_contradicts_all_others_is_left_out(kind: str) -> None:
    data, truth, note = RIGHT[kind]
    right(data(), truth, note)


@pytest.mark.slow
def test_a_sensor_that_was_computed_from_the_wheels_is_noted() -> None:
    trip = usual()
    rate = (trip.right - trip.left) * 0.05 / 0.45
    log = Log((run(replace(trip, gyro_t=trip.t, gyro=rate), places=False),), ("a note",))
    notes = calibrate(log, Config(), "a.csv").notes
    assert any("yaw_rate agrees with the wheels better than a sensor can" in n for n in notes)
    assert notes[-1] == "a note"
    where, _ = path((trip.left + trip.right) * 0.025 * 0.01, rate * 0.01)
    streams = {"left right": (trip.t, trip.left, trip.right),
               "x y": (trip.t[::5], where.real[:-1:5], where.imag[:-1:5])}  # fmt: skip
    notes = calibrate(Log((run_of("1", streams, Notes()),), ()), Config(), "a.csv").notes
    assert any("x, y agrees with the wheels better than a sensor can" in n for n in notes)
    agreeing = Config(drive=DriveConfig(wheel_separation_multiplier=1.5))
    with pytest.raises(LogError, match="No value is surely better"):
        calibrate(Log((run_of("1", streams, Notes()),), ()), agreeing, "a.csv")


def test_wheels_that_hardly_roll_are_refused() -> None:
    with pytest.raises(LogError, match=r"the wheels roll only 0\.0 rad"):
        result(csv(times(0.0, "left", "right")(sound(1, GYRO))))


@pytest.mark.slow
def test_145_short_runs_take_less_than_5_s() -> None:
    rng = np.random.default_rng(5)
    robot = Robot(chi=1.9, rate=0.1, slip=0.1, rng=rng, place_hz=20.0, outliers=0.0)
    plan = [(2.0, *rng.uniform((0, -1.6), (0.5, 1.6))) for _ in range(145)]
    log = Log(tuple(runs([drive(robot, [leg]) for leg in plan])), ())
    begin = time.process_time()
    assert calibrate(log, Config(), "a.csv").better
    assert time.process_time() - begin < 5.0
