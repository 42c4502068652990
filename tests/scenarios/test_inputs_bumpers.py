"""The whole daemon, with a simulated board that reports bumpers and faults of motor drivers."""

from __future__ import annotations

import random

import pytest

from acsard.core.config.settings import (
    Config,
    Place,
    SafetyConfig,
)
from tests.scenarios.test_inputs_estop import MOST, Watch, out_of
from tests.scenarios.world import World
from tests.stepped import Outputs

PLACES: tuple[Place, ...] = ("front", "rear", "left", "right")
STOP = Config(safety=SafetyConfig(bumpers=PLACES))
AWAY = Config(safety=SafetyConfig(bumpers=PLACES, bumper="away"))
COMMANDS = ((0.8, 0.5), (-0.8, 0.5), (0.8, 0.0), (-0.8, 0.0), (0.0, 2.0), (0.05, -1.0))


class Lines:
    """Finds the first line that the daemon sends after a bumper is pressed."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.pressed_ns, self._before, self._lines, self._first = 0, False, 0, 0
        self.applied: list[tuple[float, float]] = []
        world.watch = self.note_press

    def begin(self) -> None:
        """Forget all earlier lines and speeds."""
        self.world.port.sent.clear()
        self.applied.clear()
        self._lines = 0

    def note_press(self, outputs: Outputs) -> None:
        """Remember the time of the step in which the daemon reads the press."""
        pressed = any(self.world.loop.robot.snapshot(outputs.now.mono_ns).bumpers or ())
        if pressed > self._before:
            self.pressed_ns, self._first = outputs.now.mono_ns, self._lines
            self.applied.clear()
        self._before, self._lines = pressed, len(self.world.port.sent)
        self.applied.append((outputs.applied.linear, outputs.applied.angular))

    @property
    def first(self) -> tuple[int, bytes]:
        """The time from the press to the first line after it, ns, and this line."""
        at_ns, line = self.world.port.sent[self._first]
        return at_ns - self.pressed_ns, line


@pytest.mark.slow
@pytest.mark.variations(4)
@pytest.mark.parametrize("count", MOST)
@pytest.mark.parametrize("config", [STOP, Config()], ids=["places", "no places"])
def test_each_press_stops_the_robot_within_a_period_until_a_clear(
    config: Config, count: int
) -> None:
    world, dice = World(config), random.Random(count)
    watch, slowest_ns = Watch(world), 0
    with world.mcu.bumpers():
        world.run(0.5)
        for _ in range(count):
            number = dice.randint(1, 4)
            watch.begin()
            world.drive(*dice.choice(COMMANDS), seconds=0.5)
            world.run(dice.uniform(0.0, 0.03))
            with world.mcu.bumper_pressed(number, 0.0, 0.0):
                world.run(0.05)
                assert world.state.bumpers == [i == number for i in range(1, 5)]
                assert world.state.code == "bumper"
                slowest_ns = max(slowest_ns, watch.waited_ns)
                assert not world.call("clear").success
                world.hold(0.8, 0.5, seconds=0.1)
            world.hold(-0.8, 0.5, seconds=0.3)
            assert not watch.moved
            assert (world.state.mode, world.state.bumpers) == ("stopped", [False] * 4)
            out_of(world)
    assert slowest_ns <= world.period_ns


@pytest.mark.slow
@pytest.mark.variations(4)
@pytest.mark.parametrize("count", [5, pytest.param(25, marks=pytest.mark.slow), MOST[1]])
@pytest.mark.parametrize(("place", "sign"), [*zip(PLACES, (-1, 1, 0, 0), strict=True)])
def test_a_limiting_bumper_stops_the_robot_within_a_period_and_allows_only_retreat(
    place: Place, sign: int, count: int
) -> None:
    world, dice = World(AWAY), random.Random(count)
    lines, slowest_ns, retreats = Lines(world), 0, 0
    number = PLACES.index(place) + 1
    with world.mcu.bumpers():
        world.run(0.5)
        for _ in range(count):
            lines.begin()
            world.drive(*dice.choice(COMMANDS), seconds=0.5)
            world.run(dice.uniform(0.0, 0.03))
            with world.mcu.bumper_pressed(number, 0.0, 0.0):
                world.hold(*dice.choice(COMMANDS), seconds=0.1)
                waited_ns, line = lines.first
                assert line.startswith(b"ap00.00,bp00.00,cp00.00,dp00.00")
                slowest_ns = max(slowest_ns, waited_ns)
                assert world.state.code in ("bumper_away", "bumper_blocks")
                # Each sender must send a zero first.
                assert {*lines.applied} == {(0.0, 0.0)}
                for command in dice.sample(COMMANDS, 3):
                    world.drive(*command, seconds=0.4)
                    assert world.state.mode == ("driving" if command[0] * sign > 0 else "ready")
                assert all(0.0 <= v * sign <= 0.1 and w == 0.0 for v, w in lines.applied)
                assert sign or {*lines.applied} == {(0.0, 0.0)}
                retreats += any(v for v, _ in lines.applied)
                world.hold(-0.8 * (sign or 1), seconds=0.2)
                lines.applied.clear()
            # A sender that pushed against the obstacle at the release does not drive on.
            world.hold(-0.8 * (sign or 1), seconds=0.3)
            assert {*lines.applied} == {(0.0, 0.0)}
            assert world.newest == 0
    assert slowest_ns <= world.period_ns
    assert (retreats > 0) == (sign != 0)
