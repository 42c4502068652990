"""Tests of the guard, which checks every line just before it is sent.

They cover the lines that it passes, the lines that it replaces, and its reasons.
"""

from __future__ import annotations

import binascii
import random

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.config.contradictions import contradictions
from acsard.core.config.settings import (
    CommandsConfig,
    Config,
    DriveConfig,
    FeedbackConfig,
    LimitsConfig,
    McuConfig,
    Source,
    WheelMap,
)
from acsard.core.guard import RAMP_MARGIN_NS, Guard, Memory
from acsard.core.link.checked_line import seal
from acsard.core.link.codec import Codec
from acsard.core.motion.kinematics import Kinematics
from acsard.core.motion.limits import AT_REST
from acsard.core.robot import Robot
from acsard.core.values import (
    REST,
    STILL,
    Command,
    Instant,
    Plain,
    Received,
    Request,
    Trip,
    Twist,
    Verb,
    WheelSpeeds,
)
from tests.each import each
from tests.stepped import Inputs, Outputs, SteppedRobot
from tests.unit.core.guarded import checked

MS = 1_000_000
NOW_NS = 50_000 * MS
SOURCES = (Source("app", 50), Source("slow", 10, timeout=1.0))
CODEC = Codec(WheelMap())
STOP = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"

NOT_A_LINE = "guard_line_damaged"
TOO_FAST = "guard_too_fast"
NO_LINK = "guard_no_link"
GROWS = "guard_no_command"
LATE = "guard_too_long"


def line(*wheels: float) -> bytes:
    """Return the line with these speeds for a, b, c, d. A single number is for all of them."""
    return CODEC.encode(WheelSpeeds(*(wheels * 4 if len(wheels) == 1 else wheels)))


def outputs(
    data: bytes | None,
    *,
    mode: str = "driving",
    linked: bool = True,
    source: str = "app",
    age_ms: float | None = 0.0,
    at_ns: int = NOW_NS,
) -> Outputs:
    """Return the outputs of a step that sends this line.

    By default the link is up and the robot follows a fresh command.
    """
    return Outputs(
        now=Instant(at_ns, at_ns),
        due=True,
        line=data,
        speeds=STILL,
        applied=REST,
        linked=linked,
        estimates=(),
        mode=mode,
        code="commanded",
        reason="",
        link="up" if linked else "down",
        source=source,
        command_ns=None if age_ms is None else at_ns - int(age_ms * MS),
        status_changed=False,
    )


def coasting(data: bytes) -> Outputs:
    """Return the outputs of a step that sends this line although no command is fresh."""
    return outputs(data, mode="ready", source="", age_ms=None)


class Guarded:
    """A guard and the last line that it passed."""

    def __init__(
        self,
        stop: bytes,
        wheel_speed: float,
        sources: tuple[Source, ...],
        require_check: bool = False,
    ) -> None:
        config = Config(
            mcu=McuConfig(link_check="on" if require_check else "off"),
            limits=LimitsConfig(wheel_speed=wheel_speed),
            commands=CommandsConfig(sources=sources),
        )
        self.guard = Guard(stop, config)
        self._passed = stop
        self.trip: Trip = ""

    def check(self, result: Outputs) -> bytes | None:
        line, self.trip = checked(self.guard, result)
        self._passed = line or self._passed
        return line

    def note_sent(self) -> None:
        self.guard.record_written(self._passed)


@pytest.fixture
def guard() -> Guarded:
    return Guarded(STOP, 40.0, SOURCES)


def guard_after_line(guard: Guarded, *wheels: float) -> Guarded:
    """Return a guard that has passed a line with these speeds, which was then sent."""
    data = line(*wheels)
    assert guard.check(outputs(data)) == data
    guard.note_sent()
    return guard


def objection(guard: Guarded, result: Outputs) -> str:
    """Return why the line became STOP, or "" if it passed unchanged."""
    passed = guard.check(result)
    assert passed == (STOP if guard.trip else result.line)
    return guard.trip


# lines that pass


@pytest.mark.parametrize("linked", [True, False])
@pytest.mark.parametrize("mode", ["inactive", "waiting", "ready", "driving", "stopped", "fault"])
def test_zero_passes_always(guard: Guarded, mode: str, linked: bool) -> None:
    guard_after_line(guard, 10.0)
    assert objection(guard, outputs(STOP, mode=mode, linked=linked, age_ms=None)) == ""


