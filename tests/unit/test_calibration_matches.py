"""Compares single sensors with the wheels, and draws conclusions from the comparisons.

The logs last 40 s, and the tests are about signs, units and limits. Whole logs with their causes
are in `test_calibration_hypotheses.py`.
"""

from __future__ import annotations

import math

import numpy as np
import pytest
from msgspec import structs

from acsard.calibration import hypotheses
from acsard.calibration.comparison import (
    Match,
    Places,
    Turns,
    cost,
    gyro_bias,
    matched,
    sensors,
    weights,
    without,
)
from acsard.calibration.geometry import Base
from acsard.calibration.hypotheses import examined
from acsard.calibration.log import LogError, Notes, Run, run_of
from acsard.calibration.series import by_chance, by_turns, in_blocks
from acsard.core.config.settings import Config, DriveConfig
from tests.unit.calibration_bags import Floats, motion
from tests.unit.calibration_faults import Columns

LEGS: list[tuple[float, float, float]] = [
    (2, 0, 0), (4, 0.4, 0), (4, 0.2, 0.8), (4, 0.3, -0.6), (4, 0, -1.0), (4, 0.3, 0.5),
    (4, -0.3, 0.4), (4, 0.3, -0.9), (4, 0, 1.0), (4, 0.2, 0), (2, 0, 0),
]  # fmt: skip
DRIVE = motion(LEGS)
CARRIED = motion([*LEGS[:5], (22, 0, 0), *LEGS[5:]])
SHORT = motion([*LEGS[:5], (22, 0, 0), *LEGS[5:8]])
DRIVES = DriveConfig()
BASE = Base.of(DRIVES)
TRACK, SIZE, RIGHT = 1.4925, 1.005, 1.01


def log(
    *names: str, late: float = 0.0, lever: complex = 0j, hz: float = 5.0, left: float = 1.0,
    right: float = 1.0, name: str = "1", drive: Columns = DRIVE, carried: float = 0.0,
    step: float = 0.05,
) -> Run:  # fmt: skip
    """Return a drive. The sensors are late, s; the speeds of a side are multiplied.

    From 20 to 40 s, the gyro shows that somebody carries the robot, rad/s.
    """

    def value(name: str, t: Floats) -> Floats:
        return np.asarray(np.interp(t, drive["t"], drive[name]))

    end, rng = float(drive["t"][-1]), np.random.default_rng(1)
    t, at = np.arange(0.0, end, step), np.arange(0.0, end, 1 / hz)
    streams: dict[str, tuple[Floats, ...]] = {}
    streams["left right"] = (t, left * value("left", t), right * value("right", t))
    if "gyro" in names:
        seen = value("w", t - late) + 0.01 + rng.normal(0, 0.002, len(t))
        streams["yaw_rate"] = t, seen + carried * ((t > 20.0) & (t < 40.0))
    yaw = value("yaw", at - late)
    if "headings" in names:
        streams["yaw"] = at, np.angle(np.exp(1j * (yaw + rng.normal(0, 0.002, len(at)))))
    if "positions" in names:
        where = value("x", at - late) + 1j * value("y", at - late) + lever * np.exp(1j * yaw)
        where = 3 - 2j + np.exp(0.6j) * where
        noise = rng.normal(0, 0.002, (2, len(at)))
        streams["x y"] = at, where.real + noise[0], where.imag + noise[1]
    return run_of(name, streams, Notes())


def test_turns_show_the_track_and_the_delay() -> None:
    for sensor in ("gyro", "headings"):
        for late in (-0.3, 0.0, 0.3):
            match = matched(sensor, [log(sensor, late=late)], BASE)
            assert match.track == pytest.approx(TRACK, abs=0.02)
            assert match.delay == pytest.approx(late, abs=0.001)
            assert match.unexplained < 0.02
            assert match.given
            assert not match.bad


def test_turns_show_another_side_and_another_scale_of_a_side() -> None:
    match = matched("gyro", [log("gyro", left=-1.0, right=-1.0)], BASE)
    assert match.track == pytest.approx(-TRACK, abs=0.03)
    assert match.as_given == 1.0
    for sensor in ("gyro", "headings"):
        for left, right in ((2.0, 1.0), (1.0, 4.0), (-1.0, 1.0), (1.0, 1.6)):
            match = matched(sensor, [log(sensor, left=left, right=right)], BASE)
            assert match.ratio == pytest.approx(right / left / RIGHT * RIGHT, rel=0.06)
            assert match.follows
            assert not match.given


