"""Tests of `Robot.step`, one step at a time.

They cover the link, modes, commands, lines, answers and counters.
"""

from __future__ import annotations

import math
from collections import Counter
from itertools import pairwise

import pytest
from msgspec.structs import replace

from acsard.core.codes import Code
from acsard.core.config.settings import (
    BatteryConfig,
    CommandsConfig,
    Config,
    ControlConfig,
    FeedbackConfig,
    LimitsConfig,
    McuConfig,
    OdometryConfig,
    SafetyConfig,
    Source,
)
from acsard.core.link.codec import Codec
from acsard.core.motion.arbiter_text import MAX_SENDER_LENGTH
from acsard.core.motion.latches import after_restart
from acsard.core.robot import Robot
from acsard.core.values import (
    NS_PER_S,
    REST,
    STILL,
    Answer,
    BatteryStatus,
    Cause,
    CauseKind,
    Command,
    Event,
    GyroSample,
    Instant,
    Latches,
    Plain,
    Pose,
    Received,
    Refusal,
    Request,
    SpeedCap,
    Trip,
    Twist,
    Verb,
    WheelSpeeds,
)
from tests.each import each
from tests.stepped import Inputs, Outputs, SteppedRobot

MS = 1_000_000
WALL_NS = 1_800_000_000 * NS_PER_S
GO = Twist(0.5, 0.0)
ZERO_LINE = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"
ROLLING = WheelSpeeds(10.0, 10.0, 10.0, 10.0)
"""Wheel speeds of 0.5 m/s straight on."""


class Bench:
    """A robot with a simulated time, and an MCU that answers in every period with `reply`."""

    def __init__(
        self,
        config: Config | None = None,
        latches: Latches = Latches(),  # noqa: B008
        watched: bool = False,
    ) -> None:
        # This MCU always reports the same speeds, so nothing follows from them unless `watched`.
        config = replace(config or Config(), feedback=FeedbackConfig(encoders=watched))
        self.robot = Robot(config, latches)
        self.stepped = SteppedRobot(self.robot)
        self.codec = Codec(config.mcu.wheels, config.mcu.trailing_comma)
        self.now_ns = 50 * NS_PER_S
        self.period_ms = 1000 / config.rate_hz
        self.opened = 1
        self.port_open = True
        self.reply: bytes | None = self.codec.stop
        self.shutting_down = False
        self.out = self.stepped.step(Inputs(self.now, tick=False, port_open=False))

    @property
    def now(self) -> Instant:
        return Instant(self.now_ns, self.now_ns + WALL_NS)

    def step(
        self,
        *commands: Twist,
        source: str = "app",
        ask: Verb | None = None,
        pose: Pose | None = None,
        ms: float | None = None,
        tick: bool = True,
        superseded: bool = False,
        guard_trip: Trip = "",
        refusals: tuple[Refusal, ...] = (),
        gyro: float | None = None,
        late_ms: float | None = None,
    ) -> Outputs:
        """Run one step a period later, or `ms` later, and return its outputs.

        A `clear` or `activate` names the faults of the last step, else all causes. `gyro`
        is the rate in a gyro sample. With `late_ms`, another clock stamps the commands, and the
        stamps are `late_ms` old.
        """
        named = self.out.latches.of("fault") or self.out.latches.causes
        releases = ask in ("clear", "activate") and named
        shown = tuple([cause.number for cause in named]) if releases else None
        self.now_ns += int((self.period_ms if ms is None else ms) * MS)
        has_reply = self.reply is not None and self.port_open
        stamp_ns = None if late_ms is None else self.now_ns + WALL_NS - int(late_ms * MS)
        self.out = self.stepped.step(
            Inputs(
                now=self.now,
                tick=tick,
                port_open=self.port_open,
                opened=self.opened,
                received=(Received(self.now, self.reply),) if has_reply and self.reply else (),
                commands=tuple(Command(source, t, self.now_ns, stamp_ns) for t in commands),
                gyro=() if gyro is None else (GyroSample(self.now_ns, None, gyro),),
                requests=(Request(ask, 7, pose, numbers=shown),) if ask else (),
                refusals=refusals,
                guard_trip=guard_trip,
                superseded=superseded,
                shutting_down=self.shutting_down,
            )
        )
        return self.out

    def linked(self) -> Bench:
        """Step until the link is up."""
        for _ in range(5):  # a line, the question, and three lines
            self.step()
        assert self.out.link == "up"
        return self

    def driving(self, twist: Twist = GO, steps: int = 60) -> Bench:
        """Bring the link up, arm with a zero, and send the twist until the robot has reached it."""
        self.linked().step(REST)
        for _ in range(steps):
            self.step(twist)
        assert self.out.mode == "driving"
        return self

    def let_go(self) -> Bench:
        """Return to neutral: send zeros until one arrives a timeout after the last speed."""
        for _ in range(27):
            self.step(REST)
        return self

    def unplug(self) -> Bench:
        self.port_open = False
        return self

    def replug(self) -> Bench:
        self.port_open = True
        self.opened += 1
        return self

    def answer(self, ask: Verb, pose: Pose | None = None) -> Answer:
        (answer,) = self.step(ask=ask, pose=pose).answers
        assert answer.id == 7
        return answer

    def set(self, settings: dict[str, Plain]) -> None:
        self.now_ns += 10 * MS
        requests = (Request("set", 7, settings=settings),)
        self.out = self.stepped.step(Inputs(self.now, True, True, self.opened, requests=requests))
        assert self.out.answers[0].success

    def link(self) -> str:
        return self.out.link

    def mode(self) -> str:
        return self.out.mode

    def counters(self) -> dict[str, int]:
        return self.robot.snapshot(self.now_ns).counters


def names(outputs: Outputs) -> list[str]:
    return [event.name for event in outputs.events]


# the emergency stop

OK_LINE, PRESSED_LINE = b"!status estop=ok\r\n", b"!status estop=pressed\r\n"


class Button(Bench):
    """A bench whose board also sends a status line in each step."""

    def __init__(
        self,
        status: bytes = OK_LINE,
        config: Config | None = None,
        latches: Latches = Latches(),  # noqa: B008
    ) -> None:
        super().__init__(config, latches=latches)
        self.status(status)

    def status(self, line: bytes) -> Button:
        """Send this status line from now on, b"" for none."""
        self.reply = self.codec.stop + line
        return self


def test_a_press_sends_a_zero_line_and_latches_a_stop_in_the_same_step() -> None:
    bench = Button()
    bench.driving()
    out = bench.status(PRESSED_LINE).step(GO)
    assert (out.mode, out.line, out.speeds) == ("stopped", ZERO_LINE, STILL)
    assert out.code == "emergency_stop"
    assert {"emergency_stop", "mode"} <= set(names(out))
    assert bench.counters()["emergency_stops"] == 1
    assert bench.robot.snapshot(bench.now_ns).estop == "pressed"
    assert bench.robot.snapshot(bench.now_ns).board == {
        "emergency_stop": "pressed",
        "age_s": "0.0",
    }


def test_a_press_between_two_ticks_sends_zero_immediately_if_a_line_is_allowed() -> None:
    bench = Button()
    bench.driving()
    inputs = Inputs(
        bench.now, False, True, 1, received=(Received(bench.now, PRESSED_LINE),), at_once=True
    )
    out = bench.stepped.step(inputs)
    assert (out.mode, out.line) == ("stopped", ZERO_LINE)


def test_a_press_between_two_ticks_sets_zero_speed_even_if_no_line_is_allowed() -> None:
    bench = Button()
    bench.driving()
    out = bench.status(PRESSED_LINE).step(GO, tick=False)
    assert (out.mode, out.line, out.speeds) == ("stopped", None, STILL)
    assert bench.step(GO).line == ZERO_LINE


def test_a_zero_line_that_was_not_sent_is_repeated_as_zero() -> None:
    bench = Button()
    bench.driving()
    bench.status(PRESSED_LINE).step(GO)
    for _ in range(3):
        assert bench.step(GO, superseded=True).line == ZERO_LINE


def test_a_press_that_was_released_in_the_same_read_stays_a_stop() -> None:
    bench = Button()
    bench.driving()
    out = bench.status(PRESSED_LINE + OK_LINE).step(GO)
    assert (out.mode, out.line) == ("stopped", ZERO_LINE)
    for _ in range(200):
        out = bench.status(OK_LINE).step(GO)
        assert (out.mode, out.line) == ("stopped", ZERO_LINE)