@pytest.mark.parametrize("trailing_comma", [True, False])
def test_a_ramp_to_zero_passes_to_the_end(trailing_comma: bool) -> None:
    kinematics = Kinematics(DriveConfig())
    codec, limits = Codec(WheelMap(), trailing_comma), LimitsConfig()
    guard = Guarded(codec.stop, 40.0, SOURCES)
    motion = AT_REST.follow(Twist(0.7, -2.3), 1000.0, limits, kinematics)
    data = codec.encode(kinematics.wheel_speeds(motion.twist))
    assert guard.check(outputs(data)) == data
    guard.note_sent()
    while motion.twist != REST:
        motion = motion.coast(0.01, limits)
        data = codec.encode(kinematics.wheel_speeds(motion.twist))
        assert guard.check(coasting(data)) == data
        guard.note_sent()
    assert data == codec.stop


# not a line


@pytest.mark.parametrize(
    "data",
    [
        b"",
        b"\r\n",
        b"ap01.00,bp01.00,cp01.00\r\n",
        b"ap01.00,bp01.00,cp01.00,dp01.00",
        b"ap01.00,bp01.00,cp01.00,dp01.00\n\n",
        b"ap01.00,bp01.00,cp01.00,dp01.00,\r\n",
        b"ap01.00,bp01.00,cp01.00,dp1.00\r\n",
        b"ap01.00,bp01.00,cp01.00,dp001.0\r\n",
        b"ap01.00,bp01.00,cp01.00,dp01,00\r\n",
        b"ap01.00,bp01.00,cp01.00,dp 1.00\r\n",
        b"ap01.00,bp01.00,cp01.00,dp+1.00\r\n",
        b"ap01.00,bp01.00,cp01.00,dp0x.00\r\n",
        b"ap01.00,bp01.00,cp01.00,dp01.0_\r\n",
        b"ap01.00,bp01.00,cp01.00,dpnanan\r\n",
        b"ap01.00,bp01.00,cp01.00,d-01.00\r\n",
        b"ap01.00,bp01.00,cp01.00,dP01.00\r\n",
        b"ap01.00,bp01.00,cp01.00,cp01.00\r\n",
        b"bp01.00,ap01.00,cp01.00,dp01.00\r\n",
        b"Ap01.00,bp01.00,cp01.00,dp01.00\r\n",
        b"ap01.00;bp01.00;cp01.00;dp01.00\r\n",
        b"ap01.00 bp01.00,cp01.00,dp01.00\r\n",
        b"ap01.00, bp1.00,cp01.00,dp01.00\r\n",
        b"ap100.00,bp01.00,cp1.00,dp1.00\r\n",
        # Of two lines at once, the MCU would obey the first before the guard saw it.
        b"ap01.00,bp01.00,cp01.00,dp01.00\r\n" * 2,
        b"ap90.00,bp90.00,cp90.00,dp90.00\r\nap01.00,bp01.00,cp01.00,dp01.00\r\n",
    ],
)
def test_bytes_that_are_not_a_complete_line_of_the_dialect_become_stop(
    guard: Guarded, data: bytes
) -> None:
    assert objection(guard, outputs(data)) == NOT_A_LINE


def test_a_guard_for_trailing_commas_passes_only_lines_with_a_trailing_comma() -> None:
    stop = STOP[:-2] + b",\r\n"
    guard = Guarded(stop, 40.0, SOURCES)
    good = b"ap12.50,bn08.75,cp15.00,dn10.25,\r\n"
    assert guard.check(outputs(good)) == good
    assert guard.check(outputs(line(1.0))) == stop
    assert guard.trip == NOT_A_LINE
    assert guard.check(outputs(b"ap12.50,bn08.75,cp15.00,dn10.25;\r\n")) == stop


def test_a_question_passes_in_every_state_and_changes_no_speed(guard: Guarded) -> None:
    question = b"?\r\n"
    assert objection(guard, outputs(question, mode="stopped", linked=False, age_ms=None)) == ""
    guard_after_line(guard, 1.0)
    assert objection(guard, outputs(question)) == ""
    guard.note_sent()
    # Without a fresh command, a wheel may keep its speed but not get faster.
    assert objection(guard, outputs(line(1.0), age_ms=290)) == ""
    assert objection(guard, outputs(line(1.1), age_ms=290)) != ""
    assert objection(guard, outputs(b"?")) == NOT_A_LINE


@given(data=st.binary(max_size=40))
def test_noise_never_passes_and_never_raises(data: bytes) -> None:
    assert objection(Guarded(STOP, 40.0, SOURCES), outputs(data)) == NOT_A_LINE