def test_positions_show_track_size_delay_and_lever() -> None:
    for late, factor in ((0.3, 1.0), (-0.2, 1 / 0.9)):
        run = log("positions", late=late, lever=0.1 + 0.05j, left=factor, right=factor)
        match = matched("positions", [run], BASE)
        assert match.track == pytest.approx(TRACK * factor, rel=0.01)
        assert match.size == pytest.approx(SIZE / factor, rel=0.02)
        assert match.delay == pytest.approx(late, abs=0.051)
        assert match.lever == pytest.approx((0.1, 0.05), abs=0.02)
        assert match.unexplained < 0.03
        assert match.given


def test_positions_show_another_side_and_another_scale_of_a_side() -> None:
    match = matched("positions", [log("positions", left=-1.0, right=-1.0)], BASE)
    assert match.track < 0
    assert match.as_given > 0.3
    match = matched("positions", [log("positions", left=2.0)], BASE)
    assert match.ratio == 0.5
    assert match.size == pytest.approx(SIZE, rel=0.05)


def test_a_wrong_position_hardly_changes_what_the_others_show() -> None:
    run = log("positions")
    run.place[40] += 30.0
    match = matched("positions", [run], BASE)
    assert match.track == pytest.approx(TRACK, abs=0.05)
    assert match.size == pytest.approx(SIZE, abs=0.02)


def test_few_positions_are_compared_in_longer_windows() -> None:
    # Two positions of a window fit any wheels.
    run = log("positions", hz=0.5)
    assert matched("positions", [run], BASE).unexplained < 0.1
    for left in (6.0 * run.t, 4.0 * run.t + 8.0 * np.sin(run.t)):
        other = structs.replace(run, left=left, right=4.0 * run.t)
        assert Places("positions", [other], BASE).match().unexplained > 0.3


def test_a_part_in_which_the_robot_is_carried_is_left_out_of_the_run_that_has_it() -> None:
    carried = log("gyro", name="b", drive=CARRIED, carried=1.5)
    kept, matches, (note,) = examined([log("gyro", name="a"), carried], DRIVES)
    # The windows of 10 s that are left out have a margin of 5 s.
    assert note == "left out, because the sensors contradict the wheels there: 16 to 46 s of run b"
    assert [run.name for run in kept] == ["a", "b", "b.2"]
    assert kept[1].t[-1] == pytest.approx(15.6, abs=0.1)
    assert kept[2].t[0] == pytest.approx(46.3, abs=0.1)
    assert kept[2].t[-1] == pytest.approx(62.0, abs=0.1)
    assert matches["gyro"].track == pytest.approx(TRACK, abs=0.03)
    with pytest.raises(LogError, match=r"only 2\d s of the log are left, because the sensors"):
        examined([log("gyro", drive=SHORT, carried=1.5)], DRIVES)


def test_the_bias_of_a_gyro_is_the_rate_at_rest() -> None:
    bias, std = gyro_bias([log("gyro")])
    assert bias == pytest.approx(0.01, abs=0.001)
    assert std == 1e-3
    assert gyro_bias([log("gyro").part(3.0, 30.0)]) == (0.0, 0.05)  # it never rests


# conclusions

GIVEN = {sensor: Match(sensor, 0.02, 1.5, 0.0, 0.02) for sensor in hypotheses.NAMES}


def shown(monkeypatch: pytest.MonkeyPatch, *matches: Match) -> tuple[list[Run], list[str]]:
    """Return the runs that are left, and the notes, if the sensors show this."""
    by_sensor = {match.sensor: match for match in matches}
    monkeypatch.setattr(hypotheses, "matched", lambda sensor, runs, base: by_sensor[sensor])
    runs, _, notes = examined([log(*by_sensor)], DRIVES)
    return runs, notes


def refused(monkeypatch: pytest.MonkeyPatch, *matches: Match) -> str:
    with pytest.raises(LogError) as error:
        shown(monkeypatch, *matches)
    return str(error.value)


SPEEDS = {
    "in deg/s": 180 / math.pi, "in rpm": 60 / math.tau, "in turns/s": 1 / math.tau,
    "4 times the true ones": 4.0, "twice the true ones": 2.0, "half of the true ones": 0.5,
    "a quarter of the true ones": 0.25, "m/s at the rim": 0.05, "mm/s at the rim": 50.0,
}  # fmt: skip


