"""Time that no trusted line covers is in the covariance, whoever is the cause, and bounded."""

from __future__ import annotations

import math
from typing import Any

import pytest

from acsard.core.config.settings import (
    Config,
    FeedbackConfig,
    McuConfig,
    SimConfig,
    WheelMap,
)
from acsard.core.simulator import fake_mcu
from tests.scenarios.boards import blocks, reports_its_last_instant, turn_encoders
from tests.scenarios.world import World
from tests.wheels import four_and_two

MS = 1_000_000


def sigmas(world: World) -> float:
    """Return by how many deviations the pose of `odom` is wrong, the largest of three."""
    state, true, cells = world.state, world.mcu.vehicle.pose, world.odom.pose.covariance
    off = state.x - true.x, state.y - true.y, math.remainder(state.yaw - true.yaw, math.tau)
    return max(abs(e) / math.sqrt(cells[k]) for e, k in zip(off, (0, 7, 35), strict=True))


@pytest.mark.variations(13)
@pytest.mark.parametrize("stall", [0.2, 0.4, 0.6])
@pytest.mark.parametrize(("linear", "angular"), [(0.5, 0.0), (0.0, 1.2)])
@pytest.mark.parametrize("link_check", ["off", "on"])
@four_and_two
def test_a_stall_of_this_computer_is_a_doubt_if_the_board_reports_its_last_instant(
    stall: float, linear: float, angular: float, link_check: Any, wheels: WheelMap
) -> None:
    """The board's watchdog stops the motors, and no line says when."""
    world = World(Config(mcu=McuConfig(link_check=link_check, wheels=wheels)))
    reports_its_last_instant(world.mcu)
    world.run(1.0)
    for _ in range(5):
        world.drive(linear, angular, 2.0)
        world.stall(stall)
        world.hold(linear, angular, 0.5)
    world.drive(0.0, 0.0, 1.5)
    assert sigmas(world) < 3.0


@pytest.mark.variations(65)
@pytest.mark.parametrize("together", [True, False], ids=["one read", "paced"])
@pytest.mark.parametrize("repeats", [True, False], ids=["repeats", "zeros"])
@pytest.mark.parametrize("baud", [115_200, 500_000])
@pytest.mark.parametrize(("every", "block"), [(0.5, 0.08), (0.5, 0.05), (1.0, 0.15), (0.25, 0.03)])
@pytest.mark.parametrize(("linear", "angular"), [(0.3, 0.0), (0.0, 0.8)])
def test_lines_that_a_blocked_board_answers_together_lose_no_time(
    monkeypatch: pytest.MonkeyPatch, linear: float, angular: float,
    every: float, block: float, repeats: bool, together: bool, baud: Any,
) -> None:  # fmt: skip
    """The first answer has the motion of the whole silence, and the others have none."""
    if not repeats:
        monkeypatch.setattr(fake_mcu, "MIN_WINDOW_NS", 0)
    world = World(Config(mcu=McuConfig(baud_rate=baud)))
    world.run(1.0)
    blocks(world.mcu, every, block)
    if together:
        world.mcu.switches.stall_every_ns = int(every * 1e9)
        world.mcu.switches.stall_ns = int(block * 1e9) + 8 * MS
    world.drive(linear, angular, 12.0)
    world.drive(0.0, 0.0, 1.5)
    true, state = world.mcu.vehicle.pose, world.state
    assert sigmas(world) < 3.0
    if repeats or (baud > 115_200 and block > 0.04):  # the wire is slower than the lines' time
        assert state.x == pytest.approx(true.x, abs=0.03 * 3.6)
        assert abs(math.remainder(state.yaw - true.yaw, math.tau)) < 0.03 * 9.6


@pytest.mark.parametrize("link_check", ["off", "on"])
@pytest.mark.parametrize("how", ["unplugged", "lent"])
def test_a_robot_that_is_pushed_while_its_board_is_away_is_not_certain(
    how: str, link_check: Any
) -> None:
    counts = 3200 if link_check == "on" else 0
    world = World(
        Config(mcu=McuConfig("/dev/ttyACM0", link_check=link_check, encoder_counts=counts))
    )
    world.run(0.5)
    world.drive(0.3, 0.0, 2.0)
    world.drive(0.0, 0.0, 1.0)
    mcu = world.mcu
    if how == "lent":
        assert world.call("deactivate", b'{"release_port": true}').success
    world.port.unplug()
    for _ in range(12):
        with mcu.fault("pushed", 0.6):
            world.run(0.5)
            mcu.advance(world.now_ns)
    world.run(2.0)
    world.port.plug(mcu)
    if how == "lent":
        world.call("activate")
    world.run(2.0)
    assert abs(world.state.x - mcu.vehicle.pose.x) > 3.0
    assert sigmas(world) < 1.5
    assert world.odom.pose.covariance[0] < 150.0
    assert world.call("set_pose", b'{"x": 1.0, "y": 2.0, "yaw": 0.0}').success
    world.run(0.5)
    assert world.odom.pose.covariance[0] < 1e-3