# over the limit


@pytest.mark.parametrize("wheel", range(4))
@pytest.mark.parametrize("sign", [1.0, -1.0])
def test_no_wheel_may_be_faster_than_its_limit(guard: Guarded, wheel: int, sign: float) -> None:
    speeds = [0.0, 0.0, 0.0, 0.0]
    speeds[wheel] = sign * 40.0
    assert objection(guard, outputs(line(*speeds))) == ""
    speeds[wheel] = sign * 40.02
    assert objection(guard, outputs(line(*speeds))) == TOO_FAST


@each("limit", [0.1, 0.294, 0.295, 0.296, 1.005, 39.996, 40.0, 99.985, 99.99])
def test_a_wheel_at_its_limit_passes_however_the_limit_is_rounded(limit: float) -> None:
    guard = Guarded(STOP, limit, SOURCES)
    assert objection(guard, outputs(line(limit))) == ""
    assert objection(guard, outputs(line(-limit))) == ""


# no link


def test_without_a_link_even_a_slower_line_becomes_stop(guard: Guarded) -> None:
    guard_after_line(guard, 10.0)
    assert objection(guard, outputs(line(1.0), linked=False)) == NO_LINK
    assert objection(guard, outputs(line(0.0, 0.0, 0.0, 0.01), linked=False)) == NO_LINK


# growing speeds


@pytest.mark.parametrize("wheel", range(4))
@pytest.mark.parametrize("sign", [1.0, -1.0])
@pytest.mark.parametrize(("before", "speed"), [(10.0, 10.01), (10.0, -0.01), (0.01, -0.01)])
def test_without_a_command_no_wheel_may_speed_up_or_reverse(
    guard: Guarded, wheel: int, sign: float, before: float, speed: float
) -> None:
    guard_after_line(guard, sign * before)
    speeds = [sign * min(9.0, before)] * 4
    speeds[wheel] = sign * speed
    assert objection(guard, coasting(line(*speeds))) == GROWS


def test_a_wheel_at_rest_may_stay_at_rest_while_others_slow_down(guard: Guarded) -> None:
    guard_after_line(guard, 5.0, 0.0, -5.0, 0.0)
    assert objection(guard, coasting(line(4.0, 0.0, -4.0, 0.0))) == ""


@pytest.mark.parametrize(
    "mode", ["inactive", "waiting", "ready", "stopped", "fault", "shutdown", "", "Driving"]
)
def test_a_wheel_may_speed_up_only_in_mode_driving(guard: Guarded, mode: str) -> None:
    assert objection(guard, outputs(line(1.0), mode=mode)) == GROWS


def test_a_wheel_may_speed_up_only_for_a_configured_source(guard: Guarded) -> None:
    assert objection(guard, outputs(line(1.0), source="stranger")) == GROWS
    assert objection(guard, outputs(line(1.0), source="")) == GROWS


@pytest.mark.parametrize(("source", "timeout_ms"), [("app", 250), ("slow", 1000)])
def test_a_wheel_may_speed_up_only_for_a_command_within_the_timeout_of_its_source(
    guard: Guarded, source: str, timeout_ms: float
) -> None:
    fresh = outputs(line(1.0), source=source, age_ms=timeout_ms)
    old = outputs(line(1.0), source=source, age_ms=timeout_ms + 0.001)
    assert objection(guard, fresh) == ""
    assert objection(guard, old) == GROWS
    assert objection(guard, outputs(line(1.0), source=source, age_ms=None)) == GROWS


def test_a_command_that_arrived_while_the_step_ran_is_fresh(guard: Guarded) -> None:
    assert objection(guard, outputs(line(1.0), age_ms=-1.0)) == ""


def test_a_command_from_the_far_future_is_not_fresh(guard: Guarded) -> None:
    assert objection(guard, outputs(line(1.0), age_ms=-1000.0)) == GROWS


# the last sent line


def test_the_next_line_is_not_compared_with_a_line_that_was_not_sent(guard: Guarded) -> None:
    guard_after_line(guard, 5.0)
    assert objection(guard, outputs(line(6.0))) == ""  # passed but not sent
    assert objection(guard, coasting(line(6.0))) == GROWS
    assert objection(guard, coasting(line(5.0))) == ""


def test_a_slower_line_that_was_not_sent_does_not_lower_the_allowed_speed(guard: Guarded) -> None:
    guard_after_line(guard, 5.0)
    assert objection(guard, coasting(line(3.0))) == ""  # passed but not sent
    assert objection(guard, coasting(line(4.0))) == ""


