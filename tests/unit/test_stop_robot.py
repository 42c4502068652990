"""What ends the motion of a robot: stop, switching off, faults, the end of the daemon."""

from __future__ import annotations

import math

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config, McuConfig, OdometryConfig
from acsard.core.values import (
    BRIDGES,
    REST,
    Announcement,
    Answer,
    Command,
    Pose,
    Request,
    Verb,
    WheelSpeeds,
)
from tests.each import each
from tests.unit.rig import GO, ZERO_LINE, Rig


@each(
    ("ask", "again", "mode", "code", "braked"),
    [
        ("stop", "clear", "stopped", "stopped", 0.03),
        ("deactivate", "activate", "inactive", "switched_off", 0.01),
    ],
)
def test_a_latched_request_brakes_by_its_deceleration_until_it_is_released(
    ask: Verb, again: Verb, mode: str, code: str, braked: float
) -> None:
    rig = Rig().driving()
    answer = rig.answer(ask)
    (cause,) = rig.robot.latches.causes
    assert (answer.success, answer.numbers) == (True, (cause.number,))
    path = [rig.out.applied.linear, *rig.path(51, GO)]
    expected = [max(0.5 - braked * step, 0.0) for step in range(1, 53)]
    assert path == pytest.approx(expected, abs=1e-12)
    assert (rig.mode, rig.out.code) == (mode, code)
    answer = rig.answer(again)
    assert (answer.success, answer.numbers) == (True, (cause.number,))
    assert rig.drives()


def test_a_clear_without_a_latch_changes_nothing_and_activate_asks_for_a_zero() -> None:
    rig = Rig().driving()
    out = rig.step(GO, ask="clear")
    assert (out.answers[0].success, out.answers[0].numbers) == (True, ())
    assert (out.mode, out.applied) == ("driving", GO)
    rig.step(GO, ask="activate")
    assert rig.drives()


REAL = Config(mcu=McuConfig(port="/dev/ttyACM0"))


def ends(lent: Answer) -> tuple[int, ...]:
    """Return the numbers that end this loan and release what it latched."""
    assert lent.loan is not None
    return *lent.numbers, lent.loan


@each("before", [None, "deactivate", "stop"])
def test_the_port_is_released_at_rest_and_a_robot_that_was_off_stays_off(
    before: Verb | None,
) -> None:
    rig = Rig(REAL).linked()
    if before:
        rig.answer(before)
    mode = rig.mode
    (answer,) = rig.asked(Request("deactivate", 1, release_port=True)).answers
    assert (answer.success, len(answer.numbers)) == (True, 0 if before else 1)
    assert (rig.robot.port_released, rig.mode) == (True, mode if before else "inactive")
    rig.asked(Request("activate", 2, numbers=ends(answer)))
    assert (rig.robot.port_released, rig.mode) == (False, mode)


def test_a_robot_may_have_been_pushed_while_another_program_had_the_port() -> None:
    rig = Rig(REAL).linked()
    rig.run(100)
    (answer,) = rig.asked(Request("deactivate", 1, release_port=True)).answers
    assert "may have been pushed" in answer.message
    rig.unplug().step(ms=4_000)
    rig.replug().asked(Request("activate", 3, numbers=ends(answer)))
    assert rig.linked().out.estimates[-1].covariance.xx == pytest.approx(9.0, rel=0.1)
    rig.asked(Request("reset_odometry", 4))
    rig.run(5)
    assert rig.out.estimates[-1].covariance.xx < 1e-4


def test_a_pose_that_is_set_while_the_board_is_away_is_as_certain_as_the_time_since_then() -> None:
    rig = Rig(REAL).linked()
    rig.run(100)
    rig.unplug().step(ms=12 * 3600 * 1000)
    rig.asked(Request("set_pose", 4, pose=Pose(1.0, 2.0, 0.5)))
    rig.step(ms=1_500)
    estimate = rig.replug().linked().out.estimates[-1]
    assert (estimate.pose.x, estimate.pose.y) == (1.0, 2.0)
    assert 0.25 < math.sqrt(estimate.covariance.yy) < 0.8


