"""Tools of other projects follow the neutral-first rule, as the page howto/ros-drive describes.

Each class imitates the rates and the zeros of the tool after which it is named. Each row stops and
clears the robot while the tool sends commands. Then it does what that page's table asks the person
to do. It shows that these steps are enough, and that the robot stays at rest after fewer steps.
"""

from __future__ import annotations

import re
from functools import partial
from pathlib import Path
from typing import Any, Literal, NamedTuple, get_args

import msgspec
import pytest

from acsard.core.messages.encodings import encode
from acsard.core.messages.schema import Header, JointState, Time, Twist, TwistStamped, Vector3
from acsard.core.values import NS_PER_S
from tests.scenarios.speakers import Speaker, first_motion, moved
from tests.scenarios.world import World

Road = Literal["rmw", "bridge"]
FAST = 0.4
CLEAR_S = 2.5
"""A plain `clear` is refused within 2 s of a stop."""

ROS2 = Path(__file__).parents[2] / "deploy/ros2"


class Tool(Speaker):
    """A program, and the person or the program that uses it."""

    def use(self, linear: float | None, seconds: float) -> None:
        """Wish this speed for `seconds`. A zero asks for rest; None does nothing."""
        if linear is None:
            self.world.run(seconds)
        else:
            self.hold(linear, seconds)


class Keyboard(Tool):
    """teleop_twist_keyboard: it publishes once per received key. `i` is a speed, `k` is a zero."""

    def use(self, linear: float | None, seconds: float) -> None:
        if linear is None:
            self.world.run(seconds)
            return
        self.send(linear)
        self.world.run(0.5)  # until the terminal repeats the key
        self.hold(linear, seconds - 0.5, 30.0)


class Joystick(Tool):
    """teleop_twist_joy: it sends speeds while a button is held, and one zero after the release."""

    zero_on_release = True
    _released = False

    def use(self, linear: float | None, seconds: float) -> None:
        """Hold the button with this speed, or release it. joy_node reports both at 20 Hz."""
        for _ in range(round(seconds * 20.0)):
            if linear is not None:
                self.send(linear)
            elif self.zero_on_release and not self._released:
                self.send(0.0)
            self._released = linear is None
            self.world.run(0.05)


class JoyTeleop(Joystick):
    """joy_teleop publishes nothing when its button is released."""

    zero_on_release = False


class Steering(Tool):
    """rqt_robot_steering: it publishes the speed of its slider at 10 Hz, but a zero only once."""

    slider = 0.0

    def use(self, linear: float | None, seconds: float) -> None:
        """Move the slider, or leave it. A zero is a click on Stop."""
        if linear is not None:
            self.slider = linear
        if linear == 0.0:
            self.send(0.0)
        for _ in range(round(seconds * 10.0)):
            if self.slider:
                self.send(self.slider)
            self.world.run(0.1)


class TopicPub(Tool):
    """`ros2 topic pub -r 10` with a constant speed, which is started again after each Ctrl-C."""

    def use(self, linear: float | None, seconds: float) -> None:
        self.name += "x"
        if linear is None:
            self.world.run(seconds)
        else:
            self.hold(linear, seconds, 10.0)


class Drive(Tool):
    """`deploy/ros2/drive.py` sends zeros first, for the time `ZEROS_S` that its source sets."""

    def use(self, linear: float | None, seconds: float) -> None:
        if linear is None:
            self.world.run(seconds)
            return
        self.name += "x"
        (zeros,) = re.findall(r"^ZEROS_S = ([\d.]+)$", (ROS2 / "drive.py").read_text(), re.M)
        self.hold(0.0, float(zeros))
        self.hold(linear, seconds)


Stamps = Literal["none", "kept", "continued"]


class Nav2(Tool):
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
        self.announce()
        self._smoother, self._stamps = smoother, stamps
        self._wanted: float | None = None
        self._wanted_ns = self._stamp_ns = 0
        self._last = 0.0
        self._zeros_ns: int | None = None

    def use(self, linear: float | None, seconds: float) -> None:
        """Follow a path without reaching the goal, end it with one zero, or have no goal."""
        if linear == 0.0:
            self._tick(0.0)
        for _ in range(round(seconds * 20.0)):
            self._tick(linear or None)

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


