"""The whole daemon, with a simulated board that reports its emergency stop button."""

from __future__ import annotations

import json
import random

import pytest

from acsard.core.codes import reason
from acsard.core.config.settings import (
    Config,
    ControlConfig,
    EstopUse,
    McuConfig,
    SafetyConfig,
    SimConfig,
)
from acsard.core.incoming.queries import Query
from acsard.core.motion.latches import after_restart
from acsard.core.simulator.fake_mcu import FakeMcu
from acsard.core.values import NS_PER_S, Latches, Received
from tests.each import each
from tests.scenarios.taped import Tape, replayed
from tests.scenarios.world import SIGNED, World, naming
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


@pytest.mark.slow
@pytest.mark.parametrize("count", MOST)
def test_a_press_on_the_ramp_of_a_stop_is_a_zero_line_within_a_period(count: int) -> None:
    """A client stops the robot, and during the ramp a person presses the button.

    A zero line follows within a period. The mode is `stopped` already, so only the press can
    request the line.
    """
    world, dice = World(), random.Random(count)
    pressed_ns: list[int] = []

    def look(outputs: Outputs) -> None:
        if not pressed_ns and world.state.emergency_stop == "pressed":
            pressed_ns.append(outputs.now.mono_ns)

    slowest_ns = 0
    with world.mcu.estop():
        world.run(0.5)
        for _ in range(count):
            world.drive(0.8, seconds=0.5)
            world.run(dice.uniform(0.0, world.period_ns / NS_PER_S))
            # The first early line of a period replaces the line of the next period.
            for _ in range(2):
                world.send(0.8)
                world.run(0.001)
            world.put("stop", b"")
            world.run(dice.uniform(0.0, 0.02))
            world.port.sent.clear()
            pressed_ns.clear()
            world.watch = look
            with world.mcu.estop_pressed(0.0, 0.0):
                world.run(0.05)
            world.watch = lambda outputs: None
            world.run(0.05)
            first_ns = next(at_ns for at_ns, line in world.port.sent if line.startswith(ZERO))
            slowest_ns = max(slowest_ns, first_ns - pressed_ns[0])
            out_of(world)
    assert slowest_ns <= world.period_ns
    print(f"\n{count} presses, first zero line after at most {slowest_ns / 1e6:.2f} ms")


@pytest.mark.slow
@pytest.mark.parametrize("count", MOST)
@pytest.mark.parametrize("kind", ["flood", "damaged", "9600 baud", "checked"])
def test_a_press_is_as_fast_in_a_flood_on_a_bad_wire_and_on_a_slow_one(
    kind: str, count: int
) -> None:
    config = Config()
    if kind == "9600 baud":
        config = Config(mcu=McuConfig(baud_rate=9600), control=ControlConfig(rate=16.0))
    if kind == "checked":
        config = Config(mcu=McuConfig(link_check="on"))
    world, dice = World(config), random.Random(count)
    watch, slowest_ns, most_ns = Watch(world), 0, 0
    with world.mcu.estop():
        world.run(1.0)
        for _ in range(count):
            watch.begin()
            world.drive(0.8, 0.5, seconds=0.5)
            assert world.state.mode == "driving"
            world.run(dice.uniform(0.0, 0.03))
            pressed_ns = world.now_ns
            with world.mcu.estop_pressed(0.0, 0.0):
                if kind == "damaged":
                    with world.mcu.bit_errors(3):
                        world.run(0.4)
                for _ in range(40):
                    if kind == "flood":
                        world.send_together([0.8] * 50)
                    world.put("cmd/app", b'{"linear":{"x":0.8},"angular":{"z":0.5}}',
                              attachment=SIGNED)  # fmt: skip
                    world.run(0.005)
                world.run(0.1)
                assert world.state.mode == "stopped"
                slowest_ns = max(slowest_ns, watch.waited_ns)
                most_ns = max(most_ns, watch.stopped_ns - pressed_ns)
            world.hold(0.8, 0.5, seconds=0.3)
            assert not watch.moved
            out_of(world)
    assert slowest_ns <= world.period_ns
    print(
        f"\n{kind}: {count} presses, first zero line {slowest_ns / 1e6:.2f} ms after the line, "
        f"{most_ns / 1e6:.1f} ms from the button to the daemon"
    )


def test_a_robot_that_is_rolled_by_hand_after_a_press_latches_no_fault() -> None:
    # The robot drove at the press, so its wheels turned by command before they had no power.
    world = World()
    with world.mcu.estop():
        world.run(0.5)
        world.drive(0.8, seconds=1.5)
        with world.mcu.estop_pressed(0.0, 4.0):
            world.run(3.0)
            assert max(map(abs, world.state.wheels)) == 0.0
            with world.mcu.pushed(0.5):
                world.run(2.5)
    assert world.state.mode == "stopped"
    assert world.state.counters["uncommanded_motion"] > 0


