"""Tests of a recording's timeline in sentences."""

from __future__ import annotations

import math

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config, McuConfig
from acsard.core.messages.signature import Signature, public_name
from acsard.core.values import Received
from acsard.recording.rows import decode, encode
from acsard.recording.timeline import (
    ReasonChanges,
    TimelineEntry,
    TimelineWriter,
    entry_of,
    is_serious,
    summary,
)
from tests.scenarios.taped import Tape, recorded_world
from tests.scenarios.world import World

BOARD = Config(mcu=McuConfig(port="/dev/ttyACM0"))


def story(tape: Tape, without: range = range(0)) -> list[TimelineEntry]:
    teller = TimelineWriter()
    steps = [s for s in decode(encode(0, tape.taken)) if s.number not in without]
    return [entry for step in steps for entry in teller.step(step)]


def driven() -> Tape:
    tape, world = recorded_world()
    world.drive(0.5, seconds=2.0)
    world.call("stop")
    world.run(0.5)
    world.loop.shutting_down = True
    world.run(0.1)
    return tape


def test_a_pose_that_is_set_during_a_drive_is_no_distance() -> None:
    tape, world = recorded_world()
    world.drive(0.5, seconds=1.0)
    world.call("set_pose", b'{"x": 100.0, "y": 0.0, "yaw": 0.0}')
    world.hold(0.5, seconds=1.0)
    world.send(0.0)
    world.run(1.0)
    (drive,) = [entry for entry in story(tape) if entry.name == "drive"]
    assert drive.text.startswith("drove 0.9")


def test_a_recording_that_continues_another_begins_with_what_the_robot_does() -> None:
    tape, world = recorded_world()
    world.drive(0.5, 0.2, seconds=2.0)
    number = len(tape.taken) - 100
    writer, steps = TimelineWriter(), decode(encode(number, tape.taken[number:]))
    entry, *others = [entry for step in steps for entry in writer.step(step)]
    x, y, yaw = next(pose for step in steps for pose in step.recorded.poses)
    assert entry.name == "continues"
    assert entry.seconds == steps[0].inputs.now.wall_ns / 1e9
    assert entry.by == "app"
    assert f"x {x / 1e6:.2f} m, y {y / 1e6:.2f} m" in entry.text
    assert f"yaw {math.degrees(yaw / 1e6):.1f} deg" in entry.text
    assert "continues" not in [other.name for other in others]
    assert "continues" not in [entry.name for entry in story(tape)]


def test_without_a_link_a_recording_that_continues_another_begins_without_a_pose() -> None:
    tape, world = recorded_world(BOARD, plugged=False)
    world.run(4.0)
    first, writer = 50, TimelineWriter()
    entries = [
        entry for step in decode(encode(first, tape.taken[first:])) for entry in writer.step(step)
    ]
    (entry,) = [entry for entry in [*entries, *writer.end()] if entry.name == "continues"]
    assert entry is entries[0]
    assert " m, " not in entry.text


def test_a_drive_that_has_ended_has_no_second_entry() -> None:
    tape, writer = driven(), TimelineWriter()
    for step in decode(encode(0, tape.taken)):
        list(writer.step(step))
    assert not list(writer.end())


def stopped_by_neutral_first() -> Tape:
    """Return a drive that is stopped, and whose sender then sends speeds without a zero."""
    tape, world = recorded_world()
    world.drive(0.5, seconds=1.0)
    world.call("stop")
    world.run(1.0)
    world.call("clear")
    world.run(0.3)
    world.hold(0.5, seconds=2.5)
    world.run(1.0)
    return tape


def two_senders(world: World, first: str, second: str, seconds: float = 3.0) -> None:
    """Drive with the source `first`, while another sender sends speeds to the source `second`."""
    world.drive(0.5, seconds=1.0, source=first)
    for _ in range(round(seconds * 20)):
        world.send(0.5, source=first)
        payload, sender = b'{"linear": {"x": 0.3}, "angular": {}}', Signature("eve").pack()
        world.put(f"cmd/{second}", payload, attachment=sender)
        world.run(0.05)


def waits(first: str, second: str, seconds: float = 3.0) -> list[TimelineEntry]:
    """Return the entries about a sender that must wait."""
    tape = Tape()
    two_senders(World(recorder=tape), first, second, seconds)
    timeline = TimelineWriter(Config())
    entries = [entry for step in tape.steps() for entry in timeline.step(step)]
    return [entry for entry in entries if entry.name == "waits"]