def test_while_another_program_has_the_port_no_silence_of_an_input_counts() -> None:
    rig = Rig(REAL).board(b"!status estop=ok bumpers=..\r\n").linked()
    rig.run(5)
    (answer,) = rig.asked(Request("deactivate", 1, release_port=True)).answers
    rig.board(b"").unplug().run(200)
    assert rig.mode == "inactive"
    rig.replug().asked(Request("activate", 2, numbers=ends(answer)))
    rig.linked().run(40)
    assert rig.mode == "ready"
    rig.run(20)  # the board does not report them any more
    assert rig.mode == "stopped"


def test_the_token_of_a_bridge_and_its_silence_arm_it_where_a_pause_does() -> None:
    rig = Rig(REAL).linked()
    token = Announcement("nav", BRIDGES, present=True, at_ns=rig.now_ns)
    rig.step(announced=(token,))
    for wait_ms, mode in ((9_900, "ready"), (10_100, "driving")):
        for _ in range(wait_ms // 10):
            rig.step()
        command = Command(
            "nav", GO, rig.now_ns, sender="bridge/nav", shared=True, ros=True, bridged=True
        )
        rig.step(commands=(command,))
        assert rig.mode == mode


def test_the_gyro_of_a_robot_that_another_program_may_turn_does_not_rest() -> None:
    config = replace(REAL, odometry=OdometryConfig(gyro=True))
    rig = Rig(config).linked()
    rig.run(100)
    rig.asked(Request("deactivate", 1, release_port=True))
    rig.unplug()
    for _ in range(100):
        rig.step(gyro=0.1)
    assert rig.snapshot.gyro_bias is None


@each(("speed", "released"), [(b"01.10", False), (b"00.90", True)])
def test_the_port_is_not_released_while_the_board_reports_wheels_above_5_cm_a_second(
    speed: bytes, released: bool
) -> None:
    rig = Rig(REAL).linked()
    rig.reply = ZERO_LINE.replace(b"00.00", speed)
    rig.run(5)
    (answer,) = rig.asked(Request("deactivate", 1, release_port=True)).answers
    assert (answer.success, rig.robot.port_released) == (released, released)
    if not released:
        rig.unplug().run(100)
        (answer,) = rig.asked(Request("deactivate", 1, release_port=True)).answers
        assert answer.success, "a silent board says nothing about its wheels"


@each("numbers", [None, (), (99,)])
@each("before", [None, "stop", "deactivate"])
def test_neither_a_second_borrower_nor_a_refused_activate_ends_the_loan_of_the_port(
    before: Verb | None, numbers: tuple[int, ...] | None
) -> None:
    rig = Rig(REAL).linked()
    if before:
        rig.answer(before)
    mode = rig.mode
    (lent,) = rig.asked(Request("deactivate", 1, release_port=True)).answers
    rig.unplug().run(5)
    (second,) = rig.asked(Request("deactivate", 2, release_port=True)).answers
    assert (second.success, second.numbers, second.loan) == (False, (), None)
    assert "lent to another program" in second.message
    (refused,) = rig.asked(Request("activate", 3, numbers=numbers)).answers
    assert (refused.success, rig.robot.port_released) == (False, True)
    rig.asked(Request("activate", 4, numbers=ends(lent)))
    assert (rig.robot.port_released, rig.mode) == (False, mode if before else "waiting")


@each("verb", ["clear", "activate"])
def test_a_person_who_releases_all_causes_of_a_robot_opens_its_port(verb: Verb) -> None:
    rig = Rig(REAL).linked()
    if verb == "clear":
        rig.answer("stop")
    rig.asked(Request("deactivate", 1, release_port=True))
    rig.run(250)
    assert rig.answer(verb).success
    assert rig.robot.port_released is (verb == "clear")
    assert rig.answer("activate").success
    assert not rig.robot.port_released


def test_neither_a_moving_robot_nor_the_simulator_built_in_releases_the_port() -> None:
    for rig in (Rig(REAL).driving(), Rig().linked()):
        (answer,) = rig.asked(Request("deactivate", 1, release_port=True)).answers
        assert (answer.success, rig.robot.port_released) == (False, False)


def test_a_stop_that_comes_by_several_ways_is_one_event() -> None:
    rig, stop = Rig().linked(), Request("stop", by="ann", asked_ns=1)
    out = rig.asked(stop, stop)
    assert [event.name for event in out.events].count("stop") == 1


def test_missed_periods_are_counted_and_reported() -> None:
    rig = Rig().linked()
    out = rig.step(missed=3)
    assert rig.robot.state.counters["missed_periods"] == 3
    assert "missed_periods" in [event.name for event in out.events]


def test_the_samples_of_a_gyro_reach_its_check() -> None:
    rig = Rig(Config(odometry=OdometryConfig(gyro=True))).linked()
    rig.run(500, gyro=0.01)
    assert rig.snapshot.gyro_bias == pytest.approx(0.01)


def test_several_requests_of_one_step_are_answered_in_order() -> None:
    rig = Rig().linked()
    out = rig.asked(Request("stop", 1), Request("activate", 2), Request("reset_odometry", 3))
    assert [(a.id, a.success) for a in out.answers] == [(1, True), (2, False), (3, True)]
    for order in (("stop", "clear"), ("clear", "stop")):
        assert rig.asked(*(Request(verb) for verb in order)).mode == "stopped"


# faults


def test_a_guard_trip_is_a_fault_from_the_stop_line_that_was_sent() -> None:
    rig = Rig().driving()
    out = rig.step(guard_trip="guard_too_fast")
    assert {source.age_s for source in rig.snapshot.sources} == {None}
    assert (out.mode, out.code, out.line) == ("fault", "guard_too_fast", ZERO_LINE)
    event, mode = out.events
    assert (event.name, event.level) == ("fault", "error")
    assert (event.code, mode.code) == ("guard_too_fast", "guard_too_fast")
    assert {source.age_s for source in rig.snapshot.sources} == {
        rig.snapshot.sources[1].age_s,
        None,
    }
    rig.step(REST)
    assert {(out.mode, out.applied) for out in rig.each(50, GO)} == {("fault", REST)}
    assert rig.answer("clear").success
    assert rig.drives()
    # A clear in the step of a repeated trip does not release it.
    rig.step(guard_trip="guard_line_damaged")
    assert not rig.step(guard_trip="guard_line_damaged", ask="clear").answers[0].success
    assert rig.mode == "fault"
    assert rig.answer("clear").success


IMPOSSIBLE = WheelSpeeds(99.0, 99.0, 99.0, 99.0)


def impossible(rig: Rig, lines: int) -> Rig:
    """Let the board send this many impossible lines, then its earlier reply again."""
    reply, rig.reply = rig.reply, rig.codec.encode(IMPOSSIBLE)
    rig.each(lines, GO)
    rig.reply = reply
    return rig


def test_the_fault_of_a_board_whose_speeds_have_jumped_up_and_down_names_the_setting() -> None:
    rig = Rig().driving()
    for _ in range(10):
        for speed in (30.0, 0.0):  # one count in a line, or none
            rig.reply = rig.codec.encode(WheelSpeeds(*[speed] * 4))
            rig.step(GO)
    impossible(rig, 7)
    assert (rig.mode, rig.out.code) == ("fault", "impossible_speeds")
    assert "with fewer than 400 encoder counts per turn of a wheel, set mcu.enc" in rig.out.reason


def test_a_third_impossible_line_is_a_fault_that_brakes_by_the_stop_deceleration() -> None:
    rig = impossible(Rig().driving(), 2)
    assert (rig.mode, rig.out.applied) == ("driving", GO)
    impossible(rig, 1)
    assert (rig.mode, rig.out.code) == ("fault", "impossible_speeds")
    assert "mcu.encoder_counts" not in rig.out.reason
    # Each step removes 3 m/s2 x 10 ms.
    assert [rig.out.applied.linear, *rig.path(1, GO)] == pytest.approx([0.47, 0.44])
    assert rig.counters["line_implausible"] == 3
    # A clear begins to count again.
    rig.reply = rig.codec.encode(IMPOSSIBLE)
    rig.step(ask="clear")
    assert [out.mode for out in rig.each(3)] == ["ready", "ready", "fault"]


def test_impossible_speeds_of_any_wheel_are_one_cause_and_hide_no_later_cause() -> None:
    rig = impossible(Rig().driving(), 3)
    for wheel in range(4):
        for speed in (99.0, -99.0):
            speeds = [0.0, 0.0, 0.0, 0.0]
            speeds[wheel] = speed
            rig.reply = rig.codec.encode(WheelSpeeds(*speeds))
            rig.step(GO)
    (first,) = rig.robot.latches.of("fault")
    rig.step(GO, guard_trip="guard_too_fast")
    newest, second = rig.robot.latches.of("fault")
    assert (newest.code, second) == ("guard_too_fast", first)