@pytest.mark.parametrize("words", SPEEDS)
def test_the_unit_of_the_speeds_follows_from_track_and_size(
    monkeypatch: pytest.MonkeyPatch, words: str
) -> None:
    factor = SPEEDS[words]
    places = Match("positions", 0.05, 1.3 * factor, 0.0, 0.05, size=1 / factor)
    text = refused(monkeypatch, GIVEN["gyro"], places)
    assert f"by x, y the robot drives {1 / factor:.3g} times as far as by its wheels" in text
    assert words not in text  # the gyro speaks against it
    gyro = Match("gyro", 0.02, 1.3 * factor, 0.0, 0.02)
    text = refused(monkeypatch, gyro, places)
    assert words in text
    assert (f"the robot turns {1.3 * factor:.3g} times as far as by yaw_rate" in text) is (
        factor != 2.0
    )


PLACES = {"in cm": 100.0, "in mm": 1000.0, "in ft": 1 / 0.3048, "in inches": 1 / 0.0254,
          "degrees of longitude": 1e-5}  # fmt: skip


@pytest.mark.parametrize("words", PLACES)
def test_the_unit_of_the_positions_follows_from_their_size(
    monkeypatch: pytest.MonkeyPatch, words: str
) -> None:
    for share in (0.85, 1.2) if words != "degrees of longitude" else (1.0,):
        places = Match("positions", 0.05, 1.5, 0.0, 0.05, size=share * PLACES[words])
        assert words in refused(monkeypatch, GIVEN["gyro"], places)
    for size in (0.81, 1.24):
        shown(monkeypatch, GIVEN["gyro"], Match("positions", 0.05, 1.5, 0.0, 0.05, size=size))
    for size in (0.79, 1.26):
        text = refused(monkeypatch, Match("positions", 0.05, 1.5, 0.0, 0.05, size=size))
        assert "is t in s" in text
        fact = f"by x, y the robot drives {size:g} times as far as by its wheels: is t in s"
        assert text.startswith(fact)
    text = refused(monkeypatch, Match("positions", 0.05, 4.5, 0.0, 0.05, size=1.2))
    assert text.startswith("by the wheels the robot turns 4.5 times as far as by x, y: is t in s")


def test_the_unit_of_a_turn_follows_from_the_track(monkeypatch: pytest.MonkeyPatch) -> None:
    for sensor, name in (("gyro", "yaw_rate"), ("headings", "yaw")):
        off = Match(sensor, 0.02, 1.5 * math.pi / 180, 0.0, 0.02)
        assert f"{name} is in deg, not in rad" in refused(monkeypatch, off)
    for track in (0.82, 3.5):
        shown(monkeypatch, Match("gyro", 0.02, track, 0.0, 0.02))
    for track in (0.78, 3.7):
        assert "the robot turns" in refused(monkeypatch, Match("gyro", 0.02, track, 0.0, 0.02))


def test_a_sensor_that_turns_to_the_other_side_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    odd = {s: Match(s, 0.02, -1.5, 0.0, 0.02, as_given=0.9) for s in GIVEN}
    text = refused(monkeypatch, odd["gyro"])
    assert "miss 90% of the motion by yaw_rate, but only 2.0% if they turn to the other" in text
    assert "swapped, or both have the wrong sign, or yaw_rate must grow to the left" in text
    text = refused(monkeypatch, odd["gyro"], GIVEN["positions"])
    assert "and they follow x, y: yaw_rate must grow to the left" in text
    text = refused(monkeypatch, GIVEN["gyro"], odd["positions"])
    assert "and they follow yaw_rate: x, y are mirrored" in text
    text = refused(monkeypatch, *odd.values())
    assert "motion by yaw_rate and yaw and x, y" in text


def test_a_side_or_column_of_another_meaning_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    def gyro(**other: float | str) -> Match:
        return Match("gyro", 0.02, 1.5, 0.0, 0.02, as_given=0.9, **other)  # type: ignore[arg-type]

    assert "one side has the wrong sign" in refused(monkeypatch, gyro(ratio=-1.2))
    text = refused(monkeypatch, gyro(ratio=0.5))
    assert "left are multiplied by 0.5: has one side another unit" in text
    assert "another unit" in refused(monkeypatch, gyro(ratio=-1.3))
    assert "are angles or running counts" in refused(monkeypatch, gyro(row="angles"))
    degrees = Match("headings", 0.02, 1.5, 0.0, 0.02, row="degrees")
    assert "yaw is in deg: write it in rad" in refused(monkeypatch, degrees)


