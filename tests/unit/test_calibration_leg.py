"""A leg is driven and recorded in virtual time, with sensors that stamp by other clocks."""

from __future__ import annotations

import math
import time
from collections.abc import Callable, Generator, Iterator
from functools import partial
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from acsard.calibration import leg as legs
from acsard.calibration.leg import Recorder, Sensor, place_and_yaw
from acsard.calibration.log import LogError
from acsard.calibration.plan import Leg, Move
from acsard.client.follower import FIRST_STATE_TIMEOUT_S
from acsard.core.config.settings import Config
from acsard.core.messages.schema import (
    Header,
    Imu,
    JointState,
    Message,
    Odometry,
    Pose,
    PoseStamped,
    PoseWithCovariance,
    Quaternion,
    Time,
    Twist,
    TwistStamped,
    TwistWithCovariance,
    Vector3,
)
from acsard.host import clock
from acsard.host.errors import NoAnswerError, NotDrivenError
from acsard.terminal.prompt import Prompt
from tests.unit.screens import sample_of

CONFIG = Config()
HZ, ARMS_S, STANDS_S = 50, 0.3, legs.STANDS_S
TURNS = 3.0  # rad/s of the wheels for each rad/s
JOINTS = CONFIG.joint_names


class World(Prompt):
    """The robot, its bus, the clock, and the person at the keyboard."""

    def __init__(self) -> None:
        super().__init__()
        self.now, self.sent = 1000.0, 1000.0
        self.queues: dict[str, list[Any]] = {}
        self.command = (0.0, 0.0)
        self.ends = 0
        self.share = 1.0  # of the commanded speed that the wheels roll
        self.clocks = {"wheel_states": 5e8, "imu": 7e8}  # the other senders do not stamp
        self.late: dict[str, Callable[[int], float]] = {}  # s from stamp to arrival, by key
        self.makes: dict[str, Callable[[Header], Message]] = {
            "wheel_states": self.wheels,
            "cmd_vel_out": lambda header: TwistStamped(
                header, Twist(Vector3(x=self.command[0]), Vector3(z=self.command[1]))
            ),
        }
        self.presses = math.inf
        self.shares: list[float] = []
        self.raises: Callable[[], None] = lambda: None
        session: Any = self
        self.session, self.where = session, SimpleNamespace(robot_id="acsar")

    def key(self, name: str) -> str:
        return f"acsard/acsar/{name}"

    def wheels(self, header: Header) -> Message:
        ahead, turn = (self.share * speed for speed in self.command)
        left, right = ahead / 0.05 - TURNS * turn, ahead / 0.05 + TURNS * turn
        # Front and rear wheels differ, and the sides have their means.
        speeds = dict(
            zip(JOINTS, (right + 0.5, left - 0.25, left + 0.25, right - 0.5), strict=True)
        )
        return JointState(header, list(reversed(JOINTS)), [], [*reversed(speeds.values())])

    def publish(self) -> None:
        while self.sent < self.now:
            self.sent += 1 / HZ
            number = round((self.sent - 1000.0) * HZ)
            for name, make in self.makes.items():
                late = self.late[name](number) if name in self.late else 0.0
                at = self.sent + self.clocks[name] - late if name in self.clocks else 0.0
                stamp = Time.from_ns(round(at * 1e9))
                self.queues.setdefault(self.key(name), []).append(sample_of(make(Header(stamp))))

    def wait(self, seconds: float) -> None:
        self.now += seconds
        self.publish()

    def keys(self, wait_s: float) -> str:
        self.wait(wait_s)
        return " " if self.now >= self.presses else ""

    def progress(self, share: float) -> None:
        self.shares.append(share)


@pytest.fixture
def world(monkeypatch: pytest.MonkeyPatch) -> World:
    made = World()

    def subscription(session: Any, key: str) -> Any:
        queue = made.queues.setdefault(key, [])
        return SimpleNamespace(try_recv=lambda: queue.pop(0) if queue else None)

    def driver(client: World) -> Any:
        def zeros() -> Iterator[float]:
            client.command = 0.0, 0.0
            yield 0.1

        def end() -> None:
            client.ends += 1

        return SimpleNamespace(ride=SimpleNamespace(begun=None), zeros=zeros, end=end)

    def drive(linear: float, angular: float, seconds: float) -> Any:
        def steps(driver: Any) -> Generator[float, None, None]:
            yield ARMS_S
            driver.ride.begun, made.command = made.now, (linear, angular)
            for _ in range(round(seconds / 0.5)):
                yield 0.5
                made.raises()
            made.command = 0.0, 0.0
            yield 0.1

        return steps

    monkeypatch.setattr(legs, "Subscription", subscription)
    monkeypatch.setattr(legs, "Driver", driver)
    monkeypatch.setattr(legs, "drive", drive)
    monkeypatch.setattr(clock, "steady_s", lambda: made.now)
    monkeypatch.setattr(time, "sleep", made.wait)
    return made


