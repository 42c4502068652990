"""Tests of one leg of a guided calibration: the commands it sends, and the events that end it."""

from __future__ import annotations

from collections.abc import Callable

import msgspec
import pytest
from msgspec.structs import replace

from acsard.calibration.guided.drive_plan import Leg, Move
from acsard.calibration.guided.leg_driver import STALL_REASON, LegDriver, Phase
from acsard.client.follower import MAX_STATE_AGE_S
from acsard.client.ride import OPEN_TIMEOUT_S
from acsard.core.config.settings import Config, DriveConfig, LimitsConfig
from acsard.core.messages.schema import RobotState, SourceState, Time
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.limits import AT_REST
from acsard.core.values import REST, Twist, WheelSpeeds
from tests.each import each

US, OTHER = "joe/1/aa", "joe/2/bb"
LEG = Leg("", "", (Move(1.0, 0.3, 0.0), Move(2.0, 0.0, 0.5)))
TURN = Leg("", "", (Move(5.0, 0.0, 0.5),), by_key=True)

TICK = 0.02
RADIUS, TRACK = 0.05, 0.30

NO_RAMPS = Config(
    limits=LimitsConfig(
        linear_acceleration=1000.0, linear_deceleration=1000.0, angular_acceleration=1000.0,
        angular_deceleration=1000.0,
    )
)  # fmt: skip

Late = Callable[[RobotState], RobotState]


def telling(twist: Twist) -> RobotState:
    """Return the `state` of a robot that follows this twist of the source `app`."""
    left, right = (
        (twist.linear + side * twist.angular * TRACK / 2) / RADIUS for side in (-1.0, 1.0)
    )
    return RobotState(
        stamp=Time(), mode="driving", reason="commanded by app", x=0.0, y=0.0, yaw=0.0,
        linear=twist.linear, angular=twist.angular, wheels=[right, left, left, right], link="up",
        source="app", sources=[SourceState("app", 50, 0.01, "", "nothing")], refused="",
        counters={}, sender=US,
    )  # fmt: skip


class World:
    """A daemon that publishes its state every tick, and a robot that follows its commands."""

    def __init__(self, leg: Leg) -> None:
        self.now = 100.0
        self.driver = LegDriver(leg, "app", NO_RAMPS, self.now, US)
        self.said: list[Twist] = []
        self.tells: Late = lambda state: state
        self.speaks = True
        self.period, self.wheels_due = 0.0, 0.0

    def run(self, seconds: float) -> World:
        for _ in range(round(seconds / TICK)):
            self.now += TICK
            done = self.said[-1] if self.said else REST
            if self.speaks:
                state = self.tells(telling(done))
                self.driver.state(state, self.now)
                if state.wheels and self.now >= self.wheels_due:
                    self.wheels_due = self.now + self.period
                    self.driver.wheels(WheelSpeeds(*state.wheels), self.now + 1e9, self.now)
            self.said.append(self.driver.step(self.now))
        return self

    def until_moving(self) -> World:
        while self.said[-1:] in ([], [REST]):
            self.run(TICK)
        return self


def changed(**fields: object) -> Late:
    return lambda state: msgspec.structs.replace(state, **fields)


def test_a_leg_begins_with_zeros_drives_its_moves_and_ends_when_the_wheels_stand() -> None:
    world = World(LEG).run(5.0)
    times = {twist: world.said.count(twist) * TICK for twist in world.said}
    assert world.said[0] == REST
    assert times[Twist(0.3, 0.0)] == pytest.approx(1.0, abs=2 * TICK)
    assert times[Twist(0.0, 0.5)] == pytest.approx(2.0, abs=2 * TICK)
    assert (world.driver.phase, world.said[-1]) == (Phase.DONE, REST)
    assert world.driver.progress(world.now) == 1.0


def test_wheels_that_follow_their_command_by_the_configured_radii_do_not_halt_the_leg() -> None:
    leg, size = Leg("", "", (Move(4.0, 0.3, 0.0),)), 0.6
    world = World(leg)
    drive = DriveConfig(left_wheel_radius_multiplier=size, right_wheel_radius_multiplier=size)
    world.driver = LegDriver(leg, "app", replace(NO_RAMPS, drive=drive), world.now, US)
    world.tells = lambda state: msgspec.structs.replace(
        state, wheels=[speed / size for speed in state.wheels]
    )
    world.run(6.0)
    assert (world.driver.phase, world.driver.halted) == (Phase.DONE, "")