def test_each_sent_line_lowers_the_speed_that_the_next_line_may_have(guard: Guarded) -> None:
    guard_after_line(guard, 5.0)
    assert objection(guard, coasting(line(3.0))) == ""
    guard.note_sent()
    assert objection(guard, coasting(line(3.01))) == GROWS


def test_after_a_trip_the_last_sent_line_is_the_stop(guard: Guarded) -> None:
    guard_after_line(guard, 5.0)
    assert objection(guard, coasting(line(6.0))) == GROWS
    guard.note_sent()
    assert objection(guard, coasting(line(1.0))) == GROWS


def test_a_trip_whose_stop_was_not_sent_keeps_the_last_sent_line(guard: Guarded) -> None:
    guard_after_line(guard, 5.0)
    assert objection(guard, coasting(line(6.0))) == GROWS
    assert objection(guard, coasting(line(4.0))) == ""


def test_a_step_without_a_line_keeps_the_last_sent_line(guard: Guarded) -> None:
    guard_after_line(guard, 5.0)
    assert guard.check(outputs(None)) is None
    assert objection(guard, coasting(line(5.0))) == ""


def test_the_trip_reason_belongs_to_the_last_checked_line_only(guard: Guarded) -> None:
    assert objection(guard, coasting(line(1.0))) == GROWS
    assert objection(guard, outputs(line(1.0))) == ""
    assert objection(guard, coasting(line(2.0))) == GROWS
    assert guard.check(outputs(None)) is None
    assert guard.trip == ""


# the end of every ramp

SLOW_TO_STOP = LimitsConfig(
    linear_speed=1.0,
    angular_speed=2.0,
    linear_deceleration=0.5,
    angular_deceleration=4.0,
    linear_stop_deceleration=2.0,
    angular_stop_deceleration=5.0,
)
"""Limits whose longest ramp takes 2 s, and 0.5 s after a stop."""


class Clocked:
    """A guard with a simulated time, in ms after the last fresh command.

    All lines that the guard passes are sent.
    """

    def __init__(self, limits: LimitsConfig = SLOW_TO_STOP) -> None:
        self.guard = Guard(STOP, Config(limits=limits))
        self.drive(0)

    def drive(self, ms: float, speed: float = 10.0) -> None:
        """Follow a fresh command at this time."""
        assert self.trip(ms, "driving", speed) == ""

    def trip(self, ms: float, mode: str, speed: float = 10.0, line_due: bool = True) -> str:
        """Return the guard's objection to a line at this time.

        The step has a fresh command only if the mode is driving.
        """
        fresh = mode == "driving"
        result = outputs(
            line(speed) if line_due else None,
            mode=mode,
            source="app" if fresh else "",
            age_ms=0.0 if fresh else None,
            at_ns=NOW_NS + int(ms * MS),
        )
        passed, trip = checked(self.guard, result)
        assert passed == (STOP if trip else result.line)
        if passed is not None:
            self.guard.record_written(passed)
        return trip


def test_a_constant_speed_after_a_stop_is_cut_short_after_the_longest_ramp() -> None:
    clocked = Clocked()
    trips = [clocked.trip(ms, "stopped") for ms in range(10, 600_000, 10)]
    first = next(n for n, trip in enumerate(trips) if trip)
    assert trips[first] == LATE
    assert (first + 1) * 10 == 10 + 500 + RAMP_MARGIN_NS // MS + 10
    # no motion may start again after the stop that was sent
    assert set(trips[first + 1 :]) == {GROWS}


@each(
    ("mode", "ramp_ms"),
    [
        ("ready", 2000), ("waiting", 2000), ("inactive", 2000),
        ("stopped", 500), ("fault", 500), ("shutdown", 500),
    ],
)  # fmt: skip
def test_without_a_fresh_command_only_zero_passes_after_the_longest_ramp(
    mode: str, ramp_ms: float
) -> None:
    last_ms = ramp_ms + 300
    clocked = Clocked()
    assert clocked.trip(0, mode) == clocked.trip(last_ms, mode) == ""
    assert clocked.trip(last_ms + 0.000001, mode, 0.01) == LATE
    assert clocked.trip(last_ms + 1, mode, 0.0) == ""


def test_a_stale_command_in_mode_driving_does_not_keep_the_robot_going() -> None:
    clocked = Clocked()
    stale = outputs(line(10.0), age_ms=251, at_ns=NOW_NS + 2301 * MS)
    assert checked(clocked.guard, stale) == (STOP, LATE)