@pytest.mark.variations(19)
@pytest.mark.parametrize("counts", [16, 20, 48, 96])
@pytest.mark.parametrize("speed", [0.15, 0.3, 0.45])
@pytest.mark.parametrize("period", [0.07, 0.1, 0.2])
def test_a_board_that_reports_rarely_gives_the_mean_of_its_wheels(
    period: float, speed: float, counts: int
) -> None:
    """No line is damaged, so no line is repaired. The counts are not declared."""
    mcu = McuConfig(reply_period=period)
    world = World(Config(mcu=mcu, sim=SimConfig(encoder_counts=counts)))
    turn_encoders(world.mcu, [0.0, 0.1, 0.2, 0.25])
    with world.mcu.fault("free_running", period):
        world.run(1.5)
        world.drive(speed, 0.0, 12.0)
        world.drive(0.0, 0.0, 2.0)
    assert world.state.x == pytest.approx(world.mcu.vehicle.pose.x, rel=0.01, abs=0.03)
    assert sigmas(world) < 3.0
    assert world.state.mode != "fault"


@pytest.mark.variations(12)
@pytest.mark.parametrize("link_check", ["off", "on"])
@pytest.mark.parametrize("gyro", [False, True])
@pytest.mark.parametrize(("load", "push"), [(0.2, None), (1.0, None), (0.0, 0.5)])
def test_without_encoders_the_whole_commanded_motion_is_a_doubt(
    load: float, push: float | None, link_check: Any, gyro: bool
) -> None:
    base = Config()
    world = World(
        Config(
            mcu=McuConfig(link_check=link_check),
            feedback=FeedbackConfig(encoders=False),
            odometry=type(base.odometry)(gyro=gyro),
        )
    )
    mcu = world.mcu

    def set_points(now_ns: int) -> list[float]:
        return [sign * mcu.vehicle.set_points[motors[0]] for motors, sign in mcu._wiring]

    mcu._speeds = set_points  # type: ignore[method-assign]
    world.run(1.0)
    mcu._vehicle.load = load
    if push is None:
        world.drive(0.3, 0.0, 20.0)
    else:
        with mcu.fault("pushed", push):
            world.drive(0.3, 0.0, 20.0)
    world.drive(0.0, 0.0, 2.0)
    assert sigmas(world) < 3.0
    before = world.odom.pose.covariance
    world.run(20.0)
    assert world.odom.pose.covariance == pytest.approx(before)


@pytest.mark.slow
@pytest.mark.parametrize("link_check", ["off", "on"])
def test_a_robot_that_was_unplugged_for_long_drives_on_and_its_pose_can_be_set(
    link_check: Any,
) -> None:
    """Its doubt is bounded within 10 s: a night is no other than half an hour."""
    world = World(Config(mcu=McuConfig("/dev/ttyACM0", link_check=link_check)))
    world.run(1.5)
    world.drive(0.3, 0.2, 2.0)
    world.drive(0.0, 0.0, 1.0)
    mcu = world.mcu
    world.port.unplug()
    world.run(1800.0)
    world.port.plug(mcu)
    world.run(2.0)
    assert world.odom.pose.covariance[0] < 102.0
    before = mcu.vehicle.pose
    world.drive(0.3, 0.0, 2.0)
    assert math.dist((before.x, before.y), (mcu.vehicle.pose.x, mcu.vehicle.pose.y)) > 0.4
    assert world.state.mode == "driving"
    world.drive(0.0, 0.0, 1.0)
    assert world.call("set_pose", b'{"x": 1.0, "y": 2.0, "yaw": 0.0}').success
    world.run(0.5)
    assert world.odom.pose.covariance[0] < 1e-4


@pytest.mark.variations(4)
@pytest.mark.parametrize("link_check", ["off", "on"])
@pytest.mark.parametrize("speed", [(0.4, 0.0), (-0.4, 0.0), (0.0, 1.5)])
def test_the_doubt_of_a_long_silence_in_a_drive_is_bounded(
    speed: tuple[float, float], link_check: Any
) -> None:
    world = World(Config(mcu=McuConfig(link_check=link_check, encoder_counts=3200)))
    world.run(1.5)
    world.drive(*speed, seconds=2.0)
    with world.mcu.fault("mute"):
        world.hold(*speed, seconds=0.2)
        world.hold(0.0, 0.0, 120.0)
    world.hold(0.0, 0.0, 1.0)
    covariance = world.odom.pose.covariance
    assert covariance[0] < 10.5**2
    assert covariance[35] < 3.8**2
