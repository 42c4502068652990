"""A report has the recorded data, the speeds of the replayed robot, and the counts of the lines."""

from __future__ import annotations

import math
from itertools import pairwise

import pytest

from acsard.core.values import NS_PER_S
from acsard.recording.recorded_steps import US_PER_S
from acsard.report.report_data import FIRST, LAST, Mark, Marks, SerialCounts, StepLateness
from acsard.report.report_text import Origin, notes
from tests.scenarios.world import START, World
from tests.unit.report.driven import drive_of_two, report_from, report_of

ORIGIN = Origin("a.mcap", "r", "1", "3")


def test_the_path_and_its_length_are_the_recorded_poses() -> None:
    report, steps = drive_of_two()
    poses = [pose for step in steps for pose in step.recorded.poses]
    way = sum(math.hypot(b[0] - a[0], b[1] - a[1]) for a, b in pairwise(poses)) / US_PER_S
    assert report.metres == pytest.approx(way)
    last = report.path.places()[-1]
    assert (last.x, last.y, last.yaw) == tuple(value / US_PER_S for value in poses[-1])


def test_the_commanded_limited_and_measured_speeds_are_drawn() -> None:
    report, _ = drive_of_two()
    top = {name: max(p.value for p in curve.points()) for name, curve in report.linear.items()}
    low = {name: min(p.value for p in curve.points()) for name, curve in report.angular.items()}
    assert (top["commanded"], low["commanded"]) == (0.5, -0.8)
    assert top["limited"] == pytest.approx(0.5)
    assert low["limited"] == pytest.approx(-0.8)
    assert top["measured"] == report.fastest.linear
    assert report.fastest.angular == -low["measured"]
    assert top["measured"] == pytest.approx(0.5, rel=0.05)


def test_the_measured_speed_of_each_wheel_follows_its_command() -> None:
    report, _ = drive_of_two()
    for asked, turned in zip(report.commanded_wheels, report.measured_wheels, strict=True):
        most = max(point.value for point in asked.points())
        assert max(point.value for point in turned.points()) == pytest.approx(most, rel=0.05)
    right, left = (
        max(p.value for p in report.commanded_wheels[wheel].points()) for wheel in (0, 1)
    )
    assert right > left  # the robot turned left


def test_without_a_line_the_curves_have_a_gap() -> None:
    def unplugged(world: World) -> None:
        world.drive(0.5, seconds=0.6)
        world.port.unplug()
        world.run(1.0)
        world.port.plug(world.mcu)
        world.run(0.5)

    report, _ = report_of(unplugged)
    for curve in (report.linear["measured"], report.linear["limited"], report.commanded_wheels[0]):
        points = curve.points()
        gap = next(at for at, p in enumerate(points) if math.isnan(p.value) and p.t > 0.5)
        assert points[gap + 1].t - points[gap].t > 0.6


def test_the_bands_of_the_mode_are_the_recorded_modes() -> None:
    report, steps = drive_of_two()
    modes = [span.kind for span in report.modes.spans()]
    recorded = [step.recorded.status[0] for step in steps]
    changes = [recorded[0], *[b for a, b in pairwise(recorded) if a != b]]
    assert [kind for at, kind in enumerate(modes) if not at or kind != modes[at - 1]] == changes
    assert "stopped by unnamed (native) at 2027-01-15 08:00" in next(
        s.words for s in report.modes.spans() if s.kind == "stopped"
    )


def test_each_source_has_its_distance_and_duration() -> None:
    report, steps = drive_of_two()
    assert set(report.driven) == {"nav", "teleop"}
    driving = sum(
        b.inputs.now.mono_ns - a.inputs.now.mono_ns
        for a, b in pairwise(steps)
        if b.recorded.status[0] == "driving"
    )
    assert sum(drive.seconds for drive in report.driven.values()) == pytest.approx(driving / 1e9)
    assert 0.0 < sum(drive.metres for drive in report.driven.values()) <= report.metres