def test_nothing_moves_until_the_daemon_accepts_the_zeros() -> None:
    world = World(LEG)
    waiting = [SourceState("app", 50, 0.01, "send a zero first: app must send a zero", "neutral")]
    world.tells = changed(sources=waiting, mode="ready", source="", sender="")
    world.run(OPEN_TIMEOUT_S + 0.5)
    assert set(world.said) == {REST}
    assert "send a zero first" in world.driver.halted


STOPS: dict[str, Late] = {
    "the robot is stopped": changed(mode="stopped", reason="stopped by top"),
    "the robot is fault": changed(mode="fault"),
    "the robot is waiting": changed(mode="waiting"),
    "the robot is inactive": changed(mode="inactive"),
    "the robot is shutdown": changed(mode="shutdown"),
    "teleop commands the robot now": changed(source="teleop"),
    "send a zero first": changed(
        mode="ready",
        source="",
        sources=[SourceState("app", 50, 0.01, "send a zero first", "neutral")],
    ),
    "the daemon receives no command of source app": changed(
        sources=[SourceState("app", 50, 3.0, "a command", "command")]
    ),
    "the daemon has received no command of source app for 0.4 s": changed(
        sources=[SourceState("app", 50, 3.0, "", "nothing")]
    ),
    "app is not one of commands.sources": changed(
        sources=[SourceState("nav", 50, 0.01, "", "nothing")]
    ),
    "by its wheels although": changed(wheels=[0.0] * 4),
    "sends no feedback": changed(wheels=[]),
}


PASSING = {
    "the daemon has received no command of source app for 0.4 s", "by its wheels although",
    "sends no feedback",
}  # fmt: skip
"""The stops of `STOPS` that may not happen again."""


@each("why", STOPS)
def test_a_leg_that_halts_on_a_fault_never_moves_again(why: str) -> None:
    """The leg may be repeated only after a disturbance that ends by itself."""
    world = World(Leg("", "", (Move(10.0, 0.3),))).until_moving().run(2.0)
    world.tells = STOPS[why]
    world.run(3.0)
    stopped = world.said.index(REST, world.said.index(Twist(0.3, 0.0)))
    assert set(world.said[stopped:]) == {REST}
    assert world.driver.phase is Phase.HALTED
    assert why in world.driver.halted
    assert world.driver.disturbed == (why in PASSING)
    world.tells = lambda state: state
    assert set(world.run(3.0).said[stopped:]) == {REST}


TWO = [
    SourceState(
        "app",
        50,
        0.01,
        "1 other sender of this source must wait until the sender that drives falls silent",
        "senders",
    )
]


def of_two(leg: Leg, sender: str) -> World:
    """Return a world whose daemon receives commands of two calibrations and obeys `sender`."""
    world = World(leg)
    world.tells = changed(sources=TWO, sender=sender)
    return world


def test_a_link_that_was_lost_because_this_computer_did_not_run_is_a_passing_disturbance() -> None:
    world = World(Leg("", "", (Move(10.0, 0.3),))).until_moving()
    world.tells = changed(mode="waiting", code="host_late")
    assert world.run(1.0).driver.disturbed


def test_the_calibration_that_the_daemon_follows_continues_beside_another_one() -> None:
    assert of_two(LEG, US).run(5.0).driver.phase is Phase.DONE


def test_a_calibration_that_must_wait_names_the_driving_program_and_moves_nothing() -> None:
    world = of_two(LEG, OTHER).run(OPEN_TIMEOUT_S + 0.5)
    assert set(world.said) == {REST}
    assert world.driver.halted.startswith(
        f"another program, {OTHER}, drives the robot as source app"
    )
    assert "end that program, or wait" in world.driver.halted


def test_a_calibration_that_loses_the_robot_to_another_program_names_it_in_one_tick() -> None:
    world = of_two(LEG, US).until_moving()
    world.tells = changed(sources=TWO, sender=OTHER)
    world.run(TICK)
    assert OTHER in world.driver.halted


def test_a_calibration_waits_for_a_program_that_leaves_during_the_zeros() -> None:
    world = of_two(LEG, OTHER).run(1.0)
    world.tells = changed(sender=US)
    assert world.run(5.0).driver.phase is Phase.DONE


