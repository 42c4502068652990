"""What the robot does with the inputs of the board: emergency stop, bumpers, motor drivers."""

from __future__ import annotations

import pytest

from acsard.core.config.settings import Config, McuConfig, SafetyConfig
from acsard.core.motion.latches import after_restart
from acsard.core.values import REST, Twist, WheelSpeeds
from tests.each import each
from tests.unit.rig import GO, ROLLING, ZERO_LINE, Rig

# the emergency stop

OK, PRESSED = b"!status estop=ok\r\n", b"!status estop=pressed\r\n"


def test_a_press_that_was_released_in_the_same_read_stays_a_stop() -> None:
    rig = Rig(status=OK).driving()
    rig.board(PRESSED + OK).step(ask="stop")
    assert rig.answer("clear").message.startswith("cleared, but the robot is still stopped")
    outs = rig.board(OK).each(200, GO)
    assert {(o.mode, o.line, o.code) for o in outs} == {("stopped", ZERO_LINE, "emergency_stop")}


def test_wheels_that_roll_without_power_cause_no_fault() -> None:
    rig = Rig(watched=True)
    rig.linked().step(REST)
    for _ in range(100):
        speed = rig.step(GO).speeds.front_left
        # Equal speeds would be an echo of the lines.
        rig.reply = rig.codec.encode(WheelSpeeds(*[0.95 * speed] * 4))
    assert rig.mode == "driving"
    rig.reply = rig.codec.encode(ROLLING)
    assert {out.mode for out in rig.board(PRESSED).each(300)} == {"stopped"}


def test_status_lines_are_no_replies_and_damaged_ones_change_nothing() -> None:
    plain, other = Rig(), Rig()
    other.reply = OK + plain.codec.stop
    for _ in range(100):
        a, b = plain.step(), other.step()
        assert (a.line, a.mode, a.link, a.estimates) == (b.line, b.mode, b.link, b.estimates)
    rig = Rig(status=b"!status estop=prxssed\r\n!status estop=ok*0000\r\n").driving()
    assert rig.run(20, GO).mode == "driving"
    assert rig.counters["line_status_malformed"] > 50
    assert rig.counters["line_status_crc_error"] > 50
    assert rig.snapshot.board == {}
    rig = Rig()
    rig.reply = OK
    assert rig.run(400).code == "received_statuses"
    rig = Rig(Config(mcu=McuConfig(link_check="on")), status=OK)
    rig.step()
    assert rig.counters["line_status_without_crc"] == 1
    rig.board(b"!status estop=ok*9C94\r\n").step()
    assert rig.snapshot.state.emergency_stop == "released"


def test_a_status_line_that_begins_while_nothing_else_changes_is_processed_at_once() -> None:
    rig = Rig().driving(steps=1200)
    rig.board(b"!status temp=30.5\r\n").step()
    assert rig.snapshot.board["temperature_c"] == "30.5"
    assert rig.run(20, GO).mode == "driving"


# bumpers

FREE, FRONT, REAR, BOTH = [b"!status bumpers=%b\r\n" % m for m in (b"..", b"X.", b".X", b"XX")]
BACK = Twist(-0.5, 0.4)
AWAY = Config(safety=SafetyConfig(bumpers=("front", "rear"), bumper="away"))


def test_a_bumper_that_limits_stops_once_and_then_allows_the_retreat() -> None:
    for status in (FRONT, FRONT + FREE):
        rig = Rig(AWAY, status=FREE).driving()
        out = rig.board(status).step(GO)
        assert (out.mode, out.line, out.latches.causes) == ("ready", ZERO_LINE, ())
        if status == FRONT + FREE:
            assert rig.board(FREE).drives()
            continue
        assert out.code == "bumper_away"
        assert {out.line for out in rig.each(50, BACK)} == {ZERO_LINE}
        rig.step(REST)
        for out in rig.each(50, BACK):
            assert -0.1 <= out.applied.linear < 0.0
            assert out.applied.angular == 0.0
        assert (out.mode, out.code, out.applied.linear) == ("driving", "bumper_away", -0.1)
        # After the release the retreat goes on without the limit.
        out = rig.board(FREE).run(100, BACK)
        assert (out.mode, out.code, out.applied) == ("driving", "commanded", BACK)


@each("wrong", [GO, Twist(0.0, 1.0), Twist(0.001, -0.5)])
def test_a_command_against_a_pressed_bumper_makes_its_sender_unarmed(wrong: Twist) -> None:
    rig = Rig(AWAY, status=FRONT)
    rig.linked().step(REST)
    assert {(out.mode, out.line) for out in rig.each(20, wrong)} == {("ready", ZERO_LINE)}
    assert rig.snapshot.sources[1].waits_for.what == "neutral"
    assert rig.board(FREE).drives()


