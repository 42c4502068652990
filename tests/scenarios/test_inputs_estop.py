"""The whole daemon, with a simulated board that reports its emergency stop button."""

from __future__ import annotations

import random

import pytest

from acsard.core.codes import reason
from acsard.core.config.settings import (
    Config,
    EstopUse,
    SafetyConfig,
)
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.core.values import NS_PER_S
from tests.scenarios.world import World
from tests.stepped import Outputs

ZERO = b"ap00.00,bp00.00,cp00.00,dp00.00"
MOST = [25, pytest.param(1000, marks=[pytest.mark.soak, pytest.mark.timeout(3600)])]
"""Number of presses."""


class Watch:
    """Finds the time at which the robot is stopped, and the daemon's lines after it."""

    def __init__(self, world: World) -> None:
        self.world = world
        self.stopped_ns = 0
        self._before, self._lines, self._first = "", 0, 0
        world.watch = self.note_stop

    def begin(self) -> None:
        """Forget all earlier lines."""
        self.world.port.sent.clear()
        self._lines = 0

    def note_stop(self, outputs: Outputs) -> None:
        """Remember the step that stops the robot. `waited_ns` and `moved` use later lines."""
        if outputs.mode == "stopped" != self._before:
            self.stopped_ns, self._first = outputs.now.mono_ns, self._lines
        self._before, self._lines = outputs.mode, len(self.world.port.sent)

    @property
    def waited_ns(self) -> int:
        """The time in ns from the step that stopped the robot to the first line after it."""
        return self.world.port.sent[self._first][0] - self.stopped_ns

    @property
    def moved(self) -> bool:
        """Whether a line since that step has a wheel speed."""
        lines = list(self.world.port.sent)[self._first :]
        assert lines
        return any(not line.startswith(ZERO) for _, line in lines)


def into(world: World, mode: str) -> None:
    """Bring a ready robot into this mode: driving, stopped, inactive or fault."""
    if mode == "driving":
        world.drive(0.8, 0.5, seconds=0.5)
    elif mode == "stopped":
        world.drive(0.8, 0.5, seconds=0.4)
        world.call("stop")
    elif mode == "inactive":
        world.drive(0.8, 0.5, seconds=0.4)
        world.call("deactivate")
    elif mode == "fault":
        world.loop.robot._fault(reason("driver_fault"), world.instant, [])
        world.run(0.02)
    assert world.state.mode == mode


def out_of(world: World) -> None:
    """Release every latch, and switch the robot on."""
    while world.newest:
        done = world.call("activate" if world.state.mode == "inactive" else "clear")
        assert done.success, done.message
        world.run(0.05)
    assert world.state.mode == "ready"


@pytest.mark.slow
@pytest.mark.variations(5)
@pytest.mark.parametrize("count", MOST)
@pytest.mark.parametrize("mode", ["driving", "ready", "stopped", "inactive", "fault"])
def test_each_press_is_a_zero_line_within_a_period_and_no_release_moves_the_robot(
    mode: str, count: int
) -> None:
    world, dice = World(), random.Random(count)
    watch, slowest_ns = Watch(world), 0
    with world.mcu.estop():
        world.run(0.5)
        for _ in range(count):
            watch.begin()
            into(world, mode)
            world.run(dice.uniform(0.0, 0.03))
            before = world.newest
            with world.mcu.estop_pressed(0.0, 0.0):
                world.run(0.05)
                assert world.state.emergency_stop == "pressed"
                assert world.state.mode == ("fault" if mode == "fault" else "stopped")
                assert world.state.code == "emergency_stop"
                assert world.newest > before or mode == "fault"
                if mode in ("driving", "ready", "inactive"):
                    slowest_ns = max(slowest_ns, watch.waited_ns)
                assert not world.call("clear").success
                world.hold(0.8, 0.5, seconds=0.1)
            world.hold(0.8, 0.5, seconds=0.3)
            if mode in ("driving", "ready", "inactive"):
                assert not watch.moved
            assert world.state.mode == ("fault" if mode == "fault" else "stopped")
            out_of(world)
            world.hold(0.8, 0.5, seconds=0.1)
            assert world.state.mode == "ready"
            assert world.state.code == "neutral"
    assert slowest_ns <= world.period_ns
    print(f"\n{mode}: {count} presses, first zero line after at most {slowest_ns / 1e6:.2f} ms")


@pytest.mark.parametrize("boot_s", [0.0, 2.0])
def test_a_cable_that_is_pulled_and_put_back_does_not_release_a_pressed_button(
    boot_s: float,
) -> None:
    world = World()
    with world.mcu.estop():
        world.run(0.3)
        with world.mcu.estop_pressed(0.0, 0.0):
            world.run(0.1)
            world.port.unplug()
            world.run(1.0)
            world.mcu.reset(world.now_ns, int(boot_s * NS_PER_S))
            world.port.plug(world.mcu)
            for _ in range(50):
                assert not world.call("clear").success
                world.hold(0.5, seconds=0.1)
                assert (world.state.mode, world.state.emergency_stop) == ("stopped", "pressed")
        world.run(0.2)
        assert world.call("clear").success
        world.drive(0.5, seconds=0.5)
        assert world.state.mode == "driving"


@pytest.mark.parametrize("estop", ["auto", "required"])
def test_a_new_board_without_a_button_does_not_keep_the_robot_stopped_for_ever(
    estop: EstopUse,
) -> None:
    world = World(Config(safety=SafetyConfig(estop=estop)))
    with world.mcu.estop_pressed(0.0, 0.0), world.mcu.driver_fault(0.0, 0.0):
        world.run(1.0)
    world.port.unplug()
    world.run(1.0)
    world.mcu = FakeMcu(world.config, world.now_ns)
    world.port.plug(world.mcu)
    world.run(1.0)
    assert (world.state.link, world.state.mode) == ("up", "stopped")
    world.run(3.0)
    assert world.call("clear").success
    world.drive(0.5, seconds=0.5)
    assert world.state.mode == ("driving" if estop == "auto" else "waiting")