def test_clear_is_refused_while_pressed_and_a_sender_needs_a_zero_after_it() -> None:
    bench = Button(PRESSED_LINE)
    bench.linked()
    assert not bench.answer("clear").success
    assert bench.mode() == "stopped"
    bench.status(OK_LINE).step(GO)
    assert bench.mode() == "stopped"
    assert bench.answer("clear").success
    assert bench.step(GO).mode == "ready"
    bench.step(REST)
    assert bench.step(GO).mode == "driving"


def test_a_clear_in_the_step_of_the_press_does_not_release_the_stop() -> None:
    bench = Button()
    bench.driving()
    bench.step(ask="stop")
    bench.status(PRESSED_LINE + OK_LINE)
    assert bench.answer("clear").message.startswith("cleared, but the robot is still stopped")
    assert (bench.mode(), bench.out.code) == ("stopped", "emergency_stop")


def test_an_unreported_emergency_stop_counts_as_pressed_even_without_a_port() -> None:
    bench = Button()
    bench.linked()
    bench.unplug()
    for _ in range(50):
        assert bench.step().mode == "waiting"
    out = bench.step()
    assert (out.mode, bench.robot.snapshot(bench.now_ns).estop) == ("stopped", "silent")


def test_a_required_input_that_is_not_reported_keeps_the_robot_from_ready() -> None:
    bench = Button(b"", Config(safety=SafetyConfig(estop="required")))
    bench.linked()
    out = bench.step(GO)
    assert (out.mode, out.link, out.line) == ("waiting", "up", ZERO_LINE)
    assert out.code == "emergency_stop_missing"
    assert bench.status(OK_LINE).step().mode == "ready"
    bench.step(REST)
    assert bench.step(GO).mode == "driving"


def test_wheels_that_roll_without_power_cause_no_fault() -> None:
    bench = Bench(watched=True)
    bench.linked().step(REST)
    for _ in range(100):
        speed = bench.step(GO).speeds.front_left
        # Equal speeds would be an echo of the lines.
        bench.reply = bench.codec.encode(WheelSpeeds(*[0.95 * speed] * 4))
    assert bench.mode() == "driving"
    bench.reply = bench.codec.encode(ROLLING) + PRESSED_LINE
    for _ in range(300):
        assert bench.step().mode == "stopped"


def test_damaged_status_lines_are_counted_and_do_not_change_the_link() -> None:
    bench = Button(b"!status estop=prxssed\r\n!status estop=ok*0000\r\n")
    bench.driving()
    for _ in range(20):
        assert bench.step(GO).mode == "driving"
    counters = bench.counters()
    assert counters["line_status_malformed"] > 50
    assert counters["line_status_crc_error"] > 50
    assert bench.robot.snapshot(bench.now_ns).board == {}


def test_status_lines_change_neither_the_pose_nor_its_times() -> None:
    plain, status_bench = Bench(), Bench()
    status_bench.reply = OK_LINE + status_bench.codec.stop
    for _ in range(200):
        plain_out, other = plain.step(), status_bench.step()
        assert (plain_out.line, plain_out.mode, plain_out.link, plain_out.estimates) == (
            other.line, other.mode, other.link, other.estimates,
        )  # fmt: skip


def test_a_board_that_sends_only_status_lines_is_diagnosed() -> None:
    bench = Bench()
    bench.reply = OK_LINE
    for _ in range(400):
        bench.step()
    assert bench.out.code == "received_statuses"


def test_a_checked_link_takes_no_status_line_without_a_checksum() -> None:
    bench = Bench(Config(mcu=McuConfig(link_check="on")))
    bench.reply = OK_LINE
    bench.step()
    assert bench.counters()["line_status_without_crc"] == 1
    bench.reply = b"!status estop=ok*9C94\r\n"
    bench.step()
    assert bench.robot.snapshot(bench.now_ns).estop == "released"


# the bumpers

FREE, FRONT, REAR = [b"!status bumpers=%b\r\n" % marks for marks in (b"..", b"X.", b".X")]
AWAY = Config(safety=SafetyConfig(bumpers=("front", "rear"), bumper="away"))
BACK = Twist(-0.5, 0.4)


def test_a_bumper_stops_the_robot_immediately_until_a_clear_after_the_release() -> None:
    bench = Button(FREE)
    bench.driving()
    out = bench.status(FRONT).step(GO)
    assert (out.mode, out.line, out.speeds) == ("stopped", ZERO_LINE, STILL)
    assert out.code == "bumper"
    assert {"bumper_pressed", "mode"} <= set(names(out))
    assert bench.counters()["bumper_presses"] == 1
    snapshot = bench.robot.snapshot(bench.now_ns)
    assert snapshot.bumpers == (True, False)
    assert snapshot.bumper is not None
    assert snapshot.bumper.code == "bumper"
    assert not bench.answer("clear").success
    bench.status(FREE).step(GO)
    assert bench.mode() == "stopped"
    assert bench.answer("clear").success
    assert bench.step(GO).mode == "ready"
    bench.step(REST)
    assert bench.step(GO).mode == "driving"


def test_a_bumper_that_limits_stops_the_robot_and_each_sender_must_send_a_zero() -> None:
    bench = Button(FREE, AWAY)
    bench.driving()
    out = bench.status(FRONT).step(GO)
    assert (out.mode, out.line, out.latches.causes) == ("ready", ZERO_LINE, ())
    assert out.code == "bumper_away"
    for _ in range(50):
        assert bench.step(BACK).line == ZERO_LINE
    bench.step(REST)
    for _ in range(50):
        out = bench.step(BACK)
        assert -0.1 <= out.applied.linear < 0.0
        assert out.applied.angular == 0.0
    assert (out.mode, out.applied.linear) == ("driving", -0.1)
    assert out.code == "bumper_away"


def test_a_tap_in_one_read_stops_a_robot_that_a_bumper_only_limits_and_latches_nothing() -> None:
    bench = Button(FREE, AWAY)
    bench.driving()
    out = bench.status(FRONT + FREE).step(GO)
    assert (out.mode, out.line, out.latches.causes) == ("ready", ZERO_LINE, ())
    bench.status(FREE)
    assert bench.step(GO).line == ZERO_LINE
    bench.step(REST)
    assert bench.step(GO).mode == "driving"


@each("wrong", [GO, Twist(0.0, 1.0), Twist(0.001, -0.5)])
def test_a_command_against_a_pressed_bumper_makes_its_sender_unarmed(wrong: Twist) -> None:
    bench = Button(FRONT, AWAY)
    bench.linked().step(REST)
    for _ in range(20):
        out = bench.step(wrong)
        assert (out.mode, out.line) == ("ready", ZERO_LINE)
    assert bench.robot.snapshot(bench.now_ns).sources[1].waits_for.what == "neutral"
    # The release lets nobody drive who pushed against the obstacle.
    bench.status(FREE)
    for _ in range(20):
        assert bench.step(GO).line == ZERO_LINE
    bench.step(REST)
    assert bench.step(GO).mode == "driving"


def test_a_retreat_goes_on_after_the_release_without_its_limits() -> None:
    bench = Button(FRONT, AWAY)
    bench.linked().step(REST)
    for _ in range(20):
        bench.step(BACK)
    bench.status(FREE)
    for _ in range(100):
        out = bench.step(BACK)
    assert (out.mode, out.applied) == ("driving", BACK)
    assert out.code == "commanded"


def test_a_press_of_the_bumper_in_the_direction_of_the_retreat_ends_the_retreat() -> None:
    bench = Button(FRONT, AWAY)
    bench.linked().step(REST)
    for _ in range(20):
        bench.step(BACK)
    out = bench.status(b"!status bumpers=XX\r\n").step(BACK)
    assert (out.mode, out.line) == ("ready", ZERO_LINE)
    for twist in (REST, BACK, REST, GO):
        assert bench.step(twist).line == ZERO_LINE
    assert bench.status(REAR).step(REST).mode == "driving"
    bench.step(GO)
    assert bench.step(GO).applied.linear > 0.0


def test_silent_bumpers_latch_a_stop_also_if_a_press_would_only_limit() -> None:
    bench = Button(FREE, AWAY)
    bench.driving()
    bench.status(b"")
    for _ in range(51):
        out = bench.step(GO)
    assert out.mode == "stopped"
    assert out.code == "bumpers_silent"
    assert bench.robot.snapshot(bench.now_ns).bumpers == (True, True)