def test_the_rows_of_the_table_are_what_they_say() -> None:
    run = log("gyro", "headings")
    t = run.t
    rolled = {"left right": (t, run.left, run.right), "yaw_rate": (run.gyro_t, run.rate)}
    match = matched("gyro", [run_of("1", rolled, Notes())], BASE)
    assert match.row == "angles"
    assert match.track == pytest.approx(TRACK, abs=0.05)
    turned = {"left right": (t, np.gradient(run.left, t), np.gradient(run.right, t)),
              "yaw": (run.yaw_t, np.degrees(run.yaw))}  # fmt: skip
    assert matched("headings", [run_of("1", turned, Notes())], BASE).row == "degrees"


def test_late_sensors_are_noted_and_later_ones_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    def late(seconds: float) -> Match:
        return Match("gyro", 0.02, 1.5, seconds, 0.02)

    assert shown(monkeypatch, late(0.09))[1] == []
    assert shown(monkeypatch, late(-0.09))[1] == []
    assert shown(monkeypatch, late(0.2))[1] == [
        "the times of yaw_rate are 200 ms after the wheels'"
    ]
    assert "-200 ms" in shown(monkeypatch, late(-0.2))[1][0]
    assert len(shown(monkeypatch, late(0.89))[1]) == 1
    assert "are -1.5 s after those of the wheels" in refused(monkeypatch, late(-1.5))