class Docking(Tool):
    """Nav2's docking server: it publishes speeds at 50 Hz from its start, and one zero at its end.

    Its commands do not pass the collision monitor, which sends zeros of Nav2 meanwhile.
    """

    def __init__(self, world: World, road: Road, name: str = "docking server") -> None:
        super().__init__(world, road, name)
        self.key, self.monitor = "cmd/dock", Speaker(world, road, "monitor")
        self.monitor.key = "cmd/nav"

    def use(self, linear: float | None, seconds: float) -> None:
        if linear == 0.0:
            self.send(0.0)
        for _ in range(round(seconds * 10.0)):
            self.monitor.send(0.0)
            if linear:
                self.hold(linear, 0.1, 50.0)
            else:
                self.world.run(0.1)


class DiffDrive(Tool):
    """ros2_control: diff_drive_controller at 50 Hz, with JointStateTopicSystem.

    The controller never stops sending. It ramps within its limits, and ramps to zero if it receives
    no `cmd_vel` for 0.25 s.
    """

    RADIUS, STEP, TIMEOUT_S = 0.05, 1.0 / 50.0, 0.25
    _last, _heard_ns, _wanted = 0.0, 0, 0.0

    def use(self, linear: float | None, seconds: float) -> None:
        """Run the controller. A client sends it this speed at 50 Hz, or nothing."""
        for _ in range(round(seconds * 50.0)):
            now_ns = self.world.now_ns
            if linear is not None:
                self._wanted, self._heard_ns = linear, now_ns
            elif now_ns - self._heard_ns > self.TIMEOUT_S * NS_PER_S:
                self._wanted = 0.0
            change = max(-self.STEP, min(self.STEP, self._wanted - self._last))
            self._last = self._wanted if abs(change) < self.STEP else self._last + change
            self.send(self._last)
            joints = list(self.world.config.joint_names)
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


PAUSE, SILENCE, ALONE = -1.0, -2.0, -3.0
PAUSES: dict[float, dict[Road, float]] = {
    PAUSE: {"rmw": 0.1, "bridge": 1.1},
    SILENCE: {"rmw": 1.1, "bridge": 10.1},
    ALONE: {"rmw": 61.1, "bridge": 10.1},
}
"""Times that differ by the road: until a zero arms, until silence arms, and until it arms a
publisher that the daemon has not heard."""

# What is done for how long, and what then holds: `drives`; `rests`: the robot did not move and
# needs a zero; `cleared`: a stop was cleared meanwhile; `again`: another process of the tool.
Step = tuple[str, float | None, float]
GOES, HELD, STILL = ("drives", FAST, 1.0), ("rests", FAST, 2.0), ("cleared", FAST, CLEAR_S)
ARMED: Step = ("", 0.0, 1.1)

NAV2_GOAL: Step = ("", 0.0, 0.1)
EVERY_GOAL: list[Step] = [
    ("", None, ALONE), GOES, NAV2_GOAL, ("", None, 3.0), GOES, NAV2_GOAL, ("", None, 60.0), GOES,
    NAV2_GOAL, ("again", None, ALONE), GOES, NAV2_GOAL, ("", None, 2.0),
    ("cleared", None, CLEAR_S), ("", None, SILENCE), GOES,
]  # fmt: skip
UNDER_WAY: list[Step] = [
    ("", None, ALONE), GOES, STILL, ("rests", FAST, 3.0), ("", 0.0, 2.0), GOES,
]  # fmt: skip
TOO_EARLY: list[Step] = [("", None, 6.1), HELD, ("", 0.0, 2.0), GOES]

SMOOTHED = "Nav2 with the velocity smoother"
NAV2 = (SMOOTHED, True), ("Nav2 without it", False)

