"""Tests of the sources in a report: each one drives, waits, or sends refused commands."""

from __future__ import annotations

import math

import pytest

from acsard.core.messages.encodings import encode
from acsard.core.messages.schema import Twist, Vector3
from acsard.core.messages.signature import Signature
from acsard.core.motion.arbiter_text import OBJECTIONS
from acsard.core.thinning import Span
from acsard.recording.state import thaw
from acsard.report.command_sources import OTHER_SOURCES
from tests.scenarios.taped import recorded_world
from tests.scenarios.world import World
from tests.unit.report.driven import drive_of_two, report_from, report_of


def spans(source: str) -> list[Span]:
    report, _ = drive_of_two()
    return report.sources.bands[source].spans()


@pytest.mark.slow
def test_the_driving_source_is_the_recorded_one() -> None:
    report, steps = drive_of_two()
    for name in ("nav", "teleop"):
        drives = [(s.begin, s.end) for s in spans(name) if s.kind == "drives"]
        seconds = sum(end - begin for begin, end in drives)
        assert abs(seconds - report.driven[name].seconds) < 0.05
    recorded = {step.recorded.status[3] for step in steps if step.recorded.status[0] == "driving"}
    drew = {n for n, b in report.sources.bands.items() for s in b.spans() if s.kind == "drives"}
    assert drew == recorded == {"nav", "teleop"}


def test_a_waiting_source_names_the_source_that_it_waits_for() -> None:
    (wait,) = [span for span in spans("nav") if span.kind == "waits"]
    assert wait.words == "teleop has priority: wait until it is silent"
    assert 1.5 < wait.end - wait.begin < 2.5


def test_a_source_that_sends_during_a_fault_has_only_the_fault_as_reason() -> None:
    def dead(world: World) -> None:
        world.drive(0.5, seconds=0.4)
        with world.mcu.dead_motor(0):
            world.hold(0.5, 0.4, seconds=1.2)

    report, _ = report_of(dead)
    (fault,) = [span for span in report.modes.spans() if span.kind == "fault"]
    segments = [s for s in report.sources.bands["app"].spans() if s.begin > fault.begin]
    assert {(span.kind, span.words) for span in segments} == {("sends", f"fault: {fault.words}")}


def test_a_source_that_is_not_configured_is_refused_among_the_others() -> None:
    (refused,) = spans(OTHER_SOURCES)
    assert refused.kind == "refused"
    assert refused.words == "this source is not in commands.sources"


def test_an_invalid_message_is_refused_with_its_reason() -> None:
    def garbled(world: World) -> None:
        world.drive(0.0, seconds=0.2, source="nav")
        world.run(0.3)
        world.put("cmd/app", b'{"linear": {"x": "fast"}}')
        world.run(0.5)

    report, _ = report_of(garbled)
    (refused,) = [s for s in report.sources.bands["app"].spans() if s.kind == "refused"]
    assert refused.words.startswith("cmd/app: ")
    assert 0.2 < refused.end - refused.begin < 0.5


def put(world: World, sequence: int) -> None:
    """Send a zero with a sequence number. The robot refuses it after a newer command."""
    signed = Signature("a/b", sequence=sequence).pack()
    world.put("cmd/app", encode(Twist(Vector3(), Vector3()), "json"), attachment=signed)
    world.run(0.05)


def test_a_report_of_a_later_file_does_not_give_the_reasons_of_earlier_refusals() -> None:
    tape, world = recorded_world()
    world.send(0.1, 0.0, "stranger")
    put(world, 1)
    put(world, 2)
    tape.cut = True
    world.run(0.5)
    put(world, 1)
    ((first, state),) = tape.states.items()
    report = report_from(tape.steps(first), state=thaw(state))
    (refused,) = [s for s in report.sources.bands["app"].spans() if s.kind == "refused"]
    assert refused.words == OBJECTIONS["stale"]


def test_the_refusal_of_a_command_has_no_reason_of_an_earlier_step_without_commands() -> None:
    def delayed(world: World) -> None:
        put(world, 1)
        world.put("cmd/nav", encode(Twist(Vector3(math.nan), Vector3()), "msgpack"))
        world.run(0.5)
        assert world.state.counters["command_not_finite"] == 1
        put(world, 0)

    report, _ = report_of(delayed)
    (refused,) = [s for s in report.sources.bands["app"].spans() if s.kind == "refused"]
    assert refused.words == OBJECTIONS["stale"]


def test_a_source_that_never_sent_has_no_band() -> None:
    assert spans("ros2_control") == []