def recorder(world: World) -> Recorder:
    client: Any = world
    return Recorder(client, CONFIG, world)


def gyro(world: World) -> None:
    world.makes["imu"] = lambda header: Imu(
        header=header, angular_velocity=Vector3(x=9.0, z=0.7 * world.command[1])
    )


LEG = Leg("a", "", (Move(0.5), Move(2.0, 0.3, 0.5), Move(1.0, -0.1), Move(0.4)))


def test_a_leg_records_the_wheels_the_gyro_and_the_commands(world: World) -> None:
    gyro(world)
    # The clocks of the senders differ, and only the least delay counts.
    world.late = {"imu": lambda n: 0.03 * (n % 3), "wheel_states": lambda n: 0.04 * (n % 2)}
    made = recorder(world)
    made.add_gyro()
    run = made.ride(LEG)
    assert run.name == "a"
    assert run.left[-1] == pytest.approx(2.0 * (6.0 - 1.5) - 1.0 * 2.0, abs=0.2)
    assert run.right[-1] == pytest.approx(2.0 * (6.0 + 1.5) - 1.0 * 2.0, abs=0.2)
    assert run.turned[-1] == pytest.approx(0.7 * 0.5 * 2.0, abs=0.01)
    begun, turns = (
        float(t[np.argmax(values)])
        for t, values in ((run.t[1:], np.diff(run.left) > 0.01), (run.gyro_t, run.rate > 0.1))
    )
    assert begun == pytest.approx(0.5 + ARMS_S, abs=0.05)
    assert turns == pytest.approx(begun, abs=0.05)
    assert run.commands.max(axis=0) == pytest.approx([0.3, 0.5])
    assert run.commands_t[run.commands[:, 0] > 0].min() == pytest.approx(begun, abs=0.05)
    # The sensors may be late, so the end is recorded for a while.
    ends = 0.5 + 2.0 + 1.0 + 0.4 + 2 * (ARMS_S + 0.2)
    assert run.seconds == pytest.approx(ends + STANDS_S, abs=0.15)
    assert world.ends == 2
    assert world.shares == sorted(world.shares)
    assert world.shares[-2:] == [pytest.approx(0.99, abs=0.1), 1.0]
    assert max(world.shares[:-1]) <= 0.99
    assert 10 < len(world.shares) < 25  # every 0.2 s
    again = made.ride(LEG)
    assert again.seconds == pytest.approx(run.seconds, abs=0.1)  # without what came before


@pytest.mark.parametrize("kind", [PoseStamped, Odometry])
def test_poses_of_both_types_are_recorded(world: World, kind: type[Message]) -> None:
    def pose(header: Header) -> Message:
        half = 0.4 * (world.now - 1000.0) / 2
        made = Pose(Vector3(x=world.now - 1000.0, y=2.0),
                    Quaternion(z=math.sin(half), w=math.cos(half)))  # fmt: skip
        if kind is PoseStamped:
            return PoseStamped(header, made)
        still, none = Twist(Vector3(), Vector3()), [0.0] * 36
        return Odometry(
            header, "", PoseWithCovariance(made, none), TwistWithCovariance(still, none)
        )

    world.makes["pose"] = pose
    made = recorder(world)
    made.add_poses(world.key("pose"), world.session)
    begun = world.now - 1000.0
    run = made.ride(LEG)
    assert run.place[0] == pytest.approx(begun + 2j, abs=0.1)
    assert run.place[-1].real - run.place[0].real == pytest.approx(run.seconds, abs=0.1)
    turned = float(np.unwrap(run.yaw)[-1] - run.yaw[0])
    assert turned == pytest.approx(0.4 * run.seconds, abs=0.05)
    assert not len(run.gyro_t)


def test_any_key_ends_a_leg_and_the_last_move_of_one_that_waits_for_it(world: World) -> None:
    waits = Leg("b", "", (Move(1.0, 0.3), Move(4.0, 0.0, 0.5)), by_key=True)
    for leg, presses in ((LEG, 1.5), (waits, 0.7)):
        world.presses = world.now + presses
        with pytest.raises(NotDrivenError, match="a key was pressed"):
            recorder(world).ride(leg)
        assert world.now <= world.presses + 0.2
        assert world.command == (0.0, 0.0)
    world.presses = world.now + 1.0 + 2 * ARMS_S + 0.2 + 2.0
    run = recorder(world).ride(waits)
    assert run.right[-1] - run.left[-1] == pytest.approx(2.0 * 0.5 * 2 * TURNS, abs=0.3)
    world.presses = math.inf
    with pytest.raises(NotDrivenError, match="no key was pressed, although the robot must have"):
        recorder(world).ride(waits)