def test_each_fresh_command_restarts_the_ramp_time() -> None:
    clocked = Clocked()
    for ms in range(0, 60_000, 250):
        clocked.drive(ms)
    assert clocked.trip(59_750 + 2300, "ready") == ""
    assert clocked.trip(59_750 + 2301, "ready") == LATE


def test_a_stop_during_a_ramp_has_its_own_time_but_not_longer_than_the_ramp() -> None:
    clocked = Clocked()
    assert clocked.trip(1000, "ready") == clocked.trip(1100, "stopped") == ""
    assert clocked.trip(1900, "stopped") == ""
    assert clocked.trip(1901, "stopped") == LATE
    late = Clocked()
    assert late.trip(2000, "stopped") == late.trip(2300, "stopped") == ""
    assert late.trip(2301, "stopped") == LATE


def test_after_a_cleared_stop_the_time_of_the_ramp_counts_again() -> None:
    clocked = Clocked()
    assert clocked.trip(0, "stopped") == ""
    assert clocked.trip(500, "ready", line_due=False) == ""
    assert clocked.trip(1000, "ready") == clocked.trip(1000, "stopped") == ""
    assert clocked.trip(1800, "stopped") == ""
    assert clocked.trip(1801, "stopped") == LATE


def test_a_second_stop_has_its_own_time_even_right_after_a_command() -> None:
    clocked = Clocked()
    assert clocked.trip(100, "stopped") == ""
    clocked.drive(600)
    assert clocked.trip(1300, "stopped") == ""
    assert clocked.trip(2100, "stopped") == ""
    assert clocked.trip(2101, "stopped") == LATE


def test_new_settings_neither_restart_nor_shorten_the_ramp_time_of_a_moving_robot() -> None:
    clocked = Clocked()
    slower = replace(SLOW_TO_STOP, linear_speed=0.1, linear_deceleration=5.0)
    for ms in range(0, 2300, 100):
        clocked.guard.use(Config(limits=slower))
        assert clocked.trip(ms, "ready") == ""
    assert clocked.trip(2300, "ready") == ""
    assert clocked.trip(2301, "ready") == LATE


@each(
    ("limits", "mode", "last_ms"),
    [
        (replace(SLOW_TO_STOP, linear_deceleration=0.25), "ready", 4300),
        (replace(SLOW_TO_STOP, linear_stop_deceleration=1.0), "stopped", 1300),
    ],
)
def test_new_settings_with_a_longer_ramp_give_a_robot_in_motion_more_time(
    limits: LimitsConfig, mode: str, last_ms: int
) -> None:
    clocked = Clocked()
    clocked.guard.use(Config(limits=limits))
    assert clocked.trip(0, mode) == clocked.trip(last_ms, mode) == ""
    assert clocked.trip(last_ms + 1, mode) == LATE


def test_an_earlier_longer_ramp_does_not_count_after_the_robot_was_at_rest() -> None:
    clocked = Clocked()
    clocked.guard.use(Config(limits=LimitsConfig(linear_speed=0.4, angular_speed=0.4)))  # 0.4 s
    assert clocked.trip(100, "ready", 0.0) == ""
    clocked.drive(1000)
    assert clocked.trip(1700, "ready") == ""
    assert clocked.trip(1701, "ready") == LATE


def test_the_longest_ramp_is_calculated_from_the_effective_track() -> None:
    limits = LimitsConfig(linear_speed=0.0, angular_speed=50.0, wheel_speed=10.0)
    narrow, wide = (
        Guard(STOP, Config(limits=limits, drive=DriveConfig(wheel_separation_multiplier=factor)))
        for factor in (1.0, 2.0)
    )
    assert narrow.memory.ramp_ns == pytest.approx(2 * wide.memory.ramp_ns, rel=1e-6)


def test_new_settings_at_rest_replace_the_longest_ramp() -> None:
    clocked = Clocked()
    assert clocked.trip(100, "ready", 0.0) == ""
    # this ramp takes 0.4 s
    clocked.guard.use(Config(limits=LimitsConfig(linear_speed=0.4, angular_speed=0.4)))
    clocked.drive(1000)
    assert clocked.trip(1700, "ready") == ""
    assert clocked.trip(1701, "ready") == LATE