# By the tool's name on the page.
STORIES: list[tuple[str, Any, list[Step]]] = [
    (
        "`teleop_twist_keyboard`", Keyboard,
        [ARMED, GOES, STILL, HELD, ARMED, GOES, ("", None, 8.0), GOES],
    ),
    *(
        (name, kind, [HELD, ARMED, GOES, STILL, HELD, ARMED, GOES, ("", None, 9.0), GOES])
        for name, kind in (("`teleop_twist_joy`", Joystick), ("`joy_teleop`", JoyTeleop))
    ),
    ("`teleop_twist_joy`", Joystick, [ARMED, GOES, STILL, ("", None, PAUSE), GOES]),
    (
        "`rqt_robot_steering`", Steering,
        [("", 0.0, PAUSE), GOES, STILL, HELD, ("", 0.0, PAUSE), GOES],
    ),
    ("`ros2 topic pub`", TopicPub, [HELD, ("", None, 0.5), HELD, ("", None, 10.0), HELD]),
    ("`drive.py`", Drive, [GOES, ("cleared", None, CLEAR_S), GOES]),
    *(
        (name, partial(Nav2, smoother=smoother, stamps=stamps), EVERY_GOAL)
        for stamps in get_args(Stamps)
        for name, smoother in NAV2
    ),
    *(
        (name, partial(Nav2, smoother=smoother), steps)
        for steps in (UNDER_WAY, TOO_EARLY)
        for name, smoother in NAV2
    ),
    (SMOOTHED, Docking, [("rests", 0.15, 3.0), ("", 0.0, 1.1), ("drives", 0.15, 2.0)]),
    ("ros2_control", DiffDrive, [("", None, 2.0), GOES, STILL, HELD, ("", None, 2.0), GOES]),
]  # fmt: skip


def test_the_table_of_the_ros_page_lists_exactly_the_tools_of_this_module() -> None:
    page = (ROS2.parent / "manual/pages/howto/ros-drive.md").read_text()
    table = page.partition("\n## After a clear\n")[2]
    rows = re.findall(r"^\| ([^|]+) \| [^|]+ \| [^|]+ \|$", table.partition("\n## ")[0], re.M)
    assert set(rows) - {"tool"} == {name for name, _, _ in STORIES}


@pytest.mark.slow
@pytest.mark.parametrize("road", ["rmw", "bridge"])
@pytest.mark.parametrize(("name", "kind", "steps"), STORIES)
def test_a_tool_drives_after_what_the_page_says_and_not_before(
    name: str, kind: Any, steps: list[Step], road: Road
) -> None:
    world = World()
    world.run(0.3)
    tool = kind(world, road)
    for what, linear, seconds in steps:
        since_ns = world.now_ns
        if what == "again":
            tool = kind(world, road, "started again")
        if what == "cleared":
            assert world.call("stop").success
        tool.use(linear, PAUSES[seconds][road] if seconds in PAUSES else seconds)
        if what == "cleared":
            assert world.call("clear").success
        elif what == "rests":
            assert not moved(world, since_ns)
            assert world.state.code == "neutral"
        elif what == "drives":
            assert world.state.mode == "driving", (name, world.state.reason)


@pytest.mark.slow
@pytest.mark.parametrize(("road", "first_s"), [("rmw", 61.0), ("bridge", 10.0)])
def test_the_first_goal_drives_if_the_silence_before_it_lasted_for_the_lease(
    road: Road, first_s: float
) -> None:
    """A goal that begins sooner is cancelled: behind its zero, the next one waits for a second."""
    for wait_s, drives in ((first_s - 0.2, False), (first_s + 0.2, True)):
        world = World()
        tool = Nav2(world, road)
        tool.use(None, wait_s)
        tool.use(FAST, 3.0)
        assert (world.state.mode == "driving") == drives
        tool.use(0.0, 1.4)
        tool.use(FAST, 0.5)
        assert world.state.mode == "driving"