def test_a_mark_has_the_client_and_the_place_of_its_event() -> None:
    report, _ = drive_of_two()
    (stop,) = [mark for mark in report.marks.all() if mark.name == "stop"]
    assert stop.by == "unnamed (native)"
    assert stop.place is not None
    assert stop.place.x > 0.3
    assert [mark.t for mark in report.marks.all()] == sorted(m.t for m in report.marks.all())


def test_the_first_and_last_events_of_a_frequent_name_are_kept() -> None:
    marks = Marks()
    for n in range(1000):
        marks.add(Mark(float(n), "stop", "stopped", "info", "joe", 2, None, float(n)))
    marks.add(Mark(500.5, "fault", "a wheel", "error", "", 1, None, 500.5))
    stops = [mark.t for mark in marks.all() if mark.name == "stop"]
    assert stops == [*range(FIRST), *range(1000 - LAST, 1000)]
    assert marks.left_out == 1000 - FIRST - LAST
    assert marks.counts == {"stop": 2000, "fault": 1}


def test_events_of_one_time_keep_their_order() -> None:
    marks = Marks()
    for number in range(2 * FIRST):
        for name in ("drive", "mode"):
            marks.add(Mark(0.0, name, str(number), "info", "", 1, None, 0.0))
    names = [mark.name for mark in marks.all()]
    assert names == ["drive", "mode"] * (2 * FIRST)