@each(
    ("limits", "ramp_ms"),
    [
        (LimitsConfig(), 1000),
        (LimitsConfig(angular_deceleration=2.0), 2000),
        # The wheels allow only 0.5 m/s and 3.33 rad/s.
        (LimitsConfig(linear_speed=9.0, angular_speed=0.0, wheel_speed=10.0), 500),
        (LimitsConfig(linear_speed=0.0, angular_speed=50.0, wheel_speed=10.0), 833),
    ],
)
def test_the_longest_ramp_equals_the_time_calculated_by_hand(
    limits: LimitsConfig, ramp_ms: int
) -> None:
    assert Guard(STOP, Config(limits=limits)).memory.ramp_ns // MS == ramp_ms


def test_a_guard_continues_from_the_memory_of_another_guard() -> None:
    clocked = Clocked()
    assert clocked.trip(10, "stopped") == ""
    memory = clocked.guard.memory
    assert memory == Memory(line(10.0), NOW_NS, NOW_NS + 10 * MS, 2000 * MS, 500 * MS)
    clocked.guard = Guard(STOP, Config(limits=SLOW_TO_STOP), memory)
    assert clocked.trip(810, "stopped") == ""
    assert clocked.trip(811, "stopped") == LATE


def test_a_line_with_motion_before_any_command_is_late() -> None:
    guard = Guard(STOP, Config(), Memory(line(1.0)))
    assert checked(guard, coasting(line(1.0))) == (STOP, LATE)


# with a robot


class Loop:
    """Robot and guard, connected as in the control loop; `wire` collects the sent lines."""

    def __init__(self, config: Config, wheel_speed: float | None = None) -> None:
        self.robot = Robot(config)
        self.stepped = SteppedRobot(self.robot)
        self.stop = self.robot.link_setup.codec.stop
        most = config.limits.wheel_speed if wheel_speed is None else wheel_speed
        self.guard = Guarded(self.stop, most, config.commands.sources)
        self.guard.guard.use(replace(config, limits=replace(config.limits, wheel_speed=most)))
        self.config = config
        self.now_ns = NOW_NS
        self.opened = 1
        self.superseded = False
        self.trip: Trip = ""
        self.trips: list[str] = []
        self.events: list[str] = []
        self.wire: list[tuple[bytes, Outputs]] = []

    def step(
        self,
        *commands: Command,
        ask: Verb | None = None,
        settings: dict[str, Plain] | None = None,
        ms: float = 10.0,
        tick: bool = True,
        heard: int = 1,
        port_open: bool = True,
        goes: bool = True,
    ) -> Outputs:
        self.now_ns += int(ms * MS)
        now = Instant(self.now_ns, self.now_ns)
        result = self.stepped.step(
            Inputs(
                now=now,
                tick=tick,
                port_open=port_open,
                opened=self.opened,
                received=(Received(now, self.stop * heard),),
                commands=commands,
                requests=(Request(ask, settings=settings or {}),) if ask else (),
                guard_trip=self.trip,
                superseded=self.superseded,
            )
        )
        self.events += [event.name for event in result.events]
        if self.robot.config is not self.config:
            self.config = self.robot.config
            self.guard.guard.use(self.config)
        data, self.trip = self.guard.check(result), self.guard.trip
        self.trips += [self.trip] * bool(self.trip)
        if data is None:
            self.superseded = False
            return result
        self.superseded = not (goes and port_open)
        if not self.superseded:
            self.guard.note_sent()
            self.wire.append((data, result))
        return result

    def command(self, linear: float, angular: float = 0.0) -> Command:
        return Command("app", Twist(linear, angular), self.now_ns)


def test_one_trip_causes_one_fault_that_names_its_reason() -> None:
    loop = Loop(Config(), wheel_speed=5.0)  # the robot itself assumes 40 rad/s
    loop.step(heard=3)
    loop.step(loop.command(0.0))
    for _ in range(60):
        result = loop.step(loop.command(1.0))
    assert loop.trips == [TOO_FAST]
    assert loop.events.count("fault") == 1
    assert result.code == TOO_FAST
    assert loop.wire[-1][0] == STOP