@each("silent", [True, False])
def test_wheels_that_run_away_through_a_press_without_a_rest_are_a_fault(silent: bool) -> None:
    world = World()
    with world.mcu.estop():
        world.run(0.5)
        world.drive(0.8, seconds=1.5)
        with world.mcu.pushed(0.8):
            if silent:
                with world.mcu.estop_silent(0.0, 0.7):
                    world.run(2.0)
            else:
                with world.mcu.estop_pressed(0.0, 0.06):
                    world.run(2.0)
            assert world.state.mode == "fault"
            assert world.state.code == "wheel_runaway"


@pytest.mark.slow
def test_a_board_that_falls_silent_about_its_button_stops_the_robot() -> None:
    world = World(Config(sim=SimConfig(faults=("estop_silent=2:3",))))
    world.run(0.2)
    world.drive(0.5, seconds=1.7)
    assert world.state.mode == "driving"
    world.hold(0.5, seconds=0.7)
    assert (world.state.mode, world.state.emergency_stop) == ("stopped", "silent")
    assert not world.call("clear").success
    world.run(3.0)
    assert (world.state.mode, world.state.emergency_stop) == ("stopped", "released")
    assert world.call("clear").success


def test_the_simulator_presses_and_releases_the_button_as_configured() -> None:
    world = World(Config(sim=SimConfig(faults=("estop_pressed=2:1",))))
    states = []
    world.run(0.05)
    for _ in range(40):
        world.run(0.1)
        states.append(world.state.emergency_stop)
    assert states == ["released"] * 19 + ["pressed"] * 10 + ["released"] * 11


def test_a_robot_that_needs_the_input_waits_for_it_and_then_becomes_ready() -> None:
    world = World(Config(safety=SafetyConfig(estop="required")))
    world.run(1.0)
    assert (world.state.mode, world.state.link) == ("waiting", "up")
    assert world.state.code == "emergency_stop_missing"
    with world.mcu.estop():
        world.run(0.2)
        assert world.state.mode == "ready"


def test_a_link_that_agreed_on_the_check_takes_no_status_line_without_it() -> None:
    world = World(Config(mcu=McuConfig(link_check="on")))
    world.run(1.0)
    for word, state, refused in ((b"", "", 1), (b"*F4BC", "pressed", 1)):
        world.port.feed(Received(world.instant, b"!status estop=pressed%b\r\n" % word))
        world.run(0.02)
        assert world.state.emergency_stop == state
        assert world.state.counters["line_status_without_crc"] == refused


def test_a_press_survives_a_restart_of_the_daemon_and_of_the_board() -> None:
    world = World()
    with world.mcu.estop():
        world.run(0.3)
        with world.mcu.estop_pressed(0.0, 0.0):
            world.run(0.1)
            world.mcu.reset(world.now_ns, deaf_ns=NS_PER_S // 5)
            world.run(0.5)
            assert world.state.emergency_stop == "pressed"
        latches: Latches = world.loop.robot.latches
    again = World(latches=after_restart(latches))
    with again.mcu.estop():
        again.run(0.3)
        again.hold(0.5, seconds=0.5)
        assert again.state.mode == "stopped"
        assert again.state.code == "emergency_stop"
        assert again.call("clear").success
        again.drive(0.5, seconds=0.5)
        assert again.state.mode == "driving"


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


def test_a_clear_that_came_before_the_release_is_refused_also_if_one_step_takes_both() -> None:
    world = World()
    with world.mcu.estop():
        world.run(0.3)
        with world.mcu.estop_pressed(0.0, 1.0):
            world.run(0.5)
            shown, begin_ns = world.numbers, world.now_ns
            world.stall(1.5)
            asked = naming(shown)
            call = "srv/clear", "srv/clear", "", asked, "", begin_ns + NS_PER_S // 5
            world.bus.queries.append(Query(99, *call))
            world.run(0.05)
        answer = json.loads(world.bus.replies[99][0].payload)
        assert (answer["success"], world.state.emergency_stop) == (False, "released")
        assert "before the cause of the stop or fault had ended" in answer["message"]
        assert world.state.mode == "stopped"
        assert world.call("clear").success


@pytest.mark.slow
def test_a_recording_replays_a_press_and_its_release() -> None:
    config = Config(sim=SimConfig(faults=("estop_pressed=2:1",)))
    tape = Tape()
    world = World(config, recorder=tape)
    world.drive(0.5, seconds=2.5)
    assert world.state.emergency_stop == "pressed"
    middle, tape.cut = len(tape.taken) + 1, True
    world.drive(0.5, seconds=1.5)
    assert world.call("clear").success
    world.drive(0.5, seconds=1.0)
    assert {"driving", "stopped", "ready"} <= {step.status.mode for step in tape.taken}
    for first in (0, middle):
        comparison = replayed(tape, config, first).comparison
        assert comparison.first is None
        assert comparison.steps == len(tape.taken) - first