def test_a_daemon_that_falls_silent_halts_the_leg() -> None:
    world = World(Leg("", "", (Move(10.0, 0.3),))).until_moving()
    world.speaks = False
    world.run(MAX_STATE_AGE_S + 2 * TICK)
    assert world.said[-1] == REST
    assert (
        world.driver.halted
        == "no messages of the daemon arrive: does the daemon run (`acsard doctor`)?"
    )
    assert world.driver.silent
    assert not world.driver.disturbed


def test_a_calibration_that_was_held_up_halts_and_does_not_blame_the_daemon() -> None:
    world = World(Leg("", "", (Move(10.0, 0.3),))).until_moving()
    assert world.driver.step(world.now + MAX_STATE_AGE_S + TICK) == REST
    assert world.driver.halted == STALL_REASON
    assert world.driver.disturbed


def test_a_calibration_that_was_held_up_does_not_continue_on_queued_messages() -> None:
    """Ctrl-Z, Ctrl-S or a busy computer suspends the calibration.

    When it continues, it first receives old messages, and these must not keep the leg running.
    """
    world = World(LEG).until_moving()
    world.now += 1.5
    world.run(TICK)
    assert world.said[-1] == REST
    assert world.driver.halted == STALL_REASON
    assert set(world.run(3.0).said[-100:]) == {REST}


def test_a_calibration_that_was_held_up_before_its_first_move_does_not_start_it() -> None:
    world = World(LEG).run(0.1)
    world.now += 1.5
    assert set(world.run(3.0).said) == {REST}
    assert world.driver.halted == STALL_REASON
    assert world.driver.disturbed


def test_a_key_pressed_while_the_calibration_was_held_up_does_not_end_a_turn_well() -> None:
    world = World(TURN).until_moving()
    world.now += 1.5
    world.driver.key(" ", world.now)
    assert world.driver.halted == STALL_REASON
    assert not world.driver.disturbed  # the person may have wanted it to stop


def test_a_leg_continues_after_a_brief_interruption_of_its_commands() -> None:
    world = World(Leg("", "", (Move(10.0, 0.3),))).until_moving()
    world.tells = changed(sources=[SourceState("app", 50, 0.4, "", "nothing")], wheels=[0.0] * 4)
    world.run(0.3)
    world.tells = lambda state: state
    assert not world.run(3.0).driver.halted


def limited(linear: float, angular: float) -> Late:
    """Return a function that lowers the speeds of a state, as a limit of the daemon does."""

    def lower(state: RobotState) -> RobotState:
        twist = Twist(
            min(linear, max(-linear, state.linear or 0.0)),
            min(angular, max(-angular, state.angular or 0.0)),
        )
        return msgspec.structs.replace(state, wheels=telling(twist).wheels)

    return lower


SQUARE = Leg("", "", (Move(4.0, 0.3), Move(0.6), Move(1.75, 0.0, 0.9), Move(0.6)) * 4)


@each(
    ("moves", "tells"),
    [
        ((Move(6.7, 0.3), Move(0.6)), limited(0.165, 9.0)),
        (SQUARE.moves, limited(9.0, 0.52)),
        (SQUARE.moves, limited(9.0, 0.001)),
    ],
)
def test_a_leg_halts_if_a_limit_keeps_the_robot_from_the_planned_path(
    moves: tuple[Move, ...], tells: Late
) -> None:
    world = World(Leg("", "", moves))
    world.tells = tells
    world.run(40.0)
    assert world.driver.phase is Phase.HALTED
    assert "is there a speed limit" in world.driver.halted
    # The second side of a square has begun at most.
    assert world.said.count(Twist(0.3)) * TICK < 6.7 + TICK


def ramped(linear: float, angular: float, right: float = 1.0) -> Late:
    """Return a function that lets a robot follow with these accelerations, m/s2 and rad/s2.

    `right` is the speed of the right wheels as a fraction of the commanded speed.
    """
    rolling = [0.0, 0.0]

    def follow(state: RobotState) -> RobotState:
        for i, (goal, step) in enumerate(
            ((state.linear or 0.0, linear * TICK), (state.angular or 0.0, angular * TICK))
        ):
            rolling[i] += max(-step, min(step, goal - rolling[i]))
        front, left, rear, last = telling(Twist(*rolling)).wheels
        return msgspec.structs.replace(state, wheels=[front * right, left, rear, last * right])

    return follow


SLOW_RAMPS = LimitsConfig(
    linear_acceleration=0.3, linear_deceleration=1.0, angular_acceleration=1.0,
    angular_deceleration=4.0,
)  # fmt: skip
TURNS = Leg("", "", (Move(0.6), Move(63.0, 0.0, 1.0), Move(0.6)))


