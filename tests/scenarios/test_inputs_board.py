"""The inputs that a board reports: its emergency stop button, bumpers, drivers and battery."""

from __future__ import annotations

import random

import pytest

from acsard.core.codes import reason
from acsard.core.config.settings import (
    BatteryConfig,
    Config,
    EstopUse,
    Place,
    SafetyConfig,
    SimConfig,
)
from acsard.core.messages.schema import Battery
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.core.values import NS_PER_S
from tests.each import each
from tests.scenarios.world import World
from tests.stepped import Outputs

ZERO = b"ap00.00,bp00.00,cp00.00,dp00.00"
PRESSES = 25


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
@pytest.mark.parametrize("mode", ["driving", "ready", "stopped", "inactive", "fault"])
def test_each_press_is_a_zero_line_within_a_period_and_no_release_moves_the_robot(
    mode: str,
) -> None:
    world, dice = World(), random.Random(PRESSES)
    watch, slowest_ns = Watch(world), 0
    with world.mcu.fault("estop"):
        world.run(0.5)
        for _ in range(PRESSES):
            watch.begin()
            into(world, mode)
            world.run(dice.uniform(0.0, 0.03))
            before = world.newest
            with world.mcu.fault("estop_pressed", 0.0, 0.0):
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


@pytest.mark.parametrize("boot_s", [0.0, 2.0])
def test_a_cable_that_is_pulled_and_put_back_does_not_release_a_pressed_button(
    boot_s: float,
) -> None:
    world = World()
    with world.mcu.fault("estop"):
        world.run(0.3)
        with world.mcu.fault("estop_pressed", 0.0, 0.0):
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
    with world.mcu.fault("estop_pressed", 0.0, 0.0), world.mcu.fault("driver_fault", 0.0, 0.0):
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


# bumpers and faults of motor drivers


PLACES: tuple[Place, ...] = ("front", "rear", "left", "right")
STOP = Config(safety=SafetyConfig(bumpers=PLACES))
AWAY = Config(safety=SafetyConfig(bumpers=PLACES, bumper="away"))
COMMANDS = ((0.8, 0.5), (-0.8, 0.5), (0.8, 0.0), (-0.8, 0.0), (0.0, 2.0), (0.05, -1.0))


@pytest.mark.slow
@pytest.mark.variations(4)
@pytest.mark.parametrize("config", [STOP, Config()], ids=["places", "no places"])
def test_each_press_stops_the_robot_within_a_period_until_a_clear(
    config: Config,
) -> None:
    world, dice = World(config), random.Random(PRESSES)
    watch, slowest_ns = Watch(world), 0
    with world.mcu.fault("bumpers"):
        world.run(0.5)
        for _ in range(PRESSES):
            number = dice.randint(1, 4)
            watch.begin()
            world.drive(*dice.choice(COMMANDS), seconds=0.5)
            world.run(dice.uniform(0.0, 0.03))
            with world.mcu.fault("bumper_pressed", number, 0.0, 0.0):
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


@each("place", PLACES)
def test_a_limiting_bumper_stops_the_robot_and_allows_only_a_slow_retreat(place: Place) -> None:
    """Each sender must send a zero first, and one that pushes does not drive on at the release."""
    world, away = World(AWAY), {"front": -1, "rear": 1}.get(place, 0)
    with world.mcu.fault("bumpers"):
        world.run(0.5)
        world.drive(0.5, seconds=1.0)
        with world.mcu.fault("bumper_pressed", PLACES.index(place) + 1, 0.0, 0.0):
            world.hold(0.5, seconds=0.2)
            assert world.lines()[-1].startswith(ZERO)
            assert world.state.code in ("bumper_away", "bumper_blocks")
            for speed in (0.8, -0.8, 0.8):
                world.drive(speed, 0.5, seconds=0.7)
                retreats = speed * away > 0
                assert world.state.mode == ("driving" if retreats else "ready")
                assert world.outputs is not None
                applied = world.outputs.applied
                assert applied.linear == pytest.approx(0.1 * away if retreats else 0.0)
                assert applied.angular == 0.0
            world.hold(-0.8 * (away or 1), seconds=0.2)
        world.hold(-0.8 * (away or 1), seconds=0.3)
        assert (world.state.mode, world.newest) == ("ready", 0)


# the battery


LEVELS = BatteryConfig("percent", warning_below=50.0, stop_below=10.0)
DRAINED = Config(battery=LEVELS, sim=SimConfig(faults=("battery=60:2",)))
"""A robot with a small battery: at rest, a full one lasts two minutes."""


def level(world: World) -> str:
    assert world.state.battery is not None
    return world.state.battery.level


@pytest.mark.slow
def test_a_drained_battery_warns_and_then_stops_the_robot_until_it_is_charged() -> None:
    world = World(DRAINED)
    world.run(0.3)
    assert level(world) == "unknown"
    levels: list[tuple[str, str]] = []
    world.drive(0.3, seconds=0.5)
    for _ in range(300):
        world.hold(0.3, seconds=0.2)
        if (level(world), world.state.mode) not in levels:
            levels.append((level(world), world.state.mode))
    assert levels == [
        ("unknown", "driving"),
        ("ok", "driving"),
        ("warning", "driving"),
        ("stop", "stopped"),
    ]
    assert world.state.code == "battery_empty"
    refused = world.call("clear")
    assert not refused.success
    assert refused.message == (
        "battery below battery.stop_below = 10 %: charge the battery to 10.5 %, then "
        "type `acsard call clear` again"
    )
    with world.mcu.fault("battery", 90.0, 60.0):
        world.run(30.0)
        assert (level(world), world.state.mode) == ("ok", "stopped")
        assert world.call("clear").success
        world.drive(0.3, seconds=0.5)
        assert world.state.mode == "driving"


def test_the_battery_key_has_the_battery_about_once_a_second() -> None:
    world = World(DRAINED, wanted=frozenset({"battery"}))
    world.run(5.0)
    messages = world.bus.published["battery"]
    assert 5 <= len(messages) <= 7
    last = messages[-1]
    assert isinstance(last, Battery)
    assert (last.present, last.power_supply_status) == (True, 2)
    assert last.current == -0.5
    assert last.percentage == 0.57