def test_bumpers_with_places_that_are_not_reported_keep_the_robot_from_ready() -> None:
    config = Config(safety=SafetyConfig(estop="required", bumpers=("front", "rear")))
    bench = Button(b"", config)
    out = bench.linked().step(GO)
    assert (out.mode, out.link, out.line) == ("waiting", "up", ZERO_LINE)
    assert out.code == "emergency_stop_missing"
    assert bench.status(OK_LINE).step().code == "bumpers_missing"
    assert bench.status(OK_LINE + FREE).step().mode == "ready"


# the motor drivers

DRIVER_OK, DRIVER_FAULT = b"!status driver=ok\r\n", b"!status driver=fault\r\n"


def test_a_motor_drivers_fault_is_latched_until_a_clear_after_its_end() -> None:
    bench = Button(DRIVER_OK)
    bench.driving()
    out = bench.status(DRIVER_FAULT).step(GO)
    assert (out.mode, out.code) == ("fault", "driver_fault")
    assert not bench.answer("clear").success
    bench.status(DRIVER_OK).step(GO)
    assert bench.mode() == "fault"
    assert bench.answer("clear").success
    assert bench.step(GO).mode == "ready"


def test_a_clear_in_the_step_of_a_repeated_driver_fault_does_not_release_the_fault() -> None:
    bench = Button(DRIVER_OK)
    bench.driving()
    bench.status(DRIVER_FAULT).step(GO)
    bench.status(DRIVER_OK).step(GO)
    assert not bench.status(DRIVER_FAULT + DRIVER_OK).answer("clear").success
    assert bench.mode() == "fault"
    assert bench.status(DRIVER_OK).answer("clear").success


def test_a_clear_in_the_step_of_a_repeated_guard_trip_does_not_release_the_fault() -> None:
    bench = Bench()
    bench.driving()
    bench.step(guard_trip="guard_line_damaged")
    (answer,) = bench.step(guard_trip="guard_line_damaged", ask="clear").answers
    assert not answer.success
    assert bench.mode() == "fault"
    assert bench.answer("clear").success


@each(
    ("pressed_before", "lines", "mode"),
    [
        (False, (PRESSED_LINE, DRIVER_FAULT, OK_LINE, DRIVER_OK), "stopped"),
        (False, (b"!status estop=pressed driver=fault\r\n", b"!status estop=ok driver=ok\r\n"),
         "stopped"),
        (True, (DRIVER_FAULT, OK_LINE, DRIVER_OK), "stopped"),
        (True, (b"!status driver=fault estop=pressed\r\n", OK_LINE, DRIVER_OK), "stopped"),
        (False, (DRIVER_FAULT, PRESSED_LINE), "stopped"),
        (False, (PRESSED_LINE, OK_LINE, DRIVER_FAULT, DRIVER_OK), "stopped"),
        (True, (OK_LINE, DRIVER_FAULT, DRIVER_OK), "stopped"),
        (True, (b"!status estop=ok driver=fault\r\n", DRIVER_OK), "stopped"),
        (False, (PRESSED_LINE, OK_LINE, DRIVER_OK, DRIVER_FAULT), "stopped"),
        (True, (OK_LINE, DRIVER_OK, DRIVER_FAULT), "stopped"),
        (True, (b"!status estop=ok driver=ok\r\n", DRIVER_FAULT), "stopped"),
        (False, (DRIVER_FAULT, PRESSED_LINE, OK_LINE, DRIVER_OK), "fault"),
        (False, (DRIVER_FAULT, OK_LINE, DRIVER_OK), "fault"),
    ],
)  # fmt: skip
def test_a_driver_fault_counts_if_it_was_reported_before_the_press(
    pressed_before: bool, lines: tuple[bytes, ...], mode: str
) -> None:
    bench = Button(OK_LINE + DRIVER_OK)
    bench.linked()
    if pressed_before:
        bench.status(PRESSED_LINE + DRIVER_OK).step()
    assert bench.status(b"".join(lines)).step().mode == mode


@each("restarted", [False, True])
def test_drivers_without_power_after_a_press_block_the_clear_until_they_recover(
    restarted: bool,
) -> None:
    bench = Button(OK_LINE + DRIVER_OK)
    bench.linked()
    bench.status(PRESSED_LINE).step()
    if restarted:
        latches = after_restart(bench.out.latches)
        bench = Button(OK_LINE + DRIVER_FAULT, latches=latches)
        bench.linked()
    bench.status(OK_LINE + DRIVER_OK).step()
    assert bench.status(OK_LINE + DRIVER_FAULT).step().mode == "stopped"
    assert not bench.answer("clear").success
    bench.status(OK_LINE + DRIVER_OK).step()
    assert bench.answer("clear").success
    assert bench.status(OK_LINE + DRIVER_FAULT).step().mode == "fault"


def test_after_a_clear_of_only_the_fault_drivers_may_still_lack_power() -> None:
    bench = Button(OK_LINE + DRIVER_OK)
    bench.linked()
    bench.status(PRESSED_LINE).step()
    bench.status(OK_LINE + DRIVER_OK).step(guard_trip="guard_line_damaged")
    assert bench.mode() == "fault"
    bench.step()
    assert bench.answer("clear").success
    assert bench.mode() == "stopped"
    assert bench.status(OK_LINE + DRIVER_FAULT).step().mode == "stopped"


def test_a_driver_fault_after_the_emergency_stop_was_unreported_counts() -> None:
    bench = Button(OK_LINE + DRIVER_OK)
    bench.linked()
    bench.status(b"")
    for _ in range(60):
        bench.step()
    assert bench.mode() == "stopped"
    bench.status(OK_LINE).step()
    assert bench.status(OK_LINE + DRIVER_FAULT).step().mode == "fault"


def test_after_a_clear_a_driver_fault_counts_even_if_no_driver_was_ever_reported_ok() -> None:
    bench = Button(OK_LINE)
    bench.linked()
    bench.status(PRESSED_LINE).step()
    bench.status(OK_LINE).step()
    assert bench.answer("clear").success
    assert bench.status(OK_LINE + DRIVER_FAULT).step().mode == "fault"


def test_with_an_ignored_button_a_driver_fault_always_counts() -> None:
    bench = Button(PRESSED_LINE + DRIVER_FAULT, Config(safety=SafetyConfig(estop="off")))
    bench.linked()
    assert bench.mode() == "fault"


def test_a_driver_fault_while_the_emergency_stop_is_unreported_does_not_count() -> None:
    bench = Button(OK_LINE + DRIVER_OK)
    bench.linked()
    bench.status(b"")
    for _ in range(60):
        bench.step()
    assert bench.status(DRIVER_FAULT + OK_LINE + DRIVER_OK).step().mode == "stopped"


# another board


def replugged(bench: Button, status: bytes, closed_steps: int = 100) -> Button:
    """Plug in a board that sends this status line, and wait until the link is up."""
    bench.unplug()
    for _ in range(closed_steps):
        bench.step()
    bench.status(status).replug().linked()
    return bench


@each("line", [DRIVER_FAULT, PRESSED_LINE, b"!status bumpers=X.\r\n", b"!status estop=ok\r\n"])
def test_a_board_that_reports_no_inputs_does_not_inherit_those_of_the_previous_board(
    line: bytes,
) -> None:
    bench = Button(line)
    bench.linked()
    replugged(bench, b"")
    mode = "fault" if line == DRIVER_FAULT else "stopped"
    for _ in range(290):
        bench.step(GO)
        assert bench.mode() == mode
    assert not bench.answer("clear").success
    for _ in range(20):
        assert bench.step(GO).mode == mode
    snapshot = bench.robot.snapshot(bench.now_ns)
    assert (snapshot.estop, snapshot.bumpers, snapshot.board) == ("", None, {})
    while bench.out.latches.causes:
        assert bench.answer("clear").success
    bench.step(REST)
    assert bench.step(GO).mode == "driving"


def test_clear_is_refused_until_a_replugged_board_reports_the_button_released() -> None:
    bench = Button(PRESSED_LINE)
    bench.linked()
    replugged(bench, b"")
    for _ in range(100):
        assert not bench.answer("clear").success
    bench.status(PRESSED_LINE)
    for _ in range(500):
        assert not bench.answer("clear").success
    bench.status(OK_LINE).step()
    assert bench.answer("clear").success


def test_a_port_that_reopens_repeatedly_still_latches_the_missing_report() -> None:
    bench = Button()
    bench.linked()
    bench.reply = None
    for _ in range(12):
        bench.unplug().step()
        bench.replug()
        for _ in range(10):
            bench.step()
    assert (bench.mode(), bench.robot.snapshot(bench.now_ns).estop) == ("stopped", "silent")