@each(
    ("leg", "limits", "tells"),
    [
        (SQUARE, NO_RAMPS.limits, ramped(0.4, 1.2)),
        (SQUARE, NO_RAMPS.limits, ramped(9.0, 9.0, right=0.95)),
        (Leg("", "", (Move(6.7, 0.3),)), NO_RAMPS.limits, ramped(9.0, 9.0, right=0.95)),
        (TURNS, NO_RAMPS.limits, ramped(9.0, 9.0, right=0.95)),
    ],
)
def test_a_robot_that_follows_within_a_few_percent_finishes_its_leg(
    leg: Leg, limits: LimitsConfig, tells: Late
) -> None:
    world = World(leg)
    world.driver = LegDriver(leg, "app", Config(limits=limits), world.now, US)
    world.tells = tells
    world.run(80.0)
    assert (world.driver.phase, world.driver.halted) == (Phase.DONE, "")


def test_the_ramps_of_the_configuration_are_part_of_the_commanded_path() -> None:
    """Each side of a square is shorter because the robot starts more slowly than it brakes."""
    world = World(SQUARE)
    config = Config(limits=SLOW_RAMPS)
    world.driver = LegDriver(SQUARE, "app", config, world.now, US)
    motion, kinematics = AT_REST, Kinematics(DriveConfig())

    def follow(state: RobotState) -> RobotState:
        nonlocal motion
        wish = Twist(state.linear or 0.0, state.angular or 0.0)
        motion = motion.follow(wish, TICK, SLOW_RAMPS, kinematics)
        return msgspec.structs.replace(state, wheels=telling(motion.twist).wheels)

    world.tells = follow
    world.run(40.0)
    assert (world.driver.phase, world.driver.halted) == (Phase.DONE, "")


def test_wheel_speeds_may_be_published_rarely() -> None:
    world = World(SQUARE)
    world.period = 0.3
    world.run(40.0)
    assert (world.driver.phase, world.driver.halted) == (Phase.DONE, "")


def test_progress_is_the_elapsed_share_of_the_time() -> None:
    world = World(LEG).until_moving()
    shares = [world.run(0.5).driver.progress(world.now) for _ in range(5)]
    assert shares == pytest.approx([share / 6 for share in range(1, 6)], abs=0.02)


def test_a_key_halts_the_leg_in_the_same_step() -> None:
    world = World(LEG).until_moving()
    world.driver.key(" ", world.now)
    assert world.driver.step(world.now) == REST
    assert world.driver.phase is Phase.HALTED


def test_enter_pressed_during_the_opening_zeros_does_not_halt_the_leg() -> None:
    world = World(LEG).run(0.1)
    world.driver.key("\n", world.now)
    world.until_moving()
    assert not world.driver.halted


@pytest.mark.parametrize("leg", [LEG, TURN], ids=["leg", "turn"])
def test_any_other_key_during_the_opening_zeros_halts_the_leg_before_it_moves(leg: Leg) -> None:
    world = World(leg).run(0.1)
    world.driver.key(" ", world.now)
    world.run(3.0)
    assert set(world.said) == {REST}
    assert world.driver.phase is Phase.HALTED


def test_a_key_ends_a_turn_with_success() -> None:
    world = World(TURN).until_moving()
    world.run(1.0)
    world.driver.key(" ", world.now)
    assert world.driver.step(world.now) == REST
    assert world.run(1.0).driver.phase is Phase.DONE


def test_a_turn_without_a_key_press_is_halted() -> None:
    world = World(TURN).run(8.0)
    assert world.said[-1] == REST
    assert "no key was pressed" in world.driver.halted


def test_a_gyro_that_shows_less_turn_than_the_wheels_does_not_halt_the_leg() -> None:
    world = World(LEG)
    world.tells = changed(angular=0.2, linear=0.3)
    assert world.run(5.0).driver.phase is Phase.DONE


def test_wheels_that_never_come_to_rest_are_reported() -> None:
    world = World(Leg("", "", (Move(0.5, 0.3),))).until_moving().run(0.6)
    for _ in range(500):
        world.now += TICK
        world.driver.state(telling(REST), world.now)
        world.driver.wheels(WheelSpeeds(0.1, -0.1, 0.1, -0.1), world.now, world.now)
        world.driver.step(world.now)
    assert "come to rest" in world.driver.halted
