"""A robot's saved state can be restored, also under another configuration.

No byte of a saved state can run code.
"""

from __future__ import annotations

import random
import re
from functools import cache
from pathlib import Path

import msgspec
import pytest
from msgspec import Struct, inspect
from msgspec.structs import replace

from acsard.core.config.settings import Config
from acsard.core.guard import Memory
from acsard.core.robot import Robot
from acsard.core.robot_memory import State
from acsard.core.summary import summary
from acsard.core.values import NS_PER_S
from acsard.recording.file import Recording
from acsard.recording.replay import Playback
from acsard.recording.state import (
    LAYOUT,
    MAX_BYTES,
    StateError,
    freeze,
    layout_of,
    thaw,
)
from tests.each import each
from tests.scenarios.taped import Tape
from tests.scenarios.world import World

PLAIN = Config()

# Every error of the odometry is estimated.
ERRORS = replace(
    PLAIN.odometry, gyro=True, wheel_separation_multiplier_std=0.01, wheel_radius_ratio_std=0.01,
    distance_scale_std=0.01,
)  # fmt: skip


@cache
def driven(config: Config = PLAIN) -> bytes:
    """Return the state of a robot that drives."""
    world = World(config)
    world.drive(0.5, 0.3, seconds=2.0)
    return freeze(world.loop.robot, world.loop._guard.memory)


@pytest.mark.parametrize("config", [PLAIN, replace(PLAIN, odometry=ERRORS)])
def test_a_robot_is_read_back_unchanged(config: Config) -> None:
    world = World(config)
    world.drive(0.5, 0.3, seconds=2.0)
    robot, memory = world.loop.robot, world.loop._guard.memory
    assert memory.commanded_ns is not None
    data = freeze(robot, memory)
    restored = thaw(data)
    assert restored.memory == memory
    assert restored.robot.state == robot.state
    assert summary(restored.robot, world.now_ns) == summary(robot, world.now_ns)
    assert freeze(*restored) == freeze(*thaw(data, config)) == data
    errors = [column for column in robot.state.odometry.uncertainty.columns if any(column)]
    assert len(errors) >= 3 or config == PLAIN


def test_a_state_above_a_megabyte_is_refused_unread() -> None:
    with pytest.raises(StateError, match="bytes: the file is damaged or forged"):
        thaw(driven() + bytes(MAX_BYTES))


@pytest.mark.slow
def test_with_any_bit_flipped_the_bytes_are_a_robot_or_refused() -> None:
    """About a fifth is refused: the bytes have no checksum of their own, as their record has one.

    Half of them are names of fields. A field whose name is damaged has its default, and most others
    have a wrong number.
    """
    data, dice, refused = driven(), random.Random(1), list[str]()
    for _ in range(600):
        bad = bytearray(data)
        bad[dice.randrange(len(bad))] ^= 1 << dice.randrange(8)
        try:
            assert isinstance(thaw(bytes(bad)).robot, Robot)
        except StateError as error:
            refused.append(str(error))
    assert 50 < len(refused) < 200
    assert all(words.isprintable() for words in refused)


def structs(kind: inspect.Type, found: set[type[Struct]]) -> set[type[Struct]]:
    """Add the Structs in a type to `found`, and return it."""
    if isinstance(kind, inspect.StructType):
        if kind.cls in found:
            return found
        found.add(kind.cls)
    for name in kind.__struct_fields__:
        inner = getattr(kind, name)
        for part in inner if isinstance(inner, tuple) else (inner,):
            part = part.type if isinstance(part, inspect.Field) else part
            if isinstance(part, inspect.Type):
                structs(part, found)
    return found


def test_no_field_of_a_state_contains_configuration() -> None:
    modules = {cls.__module__ for cls in structs(inspect.type_info(State), set())}
    assert not [name for name in modules if name.startswith("acsard.core.config")]


@each("value", [{"rates": {"free_ns": {"stop": "soon"}}}, 5, [{}, 0, {}]])
def test_a_field_with_a_value_of_another_type_is_refused(value: object) -> None:
    frozen = msgspec.msgpack.decode(driven())
    frozen["state"]["throttle"] = value
    with pytest.raises(StateError, match="Expected"):
        thaw(msgspec.msgpack.encode(frozen))


def test_a_state_with_a_configuration_that_a_file_may_not_have_is_refused() -> None:
    robot = Robot(PLAIN)
    robot.config = replace(PLAIN, limits=replace(PLAIN.limits, linear_deceleration=0.11))
    with pytest.raises(StateError, match=r"limits\.linear_deceleration = 0\.11"):
        thaw(freeze(robot, Memory()))


def test_another_field_or_type_is_another_layout() -> None:
    kinds = [
        msgspec.defstruct("Wheel", [("speed", float)]),
        msgspec.defstruct("Wheel", [("speed", int)]),
        msgspec.defstruct("Wheel", [("speed", float), ("turn", float)]),
    ]
    described = msgspec.defstruct("Wheel", [("speed", float)], namespace={"__doc__": "A wheel."})
    assert len({layout_of(kind) for kind in kinds}) == 3
    assert layout_of(described) == layout_of(kinds[0])


def test_a_robot_of_another_layout_is_replaced_by_a_fresh_one_where_it_rests(
    tmp_path: Path,
) -> None:
    first, tape = 100, Tape(every=100)
    world = World(recorder=tape)
    world.drive(0.5, seconds=2.0)
    world.run(2.0)
    world.drive(0.3, seconds=1.0)
    frozen = msgspec.msgpack.decode(tape.states[first])
    tape.states[first] = msgspec.msgpack.encode(frozen | {"layout": LAYOUT + 1})
    recording = Recording([tape.save(tmp_path / "old", first=first)])
    playback = Playback(recording)
    steps = [step for step, _ in playback.steps()]
    assert 100 < len(steps) < len(tape.taken) - first - 100
    (note,) = map(str, recording.damage)
    assert re.match(r"\d\.\d s cannot be replayed: acsard .* in another layout, and a fresh", note)
    unread_s = (steps[0].now.mono_ns - tape.taken[first].now.mono_ns) / NS_PER_S
    assert unread_s > 0.1
    assert float(note.split()[0]) == pytest.approx(unread_s, abs=0.06)
    recorded, replayed = playback.comparison.end or ((0, 0, 0), (1, 1, 1))
    assert recorded == pytest.approx(replayed, abs=1000)
    assert playback.robot.state.odometry.pose.x > 0.8
    other = replace(Config(), limits=replace(Config().limits, angular_speed=0.3))
    playback = Playback(recording, other)
    next(playback.steps())
    assert playback.robot.config == other