def test_each_board_must_report_a_required_input_before_the_robot_is_ready() -> None:
    bench = Button(OK_LINE, Config(safety=SafetyConfig(estop="required", bumpers=("front",))))
    bench.status(b"!status estop=ok bumpers=.\r\n").linked()
    assert bench.mode() == "ready"
    replugged(bench, b"", closed_steps=3)
    out = bench.step()
    assert (out.mode, out.link, out.code) == ("waiting", "up", "emergency_stop_missing")
    out = bench.status(OK_LINE).step()
    assert (out.mode, out.link, out.code) == ("waiting", "up", "bumpers_missing")
    # A board with another number of bumpers is refused, also behind a board with the right one.
    for _ in range(400):
        assert bench.status(b"!status estop=ok bumpers=..\r\n").step().mode != "ready"
    assert (bench.mode(), bench.answer("clear").success, bench.mode()) == (
        "stopped", True, "waiting",
    )  # fmt: skip
    assert bench.status(b"!status estop=ok bumpers=.\r\n").step().mode == "ready"


def test_a_board_that_restarts_must_still_report_its_inputs() -> None:
    """After a restart the board has the same firmware and must report the same inputs.

    A missing input then means a broken wire.
    """
    bench = Button(PRESSED_LINE)
    bench.linked()
    bench.status(b"!acsard-mcu 1\r\n").step()
    bench.status(b"")
    for _ in range(1000):
        bench.step()
    assert bench.out.link == "up"
    assert not bench.answer("clear").success


def test_a_late_step_does_not_shorten_the_time_for_the_reports_of_a_new_board() -> None:
    bench = Button(DRIVER_FAULT)
    bench.linked()
    replugged(bench, b"")
    bench.step(ms=5000)
    assert not bench.answer("clear").success
    for _ in range(310):
        bench.step()
    assert bench.answer("clear").success


def test_reports_of_the_previous_board_expire_even_if_steps_are_sometimes_late() -> None:
    bench = Button(DRIVER_FAULT)
    bench.linked()
    replugged(bench, b"")
    for _ in range(3):
        assert not bench.answer("clear").success
        for _ in range(120):
            bench.step()
        bench.step(ms=90)
    assert bench.answer("clear").success


# the battery


FULL_LINE, EMPTY_LINE = b"!status volts=24.00\r\n", b"!status volts=19.00\r\n"
GUARDED = Config(battery=BatteryConfig(warning_below=22.0, stop_below=21.0))


def test_an_empty_battery_ramps_to_rest_and_is_latched() -> None:
    bench = Button(FULL_LINE, GUARDED)
    bench.driving(steps=500)
    assert bench.robot.snapshot(bench.now_ns).battery == BatteryStatus(
        "ok", bench.now_ns, 24.0, mean=24.0
    )
    bench.status(EMPTY_LINE)
    while bench.step(GO).mode == "driving":
        before = bench.out.applied.linear
    speeds = [bench.out.applied.linear, *(bench.step(GO).applied.linear for _ in range(30))]
    drop = GUARDED.limits.linear_stop_deceleration / 100
    assert before - speeds[0] == pytest.approx(drop)
    assert all(a - b <= drop + 1e-9 for a, b in pairwise(speeds))
    assert speeds[-1] == 0.0
    assert bench.out.code == "battery_empty"


def test_each_new_level_is_an_event_and_a_change_of_the_status() -> None:
    bench = Button(FULL_LINE, GUARDED)
    bench.linked()
    events, changed = [], []
    for step in range(1500):
        if step == 500:
            bench.status(EMPTY_LINE)
        out = bench.step()
        events += [(event.name, event.level) for event in out.events if "battery" in event.name]
        battery = bench.robot.snapshot(bench.now_ns).battery
        assert battery is not None
        if out.status_changed:
            changed.append(battery.level)
    assert events == [("battery", "info"), ("battery", "warning"), ("battery_stop", "error")]
    assert changed == ["ok", "warning", "stop"]


def test_clear_is_refused_while_the_battery_is_low_and_works_above_the_hysteresis() -> None:
    bench = Button(EMPTY_LINE, GUARDED)
    for _ in range(400):
        bench.step()
    assert bench.mode() == "stopped"
    assert not bench.answer("clear").success
    bench.status(FULL_LINE)
    for _ in range(1000):
        bench.step(GO)
    assert bench.mode() == "stopped"
    assert bench.answer("clear").success
    for _ in range(10):
        assert bench.step(GO).mode == "ready"
    bench.step(REST)
    assert bench.step(GO).mode == "driving"


@each("silence", [b"", b"!status driver=ok\r\n", b"!status charge=0.90\r\n"])
def test_clear_works_5_s_after_the_last_report_of_a_low_battery(silence: bytes) -> None:
    bench = Button(EMPTY_LINE, GUARDED)
    for _ in range(400):
        bench.step()
    bench.status(silence)
    allowed = []
    for _ in range(600):
        allowed.append(bench.answer("clear").success)
    assert 490 < allowed.index(True) < 510
    bench.step(REST)
    assert bench.step(GO).mode == "driving"
    bench.status(EMPTY_LINE)
    for _ in range(400):
        bench.step(GO)
    assert bench.mode() == "stopped"
    assert not bench.answer("clear").success


@each("line", [PRESSED_LINE, OK_LINE + DRIVER_FAULT, b"!status bumpers=.X\r\n", EMPTY_LINE])
def test_a_restarted_daemon_refuses_clear_until_the_board_has_reported_the_cause(
    line: bytes,
) -> None:
    bench = Button(line, GUARDED).linked()
    for _ in range(400):
        bench.step()
    latches = after_restart(bench.out.latches)
    after = Button(b"", GUARDED, latches)
    after.linked()
    assert (after.out.latches, after.out.code) == (latches, latches.of("fault", "stop")[0].code)
    assert not after.answer("clear").success
    after.status(b"!status estop=ok driver=ok bumpers=.. volts=24.00\r\n")
    # A new number of bumpers counts from its second line on, a voltage after 3 s.
    for _ in range(310 if line == EMPTY_LINE else 3):
        after.step()
    assert after.answer("clear").success


def test_a_restarted_daemon_allows_clear_after_3_s_without_a_report() -> None:
    latches = after_restart(Button(PRESSED_LINE).linked().out.latches)
    after = Bench(latches=latches).linked()
    allowed = [after.answer("clear").success for _ in range(320)]
    assert 290 < allowed.index(True) < 310


# the link


def test_without_a_port_the_robot_waits_and_reports_the_reason() -> None:
    out = Bench().out
    assert (out.mode, out.link, out.linked) == ("waiting", "down", False)
    assert out.code == "port_closed"


def test_three_good_lines_after_the_question_make_the_robot_ready() -> None:
    bench = Bench()
    states, lines = [], []
    for _ in range(6):
        out = bench.step()
        states.append((out.mode, out.link, out.linked))
        lines.append(out.line)
    booting = ("waiting", "booting", False)
    assert states == [*[booting] * 4, ("ready", "up", True), ("ready", "up", True)]
    assert lines == [ZERO_LINE, b"?\r\n", *[ZERO_LINE] * 4]


def test_a_step_without_a_tick_uses_feedback_and_sends_no_line() -> None:
    bench = Bench().driving()
    out = bench.step(GO, tick=False)
    assert len(out.estimates) == 1
    assert (out.line, out.due) == (None, False)
    assert out.mode == "driving"


def test_odometry_follows_the_wheels() -> None:
    bench = Bench(watched=True).linked()
    bench.reply = bench.codec.encode(ROLLING)
    for _ in range(100):
        bench.step()
    (estimate,) = bench.out.estimates
    # 0.5 m/s for 1 s
    assert estimate.pose.x == pytest.approx(0.5)
    assert estimate.twist == Twist(0.5, 0.0)
    assert estimate.positions == pytest.approx((10.0,) * 4)
    assert estimate.covariance.xx == pytest.approx(1e-6 + 0.5e-4, rel=0.05)  # 1e-4 m2 per metre
    snapshot = bench.robot.snapshot(bench.now_ns)
    assert (snapshot.pose, snapshot.measured) == (estimate.pose, estimate.twist)
    assert snapshot.speeds == ROLLING


def test_the_pose_does_not_jump_over_a_lost_port() -> None:
    bench = Bench().linked()
    bench.reply = bench.codec.encode(ROLLING)
    before = bench.step().estimates[-1].pose
    bench.unplug().step(ms=3000)
    after = bench.replug().step(ms=3000).estimates[-1].pose
    assert after == before