@pytest.mark.slow
@pytest.mark.parametrize("road", ["rmw", "bridge"])
def test_topic_pub_drives_on_cmd_vel_by_the_bridge_only(road: Road) -> None:
    """By rmw each run is a publisher that the daemon has not heard, and it speaks at once."""
    world = World()
    world.run(0.3)
    tool = TopicPub(world, road)
    tool.key = "cmd/nav"
    tool.announce()
    for _ in range(2):
        world.run(PAUSES[ALONE][road])
        tool.use(FAST, 1.0)
        assert world.state.mode == ("driving" if road == "bridge" else "ready")


@pytest.mark.slow
@pytest.mark.parametrize(
    ("road", "other", "least", "most"),
    [("rmw", 0.1, 0.38, 0.42), ("rmw", 0.0, 0.38, 0.42),
     ("bridge", 0.1, 0.09, 0.15), ("bridge", 0.0, 0.0, 0.03)],
)  # fmt: skip
def test_the_first_of_two_publishers_drives_by_rmw_and_both_drive_by_the_bridge(
    road: Road, other: float, least: float, most: float
) -> None:
    world = World()
    world.run(0.3)
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


class Recorded(NamedTuple):
    """What a real Nav2 published on `cmd_vel` after an event, and when the robot drove then."""

    event: Literal["restart", "clear"]
    parts: list[tuple[float | None, float, float]]
    """Speed (None: nothing), Hz and s of each part. A speed follows them."""
    after_s: float | None
    """When the robot drove, after the event; None if it did not."""


ZEROS_HZ = 5.0
"""The rate of collision_monitor's zeros while its scan is invalid, because TF stops."""

FOLLOWED = (0.5, 20.0, 8.0)
END = (0.0, 20.0, 0.05)

RECORDED = {
    "a filter's zeros": Recorded("restart", [(0.0, ZEROS_HZ, 1.8), (None, 1.0, 1.3)], 3.1),
    "the last of a filter's zeros": Recorded(
        "restart", [(0.0, ZEROS_HZ, 0.2), (None, 1.0, 1.3)], 1.5
    ),
    "no zero": Recorded("restart", [(None, 1.0, 1.3)], None),
    "zeros without a second of rest": Recorded(
        "restart", [(0.5, 20.0, 3.0), (0.0, ZEROS_HZ, 0.8)], None
    ),
    "the path is sent again": Recorded("clear", [FOLLOWED, END, (None, 1.0, 1.3)], 9.4),
    "the path is sent again later": Recorded(
        "clear", [(0.5, 20.0, 12.0), END, (None, 1.0, 2.0)], 14.1
    ),
    "the path is sent again at once": Recorded("clear", [FOLLOWED, END, (None, 1.0, 0.6)], None),
    "the controller waits in mid-goal": Recorded("clear", [FOLLOWED, (0.0, 20.0, 1.2)], 9.3),
    "a gap in mid-goal": Recorded("clear", [FOLLOWED, (None, 1.0, 1.3)], None),
    "a new goal after a cancelled one": Recorded(
        "clear", [(0.0, 20.0, 2.0), (None, 1.0, 3.0)], 5.1
    ),
}


@pytest.mark.variations(5)
@pytest.mark.parametrize("road", ["rmw", "bridge"])
@pytest.mark.parametrize("name", RECORDED)
def test_a_goal_under_way_drives_on_after_a_second_of_rest_and_not_before(
    name: str, road: Road
) -> None:
    event, parts, after_s = RECORDED[name]
    world = World()
    nav2 = Speaker(world, road)
    nav2.key, nav2._sent = "cmd/nav", 5000  # it has run for longer than this daemon
    nav2.announce()
    world.run(0.3)
    if event == "clear":
        nav2.open(0.5)
        assert world.call("stop").success
        nav2.hold(0.5, CLEAR_S)
        assert world.call("clear").success
    since_ns = world.now_ns
    for linear, hz, seconds in [*parts, (0.5, 20.0, 2.0)]:
        if linear is None:
            world.run(seconds)
        else:
            nav2.hold(linear, seconds, hz)
    drove = first_motion(world, since_ns)
    if after_s is None:
        assert drove is None
        assert world.state.code == "neutral"
    else:
        assert drove == pytest.approx(after_s, abs=0.3)