@st.composite
def legal(draw: st.DrawFn) -> Config:
    """Return a random valid configuration. Its slowest ramps are often the longest allowed ones."""
    drive = DriveConfig(
        draw(st.floats(0.03, 0.2)),
        draw(st.floats(0.2, 0.8)),
        draw(st.floats(0.5, 2.0)),
        draw(st.floats(0.8, 1.2)),
        draw(st.floats(0.8, 1.2)),
    )
    wheel_speed = draw(st.floats(1.0, 90.0))
    sides = drive.left_wheel_radius_multiplier + drive.right_wheel_radius_multiplier
    rim = wheel_speed * drive.wheel_radius * sides / 2
    most = (rim, 2 * rim / (drive.wheel_separation * drive.wheel_separation_multiplier))
    numbers: dict[str, float] = {"wheel_speed": wheel_speed}
    for axis, reach, limit in zip(("linear", "angular"), most, (10.0, 50.0), strict=True):
        speed = draw(st.floats(0.0, limit))
        fastest = min(speed, reach)
        least = max(0.02, 1.001 * fastest / 5)
        softer = draw(st.one_of(st.just(least), st.floats(least, 100.0)))
        harder = max(softer, 1.001 * fastest / 2)
        numbers |= {
            f"{axis}_speed": speed,
            f"{axis}_acceleration": 100.0,
            f"{axis}_deceleration": softer,
            f"{axis}_stop_deceleration": draw(st.one_of(st.just(harder), st.floats(harder, 100.0))),
            f"{axis}_jerk": draw(st.sampled_from((0.0, 0.0, 500.0))),
        }
    return Config(
        drive=drive,
        limits=LimitsConfig(**numbers),
        feedback=FeedbackConfig(wheel_speed=99.99),
    )


HAPPENINGS = (
    "silence", "stall", "superseded", "command", "half", "stop", "clear", "lower", "harder"
)  # fmt: skip


def happen(loop: Loop, what: str, steps: int, ms: float, full: Twist) -> None:
    """Apply one event in the middle of a ramp."""
    limits = loop.config.limits
    match what:
        case "stall":
            loop.step(ms=ms * 10)
        case "superseded":
            for _ in range(steps):
                loop.step(ms=ms, goes=False)
        case "command" | "half":
            share = 1.0 if what == "command" else 0.5
            for _ in range(steps):
                loop.step(loop.command(full.linear * share, full.angular * share), ms=ms)
        case "stop" | "clear":
            loop.step(ask=what, ms=ms)
        case "lower":
            slower = limits.linear_speed / 2, limits.angular_speed / 2
            names = "limits.linear_speed", "limits.angular_speed"
            loop.step(ask="set", settings=dict(zip(names, slower, strict=True)), ms=ms)
        case "harder":
            braking = limits.linear_stop_deceleration
            settings: dict[str, Plain] = {"limits.linear_deceleration": braking}
            loop.step(ask="set", settings=settings, ms=ms)
    for _ in range(steps):
        loop.step(ms=ms)


@given(
    config=legal(),
    ms=st.sampled_from((3.0, 10.0, 24.0, 90.0)),
    signs=st.tuples(st.sampled_from((-1, 0, 1)), st.sampled_from((-1, 0, 1))),
    happenings=st.lists(st.tuples(st.sampled_from(HAPPENINGS), st.integers(0, 12)), max_size=6),
)
def test_no_permitted_ramp_is_cut_short_whatever_events_interrupt_it(
    config: Config, ms: float, signs: tuple[int, int], happenings: list[tuple[str, int]]
) -> None:
    assume(not contradictions(config))
    loop = Loop(config)
    full = Twist(signs[0] * 10.0, signs[1] * 50.0)
    loop.step(heard=3)
    loop.step(loop.command(0.0))
    for _ in range(30):
        loop.step(loop.command(full.linear, full.angular), ms=24.0)
    for what, steps in happenings:
        happen(loop, what, steps, ms, full)
    for _ in range(round(5500 / ms)):
        loop.step(ms=ms)
    assert loop.trips == []
    assert loop.wire[-1][0] == STOP


EACH_CONFIG = pytest.mark.parametrize(
    "config",
    [
        pytest.param(Config(), id="default"),
        pytest.param(
            Config(limits=LimitsConfig(linear_jerk=5.0, angular_jerk=20.0, wheel_speed=20.0)),
            id="jerk",
            marks=pytest.mark.slow,
        ),
    ],
)


def random_walk(rng: random.Random, config: Config) -> Loop:
    """Run three seconds with random behaviour of the port, the MCU, the wire and the operators."""
    loop, port_open, line_count, goes = Loop(config), True, 1, 1.0
    twist = REST
    verbs: tuple[Verb, ...] = ("stop", "clear", "clear", "activate", "deactivate")
    for _ in range(300):
        if rng.random() < (0.01 if port_open else 0.2):
            port_open = not port_open
            loop.opened += port_open
        if rng.random() < 0.01:
            loop.opened += port_open  # lost and found again between two steps
        if rng.random() < 0.05:
            line_count = rng.choice((0, 1, 1, 1, 3))
        if rng.random() < 0.02:
            goes = rng.choice((1.0, 1.0, 0.7, 0.2))
        if rng.random() < 0.1:
            twist = rng.choice((REST, REST, Twist(0.5), Twist(-2.0, 2.0), Twist(0.0, -9.0)))
        loop.step(
            *[loop.command(twist.linear, twist.angular)] * (rng.random() < 0.5),
            ask=rng.choice(verbs) if rng.random() < 0.01 else None,
            ms=rng.choice((10.0, 10.0, 10.0, 11.0, 3.0, 60.0)),
            tick=rng.random() < 0.85,
            heard=line_count,
            port_open=port_open,
            goes=rng.random() < goes,
        )
    return loop