def test_a_sensor_that_does_not_follow_is_left_out_beside_one_that_does(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    (run,), (note,) = shown(monkeypatch, GIVEN["gyro"], Match("positions", 0.5, 1.5, 0.0, 0.5))
    assert note.startswith("x, y is left out: 50% of the motion by x, y is not that of the wheels")
    assert sensors([run]) == ["gyro"]
    # Positions follow three times worse than the best sensor, or by 15 %.
    for unexplained, best, left in ((0.14, 0.01, 2), (0.16, 0.01, 1), (0.2, 0.08, 2)):
        gyro = Match("gyro", best, 1.5, 0.0, best)
        (run,), notes = shown(monkeypatch, gyro, Match("positions", unexplained, 1.5, 0.0, 0.2))
        assert len(sensors([run])) == left
        assert len(notes) == 2 - left
    text = refused(monkeypatch, Match("gyro", 0.31, 1.5, 0.0, 0.3))
    assert text.startswith("31% of the motion by yaw_rate is not that of the wheels, and neither")
    assert "Does yaw_rate turn about the axis that points up?" in text


def test_two_sensors_on_one_topic_are_left_out_beside_another(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    run = log("gyro", "positions")
    other = run.gyro_t // 1 % 2 < 1
    run.rate[other] *= -1.0
    monkeypatch.setattr(hypotheses, "matched", lambda sensor, runs, base: GIVEN[sensor])
    (kept,), _, (note,) = examined([run], DRIVES)
    assert sensors([kept]) == ["positions"]
    assert note.startswith(
        "yaw_rate is left out: yaw_rate is now -0.68, now 0.67 times the turn rate of the wheels, "
        "and changes "
    )
    assert note.endswith("while that stays, as if two IMUs on one topic wrote it by turns")
    with pytest.raises(LogError, match="Record only one of them"):
        examined([without(run, "positions")], DRIVES)


def test_two_programs_that_write_the_wheels_are_named_beside_any_sensor() -> None:
    run = log("gyro", "positions")
    speeds = [np.gradient(side, run.t) for side in (run.left, run.right)]
    mixed = [np.where(run.t // 1 % 2 < 1, 0.5, 1.0) * speed for speed in speeds]
    rows = {"left right": (run.t, *mixed), "yaw_rate": (run.gyro_t, run.rate)}
    with pytest.raises(LogError) as error:
        examined([run_of("1", rows, Notes())], DRIVES)
    words = "the turn rate of the wheels is now 0.75, now 1.49 times yaw_rate, and changes "
    assert str(error.value).startswith(words)
    assert "as if two programs, like a joint_state_publisher beside the driver," in str(error.value)


# what the wheels themselves show

ODD = Match("gyro", 0.5, 1.5, 0.0, 0.5)


def wheels(
    monkeypatch: pytest.MonkeyPatch, left: Floats, right: Floats, mixed: str = "", odd: Match = ODD
) -> str:
    """Return the refusal of a log with these angles of the wheels, which a gyro contradicts."""
    monkeypatch.setattr(hypotheses, "matched", lambda sensor, runs, base: odd)
    run = structs.replace(log("gyro"), left=left, right=right, mixed=mixed)
    with pytest.raises(LogError) as error:
        examined([run], DRIVES)
    return str(error.value)


T = log("gyro").t
ROCKS = 30 * np.sin(T / 2)


def test_sides_that_are_the_same_within_4_percent_are_one(monkeypatch: pytest.MonkeyPatch) -> None:
    for more, twice in ((0.038, True), (-0.038, True), (0.044, False), (-0.044, False)):
        text = wheels(monkeypatch, ROCKS, (1 + more) * ROCKS)
        assert ("the log has one side twice" in text) is twice


def test_a_side_that_stands_for_a_fifth_of_the_way_is_dead(monkeypatch: pytest.MonkeyPatch) -> None:
    end = float(T[-1])
    rolls = 2.0 * (T - np.maximum(0.0, 2 * (T - end / 2)))
    for share, dead in ((0.27, True), (0.17, False)):
        stands = np.interp(T, [0, 12.0, 12.0 + share * end, end], [0, 24.0, 24.0, 90.0])
        for sides in ((stands, rolls), (rolls, stands)):
            text = wheels(monkeypatch, *sides)
            assert ("is its encoder dead" in text) is dead
            side = "left" if sides[0] is stands else "right"
            assert text.startswith(f"{side} stands still from 13 to 2") is dead
    slow = np.interp(T, [0, 12.0, 22.0, end], [0, 24.0, 24.0 + 10 * 1.2e-3, 90.0])
    assert "dead" not in wheels(monkeypatch, slow, rolls)


def test_a_side_that_rolls_20_times_as_far_has_another_unit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    for times, other in ((19, False), (21, True)):
        for sides in ((ROCKS, times * ROCKS), (times * ROCKS, ROCKS)):
            text = wheels(monkeypatch, *sides)
            more = "right" if sides[0] is ROCKS else "left"
            less = "left" if sides[0] is ROCKS else "right"
            fact = f"{more} rolls 21 times as far as {less}, against yaw_rate: is {more} a"
            assert text.startswith(fact) is other
            assert text.startswith("50% of the motion by yaw_rate is not that") is not other


def test_sides_that_never_turn_backwards_are_named(monkeypatch: pytest.MonkeyPatch) -> None:
    ahead = 2 * T + np.sin(T)
    for back, never in ((0.0008, True), (0.0012, False)):
        left = ahead.copy()
        left[300:] -= left[300] - left[299] + back
        text = wheels(monkeypatch, left, ROCKS)
        assert ("and left never turn backwards in this log" in text) is never
    assert "and left and right never turn backwards" in wheels(monkeypatch, ahead, 2.2 * ahead)


def test_what_the_wheels_show_counts_if_a_sensor_contradicts_them_in_any_way(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    sound = GIVEN["gyro"]
    for changes in ({"track": -1.5}, {"row": "angles"}, {"unexplained": 0.16},
                    {"bad": ((0, 10.0, 20.0),)}):  # fmt: skip
        odd = structs.replace(sound, **changes)
        assert "the log has one side twice" in wheels(monkeypatch, ROCKS, ROCKS, odd=odd)
    monkeypatch.setattr(hypotheses, "matched", lambda sensor, runs, base: sound)
    examined([structs.replace(log("gyro"), left=ROCKS, right=ROCKS)], DRIVES)


def test_columns_that_may_be_mixed_are_named_if_a_sensor_contradicts_them(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    text = wheels(monkeypatch, ROCKS, 2 * ROCKS, mixed="left and right")
    assert text.startswith("in left and right, two series of values alternate")


@pytest.mark.parametrize(
    ("bad", "left_out", "begins"),
    [
        ([(10, 20)], ["5 to 25"], [0, 25]),
        ([(10, 20), (12, 14)], ["5 to 25"], [0, 25]),
        ([(10, 12), (22, 24)], ["5 to 29"], [0, 29]),  # the margins touch
        ([(10, 12), (22.5, 24)], ["5 to 17", "18 to 29"], [0, 29]),  # less than 2 s are no part
        ([(10, 12), (24.5, 25)], ["5 to 17", "20 to 30"], [0, 17, 30]),
        ([(2, 4), (55, 60)], ["0 to 9", "50 to 62"], [9]),
    ],
)
def test_parts_that_contradict_the_wheels_are_left_out_with_a_margin_of_5_s(
    monkeypatch: pytest.MonkeyPatch, bad: list[tuple[float, float]], left_out: list[str],
    begins: list[float],
) -> None:  # fmt: skip
    spans = tuple((1, *span) for span in bad)
    shows = [structs.replace(GIVEN["gyro"], bad=spans), structs.replace(GIVEN["headings"])]
    shows[1] = structs.replace(shows[1], bad=spans[:1])
    monkeypatch.setattr(
        hypotheses, "matched", lambda sensor, runs, base: shows[sensor == "headings"]
    )
    runs = [log("gyro", "headings", name=name, drive=CARRIED) for name in "ab"]
    (whole, *parts), _, notes = examined(runs, DRIVES)
    assert whole is runs[0]
    assert notes == [
        "left out, because the sensors contradict the wheels there: "
        + ", ".join(f"{span} s of run b" for span in left_out)
    ]
    assert [part.t[0] for part in parts] == pytest.approx(begins, abs=0.06)
    assert [part.name for part in parts] == ["b", "b.2", "b.3"][: len(parts)]


def test_a_log_of_which_parts_are_left_out_needs_30_s(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(hypotheses, "matched", lambda sensor, runs, base: GIVEN["gyro"])
    assert not examined([log("gyro").part(0.0, 20.0)], DRIVES)[2]  # a short sound log is one
    run = log("gyro", drive=CARRIED)
    for end, some in ((26.5, True), (28.0, False)):
        match = structs.replace(GIVEN["gyro"], bad=((0, 0.0, end),))
        monkeypatch.setattr(hypotheses, "matched", lambda sensor, runs, base, m=match: m)
        if some:
            examined([run], DRIVES)
        else:
            with pytest.raises(LogError, match=r"^only 29 s of the log are left, because"):
                examined([run], DRIVES)


# one sensor beside the wheels


def test_a_row_of_an_impossible_robot_must_be_twice_as_clear() -> None:
    for track, possible in (
        (0.79, False),
        (0.81, True),
        (3.59, True),
        (3.61, False),
        (-1.5, False),
    ):
        assert cost(0.1, track, 0.0) == pytest.approx(0.1 if possible else 0.22)
    assert cost(0.1, 1.5, -2.0) == cost(0.1, 1.5, 2.0) == pytest.approx(0.102)
    match = Match("gyro", 0.0, 1.5, 0.5, 0.1)
    assert match.cost == pytest.approx(0.1005)
    for other in ({"track": -1.5}, {"ratio": 2.0}, {"row": "angles"}):
        assert structs.replace(match, **other).cost == pytest.approx(0.2205)


def test_errors_count_up_to_one_and_a_half_usual_sizes() -> None:
    off = np.array([0.0, 0.1, -0.149, 0.3, -0.6])
    assert weights(off, 0.1) == pytest.approx([1.0, 1.0, 1.0, 0.5, 0.25])
    assert weights(off, 0.0)[:2] == pytest.approx([1.0, 0.0], abs=1e-6)


def turning(scale: Floats, rate: float = 0.3) -> Turns:
    """Return a gyro beside wheels that turn, with a factor of the gyro for each second."""
    t: Floats = np.asarray(0.02 * np.arange(50 * len(scale) + 1), dtype=np.float64)
    rates = np.where(t // 4 % 2 < 1, rate, -rate)
    half = BASE.track / 2 / BASE.left
    factors = scale[np.minimum(t.astype(int), len(scale) - 1)]
    angle = np.concatenate(([0.0], np.cumsum(rates[:-1]) * 0.02))
    turned = np.concatenate(([0.0], np.cumsum((rates * factors)[:-1]) * 0.02))
    still, seen = np.zeros(len(t)), np.asarray(rates * factors)
    run = run_of("1", {"left right": (t, still, still), "yaw_rate": (t, seen)}, Notes())
    run = structs.replace(run, left=-half * angle, right=half * angle, turned=turned)
    return Turns("gyro", [run], BASE)


def test_the_unexplained_share_is_that_of_the_turns() -> None:
    n = np.arange(100)
    for extra, every in ((0.4, 5), (-0.3, 4)):
        match = turning(1 + extra * (n % every == 0)).match()
        off, moved = abs(extra) * (100 // every), 100 + extra * (100 // every)
        assert match.unexplained == pytest.approx(off / moved, rel=0.03)
        assert match.raw == pytest.approx(off / moved, rel=0.03)
        assert match.track == pytest.approx(1.0, abs=0.01)
        assert match.delay == 0.0
        assert not match.bad


@pytest.mark.parametrize(
    ("scale", "count", "rate", "bad"),
    [
        (-0.2, 10, 0.3, True),
        (0.0, 10, 0.17, True),  # the wheels turn alone by more than 0.15 rad in 1 s
        (0.0, 10, 0.14, False),
        (9.0, 10, 0.3, False),
        (11.0, 10, 0.3, True),  # 90 % of what the gyro shows is not explained
        (-1.0, 40, 0.3, True),
        (-1.0, 50, 0.3, False),  # more than 40 % of a log is no exception
    ],
)
def test_windows_in_which_a_sensor_moves_otherwise_are_left_out(
    scale: float, count: int, rate: float, bad: bool
) -> None:
    n = np.arange(100)
    match = turning(np.where(n < count, scale, 1.0), rate).match()
    spans = [(0, 10.0 * k, 10.0 * k + 10) for k in range(count // 10)] if bad else []
    assert [(k, round(a, 6), round(b, 6)) for k, a, b in match.bad] == spans
    # A gyro that shows nothing of a turn has no motion there that is not explained.
    assert (match.unexplained < 0.03) is (bad or scale == 0.0)


def test_a_hole_in_a_sensor_is_longer_than_8_periods_and_half_a_second() -> None:
    run = log("gyro")
    whole = int(np.isfinite(Turns("gyro", [run], BASE).seen(0.0)).sum())
    for seconds, lost in ((0.4, 0), (0.6, 1), (3.0, 4)):
        kept = ~((run.gyro_t > 20.2) & (run.gyro_t < 20.2 + seconds))
        some = structs.replace(run, gyro_t=run.gyro_t[kept], turned=run.turned[kept])
        assert np.isfinite(Turns("gyro", [some], BASE).seen(0.0)).sum() == whole - lost
    thin = structs.replace(run, gyro_t=run.gyro_t[::8], turned=run.turned[::8])
    every = int(np.isfinite(Turns("gyro", [thin], BASE).seen(0.0)).sum())
    kept = ~((thin.gyro_t > 20.2) & (thin.gyro_t < 22.8))
    thin = structs.replace(thin, gyro_t=thin.gyro_t[kept], turned=thin.turned[kept])
    assert np.isfinite(Turns("gyro", [thin], BASE).seen(0.0)).sum() == every
    assert np.isfinite(Turns("gyro", [run], BASE).seen(2.5)).sum() == whole - 3
    assert np.isfinite(Turns("gyro", [run], BASE).seen(-2.5)).sum() == whole - 3


def test_a_bias_needs_more_than_20_samples_at_rest() -> None:
    run = log("gyro").part(0.0, 30.0)
    rests = np.flatnonzero(run.rests(run.gyro_t))
    for count, known in ((20, False), (21, True)):
        some = np.append(rests[:count], np.arange(rests[-1] + 1, len(run.gyro_t)))
        few = structs.replace(run, gyro_t=run.gyro_t[some], rate=run.rate[some])
        assert gyro_bias([few])[1] == (1e-3 if known else 0.05)


def test_sides_that_differ_by_a_quarter_have_another_scale() -> None:
    for right, other in ((1.2, False), (1.3, True), (0.82, False), (0.78, True)):
        run = log("gyro", left=1 / RIGHT, right=right)  # without the ratio of the radii
        found = Turns("gyro", [run], BASE).uneven()
        assert bool(found) is other
        if found:
            assert found[0].ratio == pytest.approx(right, rel=0.01)


def test_positions_fit_the_true_path_alone() -> None:
    runs = [log("positions", lever=0.1 + 0.05j, late=0.2, name=name) for name in "ab"]
    places = Places("positions", runs, BASE)
    share, (size, ahead, aside), off = places.fitted(1 / RIGHT, TRACK, 0.2)
    assert (size, ahead, aside) == pytest.approx((SIZE * RIGHT / 1.005, 0.1, 0.05), abs=0.01)
    assert share < 0.01
    assert np.median(off) < 0.004
    assert len(off) == 2 * len(runs[0].place)
    for ratio, track, delay in ((-1.0, TRACK, 0.2), (1.0, 1.2 * TRACK, 0.2), (1.0, TRACK, 0.5)):
        assert places.fitted(ratio, track, delay)[0] > 3 * share
    assert places.window_s == 10.0
    assert Places("positions", [log("positions", hz=0.5)], BASE).window_s == pytest.approx(20.0)


STEADY = np.repeat([2.0, 0.0, -1.0, 3.0], 100)


def test_two_levels_beside_a_steady_series_are_two_writers() -> None:
    noise = np.random.default_rng(2).normal(0, 0.01, len(STEADY))
    by_turns_of_ten = np.arange(len(STEADY)) // 10 % 2 < 1
    for factor in (0.0, 0.5, -1.0, 2.0):
        mixed = STEADY * np.where(by_turns_of_ten, factor, 1.0) + noise
        low, high = sorted((factor, 1.0))
        levels = in_blocks(mixed, STEADY)
        assert levels
        assert (levels.low, levels.high) == pytest.approx((low, high), abs=0.01)
        assert 20 <= levels.changes < 30
    assert in_blocks(STEADY + noise, STEADY) is None
    # The factor changes with the other series, as of tyres that slip: four times are no proof.
    slips = STEADY * np.where(STEADY > 1.0, 0.5, 1.0)
    assert in_blocks(slips + noise, STEADY) is None
    assert in_blocks(STEADY[:10], STEADY[:10]) is None
    assert in_blocks(STEADY[:0], STEADY[:0]) is None


def test_sides_that_jump_by_one_factor_in_the_same_rows_are_of_two_writers() -> None:
    rng = np.random.default_rng(2)
    sides = np.array([np.full(400, 2.0), np.full(400, 3.0)]) * (
        1 + 0.01 * rng.normal(size=(2, 400))
    )
    other = rng.random(400) < 0.3
    assert not by_chance(sides)
    for factor in (0.0, 0.5, -1.0, 3.0):
        assert by_chance(sides * np.where(other, factor, 1.0))
    assert not by_chance(sides * np.where(other, [[0.5], [1.0]], 1.0))  # one side alone
    assert not by_chance(sides + np.where(other, 1.0, 0.0))  # a step, as of a coarse encoder
    assert not by_chance(sides * np.where(other, rng.uniform(0.3, 0.8, 400), 1.0))
    assert not by_chance((sides * np.where(other, 0.5, 1.0))[:, :60])
    alike = np.array([sides[0], sides[0]])
    assert not by_chance(alike * np.where(other, 0.5, 1.0))  # coarse encoders step together
    assert not by_chance(np.zeros((2, 0)))


def test_series_that_alternate_by_turns_are_two() -> None:
    rng = np.random.default_rng(2)
    speeds = np.repeat(rng.uniform(0.05, 3.0, 40), 25)
    for period, others in ((2, [1]), (3, [1]), (4, [2, 3]), (7, [0, 3])):
        second = np.isin(np.arange(len(speeds)) % period, others)
        assert by_turns(np.where(second, 0.5 * speeds, speeds))
    assert not by_turns(speeds)
    assert not by_turns(speeds + 0.3 * rng.normal(size=len(speeds)))
    # A coarse encoder jumps by one step at any speed.
    assert not by_turns(np.diff(np.floor(np.cumsum(speeds))))
    assert not by_turns(speeds[:20])


def test_the_configured_geometry_is_the_base() -> None:
    drive = DriveConfig(wheel_separation_multiplier=1.5, left_wheel_radius_multiplier=0.9)
    base = Base.of(drive)
    assert base.track == pytest.approx(1.5 * drive.wheel_separation)
    assert base.left == pytest.approx(0.9 * drive.wheel_radius)
    assert base.right == pytest.approx(Config().drive.wheel_radius)
