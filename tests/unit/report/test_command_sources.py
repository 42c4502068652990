"""Tests of the commanders in a report: the one that drives, those that wait, and those refused."""

from __future__ import annotations

from acsard.core.thinning import Span
from acsard.report.command_sources import OTHERS
from tests.scenarios.world import World
from tests.unit.report.driven import course_of, drive_of_two


def spans(source: str) -> list[Span]:
    course, _ = drive_of_two()
    return course.sources.bands[source].spans()


def test_who_drives_is_who_the_recording_says_drives() -> None:
    course, steps = drive_of_two()
    for name in ("nav", "teleop"):
        drives = [(s.begin, s.end) for s in spans(name) if s.kind == "drives"]
        seconds = sum(end - begin for begin, end in drives)
        assert abs(seconds - course.driven[name].seconds) < 0.05
    recorded = {step.recorded.status[3] for step in steps if step.recorded.status[0] == "driving"}
    drew = {n for n, b in course.sources.bands.items() for s in b.spans() if s.kind == "drives"}
    assert drew == recorded == {"nav", "teleop"}


def test_who_waits_says_for_whom() -> None:
    (wait,) = [span for span in spans("nav") if span.kind == "waits"]
    assert wait.words == "teleop has priority: wait until it is silent"
    assert 1.5 < wait.end - wait.begin < 2.5


def test_who_sends_to_a_robot_in_fault_reads_the_fault_and_no_other_reason() -> None:
    def dead(world: World) -> None:
        world.drive(0.5, seconds=0.4)
        with world.mcu.dead_motor(0):
            world.hold(0.5, 0.4, seconds=1.2)

    course, _ = course_of(dead)
    (fault,) = [span for span in course.modes.spans() if span.kind == "fault"]
    said = [s for s in course.sources.bands["app"].spans() if s.begin > fault.begin]
    assert {(span.kind, span.words) for span in said} == {("sends", f"fault: {fault.words}")}


def test_a_source_in_no_list_is_refused_among_the_others() -> None:
    (refused,) = spans(OTHERS)
    assert refused.kind == "refused"
    assert refused.words == "not one of commands.sources"


def test_a_message_that_is_none_is_refused_with_its_reason() -> None:
    def garbled(world: World) -> None:
        world.drive(0.0, seconds=0.2, source="nav")
        world.run(0.3)
        world.put("cmd/app", b'{"linear": {"x": "fast"}}')
        world.run(0.5)

    course, _ = course_of(garbled)
    (refused,) = [s for s in course.sources.bands["app"].spans() if s.kind == "refused"]
    assert refused.words.startswith("cmd/app: ")
    assert 0.2 < refused.end - refused.begin < 0.5


def test_who_never_sent_has_no_band() -> None:
    assert spans("ros2_control") == []