# commands


def test_a_commander_that_never_sent_a_zero_does_not_drive() -> None:
    bench = Bench().linked()
    for _ in range(100):
        assert bench.step(GO).applied == REST
    assert bench.mode() == "ready"
    assert (bench.out.code, bench.out.source) == ("neutral", "app")


@pytest.mark.parametrize("angular", [0.0, 1.0])
def test_the_reason_says_that_a_robot_with_the_limits_0_cannot_move(angular: float) -> None:
    limits = LimitsConfig(linear_speed=0.0, angular_speed=angular)
    bench = Bench(Config(limits=limits)).linked()
    bench.step(REST)
    out = bench.step(GO)
    assert (out.mode, out.applied.linear) == ("driving", 0.0)
    assert out.code == ("commanded" if angular else "limits_zero")


def test_after_a_zero_a_command_drives() -> None:
    bench = Bench().linked()
    bench.step(REST)
    out = bench.step(GO)
    assert (out.mode, out.code) == ("driving", "commanded")
    assert (out.source, out.command_ns) == ("app", bench.now_ns)
    assert out.applied.linear == pytest.approx(0.01)


def test_the_line_has_the_wheel_speeds_of_the_applied_twist() -> None:
    bench = Bench().driving(Twist(0.3, 1.0), steps=100)
    # The wheels turn at 3 and 9 rad/s.
    assert bench.out.line == b"ap09.00,bp03.00,cp03.00,dp09.00\r\n"
    assert bench.out.applied == Twist(0.3, 1.0)
    assert bench.out.speeds.as_tuple() == pytest.approx((9.0, 3.0, 3.0, 9.0))


def test_a_silent_commander_is_followed_until_its_timeout_and_then_ramped_to_zero() -> None:
    bench = Bench().driving()
    for _ in range(25):
        assert bench.step().applied == GO
    for step in range(1, 51):
        out = bench.step()
        assert out.applied.linear == pytest.approx(max(0.5 - 0.01 * step, 0.0), abs=1e-12)
        assert out.mode == "ready"
    assert out.applied == REST
    assert out.line == ZERO_LINE
    assert out.code == "no_command"


def test_commands_are_counted_and_refusals_are_counted_by_reason() -> None:
    bench = Bench().linked()
    bench.step(REST, GO)
    refusals = tuple(Refusal(reason, "") for reason in ("malformed", "malformed", "wildcard"))
    bench.step(Twist(math.nan, 0.0), refusals=refusals)
    bench.step(GO, source="stranger")
    counters = bench.counters()
    assert counters["commands"] == 2
    assert counters["command_not_finite"] == 1
    assert counters["command_unknown_source"] == 1
    assert counters["command_malformed"] == 2
    assert counters["command_wildcard"] == 1


def test_lines_and_rejects_by_reason_are_counted_and_zero_counters_are_left_out() -> None:
    bench = Bench().linked()
    bench.reply = b"hello\r\n" + bench.codec.stop
    bench.step()
    counters = bench.counters()
    assert counters["lines"] == 6
    assert counters["line_malformed"] == 1
    assert "line_too_long" not in counters


def test_commands_are_accepted_in_a_step_without_a_tick() -> None:
    bench = Bench().linked()
    bench.step(REST, tick=False)
    bench.step(GO, tick=False)
    bench.step()
    assert bench.mode() == "driving"


# a lost link


def test_an_unplugged_port_sets_zero_speed_in_the_same_step() -> None:
    bench = Bench().driving()
    out = bench.unplug().step(GO, tick=False)
    assert (out.mode, out.link, out.linked) == ("waiting", "down", False)
    assert (out.applied, out.speeds) == (REST, STILL)


def test_a_lost_port_clears_every_command() -> None:
    bench = Bench().driving()
    bench.unplug().step()
    sources = bench.robot.snapshot(bench.now_ns).sources
    assert {source.age_s for source in sources} == {None}


def test_a_silent_mcu_makes_the_link_stale_and_the_speed_zero() -> None:
    bench = Bench().driving()
    bench.reply = None
    for _ in range(10):
        assert bench.step(GO).applied == GO
    out = bench.step(GO)
    assert (out.applied, out.link, out.mode) == (REST, "stale", "waiting")
    assert out.code == "simulator_fault"


def test_without_feedback_only_zero_lines_go_out_ten_times_a_second() -> None:
    bench = Bench().driving()
    bench.reply = None
    for _ in range(10):
        bench.step(GO)  # the silence timeout has not passed, so these still drive
    lines = [bench.step(GO).line for _ in range(100)]
    assert [index for index, line in enumerate(lines) if line] == list(range(0, 100, 10))
    assert {line for line in lines if line} == {ZERO_LINE}


def test_the_first_step_of_a_new_robot_sends_a_zero_line() -> None:
    bench = Bench()
    bench.reply = None
    assert bench.step().line == ZERO_LINE
    assert bench.step().line is None


def test_while_the_link_boots_every_line_is_zero() -> None:
    bench = Bench()
    assert bench.step(REST).line == ZERO_LINE
    assert bench.step(GO).line == b"?\r\n"
    assert bench.step(GO).line == ZERO_LINE
    assert bench.link() == "booting"


def test_after_a_short_gap_the_robot_ramps_up_again_from_zero() -> None:
    bench = Bench().driving()
    reply, bench.reply = bench.reply, None
    for _ in range(50):
        bench.step(GO)
    bench.reply = reply
    assert [bench.step(GO).applied.linear for _ in range(5)] == pytest.approx(
        [0.0, 0.0, 0.01, 0.02, 0.03]
    )


def test_after_a_long_gap_each_source_must_be_neutral_again() -> None:
    bench = Bench().driving()
    reply, bench.reply = bench.reply, None
    for _ in range(101):
        bench.step(GO)
    bench.reply = reply
    for _ in range(20):
        assert bench.step(GO).applied == REST
    assert bench.out.code == "neutral"
    bench.let_go()
    assert bench.step(GO).mode == "driving"


def test_a_port_reopened_between_two_steps_is_a_new_session() -> None:
    bench = Bench().driving()
    out = bench.replug().step(GO)
    assert (out.link, out.applied) == ("booting", REST)
    for _ in range(20):
        assert bench.step(GO).applied == REST


def test_a_zero_sent_while_the_port_was_closed_does_not_count_as_neutral() -> None:
    bench = Bench().driving()
    bench.unplug().step(REST)
    bench.replug().step(GO)
    for _ in range(20):
        assert bench.step(GO).applied == REST


# stop, clear, activate, deactivate


def test_a_stop_brakes_by_its_own_deceleration_and_is_latched() -> None:
    bench = Bench().driving()
    answer = bench.answer("stop")
    (stop,) = bench.robot.latches.of("stop")
    assert (answer.success, answer.numbers) == (True, (stop.number,))
    # 3 m/s2 is 0.03 m/s per step; 0.5 m/s take 17 steps.
    path = [bench.out.applied.linear, *(bench.step(GO).applied.linear for _ in range(17))]
    assert path == pytest.approx([max(0.5 - 0.03 * step, 0.0) for step in range(1, 19)], abs=1e-12)
    assert (bench.mode(), bench.out.code) == ("stopped", "stopped")


def test_a_stop_of_a_stopped_robot_is_an_event_because_a_clear_must_name_its_latch() -> None:
    bench = Bench().driving()
    bench.step(ask="stop")
    assert bench.answer("stop").success
    assert names(bench.out) == ["stop"]


def test_a_refused_request_is_no_event() -> None:
    bench = Bench().driving()
    bench.step(ask="stop")
    assert not bench.answer("activate").success
    assert names(bench.out) == []


def test_a_clear_without_a_latch_succeeds_and_changes_nothing() -> None:
    bench = Bench().driving()
    mode, twist = bench.mode(), bench.out.applied
    (answer,) = bench.step(GO, ask="clear").answers
    assert (answer.success, answer.numbers) == (True, ())
    assert (bench.mode(), bench.out.applied != REST, twist != REST) == (mode, True, True)


def test_after_clear_the_robot_is_ready_and_each_source_must_be_neutral() -> None:
    bench = Bench().driving()
    bench.step(ask="stop")
    answer = bench.answer("clear")
    assert answer.success
    assert answer.numbers
    assert bench.mode() == "ready"
    for _ in range(20):
        bench.step(GO)
        assert bench.mode() == "ready"
    bench.let_go()
    assert bench.step(GO).mode == "driving"


