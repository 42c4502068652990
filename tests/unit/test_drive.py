"""How a robot drives: by a fresh command of an armed sender, along its ramps, line by line."""

from __future__ import annotations

import pytest

from acsard.core.config.settings import CommandsConfig, Config, ControlConfig, LimitsConfig, Source
from acsard.core.values import (
    REST,
    STILL,
    Command,
    Plain,
    Pose,
    Refusal,
    Request,
    Twist,
)
from tests.each import each
from tests.unit.rig import GO, MS, Rig


def near(*values: float) -> object:
    return pytest.approx(list(values), abs=1e-12)


def test_after_a_zero_a_command_drives_and_not_before() -> None:
    rig = Rig().linked()
    assert {out.applied for out in rig.each(100, GO)} == {REST}
    assert (rig.mode, rig.out.code, rig.out.source) == ("ready", "neutral", "app")
    rig.step(REST, tick=False)
    out = rig.step(GO, tick=False)
    assert (out.mode, out.code, out.source, out.command_ns) == (
        "driving", "commanded", "app", rig.now_ns,
    )  # fmt: skip
    # A step without a tick uses commands and feedback, and sends no line.
    assert (out.line, out.due, len(out.estimates)) == (None, False, 1)


def test_the_line_has_the_wheel_speeds_of_the_applied_twist() -> None:
    out = Rig().driving(Twist(0.3, 1.0), steps=100).out
    # The wheels turn at 3 and 9 rad/s.
    assert out.line == b"ap09.00,bp03.00,cp03.00,dp09.00\r\n"
    assert out.applied == Twist(0.3, 1.0)
    assert out.speeds.as_tuple() == pytest.approx((9.0, 3.0, 3.0, 9.0))


@each(("refused_ms", "mode"), [(502, "ready"), (2, "ready"), (0, "driving")])
def test_a_refused_message_disarms_only_the_zeros_before_it(refused_ms: int, mode: str) -> None:
    rig = Rig().linked()
    zero_ns = rig.now_ns + MS
    refused = Refusal("malformed", "it cannot be read", "app", "", zero_ns + refused_ms * MS)
    for number in range(150):
        zero = (Command("app", REST, zero_ns + MS, shared=True),) if number == 0 else ()
        rig.step(commands=zero, refusals=(refused,) if number == refused_ms // 10 else ())
    rig.step(commands=(Command("app", GO, rig.now_ns + 10 * MS, shared=True),))
    assert rig.mode == mode


# the link: without it every line is zero, at once


def test_a_lost_port_sets_zero_in_the_same_step_and_a_zero_sent_meanwhile_arms_nobody() -> None:
    rig = Rig().driving()
    out = rig.unplug().step(tick=False)
    assert (out.mode, out.link, out.linked) == ("waiting", "down", False)
    assert (out.applied, out.speeds) == (REST, STILL)
    assert {source.age_s for source in rig.snapshot.sources} == {None}
    rig.step(REST)
    rig.step(superseded=True)
    rig.replug().step(GO)
    assert rig.drives()


# lines that did not leave


def test_after_superseded_lines_the_speed_grows_from_the_last_line_that_left() -> None:
    # Every second line leaves, so two periods have passed since the last sent one.
    rig = Rig().linked()
    rig.step(REST)
    assert rig.path(2, GO) == near(0.01, 0.02)
    assert rig.path(2, GO, superseded=True) == near(0.03, 0.04)  # 0.01, and 20 and 30 ms
    assert rig.path(1, GO) == near(0.05)
    rig = Rig().driving(Twist(0.1, 0.0))
    fast = Twist(1.0, 0.0)
    rig.run(2, fast)  # 0.11 m/s was sent; no later line leaves
    assert max(rig.path(23, fast, superseded=True)) <= 0.11 + 0.05 + 1e-9


def test_after_250_ms_without_a_line_that_left_the_speed_starts_from_zero() -> None:
    rig = Rig().driving()
    assert rig.step(ms=250).applied == GO
    assert rig.step(ms=260).applied == REST
    assert next(speed for speed in rig.path(11, GO) if speed) == pytest.approx(0.01)
    rig = Rig().driving()
    rig.step(GO)  # the first line that does not leave; the board received the one before it last
    path = rig.path(26, GO, superseded=True)
    assert path == [0.5] * 24 + [0.0, 0.0]  # from 20 to 250 ms


SLOW = Config(
    control=ControlConfig(rate=10.0),
    limits=LimitsConfig(linear_acceleration=0.2),
    commands=CommandsConfig(sources=(Source("app", 50, 1.0),)),
)


def test_a_stall_adds_at_most_50_ms_of_acceleration_or_one_and_a_half_periods() -> None:
    rig = Rig().linked()
    rig.step(REST)
    rig.step(GO)
    assert rig.path(1, ms=200) == near(0.01 + 0.05)
    rig = Rig(SLOW).linked()
    rig.step(REST)
    assert rig.path(1, GO, ms=100) == near(0.02)
    assert rig.path(1, GO, ms=240) == near(0.05)


def test_a_line_superseded_before_the_port_was_lost_does_not_bring_its_speed_back() -> None:
    for ticks in ((True,) * 3, (True, True, True, False, False)):
        rig = Rig().driving()
        rig.step(GO)  # this line does not leave
        rig.replug()
        assert rig.step(GO, superseded=True).applied == REST
        for tick in ticks[1:]:
            rig.step(GO, tick=tick)
        rig.reply = rig.codec.stop * 3
        assert rig.step(GO, superseded=True).link == "up"
        assert rig.out.applied.linear <= 0.05


# the pose and the settings


def test_the_pose_is_set_by_request_and_the_robot_drives_on() -> None:
    rig = Rig().driving()
    assert rig.answer("set_pose", Pose(1.0, 2.0, 0.5)).success
    out = rig.step(GO)
    assert (out.estimates[-1].pose, out.mode, out.applied) == (Pose(1.0, 2.0, 0.5), "driving", GO)
    assert rig.robot.travelled == 0.0
    assert rig.answer("reset_odometry").success
    assert rig.step().estimates[-1].pose == Pose()


def test_a_setting_applies_at_once_and_a_refused_one_changes_nothing() -> None:
    rig = Rig().linked()
    before = rig.robot.config
    answer = rig.set({"limits.linear_speed": -1.0})
    assert not answer.success
    assert "limits.linear_speed" in answer.message
    assert rig.robot.config is before
    # With another timeout each sender must be neutral again.
    assert rig.set({"commands.sources.app.timeout": 0.5}).success
    rig.step(GO)
    assert rig.snapshot.sources[1].waits_for.what == "neutral"
    rig.step(REST)
    assert rig.run(45, GO).mode == "driving"
    assert rig.run(45).mode == "driving"
    assert rig.set({"limits.linear_speed": 0.3}).success
    assert rig.run(30, GO).applied.linear == pytest.approx(0.3)


def test_settings_for_a_robot_at_rest_are_refused_until_the_zero_lines_were_sent() -> None:
    rig = Rig().driving()
    rig.step(ask="stop", superseded=True)
    rig.run(19, superseded=True)
    softer: dict[str, Plain] = {
        "limits.linear_deceleration": 0.3, "limits.linear_stop_deceleration": 0.5,
    }  # fmt: skip
    assert rig.out.applied == REST
    request = Request("set", 7, settings=softer)
    assert not rig.asked(request, superseded=True).answers[0].success
    rig.run(2)
    assert rig.set(softer).success
