"""Names the mistake that explains why the sensors of a log contradict its wheels.

A fit that is better than a wrong configuration is not right, so each sensor of every log is first
compared with the wheels (`comparison.py`). The comparison also shows the size of the wheels, so
wrong units and counts show as a robot that cannot be. A cause is named if it leads to a possible
robot.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence

import numpy as np
from msgspec.structs import replace

from acsard.calibration.comparison import (
    LATE_S,
    ROBOTS,
    STEP_S,
    WIDE_DELAYS_S,
    Match,
    Span,
    gyro_bias,
    matched,
    sensors,
    without,
)
from acsard.calibration.geometry import Base
from acsard.calibration.log import MIXED, LogError, Run
from acsard.calibration.series import TINY, in_blocks
from acsard.core.config.settings import DriveConfig
from acsard.core.values import Seconds

NOTED_LATE_S = 0.1
POOR, POORER = 0.15, 3.0  # share, and in that of the best sensor, of one that is left out
USUAL_ROBOTS = 0.8, 2.8  # effective track / wheel separation, if a cause explains it
SIZES = 0.8, 1.25  # distance by positions / by the wheels
SAME_SIGN = 0.25  # of a ratio of -1

MARGIN_S = 5.0  # beside a window that is left out
LEAST_S, LEAST_PART_S = 30.0, 2.0  # of a log of which a part is left out, and of its parts
STILL, ALONE = 1e-3, 0.2  # of a side that stands, rad in a step, and what the other rolls meanwhile
TWICE, BACKWARDS = 0.02, 1e-3  # share of the rolled angle; rad in a row
MAX_SIDE_RATIO = 20.0  # ways of one side / of the other

NAMES = {"gyro": "yaw_rate", "headings": "yaw", "positions": "x, y"}
UNITS = "the speeds of the wheels are in {}, not in rad/s"
COUNTS = "the speeds of the wheels are {} the true ones: correct the counts of a wheel turn"
SPEEDS = {
    180 / math.pi: UNITS.format("deg/s"), 60 / math.tau: UNITS.format("rpm"),
    1 / math.tau: UNITS.format("turns/s"), 4.0: COUNTS.format("4 times"),
    2.0: COUNTS.format("twice") + ", or drive.wheel_radius, if that is the diameter",
    0.5: COUNTS.format("half of"), 0.25: COUNTS.format("a quarter of"),
}  # fmt: skip
DEGREES = "x, y are degrees of longitude and latitude: convert them to m to the east and north"
PLACES = {
    100.0: "x, y are in cm, not in m", 1000.0: "x, y are in mm, not in m",
    9e-6: DEGREES, 1.3e-5: DEGREES,  # at the equator, and far from it
    1 / 0.3048: "x, y are in ft, not in m", 1 / 0.0254: "x, y are in inches, not in m",
}  # fmt: skip
QUESTIONS = {
    "gyro": "Does yaw_rate turn about the axis that points up?",
    "headings": "Is yaw the angle about the axis that points up, and no part of a quaternion?",
    "positions": "Do x and y lie in the floor, and are they positions in one map?",
}
SWAPPED = "left and right are swapped, or both have the wrong sign"
MIRRORED = {
    "gyro": "yaw_rate must grow to the left", "headings": "yaw must grow to the left",
    "positions": "x, y are mirrored: y must point to the left of x",
}  # fmt: skip


def examined(
    runs: Sequence[Run], drive: DriveConfig
) -> tuple[list[Run], dict[str, Match], list[str]]:
    """Return the runs without the parts and sensors that contradict all others, the match of each
    sensor that is left, and notes. Raise `LogError` with the cause that explains a contradiction.
    """
    base, notes = Base.of(drive), list[str]()
    fact, of_wheels = _alternates(runs, base)
    if (fact and sensors(runs) == ["gyro"]) or of_wheels:
        raise LogError(f"{fact or of_wheels}. Record only one of them")
    if fact:
        runs, notes = [without(run, "gyro") for run in runs], [f"yaw_rate is left out: {fact}"]
    matches = {sensor: matched(sensor, runs, base) for sensor in sensors(runs)}
    odd = {s: m for s, m in matches.items() if not m.given or m.unexplained > POOR or m.bad}
    for cause in _facts(runs, odd) if odd else ():
        raise LogError(cause)
    best = min((match.unexplained for match in matches.values()), default=0.0)
    following = {
        sensor: match for sensor, match in matches.items()
        if match.follows
        and (sensor != "positions" or match.unexplained < max(POOR, POORER * best))
    }  # fmt: skip
    if causes := [
        *_turned(following),
        *_sized(following, drive, forward(runs)),
        *_late(following),
    ]:
        raise LogError(". ".join(causes))
    for sensor, match in matches.items():
        name = NAMES[sensor]
        fact = f"{percent(match.unexplained)} of the motion by {name} is not that of the wheels"
        if not following:
            if words := forward(runs):
                raise LogError(f"{fact}, and {words}")
            raise LogError(
                f"{fact}, and neither swapped sides nor signs, units or delays of up to "
                f"{WIDE_DELAYS_S[-1]:.0f} s explain it. Is {name} of the same drive, with times "
                f"from the same clock? Did the wheels roll on the floor? {QUESTIONS[sensor]}"
            )
        if sensor not in following:
            others = " and ".join(NAMES[other] for other in following)
            notes.append(f"{name} is left out: {fact}, but {others} follows them")
            runs = [without(run, sensor) for run in runs]
        if sensor in following and abs(match.delay) > NOTED_LATE_S:
            notes.append(f"the times of {name} are {1000 * match.delay:.0f} ms after the wheels'")
    kept, more = _without_spans(runs, {span for m in following.values() for span in m.bad})
    if more:
        following = {sensor: matched(sensor, kept, base) for sensor in following}
    return kept, following, [*notes, *more]


def _alternates(runs: Sequence[Run], base: Base) -> tuple[str, str]:
    # Return the sentence about two IMUs, and that about two programs that write the wheels, if rows
    # come from one or the other by turns. "" if they do not.
    found = [(np.zeros(0), np.zeros(0))]
    for run in runs:
        left, right = (np.gradient(side, run.t) for side in (run.left, run.right))
        turn = np.interp(run.gyro_t, run.t, base.right * right - base.left * left) / base.track
        found.append((turn, run.rate))
    turn, rate = (np.concatenate(columns) for columns in zip(*found, strict=True))
    wheels = "the turn rate of the wheels"
    facts = []
    for name, values, other_name, other, writers in (
        ("yaw_rate", rate, wheels, turn, "two IMUs on one topic"),
        (wheels, turn, "yaw_rate", rate - gyro_bias(runs)[0],
         "two programs, like a joint_state_publisher beside the driver,"),
    ):  # fmt: skip
        levels = in_blocks(values, other)
        facts.append(
            f"{name} is now {levels.low:.2f}, now {levels.high:.2f} times {other_name}, and "
            f"changes {levels.changes} times while that stays, as if {writers} wrote it by turns"
            if levels else ""
        )  # fmt: skip
    return facts[0], facts[1]


def _without_spans(runs: Sequence[Run], spans: set[Span]) -> tuple[list[Run], list[str]]:
    made, parts = list[Run](), list[str]()
    for n, run in enumerate(runs):
        bad = _joined([
            (max(run.t[0], begin - MARGIN_S), min(run.t[-1], end + MARGIN_S))
            for index, begin, end in spans if index == n
        ])  # fmt: skip
        if not bad:
            made.append(run)
            continue
        parts += [f"{begin:.0f} to {end:.0f} s of run {run.name}" for begin, end in bad]
        begins, ends = zip((run.t[0], run.t[0]), *bad, (run.t[-1], run.t[-1]), strict=True)
        kept = [run.part(begin, end) for begin, end in zip(ends[:-1], begins[1:], strict=True)
                if end - begin > LEAST_PART_S]  # fmt: skip
        made += [replace(part, name=f"{run.name}.{k}" if k > 1 else run.name)
                 for k, part in enumerate(kept, 1)]  # fmt: skip
    words = f"the sensors contradict the wheels there: {', '.join(parts)}"
    left = sum(run.seconds for run in made)
    if parts and left < LEAST_S:
        raise LogError(f"only {left:.0f} s of the log are left, because {words}")
    return made, [f"left out, because {words}"] if parts else []


def _joined(spans: Sequence[tuple[Seconds, Seconds]]) -> list[tuple[Seconds, Seconds]]:
    made = list[tuple[Seconds, Seconds]]()
    for begin, end in sorted(spans):
        if made and begin <= made[-1][1]:
            made[-1] = made[-1][0], max(end, made[-1][1])
        else:
            made.append((begin, end))
    return made


def _facts(runs: Sequence[Run], matches: Mapping[str, Match]) -> Iterator[str]:
    # Causes that the columns of the wheels show, if a sensor contradicts them.
    names = " and ".join(NAMES[sensor] for sensor in matches)
    for mixed in {run.mixed for run in runs if run.mixed}:
        yield MIXED.format(mixed)
    turns = sum(float(np.abs(np.diff(run.right - run.left)).sum()) for run in runs)
    if turns < TWICE * sum(_rolled(runs, side) for side in ("left", "right")):
        yield (
            f"left and right are the same in every row, although the robot turns by {names}: the "
            "log has one side twice. Record the wheels of both sides"
        )
    for side, other in (("left", "right"), ("right", "left")):
        rolled = _rolled(runs, other)
        alone, begin, end = max(_alone(run, side, other) for run in runs)
        if alone > ALONE * rolled:
            yield (
                f"{side} stands still from {begin:.0f} to {end:.0f} s, while {other} rolls "
                f"{alone:.0f} of its {rolled:.0f} rad, against {names}: is its encoder dead, or "
                "its cable loose?"
            )
    less, more = sorted(("left", "right"), key=lambda side: _rolled(runs, side))
    if (ratio := _rolled(runs, more) / (_rolled(runs, less) + TINY)) > MAX_SIDE_RATIO:
        yield (
            f"{more} rolls {ratio:.0f} times as far as {less}, against {names}: is {more} a "
            "running count, or in another unit? Write both as speeds in rad/s"
        )


def forward(runs: Sequence[Run]) -> str:
    """Return a sentence about sides that never turn backwards, or nothing."""
    sides = [
        side for side in ("left", "right")
        if all(np.diff(getattr(run, side)).min() > -BACKWARDS for run in runs)
    ]  # fmt: skip
    words = (
        f"{' and '.join(sides)} never turn backwards in this log. If they did, their encoders have "
        "one channel, or a sign was lost: record speeds with their sign"
    )
    return words if sides else ""


def percent(share: float) -> str:
    return f"{share:.0%}" if share >= 0.1 else f"{share:.1%}"


def _rolled(runs: Sequence[Run], side: str) -> float:
    return sum(float(np.abs(np.diff(getattr(run, side))).sum()) for run in runs)


def _alone(run: Run, side: str, other: str) -> tuple[float, Seconds, Seconds]:
    # The longest way that one side rolls while the other one stands, rad, and its begin and end.
    edges = run.edges(STEP_S)
    stands, rolls = (np.abs(np.diff(np.interp(edges, run.t, getattr(run, name))))
                     for name in (side, other))  # fmt: skip
    change = np.diff(np.concatenate(([0], (stands < STILL).astype(int), [0])))
    ends = zip(np.flatnonzero(change > 0), np.flatnonzero(change < 0), strict=True)
    ways = [(float(rolls[a:b].sum()), float(edges[a]), float(edges[b])) for a, b in ends]
    return max(ways, default=(0.0, 0.0, 0.0))


def _turned(matches: Mapping[str, Match]) -> Iterator[str]:
    odd = {sensor: match for sensor, match in matches.items() if not match.given}
    if not odd:
        return
    names = " and ".join(NAMES[sensor] for sensor in odd)
    worst = max(odd.values(), key=lambda match: match.as_given)
    fact = (
        f"the wheels miss {percent(worst.as_given)} of the motion by {names}, but only "
        f"{percent(worst.unexplained)} if"
    )
    rows = {match.row for match in odd.values()}
    if "angles" in rows:
        yield (
            f"{fact} left and right are angles or running counts: write speeds, which are 2 pi x "
            "(counts since the last row) / (counts of a wheel turn x seconds since the last row)"
        )
    elif "degrees" in rows:
        yield f"{fact} yaw is in deg: write it in rad"
    elif worst.ratio != 1.0:
        yield f"{fact} the speeds of left are multiplied by {worst.ratio:.2g}: " + (
            "one side has the wrong sign. Turn the sign of left or of right"
            if abs(worst.ratio + 1) < SAME_SIGN
            else "has one side another unit, other counts of a wheel turn or a larger wheel?"
        )
    elif len(odd) < len(matches):
        straight = " and ".join(NAMES[sensor] for sensor in matches if sensor not in odd)
        causes = " and ".join(MIRRORED[sensor] for sensor in odd)
        yield f"{fact} it turns to the other side, and they follow {straight}: {causes}"
    else:
        mirrored = " and ".join(MIRRORED[sensor] for sensor in odd)
        yield f"{fact} they turn to the other side: {SWAPPED}, or {mirrored}"


def _sized(matches: Mapping[str, Match], drive: DriveConfig, other: str) -> Iterator[str]:
    # Tracks and sizes that no robot has, and what would make them possible.
    seen = [
        (s, abs(m.track) * drive.wheel_separation_multiplier, m.size)
        for s, m in matches.items() if m.row != "angles" and m.ratio == 1.0
    ]  # fmt: skip

    def possible(
        robots: tuple[float, float] = USUAL_ROBOTS, *, speeds: float = 1.0, places: float = 1.0,
        turns: Mapping[str, float] = {}, alias: bool = False,
    ) -> bool:  # fmt: skip
        return all(
            (alias and sensor == "positions")
            or robots[0] < track / speeds * turns.get(sensor, 1.0) < robots[1]
            for sensor, track, _ in seen
        ) and all(
            sensor != "positions" or SIZES[0] < size * speeds / places < SIZES[1]
            for sensor, _, size in seen
        )

    if possible(ROBOTS):
        return
    facts = [f"by the wheels the robot turns {track:.3g} times as far as by {NAMES[sensor]}"
             for sensor, track, _ in seen if not ROBOTS[0] < track < ROBOTS[1]]  # fmt: skip
    facts += [f"by x, y the robot drives {size:.3g} times as far as by its wheels"
              for _, _, size in seen if not SIZES[0] < size < SIZES[1]]  # fmt: skip
    speeds = SPEEDS | {
        drive.wheel_radius * factor: UNITS.format(f"{unit} at the rim")
        for factor, unit in ((1.0, "m/s"), (1000.0, "mm/s"))
    }
    causes = [words for k, words in speeds.items() if possible(speeds=k)]
    causes += dict.fromkeys(words for k, words in PLACES.items() if possible(places=k))
    causes += [f"{NAMES[sensor]} is in deg, not in rad" for sensor, _, _ in seen
               if possible(turns={sensor: 180 / math.pi})]  # fmt: skip
    # Turns of 90 deg on the spot show no track by positions, but their size is right.
    causes = causes or [words for k, words in speeds.items() if possible(speeds=k, alias=True)]
    yield f"{' and '.join(facts)}: " + (
        ", or ".join(causes)
        or other
        or "is t in s, are the speeds of the wheels and yaw_rate in rad/s, x "
        "and y in m, and drive.wheel_radius and drive.wheel_separation right?"
    )


def _late(matches: Mapping[str, Match]) -> Iterator[str]:
    for sensor, match in matches.items():
        if abs(match.delay) > LATE_S:
            yield (
                f"the times of {NAMES[sensor]} are {match.delay:.1f} s after those of the wheels: "
                "record all sensors with times from the same clock"
            )