def test_deactivating_ramps_to_zero_by_the_normal_deceleration() -> None:
    bench = Bench().driving()
    answer = bench.answer("deactivate")
    (off,) = bench.robot.latches.of("inactive")
    assert (answer.success, answer.numbers) == (True, (off.number,))
    assert bench.out.applied.linear == pytest.approx(0.49)
    for _ in range(50):
        bench.step(GO)
    assert (bench.mode(), bench.out.applied) == ("inactive", REST)
    assert bench.out.code == "switched_off"


def test_after_an_activation_each_source_must_be_neutral() -> None:
    bench = Bench().driving()
    bench.step(ask="deactivate")
    (off,) = bench.robot.latches.of("inactive")
    answer = bench.answer("activate")
    assert (answer.success, answer.numbers) == (True, (off.number,))
    for _ in range(20):
        bench.step(GO)
    assert bench.mode() == "ready"
    bench.let_go()
    bench.step(GO)
    assert bench.mode() == "driving"


def test_activating_an_active_robot_asks_each_sender_for_a_zero() -> None:
    bench = Bench().driving()
    bench.step(GO, ask="activate", gyro=0.0)
    assert bench.mode() == "ready"
    bench.step(REST)
    bench.step(GO)
    assert bench.mode() == "driving"
    bench.set({"limits.linear_speed": 0.9})
    assert bench.step(GO).applied == GO


def test_a_sample_of_the_gyro_is_kept_if_the_robot_uses_one() -> None:
    for uses in (True, False):
        bench = Bench(Config(odometry=OdometryConfig(gyro=uses))).linked()
        before = bench.robot.snapshot(bench.now_ns).gyro
        bench.step(gyro=0.0)
        assert (bench.robot.snapshot(bench.now_ns).gyro != before) is uses


def test_each_change_of_mode_by_request_is_an_event_even_in_quick_succession() -> None:
    bench = Bench().linked()
    for _ in range(2):
        assert names(bench.step(ask="stop")) == ["stop", "mode"]
        assert names(bench.step(ask="clear")) == ["clear", "mode"]


# the pose


def test_set_pose_and_reset_odometry_set_the_pose_of_the_next_estimate() -> None:
    bench = Bench().driving()
    assert bench.answer("set_pose", Pose(1.0, 2.0, 0.5)).success
    out = bench.step(GO)
    assert (out.estimates[-1].pose, out.mode, out.applied) == (Pose(1.0, 2.0, 0.5), "driving", GO)
    assert bench.answer("reset_odometry").success
    assert bench.step().estimates[-1].pose == Pose()


def test_several_requests_of_one_step_are_answered_in_order() -> None:
    bench = Bench().linked()
    bench.now_ns += 10 * MS
    requests = (Request("stop", 1), Request("activate", 2), Request("reset_odometry", 3))
    out = bench.stepped.step(Inputs(bench.now, True, True, 1, requests=requests))
    assert [(answer.id, answer.success) for answer in out.answers] == [
        (1, True),
        (2, False),
        (3, True),
    ]


@pytest.mark.parametrize("order", [("stop", "clear"), ("clear", "stop")])
def test_a_clear_in_the_same_step_as_a_stop_does_not_release_the_stop(
    order: tuple[Verb, Verb],
) -> None:
    bench = Bench().linked()
    bench.step(ask="stop")
    bench.now_ns += 10 * MS
    requests = tuple(Request(verb) for verb in order)
    assert bench.stepped.step(Inputs(bench.now, True, True, 1, requests=requests)).mode == "stopped"


def test_a_service_that_is_called_continuously_causes_one_event_per_second() -> None:
    bench = Bench().linked()
    events = [event for _ in range(250) for event in bench.step(ask="reset_odometry").events]
    assert [event.count for event in events] == [1, 100, 100]


def test_a_stop_that_arrives_before_its_query_and_with_it_is_one_event() -> None:
    bench = Bench().linked()
    for number in (1, 2):
        asked_ns = bench.now_ns
        ahead = Request("stop", asked_ns=asked_ns, by="joe (native)")
        bench.now_ns += 10 * MS
        out = bench.stepped.step(Inputs(bench.now, True, True, 1, requests=(ahead,)))
        batches = [out.events]
        bench.now_ns += 1500 * MS
        out = bench.stepped.step(Inputs(bench.now, True, True, 1, requests=(replace(ahead, id=7),)))
        assert out.answers[0].success
        batches.append(out.events)
        stops = [event for events in batches for event in events if event.name == "stop"]
        assert [(event.by, event.count) for event in stops] == [("joe (native)", 1)], number
        bench.now_ns += 1500 * MS


# logged events


def test_a_refused_command_is_reported_with_its_reason_and_its_sender() -> None:
    (event,) = Bench().linked().step(REST, source="nobody").events
    assert (event.name, event.level) == ("command_refused", "warning")
    assert event.code == "unknown_source"
    refusal = Refusal("malformed", "cmd/app: no map", "app", "a" * 1000)
    bench = Bench().linked()
    events = [event for _ in range(150) for event in bench.step(refusals=(refusal,)).events]
    first, second = events
    assert (first.code, first.by, first.count) == ("malformed", "a" * MAX_SENDER_LENGTH, 1)
    assert (second.code, second.count) == ("malformed", 100)


def test_missed_periods_are_reported_with_their_number() -> None:
    bench = Bench().linked()
    bench.now_ns += 50 * MS
    out = bench.stepped.step(Inputs(bench.now, True, True, 1, missed=4))
    assert [(event.name, event.count) for event in out.events] == [("missed_periods", 4)]
    assert bench.counters()["missed_periods"] == 4


def test_a_speed_limit_applies_until_it_ends_and_each_change_is_an_event() -> None:
    bench = Bench().driving()

    def cap(speed: float | None) -> list[str]:
        bench.now_ns += 10 * MS
        bench.out = bench.stepped.step(
            Inputs(
                bench.now, True, True, 1, received=(Received(bench.now, bench.codec.stop),),
                commands=(Command("app", GO, bench.now_ns),), speed_cap=SpeedCap(speed, "joe"),
            )
        )  # fmt: skip
        return [event.by for event in bench.out.events if event.name == "speed_limit"]

    assert cap(0.3) == ["joe"]
    assert cap(0.3) == []
    for _ in range(110):  # an event that comes again within a second is held back
        assert bench.step(GO).applied.linear >= 0.3 - 1e-9
    assert bench.out.applied.linear == pytest.approx(0.3)
    assert "0.3 m/s" in bench.robot.snapshot(bench.now_ns).speed_limit
    assert cap(None) == ["joe"]
    for _ in range(60):
        bench.step(GO)
    assert bench.out.applied == GO
    assert bench.robot.snapshot(bench.now_ns).speed_limit == ""


def test_events_from_outside_the_robot_come_first_and_are_throttled() -> None:
    bench = Bench()
    events: list[Event] = []
    lost = Event("port_lost", "it is gone", "warning")
    for _ in range(1000):
        bench.now_ns += 10 * MS
        events += bench.stepped.step(Inputs(bench.now, True, True, 1, events=(lost,))).events
    assert events[0] == lost
    lines = [event for event in events if event.name == "port_lost"]
    assert len(lines) <= 15
    assert sum(event.count for event in lines) > 900


def test_more_than_one_implausible_line_in_a_hundred_is_an_event() -> None:
    bench, event_counts = Bench().linked(), Counter[str]()
    for i in range(2000):
        bench.reply = bench.codec.encode(WheelSpeeds(99.0, 0.0, 0.0, 0.0) if i % 50 == 0 else STILL)
        event_counts.update(names(bench.step()))
    assert event_counts["lines_implausible"] == 2
    assert bench.out.mode == "ready"


# fault


def test_a_guard_trip_is_a_latched_fault_and_an_error_event() -> None:
    bench = Bench().driving()
    out = bench.step(GO, guard_trip="guard_too_fast")
    assert (out.mode, out.code) == ("fault", "guard_too_fast")
    event, mode = out.events
    assert (event.name, event.level) == ("fault", "error")
    assert (event.code, mode.code) == ("guard_too_fast", "guard_too_fast")
    for _ in range(50):
        bench.step(REST)
        bench.step(GO)
    assert (bench.mode(), bench.out.applied) == ("fault", REST)


def test_after_a_guard_trip_the_robot_continues_from_the_stop_that_was_sent() -> None:
    bench = Bench().driving()
    assert bench.step(GO, guard_trip="guard_too_fast").line == ZERO_LINE


