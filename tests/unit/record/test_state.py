"""A robot as bytes: it comes back as it was, and a stranger's bytes do nothing."""

from __future__ import annotations

import os
import pickle
from collections.abc import Callable
from pathlib import Path

import pytest

from acsard.config.settings import Config
from acsard.host.errors import RecordingError
from acsard.record.export import export
from acsard.record.file import Recording
from acsard.record.replayed import Onlooker, live
from acsard.record.state import StateError, freeze, thaw
from acsard.robot import Robot
from acsard.values import Instant
from tests.scenarios.taped import Tape
from tests.scenarios.world import World


def test_it_comes_back_as_it_was() -> None:
    world = World()
    world.drive(0.5, 0.3, seconds=2.0)
    state = thaw(freeze(world.loop.robot, b"line"))
    assert state.last == b"line"
    assert state.robot.snapshot(world.now_ns) == world.loop.robot.snapshot(world.now_ns)
    again = freeze(state.robot, b"")
    assert freeze(thaw(again).robot, b"") == again


class Harm:
    """What a stranger may put into a file: something that runs when it is read."""

    def __init__(self, call: object, *words: object) -> None:
        self.call, self.words = call, words

    def __reduce__(self) -> tuple[object, tuple[object, ...]]:
        return self.call, self.words


def test_nothing_runs_that_is_no_part_of_a_robot(tmp_path: Path) -> None:
    mark = tmp_path / "mark"
    calls = ((os.system, f"touch {mark}"), (eval, "1"), (Path, "/"), (open, mark, "w"))
    for harm in (Harm(*call) for call in calls):
        with pytest.raises(StateError, match="no part of a robot"):
            thaw(pickle.dumps((harm, b"")))
    assert not mark.exists()


@pytest.mark.parametrize(
    ("module", "name"),
    [
        ("acsard.robot", "Counter"),
        ("acsard.robot", "Robot.step"),
        ("acsard.robot", "__builtins__"),
        ("acsard.drive.words", "chosen"),
        ("acsard.drive.tally", "dict"),
        ("acsard.host.files", "replace"),
        ("acsard.roboter", "Robot"),
        ("builtins", "getattr"),
    ],
)
def test_nothing_is_found_by_way_of_a_part(module: str, name: str) -> None:
    data = b"\x80\x05" + pickle.SHORT_BINUNICODE + bytes([len(module)]) + module.encode()
    data += pickle.SHORT_BINUNICODE + bytes([len(name)]) + name.encode()
    with pytest.raises(StateError):
        thaw(data + pickle.STACK_GLOBAL + pickle.STOP)


@pytest.mark.parametrize("value", [1, (1, 2), ("robot", b""), (Instant(1, 2), b"")])
def test_what_is_no_robot_is_refused(value: object) -> None:
    with pytest.raises(StateError):
        thaw(pickle.dumps(value))


def test_damaged_bytes_are_refused_in_words(tmp_path: Path) -> None:
    data = freeze(World().loop.robot, b"")
    with pytest.raises(StateError, match="this version"):
        thaw(data[:1000])
    with pytest.raises(StateError):
        thaw(b"")
    assert isinstance(thaw(data).robot, Robot)


def of_older_code(path: Path, forget: Callable[[Robot], None]) -> Recording:
    """A recording that begins within a drive, with a robot that lacks what `forget` takes away."""
    first, tape = 100, Tape(every=100)
    World(recorder=tape).drive(0.5, seconds=2.0)
    robot, last = thaw(tape.states[first])
    forget(robot)
    tape.states[first] = freeze(robot, last)
    tape.write(path, Config(), first)
    return Recording(path)


def test_what_a_part_of_an_older_robot_lacks_begins_as_in_a_new_one(tmp_path: Path) -> None:
    def forget(robot: Robot) -> None:
        for wheel in robot._sanity._wheels:
            del wheel.suspected

    recording = of_older_code(tmp_path / "old.mcap", forget)
    looked = Onlooker(recording)
    assert len([*looked.steps()]) == looked.replay.tally.steps > 100
    assert looked.replay.tally.same
    assert live(recording).tally.same


def test_what_no_new_robot_has_is_a_sentence_and_no_traceback(tmp_path: Path) -> None:
    def forget(robot: Robot) -> None:
        for sender in robot._arbiter._sources["app"].senders.values():
            del sender.arrived_ns

    recording = of_older_code(tmp_path / "old.mcap", forget)
    words = (
        r"old\.mcap: this version cannot read the state at its start: .*'arrived_ns'.* by acsard"
    )
    with pytest.raises(RecordingError, match=words):
        live(recording)
    with pytest.raises(RecordingError, match=words):
        list(Onlooker(recording).steps())
    with pytest.raises(RecordingError, match=words):
        export(recording, tmp_path / "new.mcap", "mcap")
    assert [*tmp_path.iterdir()] == [recording.path]
