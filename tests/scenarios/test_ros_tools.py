"""Tools of other projects follow the neutral-first rule, as the page howto/ros-drive describes.

Each class imitates the rates and the zeros of the tool after which it is named. Each test stops and
clears the robot while the tool sends commands. Then it does what that page's table asks the person
to do. It shows that these steps are enough, and that the robot stays at rest after fewer steps.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Literal, get_args

import msgspec
import pytest

from acsard.core.messages.encodings import encode
from acsard.core.messages.schema import Header, JointState, Time, Twist, TwistStamped, Vector3
from acsard.core.values import NS_PER_S
from tests.scenarios.speakers import Speaker, moved
from tests.scenarios.world import World

Road = Literal["rmw", "bridge"]
ROADS: tuple[Road, ...] = ("rmw", "bridge")
FAST = 0.4
CLEAR_S = 2.5
"""A plain `clear` is refused within 2 s of a stop."""

ROS2 = Path(__file__).parents[2] / "deploy/ros2"

TOOLS = {
    "`teleop_twist_keyboard`",
    "`teleop_twist_joy`",
    "`joy_teleop`",
    "`rqt_robot_steering`",
    "`ros2 topic pub`",
    "`drive.py`",
    "Nav2 with the velocity smoother",
    "Nav2 without it",
    "ros2_control",
}
"""The tools that this module imitates."""

by_each_road = pytest.mark.parametrize("road", ROADS)


@pytest.fixture
def world() -> World:
    world = World()
    world.run(0.3)
    return world


def stop_and_clear(world: World, meanwhile: Callable[[], None]) -> None:
    """Stop the robot, call `meanwhile`, and clear the stop.

    `meanwhile` lets the tool publish between the two calls.
    """
    assert world.call("stop").success
    since_ns = world.now_ns
    meanwhile()
    world.run(max(0.0, CLEAR_S - (world.now_ns - since_ns) / NS_PER_S))
    assert world.call("clear").success


def check_stays_at_rest(world: World, act: Callable[[], None]) -> None:
    """Call `act`. Check that the robot stays at rest meanwhile and reports that it needs a zero."""
    since_ns = world.now_ns
    act()
    assert not moved(world, since_ns)
    assert world.state.code == "neutral"


def drives(world: World, act: Callable[[], None]) -> None:
    """Call `act`, and check that the robot drives at its end."""
    act()
    assert world.state.mode == "driving", world.state.reason


def test_the_table_of_the_ros_page_lists_exactly_the_tools_of_this_module() -> None:
    page = (ROS2.parent / "manual/pages/howto/ros-drive.md").read_text()
    table = page.partition("\n## After a clear\n")[2]
    rows = re.findall(r"^\| ([^|]+) \| [^|]+ \| [^|]+ \|$", table.partition("\n## ")[0], re.M)
    assert set(rows) - {"tool"} == TOOLS


# Two publishers on one topic


@pytest.mark.slow
@pytest.mark.parametrize(
    ("road", "other", "least", "most"),
    [("rmw", 0.1, 0.38, 0.42), ("rmw", 0.0, 0.38, 0.42),
     ("bridge", 0.1, 0.09, 0.15), ("bridge", 0.0, 0.0, 0.03)],
)  # fmt: skip
def test_the_first_of_two_publishers_drives_by_rmw_and_both_drive_by_the_bridge(
    world: World, road: Road, other: float, least: float, most: float
) -> None:
    first, second = Speaker(world, road, "first"), Speaker(world, road, "second")
    for _ in range(25):
        first.send(0.0)
        second.send(0.0)
        world.run(0.05)
    world.run(1.2)
    speeds = []
    for _ in range(60):
        for speaker, speed in ((first, FAST), (second, other)):
            speaker.send(speed)
            world.run(0.025)
            speeds.append(world.state.linear or 0.0)
    assert least <= min(speeds[60:]) <= max(speeds[60:]) <= most
    second.hold(0.2, 1.0)
    assert world.state.linear == pytest.approx(0.2, abs=0.02)


# teleop_twist_keyboard


class Keyboard(Speaker):
    """teleop_twist_keyboard: it publishes once per received key. `i` is a speed, `k` is a zero."""

    def press(self, linear: float, seconds: float, delay: float = 0.5, hz: float = 30.0) -> None:
        """Hold a key for `seconds`. The terminal repeats the key at `hz` after `delay` seconds."""
        self.send(linear)
        self.world.run(delay)
        self.hold(linear, seconds - delay, hz)


@pytest.mark.slow
@by_each_road
def test_keyboard_drives_after_k_was_held_for_a_second(world: World, road: Road) -> None:
    keyboard = Keyboard(world, road)
    keyboard.press(0.0, 1.1)
    drives(world, lambda: keyboard.press(FAST, 1.5))
    stop_and_clear(world, lambda: keyboard.press(FAST, 2.0))
    check_stays_at_rest(world, lambda: keyboard.press(FAST, 2.0))
    keyboard.press(0.0, 1.1)
    drives(world, lambda: keyboard.press(FAST, 1.5))
    world.run(8.0)
    drives(world, lambda: keyboard.press(FAST, 1.5))


# teleop_twist_joy and joy_teleop


class Joystick(Speaker):
    """teleop_twist_joy: it sends speeds while a button is held, and one zero after the release."""

    JOY_HZ = 20.0
    zero_on_release = True
    _released = False

    def joy(self, button: bool, stick: float, seconds: float) -> None:
        """Hold the button (or not) and the stick for `seconds`. joy_node reports both at 20 Hz."""
        for _ in range(round(seconds * self.JOY_HZ)):
            if button:
                self.send(stick)
            elif self.zero_on_release and not self._released:
                self.send(0.0)
            self._released = not button
            self.world.run(1 / self.JOY_HZ)


class JoyTeleop(Joystick):
    """joy_teleop publishes nothing when its button is released."""

    zero_on_release = False


@pytest.mark.slow
@pytest.mark.variations(4)
@by_each_road
@pytest.mark.parametrize("kind", [Joystick, JoyTeleop])
def test_joystick_drives_after_the_button_was_held_for_a_second_with_the_stick_at_rest(
    world: World, kind: type[Joystick], road: Road
) -> None:
    joystick = kind(world, road)
    check_stays_at_rest(world, lambda: joystick.joy(True, FAST, 1.0))
    joystick.joy(True, 0.0, 1.1)
    drives(world, lambda: joystick.joy(True, FAST, 1.0))
    stop_and_clear(world, lambda: joystick.joy(True, FAST, CLEAR_S))
    check_stays_at_rest(world, lambda: joystick.joy(True, FAST, 2.0))
    joystick.joy(True, 0.0, 1.1)
    drives(world, lambda: joystick.joy(True, FAST, 0.5))
    joystick.joy(False, 0.0, 9.0)
    drives(world, lambda: joystick.joy(True, FAST, 0.5))


@pytest.mark.slow
@pytest.mark.parametrize(("road", "released"), [("rmw", 0.1), ("bridge", 1.1)])
def test_teleop_twist_joy_drives_after_its_button_was_released(
    world: World, road: Road, released: float
) -> None:
    joystick = Joystick(world, road)
    joystick.joy(True, 0.0, 1.1)
    joystick.joy(True, FAST, 1.0)
    stop_and_clear(world, lambda: joystick.joy(True, FAST, CLEAR_S))
    joystick.joy(True, FAST, 0.5)
    joystick.joy(False, 0.0, released)
    drives(world, lambda: joystick.joy(True, FAST, 0.5))


@pytest.mark.slow
@by_each_road
def test_joy_teleop_is_not_armed_by_releasing_its_button(world: World, road: Road) -> None:
    joystick = JoyTeleop(world, road)
    joystick.joy(True, 0.0, 1.1)
    joystick.joy(True, FAST, 1.0)
    stop_and_clear(world, lambda: joystick.joy(True, FAST, CLEAR_S))
    joystick.joy(False, 0.0, 10.0)
    check_stays_at_rest(world, lambda: joystick.joy(True, FAST, 2.0))


# rqt_robot_steering


class Steering(Speaker):
    """rqt_robot_steering: it publishes the speed of its slider at 10 Hz, but a zero only once."""

    slider = 0.0
    _zero_sent = False

    def wait(self, seconds: float) -> None:
        """Do not move the slider for `seconds`."""
        for _ in range(round(seconds * 10.0)):
            self._publish()
            self.world.run(0.1)

    def stop(self) -> None:
        """Click Stop, which sets the slider to zero and publishes."""
        self.slider, self._zero_sent = 0.0, False
        self._publish()

    def _publish(self) -> None:
        if self.slider or not self._zero_sent:
            self.send(self.slider)
        self._zero_sent = not self.slider


def slide(steering: Steering, linear: float, seconds: float) -> None:
    """Move a slider, and leave it there."""
    steering.slider = linear
    steering.wait(seconds)


@pytest.mark.slow
@pytest.mark.parametrize(("road", "pause"), [("rmw", 0.1), ("bridge", 1.1)])
def test_rqt_robot_steering_drives_after_stop_was_clicked(
    world: World, road: Road, pause: float
) -> None:
    steering = Steering(world, road)
    steering.wait(5.0)
    slide(steering, FAST, 1.0)
    steering.stop()
    steering.wait(pause)
    drives(world, lambda: slide(steering, FAST, 1.0))
    stop_and_clear(world, lambda: steering.wait(CLEAR_S))
    check_stays_at_rest(world, lambda: steering.wait(2.0))
    steering.stop()
    steering.wait(pause)
    drives(world, lambda: slide(steering, FAST, 0.5))


# ros2 topic pub


def topic_pub(world: World, road: Road, name: str, linear: float, seconds: float) -> None:
    """Run `ros2 topic pub -r 10` with a constant speed for `seconds`, and end it by Ctrl-C."""
    Speaker(world, road, name).hold(linear, seconds, 10.0)


@pytest.mark.slow
@by_each_road
def test_topic_pub_of_a_speed_never_drives_however_often_it_is_started(
    world: World, road: Road
) -> None:
    for pause in (0.5, 2.0, 10.0):
        name = f"before a pause of {pause} s"
        check_stays_at_rest(world, partial(topic_pub, world, road, name, FAST, 3.0))
        world.run(pause)


# drive.py


@pytest.mark.slow
@by_each_road
def test_drive_py_drives_immediately_after_a_clear(world: World, road: Road) -> None:
    """`deploy/ros2/drive.py` sends zeros first, for the time `ZEROS_S` that its source sets."""
    text = (ROS2 / "drive.py").read_text()
    (zeros,) = re.findall(r"^ZEROS_S = ([\d.]+)$", text, re.M)
    for number in range(2):
        script = Speaker(world, road, f"drive {number}")
        script.hold(0.0, float(zeros))
        drives(world, partial(script.hold, FAST, 0.5))
        script.hold(0.0, 0.1)
        stop_and_clear(world, lambda: None)


# Nav2

Stamps = Literal["none", "kept", "continued"]


class Nav2(Speaker):
    """controller_server, velocity_smoother and collision_monitor at 20 Hz, by nav2_params.yaml.

    The controller sends speeds while it has a goal, and one zero at the end. The smoother ramps to
    the newest speed that it received. If it receives nothing for `TIMEOUT_S` it ramps to zero,
    publishes this zero and stops publishing. The monitor forwards every speed. It forwards zeros
    for only 2 s.
    """

    TIMEOUT_S, STEP, MONITOR_S = 0.25, 1.0 / 20.0, 2.0

    def __init__(
        self,
        world: World,
        road: Road,
        name: str = "a",
        *,
        smoother: bool = True,
        stamps: Stamps = "none",
    ) -> None:
        super().__init__(world, road, name)
        self.key = "cmd/nav"
        self._smoother, self._stamps = smoother, stamps
        self._wanted: float | None = None
        self._wanted_ns = self._stamp_ns = 0
        self._last = 0.0
        self._zeros_ns: int | None = None

    def goal(self, linear: float, seconds: float) -> None:
        """Follow a path at this speed for `seconds`, without reaching the goal."""
        for _ in range(round(seconds * 20.0)):
            self._tick(linear)

    def cancel(self) -> None:
        """Cancel the goal, or let it abort: the controller sends one zero."""
        self._tick(0.0)

    def receive_zeros(self, seconds: float) -> None:
        """Let another program publish zeros to the smoother, while Nav2 has no goal."""
        for _ in range(round(seconds * 20.0)):
            self._tick(0.0)

    def idle(self, seconds: float) -> None:
        """Let `seconds` pass in which Nav2 has no goal and receives nothing."""
        for _ in range(round(seconds * 20.0)):
            self._tick(None)

    def _tick(self, command: float | None) -> None:
        now_ns = self.world.now_ns
        if command is not None:
            self._wanted, self._wanted_ns = command, now_ns
            self._stamp_ns = self.world.instant.wall_ns
        if not self._smoother:
            if command is not None:
                self._monitor(command, self._stamp_ns)
        elif self._wanted is not None:
            self._smooth(now_ns - self._wanted_ns)
        self.world.run(0.05)

    def _smooth(self, since_ns: int) -> None:
        assert self._wanted is not None
        stamp_ns = self._stamp_ns + (since_ns if self._stamps == "continued" else 0)
        if since_ns > self.TIMEOUT_S * NS_PER_S:
            if self._last == 0.0:
                return
            self._wanted, self._stamp_ns = 0.0, self.world.instant.wall_ns
        change = max(-self.STEP, min(self.STEP, self._wanted - self._last))
        self._last = self._wanted if abs(change) < self.STEP else self._last + change
        self._monitor(self._last, stamp_ns)

    def _monitor(self, linear: float, stamp_ns: int) -> None:
        now_ns = self.world.now_ns
        if linear:
            self._zeros_ns = None
        elif self._zeros_ns is None:
            self._zeros_ns = now_ns
        elif now_ns - self._zeros_ns > self.MONITOR_S * NS_PER_S:
            return
        self.send(linear)
        if self._stamps != "none":
            twist = Twist(Vector3(linear), Vector3())
            payload = encode(TwistStamped(Header(Time.from_ns(stamp_ns)), twist), "cdr")
            arrivals = self.world.bus.arrivals
            arrivals[-1] = msgspec.structs.replace(
                arrivals[-1],
                payload=payload,
                encoding="application/cdr;geometry_msgs/msg/TwistStamped",
            )


@pytest.mark.variations(12)
@by_each_road
@pytest.mark.parametrize("smoother", [True, False])
@pytest.mark.parametrize("stamps", get_args(Stamps))
def test_every_goal_of_nav2_drives_without_a_hand(
    world: World, road: Road, smoother: bool, stamps: Stamps
) -> None:
    """Nav2 publishes nothing between two goals, and begins each with a speed.

    The smoother of 2026 stamps the zero at the end of its ramp with a time in the future.
    """
    world.run(6.1)
    for name, pause in (("first", 3.0), ("first", 60.0), ("started again", 2.0)):
        nav2 = Nav2(world, road, name, smoother=smoother, stamps=stamps)
        drives(world, lambda: nav2.goal(FAST, 1.0))  # noqa: B023
        nav2.cancel()
        nav2.idle(pause)
    stop_and_clear(world, lambda: nav2.idle(CLEAR_S))
    nav2.idle(1.1)
    drives(world, lambda: nav2.goal(FAST, 1.0))


@pytest.mark.slow
@by_each_road
@pytest.mark.parametrize("smoother", [True, False])
def test_a_goal_of_nav2_under_way_at_a_clear_drives_when_it_was_cancelled_and_sent_again(
    world: World, road: Road, smoother: bool
) -> None:
    world.run(6.1)
    nav2 = Nav2(world, road, smoother=smoother)
    drives(world, lambda: nav2.goal(FAST, 1.0))
    stop_and_clear(world, lambda: nav2.goal(FAST, CLEAR_S))
    check_stays_at_rest(world, lambda: nav2.goal(FAST, 3.0))
    nav2.cancel()
    nav2.idle(2.0 if smoother else 1.1)
    drives(world, lambda: nav2.goal(FAST, 1.0))


@pytest.mark.slow
@by_each_road
def test_nav2_that_retries_a_goal_by_itself_after_a_clear_drives_when_its_zero_counts(
    world: World, road: Road
) -> None:
    """Nav2 makes no progress for 10 s. Its behavior tree waits some seconds and retries the goal.

    Nav2 sends a zero before the retry. The robot drives if this zero arms Nav2.
    """
    nav2 = Nav2(world, road)
    stop_and_clear(world, lambda: nav2.goal(FAST, CLEAR_S))
    check_stays_at_rest(world, lambda: nav2.goal(FAST, 10.0))
    nav2.cancel()
    nav2.idle(5.0)
    drives(world, lambda: nav2.goal(FAST, 1.0))


class Docking(Speaker):
    """Nav2's docking server: it publishes speeds at 50 Hz from its start, and one zero at its end.

    Its commands do not pass the collision monitor.
    """

    def __init__(self, world: World, road: Road) -> None:
        super().__init__(world, road, "docking server")
        self.key = "cmd/dock"

    def dock(self, linear: float, seconds: float) -> None:
        """Approach the dock."""
        self.hold(linear, seconds, 50.0)

    def end(self) -> None:
        """Send the zero with which docking ends, whatever its result."""
        self.send(0.0)
        self.world.run(0.02)


def test_docking_has_its_own_place_above_nav2_and_below_ros2_control() -> None:
    rank = {source.name: source.priority for source in World().config.commands.sources}
    assert rank["nav"] < rank["dock"] < rank["ros2_control"]


@pytest.mark.slow
@by_each_road
def test_after_one_cancelled_docking_later_ones_drive_through_the_zeros_of_nav2(
    world: World, road: Road
) -> None:
    """A cancelled docking arms the docking server, so later dockings drive.

    They drive although the collision monitor still sends zeros, because their source has a higher
    priority.
    """
    monitor, docking = Speaker(world, road, "monitor"), Docking(world, road)
    monitor.key = "cmd/nav"
    check_stays_at_rest(world, lambda: docking.dock(0.15, 3.0))
    docking.end()
    world.run(1.1)
    since_ns = world.now_ns
    for _ in range(20):
        monitor.send(0.0)
        docking.dock(0.15, 0.1)
    assert (world.state.mode, world.state.source) == ("driving", "dock")
    docking.end()
    assert moved(world, since_ns)


# ros2_control


class DiffDrive(Speaker):
    """ros2_control: diff_drive_controller at 50 Hz, with JointStateTopicSystem.

    The controller never stops sending. It ramps within its limits, and ramps to zero if it receives
    no `cmd_vel` for 0.25 s.
    """

    RADIUS, STEP, TIMEOUT_S = 0.05, 1.0 / 50.0, 0.25
    _last, _heard_ns, _wanted = 0.0, 0, 0.0

    def cycle(self, seconds: float, cmd_vel: float | None = None) -> None:
        """Run the controller for `seconds`.

        If `cmd_vel` is a speed, a client sends it to the controller at 50 Hz. If it is None, no
        client sends anything.
        """
        for _ in range(round(seconds * 50.0)):
            now_ns = self.world.now_ns
            if cmd_vel is not None:
                self._wanted, self._heard_ns = cmd_vel, now_ns
            elif now_ns - self._heard_ns > self.TIMEOUT_S * NS_PER_S:
                self._wanted = 0.0
            change = max(-self.STEP, min(self.STEP, self._wanted - self._last))
            self._last = self._wanted if abs(change) < self.STEP else self._last + change
            self.send(self._last)
            joints = list(self.world.config.joints.as_tuple())
            stamp = Time.from_ns(self.world.instant.wall_ns)
            message = JointState(Header(stamp), joints, [], [self._last / self.RADIUS] * 4, [])
            arrivals = self.world.bus.arrivals
            arrivals[-1] = msgspec.structs.replace(
                arrivals[-1],
                key="wheel_cmd/app",
                payload=encode(message, "cdr"),
                encoding="application/cdr;sensor_msgs/msg/JointState",
            )
            self.world.run(0.02)


@pytest.mark.slow
@pytest.mark.parametrize(("road", "silence"), [("rmw", 1.0), ("bridge", 2.0)])
def test_ros2_control_drives_after_a_while_without_cmd_vel(
    world: World, road: Road, silence: float
) -> None:
    control = DiffDrive(world, road)
    control.cycle(2.0)
    drives(world, lambda: control.cycle(1.0, FAST))
    stop_and_clear(world, lambda: control.cycle(CLEAR_S, FAST))
    check_stays_at_rest(world, lambda: control.cycle(2.0, FAST))
    control.cycle(silence)
    drives(world, lambda: control.cycle(0.5, FAST))


@pytest.mark.slow
@by_each_road
def test_ros2_control_that_sends_zeros_through_a_clear_is_armed_by_them(
    world: World, road: Road
) -> None:
    control = DiffDrive(world, road)
    control.cycle(2.0)
    stop_and_clear(world, lambda: control.cycle(CLEAR_S))
    control.cycle(1.1)
    drives(world, lambda: control.cycle(0.5, FAST))
