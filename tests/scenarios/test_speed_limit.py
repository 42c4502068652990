"""Nav2's speed filter limits the robot in a zone, while an operator changes the limits too."""

from __future__ import annotations

from itertools import pairwise
from pathlib import Path
from typing import Any

import msgspec
import pytest

from acsard.core.config.parsing import parse
from acsard.core.config.settings import Config
from acsard.core.messages.schema import ServiceReply
from acsard.core.values import NS_PER_S, Inputs, Latches, Outputs, Plain
from acsard.daemon.settings_file import SettingsFile
from tests.each import each
from tests.scenarios.taped import Tape, replayed
from tests.scenarios.test_restart import MemoryFile
from tests.scenarios.world import START, World


@pytest.fixture
def world() -> World:
    world = World()
    world.run(0.2)
    return world


def limit(world: World, value: float, **fields: Any) -> None:
    world.put("speed_limit", msgspec.json.encode({"speed_limit": value} | fields))
    world.run(0.15)


def sets(world: World, **settings: Plain) -> ServiceReply:
    """Call `set` with these settings. Two underscores in a name stand for a dot."""
    wishes = {key.replace("__", "."): value for key, value in settings.items()}
    return world.call("set", msgspec.json.encode({"settings": wishes}))


def config(world: World) -> Config:
    (reply,) = world.ask("config")
    return msgspec.json.decode(reply.payload, type=Config)


def fastest(world: World) -> list[float]:
    """Return a list to which each later step adds its linear speed in m/s, without its sign."""
    speeds: list[float] = []

    def note(outputs: Outputs) -> None:
        speeds.append(abs(outputs.applied.linear))

    world.watch = note
    return speeds


@pytest.mark.slow
def test_a_zone_slows_the_robot_and_its_end_lets_it_go_on_as_before(world: World) -> None:
    world.drive(0.8, seconds=2.0)
    limit(world, 25.0, percentage=True)
    world.hold(0.8, seconds=1.5)
    assert world.state.linear == pytest.approx(0.25, abs=0.02)
    assert world.state.speed_limit.startswith("0.25 m/s, set by ")
    assert config(world).limits.linear_speed == 0.25
    (reply,) = world.ask("diagnostics")
    assert f"speed limit: {world.state.speed_limit}".encode() in reply.payload
    limit(world, 0.0)
    world.hold(0.8, seconds=1.5)
    assert world.state.linear == pytest.approx(0.8, abs=0.02)
    assert (world.state.speed_limit, config(world)) == ("", Config())
    events = [(event.text, event.by.rpartition(") ")[2]) for event in world.events
            if event.name == "set"]  # fmt: skip
    assert events == [
        ("limits.linear_speed = 0.25 (was 1.0)", "on the key speed_limit"),
        ("limits.linear_speed = 1.0 (was 0.25)", "on the key speed_limit"),
    ]


def test_the_robot_slows_down_by_its_deceleration_while_it_keeps_driving(world: World) -> None:
    world.drive(1.0, seconds=2.0)
    speeds = fastest(world)
    limit(world, 0.4)
    world.hold(1.0, seconds=1.5)
    assert world.state.mode == "driving"
    assert max(a - b for a, b in pairwise(speeds)) < 0.02
    assert speeds[-1] == pytest.approx(0.4)


@pytest.mark.slow
@each("first", ["limit", "set"])
@each("value", [0.2, 0.5])
def test_the_lower_of_a_speed_limit_and_a_setting_wins_in_either_order(
    first: str, value: float
) -> None:
    world = World()
    world.run(0.2)
    if first == "limit":
        limit(world, value)
        assert sets(world, limits__linear_speed=0.3).success
    else:
        assert sets(world, limits__linear_speed=0.3).success
        limit(world, value)
    speeds = fastest(world)
    world.drive(1.0, seconds=1.5)
    assert max(speeds) == pytest.approx(min(value, 0.3))
    limit(world, 0.0)
    speeds = fastest(world)
    world.hold(1.0, seconds=1.5)
    assert max(speeds) == pytest.approx(0.3)


def test_no_line_is_faster_than_the_limit_when_an_operator_sets_more(world: World) -> None:
    limit(world, 0.3)
    world.drive(1.0, seconds=1.0)
    speeds = fastest(world)
    reply = sets(world, limits__linear_speed=1.5)
    assert reply.success
    assert "limits.linear_speed = 1.5 will apply when the limit of 0.3 m/s ends" in reply.message
    world.hold(1.0, seconds=1.0)
    assert max(speeds) <= 0.3 + 1e-9
    assert "; back to 1.5 m/s when this limit ends" in world.state.speed_limit


@each(
    "payload",
    [b'{"speed_limit": -0.1}', b'{"speed_limit": 101, "percentage": true}', b"{}", b"\x00\x01",
     b'{"speed_limit": 0.9, "more": 1}'],
)  # fmt: skip
def test_a_bad_message_is_counted_and_shown_and_leaves_the_limit_as_it_was(payload: bytes) -> None:
    world = World()
    world.run(0.2)
    limit(world, 0.3)
    before = sum(count for name, count in world.state.counters.items() if "command_" in name)
    world.put("speed_limit", payload)
    world.run(0.2)
    counters = world.state.counters
    assert sum(count for name, count in counters.items() if "command_" in name) == before + 1
    assert world.state.refused.startswith("speed_limit: ")
    assert config(world).limits.linear_speed == 0.3