def impossible(bench: Bench, lines: int) -> Bench:
    """Let the board send this many impossible lines, then its earlier reply again."""
    reply, bench.reply = bench.reply, bench.codec.encode(WheelSpeeds(99.0, 99.0, 99.0, 99.0))
    for _ in range(lines):
        bench.step(GO)
    bench.reply = reply
    return bench


def test_impossible_speeds_of_any_wheel_are_one_cause_and_hide_no_later_cause() -> None:
    bench = impossible(Bench().driving(), 3)
    for wheel in range(4):
        for speed in (99.0, -99.0):
            speeds = [0.0, 0.0, 0.0, 0.0]
            speeds[wheel] = speed
            bench.reply = bench.codec.encode(WheelSpeeds(*speeds))
            bench.step(GO)
    (first,) = bench.robot.latches.of("fault")
    bench.step(GO, guard_trip="guard_too_fast")
    newest, second = bench.robot.latches.of("fault")
    assert (newest.code, second) == ("guard_too_fast", first)


def test_a_third_impossible_line_is_a_fault_that_brakes_by_the_stop_deceleration() -> None:
    bench = impossible(Bench().driving(), 2)
    assert (bench.mode(), bench.out.applied) == ("driving", GO)
    impossible(bench, 1)
    assert (bench.mode(), bench.out.code) == ("fault", "impossible_speeds")
    # Each step removes 3 m/s2 x 10 ms.
    assert bench.out.applied.linear == pytest.approx(0.47)
    assert bench.step(GO).applied.linear == pytest.approx(0.44)
    assert bench.counters()["line_implausible"] == 3


def test_a_lost_link_resets_the_count_of_impossible_lines() -> None:
    bench = impossible(Bench().driving(), 2)
    bench.unplug().step()
    impossible(bench.replug(), 5)
    assert (bench.link(), bench.mode()) == ("up", "ready")


def test_a_fault_clears_every_command() -> None:
    bench = Bench().driving()
    bench.step(guard_trip="guard_too_fast")
    sources = bench.robot.snapshot(bench.now_ns).sources
    assert {source.age_s for source in sources} == {None}


def test_clear_resets_the_count_of_impossible_lines() -> None:
    bench = impossible(Bench().driving(), 3)
    bench.reply = bench.codec.encode(WheelSpeeds(99.0, 99.0, 99.0, 99.0))
    bench.step(ask="clear")
    assert [bench.step().mode for _ in range(3)] == ["ready", "ready", "fault"]


def test_after_a_fault_each_source_must_be_neutral() -> None:
    bench = Bench().driving()
    bench.step(GO, guard_trip="guard_too_fast")
    bench.step(GO, ask="clear")
    for _ in range(20):
        bench.step(GO)
    assert bench.mode() == "ready"


# shutdown


def test_shutting_down_ramps_to_zero_by_the_stop_deceleration_and_stays_there() -> None:
    bench = Bench().driving()
    bench.shutting_down = True
    path = [bench.step(GO).applied.linear for _ in range(20)]
    assert path[:3] == pytest.approx([0.47, 0.44, 0.41])
    assert path[17:] == [0.0, 0.0, 0.0]
    assert (bench.mode(), bench.out.code) == ("shutdown", "shutting_down")


def test_shutting_down_is_one_event() -> None:
    bench = Bench().driving()
    bench.shutting_down = True
    (event,) = bench.step().events
    assert (event.name, event.code) == ("mode", "shutting_down")
    assert names(bench.step()) == []


# lines that did not leave


def test_after_superseded_lines_the_speed_grows_from_the_last_sent_line() -> None:
    # Every second line leaves, so two periods have passed since the last sent one.
    bench = Bench().linked()
    bench.step(REST)
    bench.step(GO)
    assert bench.out.applied.linear == pytest.approx(0.01)
    bench.step(GO)
    assert bench.out.applied.linear == pytest.approx(0.02)
    bench.step(GO, superseded=True)
    assert bench.out.applied.linear == pytest.approx(0.03)  # 0.01 and 20 ms
    bench.step(GO, superseded=True)
    assert bench.out.applied.linear == pytest.approx(0.04)  # 0.01 and 30 ms
    bench.step(GO)
    assert bench.out.applied.linear == pytest.approx(0.05)


def test_while_lines_are_superseded_the_speed_cannot_run_away_from_the_last_line_sent() -> None:
    bench = Bench().driving(Twist(0.1, 0.0))
    bench.step(Twist(1.0, 0.0))  # 0.11 m/s was sent; no later line leaves
    bench.step(Twist(1.0, 0.0))
    for _ in range(23):
        out = bench.step(Twist(1.0, 0.0), superseded=True)
        assert out.applied.linear <= 0.11 + 0.05 + 1e-9


def test_after_a_superseded_line_a_ramp_brakes_for_the_whole_elapsed_time() -> None:
    bench = Bench().driving()
    for _ in range(26):
        bench.step()
    assert bench.out.applied.linear == pytest.approx(0.49)
    bench.step()  # this line does not leave
    assert bench.step(superseded=True).applied.linear == pytest.approx(0.47)  # 0.49 and 20 ms


def test_after_too_long_without_a_sent_line_the_speed_starts_from_zero() -> None:
    bench = Bench().driving()
    assert bench.step(ms=250).applied == GO
    assert bench.step(ms=260).applied == REST
    speeds = [bench.step(GO).applied.linear for _ in range(11)]
    assert next(speed for speed in speeds if speed) == pytest.approx(0.01)


def test_after_lines_were_superseded_for_too_long_the_speed_is_zero() -> None:
    bench = Bench().driving()
    bench.step(GO)  # the first line that does not leave; the MCU received the one before it last
    path = [bench.step(GO, superseded=True).applied.linear for _ in range(26)]
    assert path[:24] == [0.5] * 24  # from 20 to 250 ms
    assert path[24:] == [0.0, 0.0]


def test_after_a_stall_the_speed_grows_by_at_most_50_ms_of_acceleration() -> None:
    bench = Bench().linked()
    bench.step(REST)
    bench.step(GO)
    assert bench.step(ms=200).applied.linear == pytest.approx(0.01 + 0.05)


def test_at_a_slow_rate_a_stall_adds_at_most_1_5_periods_of_acceleration() -> None:
    slow = Config(
        control=ControlConfig(rate=10.0),
        commands=CommandsConfig(sources=(Source("app", 50, 1.0),)),
    )
    bench = Bench(slow).linked()
    bench.step(REST)
    assert bench.step(GO, ms=100).applied.linear == pytest.approx(0.1)
    assert bench.step(ms=240).applied.linear == pytest.approx(0.25)


def test_the_question_that_takes_the_place_of_a_line_is_no_step_of_the_ramp() -> None:
    slow = Config(
        control=ControlConfig(rate=10.0),
        limits=LimitsConfig(linear_acceleration=0.2),
        commands=CommandsConfig(sources=(Source("app", 50, 1.0),)),
    )
    bench = Bench(slow).linked()
    bench.step(REST)
    for _ in range(20):
        before = bench.out.applied.linear
        bench.reply = bench.out.line  # a board that repeats its commands is asked
        if bench.step(GO).line == b"?\r\n":
            break
    assert bench.out.line == b"?\r\n"
    assert 0.0 < before < 0.4
    # The last line that moved the motors is two periods old: the speed grows by 1.5.
    assert bench.step(GO).applied.linear == pytest.approx(before + 0.03)


def test_after_a_stall_the_robot_brakes_for_the_whole_elapsed_time() -> None:
    bench = Bench().driving()
    bench.reply = bench.codec.stop
    for _ in range(25):
        bench.step()
    assert bench.step(ms=200).applied.linear == pytest.approx(0.3)


def test_a_line_superseded_before_the_port_was_lost_does_not_bring_its_speed_back() -> None:
    bench = Bench().driving()
    bench.step(GO)  # this line does not leave
    bench.replug().step(GO, superseded=True)
    assert bench.out.applied == REST
    bench.step(GO)
    bench.step(GO)
    bench.reply = bench.codec.stop * 3
    bench.step(GO, superseded=True)
    assert bench.link() == "up"
    assert bench.out.applied.linear <= 0.05


def test_a_superseded_speed_does_not_return_if_the_port_reopened_between_two_ticks() -> None:
    bench = Bench().driving()
    bench.step(GO)  # this line does not leave
    bench.replug()
    for tick in (True, True, True, False, False):
        bench.step(GO, tick=tick)
    assert bench.link() == "up"
    assert bench.step(GO, superseded=True).applied.linear <= 0.05