def test_the_last_marks_are_the_drive_that_goes_on_and_the_ending() -> None:
    _, steps = drive_of_two()
    report = report_from(steps[: len(steps) // 3], ending="the disk accepted no more data")
    drive, cut = report.marks.all()[-2:]
    assert (drive.name, drive.text[:13]) == ("drive", "was driving, ")
    assert (cut.name, cut.text) == ("cut", "the disk accepted no more data")


def test_the_events_of_a_clock_that_was_set_have_the_time_of_the_clock() -> None:
    def set_back(world: World) -> None:
        world.run(1.0)
        world.wall_offset_ns -= 3600 * NS_PER_S
        world.call("stop")
        world.run(0.5)

    report, steps = report_of(set_back)
    (stop,) = [mark for mark in report.marks.all() if mark.name == "stop"]
    assert stop.seconds == pytest.approx(START.wall_ns / NS_PER_S - 3600 + 1.0, abs=0.1)
    assert stop.t == pytest.approx(1.0, abs=0.1)
    assert report.ended == steps[-1].inputs.now.wall_ns / NS_PER_S
    assert any("was set during this recording" in note for note in notes(report, ORIGIN))


@pytest.mark.slow
def test_a_pose_that_was_set_adds_no_distance() -> None:
    def set_away(world: World) -> None:
        world.drive(0.3, seconds=0.3)
        world.call("set_pose", b'{"x": 100.0, "y": 0.0, "yaw": 0.0}')
        world.run(0.2)

    report, _ = report_of(set_away)
    assert report.metres < 1.0
    # the first place counts as new too
    assert [place.new for place in report.path.places()].count(True) == 2


@pytest.mark.slow
def test_only_steps_of_the_time_window_are_collected() -> None:
    _, steps = drive_of_two()
    begin = START.wall_ns / 1e9 + 1.0
    report = report_from(steps, begin=begin, end=begin + 0.9)
    assert report.began == pytest.approx(begin, abs=0.02)
    assert report.seconds == pytest.approx(0.9, abs=0.03)
    assert set(report.driven) == {"nav"}
    assert "stop" not in report.marks.counts
    assert report.linear["measured"].points()[0].value == pytest.approx(0.5, rel=0.1)
    assert report_from(steps, begin=begin + 1e6).began is None


@pytest.mark.slow
def test_missing_steps_are_counted() -> None:
    _, steps = drive_of_two()
    report = report_from(steps[:200] + steps[260:])
    assert report.missing == 60
    assert report.marks.counts["gap"] == 1


MS = 1_000_000


def linked(answers: dict[int, int], seconds: int = 10, in_flight: int = 0) -> SerialCounts:
    """Return the line counts of a link with 100 lines a second in each direction.

    `answers` maps a second to another number of received lines.
    """
    link, sent, good = SerialCounts(), 0, 0.0
    for n in range(100 * seconds):
        second = n // 100
        sent, good = sent + 1, good + answers.get(second, 100) / 100
        link.step(n / 100, True, {"lines": max(0, round(good) - in_flight), "line_header": 0})
    link.end()
    return link


def test_a_good_serial_port_loses_no_line() -> None:
    for in_flight in (0, 1):
        link = linked({}, in_flight=in_flight)
        assert link.unanswered.total == 0
        assert [point.value for point in link.sent.curve.points()] == [100.0] * 10


def test_lost_lines_are_counted_in_their_second() -> None:
    link = linked({4: 70})
    lost = {int(point.t): point.value for point in link.unanswered.curve.points()}
    assert link.unanswered.total == 30
    # The newest line of a second counts once another one has report_from it.
    assert lost[4] + lost[5] == 30
    assert {second: count for second, count in lost.items() if count and second not in (4, 5)} == {}


def test_unreadable_lines_count_as_dropped_and_not_as_lost() -> None:
    link = SerialCounts()
    for n in range(300):
        bad = n // 10
        counters = {"lines": n + 1 - bad, "line_header": bad - bad // 2, "line_value": bad // 2}
        link.step(n / 100, True, counters)
    link.end()
    assert (link.sent.total, link.unanswered.total) == (300, 0)
    assert link.good.total + link.dropped.total == 299  # the first line had already arrived


def test_an_implausible_line_counts_as_dropped() -> None:
    link = SerialCounts()
    link.step(0.0, True, {"lines": 0})
    link.step(0.5, True, {"lines": 2, "line_implausible": 1})
    link.end()
    assert (link.good.total, link.dropped.total) == (1, 1)


def late(lates: list[float], ahead: frozenset[int] = frozenset()) -> StepLateness:
    """Return the lateness of periods of 10 ms, each late by this many ms.

    In the periods of `ahead` the daemon has already sent a line at once for a new command.
    """
    lateness, number = StepLateness(100.0), 0
    for n, ms in enumerate(lates):
        if n in ahead:
            lateness.at_once()
            continue
        lateness.tick(n / 100, round(n * 10 * MS + ms * MS), 0, known=True)
        number += 1
    return lateness


def test_lateness_is_relative_to_the_smallest_delay() -> None:
    values = [point.value for point in late([0.3, 0.1, 7.1, 0.1, 9.6, 0.1]).points()]
    assert values == pytest.approx([0.2, 0.0, 7.0, 0.0, 9.5, 0.0])


def test_a_line_that_was_sent_immediately_makes_no_period_late() -> None:
    assert late([0.0] * 50, ahead=frozenset({7, 8, 20})).most_ms == pytest.approx(0.0)


@pytest.mark.parametrize("at_once", [False, True])
def test_lateness_counts_from_the_first_missed_period(at_once: bool) -> None:
    lateness = StepLateness(100.0)
    for n in range(10):
        lateness.tick(n / 100, n * 10 * MS, 0, known=True)
    if at_once:  # it replaces the first missed line
        lateness.at_once()
    lateness.tick(0.132, 132 * MS, 3, known=True)
    lateness.tick(0.14, 140 * MS, 0, known=True)
    assert lateness.missed == 3
    assert lateness.most_ms == pytest.approx(32.0)
    assert lateness.points()[-1].value == pytest.approx(0.0)


def test_missing_steps_do_not_count_as_lateness() -> None:
    lateness = StepLateness(100.0)
    lateness.tick(0.0, 0, 0, known=True)
    lateness.tick(60.0, 60_000 * MS, 2, known=False)
    lateness.tick(60.01, 60_010 * MS, 0, known=True)
    assert lateness.most_ms == pytest.approx(0.0)