@pytest.mark.slow
def test_a_sender_that_waits_for_the_same_source_has_one_entry() -> None:
    (entry,) = waits("app", "app")
    assert entry.by == f"app ({public_name('eve')})"
    assert public_name("somebody") in entry.text


@pytest.mark.slow
def test_a_sender_of_an_unknown_source_has_no_entry() -> None:
    """The robot refuses the sender's commands, and the log already has an event for this."""
    assert waits("nav", "stranger") == []


@pytest.mark.slow
def test_senders_under_many_names_make_an_entry_a_second() -> None:
    tape, world = recorded_world()
    world.drive(0.5, seconds=1.0, source="teleop")
    for number in range(60):
        world.send(0.5, source="teleop")
        for name in range(8):
            payload = b'{"linear": {"x": 0.3}, "angular": {}}'
            world.put("cmd/app", payload, attachment=Signature(f"{name}").pack())
            world.put("cmd/app", payload, attachment=Signature(f"{number} {name}").pack())
        world.run(0.05)
    timeline = TimelineWriter(Config())
    entries = [entry for step in tape.steps() for entry in timeline.step(step)]
    assert 1 <= len([entry for entry in entries if entry.name == "waits"]) <= 3


def test_a_sender_that_waits_for_less_than_a_second_has_no_entry() -> None:
    assert waits("teleop", "app", 0.8) == []


def test_a_sender_that_alone_sends_speeds_has_no_waiting_entry() -> None:
    assert "waits" not in [entry.name for entry in story(driven())]


@pytest.mark.slow
def test_a_link_that_is_lost_briefly_has_the_reason_of_its_event_only() -> None:
    tape = Tape()
    checked = McuConfig(port="/dev/ttyACM0", link_check="auto", encoder_counts=3200)
    world = World(Config(mcu=checked), recorder=tape)
    world.run(0.5)
    world.drive(0.5, seconds=1.0)
    world.stall(0.6)
    world.run(1.0)
    entries = [entry for entry in story(tape) if entry.name in ("reason", "link_late", "mode")]
    late = next(n for n, entry in enumerate(entries) if entry.name == "link_late")
    lost, back = entries[late + 1 : late + 3]
    assert (lost.name, back.name) == ("mode", "mode")


def restarted(identity: bytes) -> list[TimelineEntry]:
    """Return the timeline after a board was silent and then sent `identity` in two pieces."""
    tape, world = recorded_world(BOARD)
    world.run(1.0)
    with world.mcu.mute():
        world.run(0.5)
        for data in (identity[:40], identity[40:]):
            world.port.feed(Received(world.instant, data))
            world.run(0.05)
    world.run(1.0)
    return story(tape)


def test_a_board_that_names_itself_again_and_again_has_an_entry_a_second() -> None:
    entries = restarted(50 * b"!acsard-mcu 1 reset=pin\r\n")
    assert len([entry for entry in entries if entry.name == "board"]) == 1


def test_a_restart_that_the_robot_reports_has_no_second_entry() -> None:
    tape, world = recorded_world(BOARD)
    world.run(1.0)
    world.port.feed(Received(world.instant, b"!acsard-mcu 1 reset=pin\r\n"))
    world.run(1.0)
    names = [entry.name for entry in story(tape)]
    assert "mcu_restarted" in names
    assert "board" not in names


def test_reasons_that_alternate_in_every_step_make_an_entry_a_second() -> None:
    steps, changes = stopped_by_neutral_first().steps()[-500:], ReasonChanges()
    entries = list[TimelineEntry]()
    for number, step in enumerate(steps):
        status = ("ready", "a reason", "up", "", "late" if number % 2 else "proof")
        entries += changes.step(replace(step, recorded=replace(step.recorded, status=status)))
    seconds = (steps[-1].inputs.now.wall_ns - steps[0].inputs.now.wall_ns) / 1e9
    assert seconds - 1 < len(entries) <= seconds + 1


def test_reasons_with_the_same_code_and_source_are_one_reason() -> None:
    step, changes = driven().steps()[-1], ReasonChanges()

    def entries(source: str, reason: str, seconds: float) -> list[TimelineEntry]:
        now = replace(step.inputs.now, mono_ns=step.inputs.now.mono_ns + int(seconds * 1e9))
        recorded = replace(step.recorded, status=("ready", reason, "up", source, "late"))
        inputs = replace(step.inputs, now=now)
        return [*changes.step(replace(step, inputs=inputs, recorded=recorded))]

    assert not entries("app1", "app1 has sent speeds for over 2 s", 0.0)
    assert not entries("app1", "app1 has sent speeds for over 4.5 s", 5.0)
    assert len(entries("app2", "app2 has sent speeds for over 5 s", 10.0)) == 1