# changes of the status


def test_the_status_changes_with_mode_reason_link_and_source_and_not_otherwise() -> None:
    bench = Bench()
    assert bench.out.status_changed
    assert not bench.unplug().step().status_changed
    bench.replug()
    changes = [bench.step().status_changed for _ in range(6)]
    assert changes == [True, False, False, False, True, False]
    assert bench.step(REST).status_changed  # driven by app
    assert not bench.step(GO).status_changed
    assert bench.step(REST, source="teleop").status_changed
    assert not bench.step(REST, source="teleop").status_changed
    assert bench.step(ask="stop").status_changed


# determinism


# the latches that a robot starts with


def kept(kind: CauseKind, code: Code, text: str, by: str = "") -> Latches:
    return Latches((Cause(7, kind, code, text, by=by, at_ns=WALL_NS, kept=True),), 7)


STOPPED = kept("stop", "stopped", "stopped by ann", "ann")
FAULTED = kept("fault", "wheel_reversed", "a wheel turns the wrong way")
OFF = kept("inactive", "switched_off", "switched off by joe", "joe")


@each(
    ("latches", "mode", "code"),
    [
        (STOPPED, "stopped", "stopped"),
        (FAULTED, "fault", "wheel_reversed"),
        (OFF, "inactive", "switched_off"),
    ],
)
def test_a_robot_starts_in_the_mode_of_its_latches_with_one_event(
    latches: Latches, mode: str, code: str
) -> None:
    bench = Bench(latches=latches)
    assert (bench.out.mode, bench.out.code) == (mode, code)
    assert bench.out.latches is latches
    (event,) = bench.out.events
    assert (event.name, event.level, event.code) == ("mode", "warning", code)
    bench.linked().step(REST)
    for _ in range(100):
        assert bench.step(GO).applied == REST
    assert (bench.mode(), bench.out.latches) == (mode, latches)
    assert bench.answer("activate" if mode == "inactive" else "clear").success
    assert bench.out.latches.causes == ()
    bench.let_go()
    assert bench.step(GO).mode == "driving"


def test_a_flood_of_bytes_faster_than_the_wire_raises_no_error() -> None:
    """A board floods the USB link, or the configured baud rate is too low.

    Many reads have the same time, so the host cannot estimate the board's clock from them.
    """
    robot = SteppedRobot(Robot(Config()))
    good = b"a0.00,b0.00,c0.00,d0.00\r\n"
    for n in range(2000):
        odd, after = n % 12 == 0, n % 12 == 1
        data = (b"" if after else b"xxxxxxxxxx\n") + good + (b"" if odd else b"y" * 120)
        now = Instant(10**12 + n * 1_000_000, 0)
        robot.step(
            Inputs(
                now=now,
                tick=n % 10 == 0,
                port_open=True,
                opened=1,
                received=(Received(now, data),),
            )
        )


# the gyro, the wheels and the clocks, as the robot reports them


def test_the_distance_travelled_counts_forwards_and_backwards() -> None:
    bench = Bench().linked()
    for speeds in (ROLLING, WheelSpeeds(-10.0, -10.0, -10.0, -10.0)):
        bench.reply = bench.codec.encode(speeds)
        for _ in range(100):
            bench.step()
    assert bench.robot.travelled == pytest.approx(1.0, abs=0.05)


def test_a_link_that_was_lost_while_no_step_came_is_counted_as_late() -> None:
    bench = Bench().linked()
    bench.reply = None
    bench.step(ms=400)
    assert bench.link() == "stale"
    assert bench.counters()["link_lost"] == 1
    assert bench.counters()["link_lost_host_stall"] == 1


def test_a_link_that_was_lost_in_time_is_not_counted_as_late() -> None:
    bench = Bench().linked()
    bench.reply = None
    for _ in range(40):
        bench.step()
    assert bench.counters()["link_lost"] == 1
    assert "link_lost_host_stall" not in bench.counters()


def test_wheels_that_turn_against_their_command_are_a_fault() -> None:
    bench = Bench(watched=True).driving(steps=1)
    bench.reply = bench.codec.encode(WheelSpeeds(-10.0, -10.0, -10.0, -10.0))
    for _ in range(200):
        bench.step(GO)
    assert bench.mode() == "fault"


def test_wheels_that_turn_without_a_command_are_reported_and_counted() -> None:
    bench = Bench(watched=True).linked()
    bench.reply = bench.codec.encode(WheelSpeeds(5.0, 5.0, 5.0, 5.0))
    event_names = [event.name for _ in range(100) for event in bench.step().events]
    assert "uncommanded_motion" in event_names
    assert bench.counters()["uncommanded_motion"] >= 1
    assert bench.mode() == "ready"


def test_a_wheel_at_rest_while_the_others_roll_is_reported_and_counted() -> None:
    bench = Bench(watched=True).driving()
    bench.reply = bench.codec.encode(replace(ROLLING, front_left=0.0))
    event_names = [event.name for _ in range(200) for event in bench.step(GO).events]
    assert "wheel_fault" in event_names
    assert bench.counters()["wheel_faults"] >= 1


def test_an_invalid_setting_is_refused_and_changes_nothing() -> None:
    bench = Bench().linked()
    before = bench.robot.config
    settings: dict[str, Plain] = {"limits.linear_speed": -1.0}
    request = Request("set", 7, settings=settings)
    outputs = bench.stepped.step(Inputs(bench.now, True, True, bench.opened, requests=(request,)))
    assert not outputs.answers[0].success
    assert "limits.linear_speed" in outputs.answers[0].message
    assert bench.robot.config is before


def test_a_timeout_that_is_set_applies_and_each_sender_must_be_neutral_again() -> None:
    bench = Bench().linked()
    bench.step(REST)
    bench.set({"commands.sources.app.timeout": 0.5})
    bench.step(GO)
    assert bench.robot.snapshot(bench.now_ns).sources[1].waits_for.what == "neutral"
    bench.step(REST)
    bench.step(GO)
    for _ in range(45):
        bench.step()
    assert bench.mode() == "driving"


@pytest.mark.parametrize(("refused_ms", "mode"), [(502, "ready"), (2, "ready"), (0, "driving")])
def test_a_refused_message_disarms_only_the_zeros_before_it(refused_ms: int, mode: str) -> None:
    bench = Bench().linked()
    zero_ns = bench.now_ns + MS
    refused = Refusal("malformed", "it cannot be read", "app", "", zero_ns + refused_ms * MS)
    for number in range(150):
        bench.now_ns += 10 * MS
        inputs = Inputs(
            bench.now, True, True, bench.opened,
            received=(Received(bench.now, bench.codec.stop),),
            commands=(Command("app", REST, zero_ns + MS, shared=True),) if number == 0 else (),
            refusals=(refused,) if number == refused_ms // 10 else (),
        )  # fmt: skip
        bench.out = bench.stepped.step(inputs)
    bench.now_ns += 10 * MS
    command = Command("app", GO, bench.now_ns, shared=True)
    bench.out = bench.stepped.step(
        Inputs(bench.now, True, True, bench.opened, commands=(command,),
               received=(Received(bench.now, bench.codec.stop),))
    )  # fmt: skip
    assert bench.mode() == mode


def test_first_commands_of_a_new_sender_are_counted_apart_from_refused_ones() -> None:
    bench = Bench().linked()
    bench.step(REST, late_ms=0.0)
    counters = bench.counters()
    assert counters["commands_of_new_senders"] == 1
    assert not [name for name in counters if name.startswith("command_")]


def test_lines_that_are_not_answered_are_reported() -> None:
    bench = Bench().linked()
    event_names: list[str] = []
    for number in range(1100):
        bench.reply = None if number % 5 == 0 else bench.codec.stop
        event_names += [event.name for event in bench.step().events]
    assert event_names.count("lines_lost") == 1


def test_stamps_that_a_router_replaced_are_counted() -> None:
    bench = Bench().linked()
    command = Command("app", REST, bench.now_ns, stamp_replaced=True)
    bench.stepped.step(Inputs(bench.now, True, True, bench.opened, commands=(command,)))
    assert bench.counters()["stamps_replaced"] == 1


def test_each_source_that_sends_and_does_not_drive_has_what_it_waits_for() -> None:
    bench = Bench().driving()
    bench.step(GO, source="teleop")
    waits = bench.robot.waits(bench.now_ns)
    assert {name: why.code for name, why in waits.items()} == {"teleop": "neutral", "app": "higher"}