@EACH_CONFIG
def test_a_healthy_robot_never_trips_the_guard_and_speeds_up_only_by_fresh_commands(
    config: Config,
) -> None:
    moved = 0
    for seed in range(40):
        loop = random_walk(random.Random(seed), config)
        assert loop.trips == []
        moved += sum(data != STOP for data, _ in loop.wire)
        before = (0.0, 0.0, 0.0, 0.0)
        for data, result in loop.wire:
            if data == b"?\r\n":
                continue
            wheels = CODEC.decode(data.rstrip()).as_tuple()
            assert result.linked or not any(wheels)
            arrived_ns = result.command_ns
            fresh = arrived_ns is not None and result.now.mono_ns - arrived_ns <= 250 * MS
            if not (fresh and result.linked and result.mode == "driving"):
                for old, new in zip(before, wheels, strict=True):
                    assert abs(new) <= abs(old)
                    assert new * old >= 0.0
            before = wheels
    assert moved > 500


# the checked line

NO_CHECK = "guard_no_checksum"


@pytest.mark.parametrize("comma", [False, True])
@pytest.mark.parametrize("letters", [b"", b"S"])
@given(sequence=st.integers(0, 255), speed=st.floats(-40.0, 40.0))
def test_a_line_with_a_correct_checksum_passes(
    comma: bool, letters: bytes, sequence: int, speed: float
) -> None:
    codec = Codec(WheelMap(), comma)
    sealed = seal(codec.encode(WheelSpeeds(speed, -speed, speed, -speed)), sequence, letters)
    assert objection(Guarded(codec.stop, 40.0, SOURCES), outputs(sealed)) == ""


def test_a_checked_line_must_keep_the_same_limits_as_any_other_line(guard: Guarded) -> None:
    assert objection(guard, outputs(seal(line(41.0), 7))) == TOO_FAST
    assert objection(guard, outputs(seal(line(1.0), 7), linked=False)) == NO_LINK
    assert objection(guard, coasting(seal(line(1.0), 7))) == GROWS
    assert objection(guard, outputs(seal(STOP, 7), mode="fault", linked=False)) == ""


@each("place", range(42))
@each("bit", range(8))
def test_a_checked_line_with_one_flipped_bit_is_refused(
    guard: Guarded, place: int, bit: int
) -> None:
    good = seal(line(12.5, -8.75, 15.0, -10.25), 7, b"S")
    bad = b"%b%c%b" % (good[:place], good[place] ^ 1 << bit, good[place + 1 :])
    assert objection(guard, outputs(bad)) == NOT_A_LINE


@pytest.mark.parametrize(
    ("suffix", "letters"),
    [(b"#07", b"Z"), (b"#07", b"SS"), (b"#0", b""), (b"#007", b""), (b"#0a", b""), (b",#07", b"")],
)
def test_an_unknown_suffix_is_refused_even_with_a_correct_checksum(
    guard: Guarded, suffix: bytes, letters: bytes
) -> None:
    body = line(1.0)[:-2] + suffix + letters
    closed = b"%b*%04X\r\n" % (body, binascii.crc_hqx(body, 0))
    assert objection(guard, outputs(closed)) == NOT_A_LINE


def test_a_checked_line_without_the_comma_of_the_dialect_is_refused() -> None:
    guard = Guarded(STOP[:-2] + b",\r\n", 40.0, SOURCES)
    guard.check(outputs(seal(line(1.0), 7)))
    assert guard.trip == NOT_A_LINE


def test_a_line_without_a_required_checksum_moves_no_wheel() -> None:
    guard = Guarded(STOP, 40.0, SOURCES, require_check=True)
    assert objection(guard, outputs(line(1.0))) == NO_CHECK
    assert objection(guard, outputs(STOP)) == ""
    assert objection(guard, outputs(seal(line(1.0), 7))) == ""