# the motor drivers

DRIVER_OK, FAULT = b"!status driver=ok\r\n", b"!status driver=fault\r\n"


@each(
    ("before", "lines", "mode"),
    [
        # After a press the drivers have no power, and report that as a fault.
        (b"", PRESSED + FAULT + OK + DRIVER_OK, "stopped"),
        (b"", b"!status estop=pressed driver=fault\r\n!status estop=ok driver=ok\r\n", "stopped"),
        (PRESSED, FAULT + OK + DRIVER_OK, "stopped"),
        (PRESSED, b"!status driver=fault estop=pressed\r\n" + OK + DRIVER_OK, "stopped"),
        (b"", FAULT + PRESSED, "stopped"),
        (b"", PRESSED + OK + FAULT + DRIVER_OK, "stopped"),
        (PRESSED, OK + FAULT + DRIVER_OK, "stopped"),
        (PRESSED, b"!status estop=ok driver=fault\r\n" + DRIVER_OK, "stopped"),
        (b"", PRESSED + OK + DRIVER_OK + FAULT, "stopped"),
        (PRESSED, OK + DRIVER_OK + FAULT, "stopped"),
        (PRESSED, b"!status estop=ok driver=ok\r\n" + FAULT, "stopped"),
        # A fault before it counts.
        (b"", FAULT + PRESSED + OK + DRIVER_OK, "fault"),
        (b"", FAULT + OK + DRIVER_OK, "fault"),
    ],
)
def test_a_driver_fault_counts_if_it_was_reported_before_the_press(
    before: bytes, lines: bytes, mode: str
) -> None:
    rig = Rig(status=OK + DRIVER_OK).linked()
    if before:
        rig.board(before + DRIVER_OK).step()
    assert rig.board(lines).step().mode == mode


# another board, or a restart


def replugged(rig: Rig, status: bytes, closed: int = 100) -> Rig:
    """Plug in a board that sends this status line, and wait until the link is up."""
    rig.unplug().run(closed)
    return rig.board(status).replug().linked()


@each("line", [FAULT, PRESSED, FRONT, OK])
def test_a_board_without_inputs_does_not_inherit_those_of_the_previous_one(
    line: bytes,
) -> None:
    rig = replugged(Rig(status=line).linked(), b"")
    mode = "fault" if line == FAULT else "stopped"
    assert {out.mode for out in rig.each(290, GO)} == {mode}
    assert not rig.answer("clear").success
    rig.run(20, GO)
    state = rig.snapshot.state
    assert (state.emergency_stop, state.bumpers, rig.snapshot.board) == ("", None, {})
    while rig.out.latches.causes:
        assert rig.answer("clear").success
    assert rig.drives()


def test_each_board_must_report_the_required_inputs_before_the_robot_is_ready() -> None:
    rig = Rig(Config(safety=SafetyConfig(estop="required"))).linked()
    assert (rig.mode, rig.board(OK).step().mode) == ("waiting", "ready")
    one = b"!status estop=ok bumpers=.\r\n"
    rig = Rig(Config(safety=SafetyConfig(estop="required", bumpers=("front",))))
    out = rig.linked().step(GO)
    assert (out.mode, out.link, out.line) == ("waiting", "up", ZERO_LINE)
    for closed in (0, 3):
        if closed:
            out = replugged(rig, b"", closed).step()
        assert (out.mode, out.link, out.code) == ("waiting", "up", "emergency_stop_missing")
        out = rig.board(OK).step()
        assert (out.mode, out.link, out.code) == ("waiting", "up", "bumpers_missing")
        if not closed:
            assert rig.board(one).step().mode == "ready"
            assert rig.drives()
    # A board with another number of bumpers is refused, also behind a board with the right one.
    modes = {out.mode for out in rig.board(b"!status estop=ok bumpers=..\r\n").each(400)}
    assert modes == {"waiting", "stopped"}
    assert (rig.answer("clear").success, rig.mode) == (True, "waiting")
    assert rig.board(one).step().mode == "ready"


@pytest.mark.parametrize("line", [PRESSED, OK + FAULT, REAR])
def test_a_restarted_daemon_refuses_clear_until_the_board_reports_the_cause(
    line: bytes,
) -> None:
    latches = after_restart(Rig(status=line).linked().out.latches)
    rig = Rig(latches=latches).linked()
    assert (rig.out.latches, rig.out.code) == (latches, latches.of("fault", "stop")[0].code)
    assert not rig.answer("clear").success
    # A new number of bumpers counts from its second line on.
    rig.board(b"!status estop=ok driver=ok bumpers=..\r\n").run(3)
    assert rig.answer("clear").success