def test_a_speed_limit_neither_moves_the_robot_nor_clears_a_stop(world: World) -> None:
    assert world.call("stop").success
    limit(world, 0.3)
    limit(world, 0.0)
    assert world.state.mode == "stopped"
    assert world.state.latch
    assert world.state.sources[0].age is None


class Memory:
    """A robot whose latch file and configuration file outlive each daemon."""

    def __init__(self, file: Path, text: str) -> None:
        file.write_text(text)
        self.file, self.latches = file, MemoryFile()

    def start(self) -> World:
        started = parse(self.file.read_bytes())
        latches = self.latches.read(START) if self.latches.data else Latches()
        settings_file = SettingsFile(self.file, parse, started)
        world = World(started, latches=latches, keeper=self.latches, settings_file=settings_file)
        world.run(0.3)
        return world


def test_a_restart_forgets_the_limit_and_keeps_the_lower_setting_of_the_operator(
    tmp_path: Path,
) -> None:
    """A restart removes the speed filter's limit, because no program may be left to lift it."""
    robot = Memory(tmp_path / "acsard.toml", "[limits]\nlinear_speed = 0.9\n")
    world = robot.start()
    assert sets(world, limits__linear_speed=0.6).success
    limit(world, 0.2)
    assert config(world).limits.linear_speed == 0.2
    again = robot.start()
    assert config(again).limits.linear_speed == 0.6
    assert again.state.speed_limit == ""
    limit(again, 50.0, percentage=True)
    assert config(again).limits.linear_speed == pytest.approx(0.45), "of the file's 0.9"
    limit(again, 0.0)
    assert config(again).limits.linear_speed == 0.6


@each("obeyed", [True, False])
@each("lifts", [True, False])
def test_a_speed_limit_is_not_stored_if_its_step_raises(
    lifts: bool, obeyed: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """If the latch file contained the limit, no message would ever lift it."""
    robot = Memory(tmp_path / "acsard.toml", "[limits]\nlinear_speed = 0.9\n")
    world = robot.start()
    if lifts:
        limit(world, 0.2)
    usual = world.loop.robot.step

    def broken(inputs: Inputs) -> Outputs:
        if inputs.requests and not obeyed:
            raise ZeroDivisionError("a bug")
        outputs = usual(inputs)
        if inputs.requests:
            raise ZeroDivisionError("a bug")
        return outputs

    monkeypatch.setattr(world.loop.robot, "step", broken)
    with pytest.raises(ZeroDivisionError):
        limit(world, 0.0 if lifts else 0.2)
    again = robot.start()
    assert config(again).limits.linear_speed == 0.9


def test_a_zone_writes_no_latch_file(tmp_path: Path) -> None:
    robot = Memory(tmp_path / "acsard.toml", "")
    world = robot.start()
    assert sets(world, limits__linear_speed=0.6).success
    robot.latches.data = b"nothing was written"
    for _ in range(5):
        limit(world, 0.2)
        world.run(1.0)
        limit(world, 0.0)
    assert robot.latches.data == b"nothing was written"
    assert world.call("stop").success
    assert robot.latches.read(START).lowered == {"limits.linear_speed": 0.6}


def test_a_zone_limit_is_not_reported_as_a_difference_from_the_file(tmp_path: Path) -> None:
    robot = Memory(tmp_path / "acsard.toml", "")
    world = robot.start()
    file = world.loop._settings_file
    assert file is not None
    limit(world, 0.2)
    assert file._in_force == Config()
    assert sets(world, limits__linear_speed=0.6).success
    assert file._in_force.limits.linear_speed == 0.6


def test_a_flood_of_limits_changes_the_robot_ten_times_a_second(world: World) -> None:
    world.run(1.0)
    since_ns = world.now_ns
    for number in range(200):
        world.put("speed_limit", b'{"speed_limit": %f}' % (0.2 + 0.001 * number))
        world.run(0.01)
    seconds = (world.now_ns - since_ns) / NS_PER_S
    assert sum(event.count for event in world.events if event.name == "set") <= 10 * seconds + 1


@pytest.mark.slow
def test_a_drive_through_a_zone_is_replayed_to_the_last_bit() -> None:
    """The replay needs no speed filter, because the recording contains the resulting requests."""
    tape = Tape()
    world = World(recorder=tape)
    world.run(0.2)
    world.drive(0.8, seconds=1.0)
    limit(world, 30.0, percentage=True)
    world.hold(0.8, seconds=1.0)
    assert sets(world, limits__linear_speed=0.7).success
    world.hold(0.8, seconds=0.5)
    limit(world, 0.0)
    world.hold(0.8, seconds=1.0)
    comparison = replayed(tape, world.config).comparison
    assert comparison.first is None
    assert comparison.exact
    assert world.state.linear == pytest.approx(0.7, abs=0.02)