def test_a_host_stall_is_not_called_a_silence_of_the_board() -> None:
    tape, world = recorded_world(BOARD)
    world.drive(0.5, seconds=1.0)
    with world.mcu.mute():
        world.run(0.05)
        world.stall(0.2)
        world.run(0.05)
    world.hold(0.5, seconds=1.0)
    with world.mcu.mute():
        world.run(0.2)
    entries = [entry for entry in story(tape) if entry.name in ("link_stale", "link_late")]
    late, stale = entries
    assert (late.name, stale.name) == ("link_late", "link_stale")
    assert summary(entries) == "1 computer stall, 1 board silence"


def test_lines_during_a_silence_do_not_count_as_another_silence() -> None:
    tape, world = recorded_world(BOARD)
    world.run(1.0)
    with world.mcu.mute():
        world.run(5.0)
    world.run(1.0)
    entries = story(tape)
    assert [item.name for item in entries if item.name in ("link_stale", "link_heard")] == [
        "link_stale", "link_heard"
    ]  # fmt: skip
    events = [item for _, outputs, _ in tape.taken for item in outputs.events]
    assert summary([entry_of(item, 1) for item in events]) == "1 board silence"


def test_missing_steps_are_reported() -> None:
    gaps = [entry.text for entry in story(driven(), range(100, 160)) if entry.name == "gap"]
    assert gaps == ["60 steps are missing before this step (0.3 s)"]


def test_a_pressed_emergency_stop_is_a_serious_incident_but_its_release_is_not() -> None:
    events = [
        TimelineEntry(1.0, "emergency_stop", "pressed", "error"),
        TimelineEntry(2.0, "emergency_stop_released", "released"),
    ]
    assert summary(events) == "1 emergency stop"
    assert is_serious(events)
    assert not is_serious(events[1:])
    assert not is_serious([TimelineEntry(1.0, "wheel_fault", "a fault", "warning", "fault")])


def test_a_pressed_bumper_is_a_serious_incident_but_its_release_is_not() -> None:
    events = [TimelineEntry(1.0 + i, "bumper_pressed", "pressed", "error") for i in range(2)]
    events.append(TimelineEntry(3.0, "bumper_released", "released"))
    assert summary(events) == "2 bumper hits"
    assert is_serious(events)


def test_a_battery_stop_is_a_serious_incident_but_another_level_is_not() -> None:
    events = [
        TimelineEntry(1.0, "battery", "21.50 V", "warning"),
        TimelineEntry(2.0, "battery_stop", "20.90 V", "error"),
    ]
    assert summary(events) == "1 battery stop"
    assert is_serious(events)


def test_a_summary_does_not_count_the_recovery_of_a_wheel_as_a_fault() -> None:
    left_out = TimelineEntry(1.0, "wheel_fault", "left out: ...", "warning")
    assert summary([left_out, TimelineEntry(5.0, "wheel_fault", "again: ...")]) == "1 wheel fault"


def test_a_summary_names_the_client_that_stopped_the_robot_and_counts_the_incidents() -> None:
    events = [
        TimelineEntry(1.0, "stop", "stopped", by="joe"),
        TimelineEntry(2.0, "stop", "stopped", by="joe"),
        TimelineEntry(2.5, "mode", "driving"),
        TimelineEntry(3.0, "fault", "a wheel", "error"),
        TimelineEntry(4.0, "command_refused", "old", count=7),
        TimelineEntry(5.0, "link_stale", "silent", "warning", count=2),
        TimelineEntry(6.0, "link_down", "gone", "warning", count=2),
        TimelineEntry(7.0, "mcu_restarted", "has restarted", "warning", count=2),
    ]
    assert summary(events) == (
        "2 stops, 1 fault, 7 refused commands, 2 board silences, 2 lost ports, 2 board restarts "
        "(stopped by joe)"
    )
    assert summary([]) == ""
    assert summary([], starts=True) == "start"
    assert summary([TimelineEntry(1.0, "fault", "a wheel")], starts=True) == "start, 1 fault"
