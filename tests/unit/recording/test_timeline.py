"""Tests of a recording's timeline in sentences."""

from __future__ import annotations

from msgspec.structs import replace

from acsard.core.config.settings import Config, McuConfig
from acsard.recording.rows import decode, encode
from acsard.recording.timeline import (
    ReasonChanges,
    TimelineEntry,
    TimelineWriter,
    entry_of,
    summary,
)
from tests.scenarios.taped import Tape
from tests.scenarios.world import World

BOARD = Config(mcu=McuConfig(port="/dev/ttyACM0"))


def story(tape: Tape, without: range = range(0)) -> list[TimelineEntry]:
    teller = TimelineWriter()
    steps = [s for s in decode(encode(0, tape.taken)) if s.number not in without]
    return [one for step in steps for one in teller.step(step)]


def driven() -> Tape:
    tape = Tape()
    world = World(recorder=tape)
    world.drive(0.5, seconds=2.0)
    world.call("stop")
    world.run(0.5)
    world.loop.shutting_down = True
    world.run(0.1)
    return tape


def test_the_timeline_has_the_start_each_drive_and_the_end() -> None:
    tape = driven()
    told = story(tape)
    assert (told[0].name, told[-1].name) == ("start", "end")
    (drive,) = [one for one in told if one.name == "drive"]
    assert drive.by == "app"
    assert drive.text == "drove 0.85 m in 2.0 s"
    assert "stop" in [one.name for one in told]
    assert [one.seconds for one in told] == sorted(one.seconds for one in told)


def test_a_drive_that_goes_on_at_the_last_step_has_an_entry() -> None:
    tape = Tape()
    World(recorder=tape).drive(0.5, seconds=1.3)
    writer, steps = TimelineWriter(), decode(encode(0, tape.taken))
    assert not [one for step in steps for one in writer.step(step) if one.name == "drive"]
    (drive,) = writer.end()
    assert (drive.name, drive.by, drive.text[:13]) == ("drive", "app", "was driving, ")
    assert drive.text.endswith(" m in 1.3 s so far")
    assert drive.seconds == steps[-1].inputs.now.wall_ns / 1e9


def test_a_drive_that_has_ended_has_no_second_entry() -> None:
    tape, writer = driven(), TimelineWriter()
    for step in decode(encode(0, tape.taken)):
        list(writer.step(step))
    assert not list(writer.end())


def held_by_neutral_first() -> tuple[Tape, float]:
    """Return a drive after whose stop the sender sends speeds for 2.5 s without a zero.

    Also returns the wall-clock time at which these speeds begin, s.
    """
    tape = Tape()
    world = World(recorder=tape)
    world.drive(0.5, seconds=1.0)
    world.call("stop")
    world.run(1.0)
    world.call("clear")
    world.run(0.3)
    began = tape.taken[-1].inputs.now.wall_ns / 1e9
    world.hold(0.5, seconds=2.5)
    world.run(1.0)
    return tape, began


def test_a_reason_that_changes_without_the_mode_has_an_entry() -> None:
    tape, began = held_by_neutral_first()
    held, silent = [one for one in story(tape) if one.name == "reason"]
    sentence = "ready: send a zero first: app must send a zero before it can drive"
    assert (held.text, held.seconds - began < 0.1) == (sentence, True)
    assert silent.text.startswith("ready: waiting for a command: no source has sent one")
    assert 2.4 < silent.seconds - held.seconds < 2.9


def test_reasons_that_alternate_in_every_step_make_an_entry_a_second() -> None:
    tape, _ = held_by_neutral_first()
    steps, changes = tape.steps()[-500:], ReasonChanges()
    entries = list[TimelineEntry]()
    for number, step in enumerate(steps):
        status = ("ready", "one" if number % 2 else "another", "up", "")
        entries += changes.step(replace(step, recorded=replace(step.recorded, status=status)))
    seconds = (steps[-1].inputs.now.wall_ns - steps[0].inputs.now.wall_ns) / 1e9
    assert seconds - 1 < len(entries) <= seconds + 1


def test_reasons_that_differ_in_a_number_are_one_reason_but_names_with_digits_differ() -> None:
    step, changes = driven().steps()[-1], ReasonChanges()

    def entries(reason: str, seconds: float) -> list[TimelineEntry]:
        now = replace(step.inputs.now, mono_ns=step.inputs.now.mono_ns + int(seconds * 1e9))
        recorded = replace(step.recorded, status=("ready", reason, "up", ""))
        inputs = replace(step.inputs, now=now)
        return [*changes.step(replace(step, inputs=inputs, recorded=recorded))]

    assert not entries("app1 has sent speeds for over 2 s", 0.0)
    assert not entries("app1 has sent speeds for over 4.5 s", 5.0)
    assert len(entries("app2 has sent speeds for over 5 s", 10.0)) == 1


def test_a_host_stall_is_not_called_a_silence_of_the_board() -> None:
    tape = Tape()
    world = World(BOARD, recorder=tape)
    world.drive(0.5, seconds=1.0)
    with world.mcu.mute():
        world.run(0.05)
        world.stall(0.2)
        world.run(0.02)
    world.hold(0.5, seconds=1.0)
    with world.mcu.mute():
        world.run(0.2)
    told = [one for one in story(tape) if one.name in ("link_stale", "link_late")]
    late, stale = told
    assert (late.name, stale.name) == ("link_late", "link_stale")
    assert late.text.startswith("this computer did not run for 0.2")
    assert summary(told) == "1 computer stall, 1 board silence"


def test_lines_during_a_silence_do_not_count_as_another_silence() -> None:
    tape = Tape()
    world = World(BOARD, recorder=tape)
    world.run(1.0)
    with world.mcu.mute():
        world.run(5.0)
    world.run(1.0)
    told = story(tape)
    assert [one.name for one in told if one.name in ("link_stale", "link_heard")] == [
        "link_stale", "link_heard"
    ]  # fmt: skip
    said = [one for _, outputs, _ in tape.taken for one in outputs.events]
    assert summary([entry_of(one, 1) for one in said]) == "1 board silence"


def test_missing_steps_are_reported() -> None:
    gaps = [one.text for one in story(driven(), range(100, 160)) if one.name == "gap"]
    assert gaps == ["60 steps are missing before this one"]


def test_a_summary_names_who_stopped_the_robot_and_counts_the_incidents() -> None:
    events = [
        TimelineEntry(1.0, "stop", "stopped", by="joe"),
        TimelineEntry(2.0, "stop", "stopped", by="joe"),
        TimelineEntry(2.5, "mode", "driving"),
        TimelineEntry(3.0, "fault", "a wheel", "error"),
        TimelineEntry(4.0, "command_refused", "old", count=7),
        TimelineEntry(5.0, "link_stale", "silent", "warning", count=2),
        TimelineEntry(6.0, "link_down", "gone", "warning", count=2),
        TimelineEntry(7.0, "mcu_restarted", "has started", "warning", count=2),
    ]
    assert summary(events) == (
        "2 stops, 1 fault, 7 refused commands, 2 board silences, 2 lost ports, 2 board restarts "
        "(stopped by joe)"
    )
    assert summary([]) == ""
    assert summary([], starts=True) == "start"
    assert summary([TimelineEntry(1.0, "fault", "a wheel")], starts=True) == "start, 1 fault"