@pytest.mark.parametrize("error", [NotDrivenError, NoAnswerError])
def test_a_pause_of_this_computer_explains_why_the_robot_is_not_driven(
    world: World, error: type[Exception]
) -> None:
    for pause, words in ((0.19, "^other$"), (0.3, r"did not run the calibration for 0\.3 s")):
        # The computer pauses, and the robot's state says so half a second later.
        steps = [partial(world.wait, pause), partial(raised, error("other"))]
        world.raises = lambda steps=steps: steps.pop(0)()  # type: ignore[misc]
        with pytest.raises((NotDrivenError, error), match=words):
            recorder(world).ride(LEG)


def raised(error: Exception) -> None:
    raise error


def test_wheels_that_stand_end_a_leg_within_2_s_and_others_after_it(world: World) -> None:
    world.share = 0.0
    with pytest.raises(NotDrivenError, match=r"moved 0\.00 m, although 0\.\d\d m was commanded"):
        recorder(world).ride(Leg("c", "", (Move(9.0, 0.3),)))
    assert 1.5 < world.now - 1000.0 < 2.5 + ARMS_S
    # At the end, there is no time left in which late wheels could follow.
    world.share = 0.7
    with pytest.raises(NotDrivenError, match=r"moved 0\.4\d m, although 0\.60 m was commanded"):
        recorder(world).ride(Leg("c", "", (Move(2.0, 0.3),)))
    world.makes.clear()
    with pytest.raises(NotDrivenError, match="hardly any wheel speeds arrive"):
        recorder(world).ride(Leg("c", "", (Move(2.0, 0.3),)))


def test_sensors_that_are_silent_or_of_another_type_are_named(world: World) -> None:
    made = recorder(world)
    with pytest.raises(LogError, match=r"a gyro's turn rate does not arrive .* acsard/acsar/imu:"):
        made.add_gyro()
    assert world.now - 1000.0 == pytest.approx(FIRST_STATE_TIMEOUT_S, abs=0.1)
    with pytest.raises(LogError, match=r"a pose \(PoseStamped or Odometry\) does not arrive"):
        made.add_poses(world.key("pose"), world.session)
    gyro(world)
    world.wait(1.0)
    with pytest.raises(LogError, match=r"key acsard/acsar/imu cannot be read \(.*; .*\): does the"):
        made.add_poses(world.key("imu"), world.session)
    world.makes["wheel_states"] = lambda header: JointState(header, ["a"], [], [1.0])
    with pytest.raises(LogError, match=f"wheel_states has no speed of {JOINTS[0]}: if another"):
        recorder(world).ride(LEG)


@pytest.mark.parametrize(
    ("stamps", "times"),
    [
        ((5.0, 6.0, 7.0), (11.5, 12.5, 13.5)),  # by the one with the least delay
        ((0.0, 6.0, 7.0), (12.0, 13.0, 13.5)),  # one has no stamp
        ((5.0, 6.0, 11.6), (12.0, 13.0, 13.5)),  # no message is late by more than 5 s
        ((5.0, 6.0, 11.4), (5.0 + 2.1, 6.0 + 2.1, 13.5)),
    ],
)
def test_stamps_count_if_all_samples_have_one_of_one_clock(
    world: World, stamps: tuple[float, ...], times: tuple[float, ...]
) -> None:
    session: Any = world
    sensor = Sensor(session, "a", (Imu,), lambda m: (m.angular_velocity.z,), ("yaw_rate",))
    assert [len(column) for column in sensor.stream()] == [0, 0]
    for arrival, stamp in zip((12.0, 13.0, 13.5), stamps, strict=True):
        header = Header(Time.from_ns(round(stamp * 1e9)))
        message = Imu(header=header, angular_velocity=Vector3(z=arrival))
        world.queues["a"].append(sample_of(message, "a"))
        assert sensor.receive(arrival) == 1
    t, rate = sensor.stream()
    assert t == pytest.approx(times)
    assert rate == pytest.approx([12.0, 13.0, 13.5])


def test_a_key_has_messages_of_one_type(world: World) -> None:
    session: Any = world
    pose = Pose(Vector3(x=1.0, y=2.0), Quaternion())
    still, none = Twist(Vector3(), Vector3()), [0.0] * 36
    odometry = Odometry(
        Header(), "", PoseWithCovariance(pose, none), TwistWithCovariance(still, none)
    )
    messages: list[Message] = [odometry, PoseStamped(Header(), pose)]
    for first, second in (messages, messages[::-1]):
        sensor = Sensor(session, "b", (Odometry, PoseStamped), place_and_yaw, ("x", "y", "yaw"))
        world.queues["b"] += [sample_of(first, "b"), sample_of(first, "b")]
        assert sensor.receive(1.0) == 2
        world.queues["b"].append(sample_of(second, "b"))
        with pytest.raises(LogError, match="does the sender publish another message type"):
            sensor.receive(1.0)


def test_a_pose_is_a_place_and_the_turn_about_z() -> None:
    pose = Pose(Vector3(x=1.0, y=2.0), Quaternion(z=math.sin(0.4), w=math.cos(0.4)))
    assert place_and_yaw(PoseStamped(Header(), pose)) == pytest.approx((1.0, 2.0, 0.8))
