"""The guard checks every line just before it is sent: what passes, what becomes STOP, and why."""

from __future__ import annotations

import binascii

from hypothesis import given, settings
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.config.settings import (
    CommandsConfig,
    Config,
    DriveConfig,
    LimitsConfig,
    McuConfig,
    Source,
    WheelMap,
)
from acsard.core.guard import RAMP_MARGIN_NS, Guard, Memory
from acsard.core.link.checked_line import seal
from acsard.core.link.codec import Codec
from acsard.core.values import (
    NS_PER_S,
    Status,
    Trip,
    WheelSpeeds,
)
from tests.each import each
from tests.wheels import FOUR, MAPS, TWO

MS = 1_000_000
NOW_NS = 50 * NS_PER_S
SOURCES = (Source("app", 50), Source("slow", 10, timeout=1.0))
STOP = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"
DAMAGED, FAST, NO_LINK = "guard_line_damaged", "guard_too_fast", "guard_no_link"
GROWS, LATE = "guard_no_command", "guard_too_long"


def line(*speeds: float, wheels: WheelMap = FOUR) -> bytes:
    """Return the line with these speeds of the wheels. A single number is for all of them."""
    return Codec(wheels).encode(WheelSpeeds(*(speeds * 4 if len(speeds) == 1 else speeds)))


class Guarded:
    """A guard, and the times of its lines in ms."""

    def __init__(
        self,
        wheel_speed: float = 40.0,
        stop: bytes = b"",
        limits: LimitsConfig | None = None,
        link_check: str = "off",
        wheels: WheelMap = FOUR,
    ) -> None:
        limits, self.wheels = limits or LimitsConfig(wheel_speed=wheel_speed), wheels
        stop = stop or Codec(wheels).stop
        mcu = McuConfig(link_check=link_check, wheels=wheels)  # type: ignore[arg-type]
        config = Config(mcu=mcu, limits=limits, commands=CommandsConfig(sources=SOURCES))
        self.guard, self.stop = Guard(stop, config), stop

    def check(
        self,
        data: bytes,
        mode: str = "driving",
        linked: bool = True,
        source: str = "app",
        age_ms: float | None = 0.0,
        at_ms: float = 0.0,
    ) -> Trip:
        """Return why the line becomes STOP, or "". The robot has a fresh command by default."""
        now_ns = NOW_NS + int(at_ms * MS)
        command_ns = None if age_ms is None else now_ns - int(age_ms * MS)
        status = Status(mode, "commanded", "", "up" if linked else "down", source)
        self.passed, trip = self.guard.check(data, now_ns, status, command_ns)
        assert self.passed == (self.stop if trip else data)
        return trip

    def coast(self, data: bytes) -> Trip:
        return self.check(data, "ready", source="", age_ms=None)

    def sent(self, *speeds: float) -> Guarded:
        """Check and send this line of a fresh command, or send the one that was checked last."""
        if speeds:
            assert self.check(line(*speeds, wheels=self.wheels)) == ""
        self.guard.record_written(self.passed)
        return self

    def at(self, ms: float, mode: str, speed: float = 10.0) -> Trip:
        """Check a line at this time and send what passes; `driving` has a fresh command."""
        fresh = mode == "driving"
        age_ms = 0.0 if fresh else None
        trip = self.check(line(speed), mode, source="app" * fresh, age_ms=age_ms, at_ms=ms)
        self.sent()
        return trip


# the bytes


@each(
    "data",
    [
        b"", b"\r\n", b"?", b"ap01.00,bp01.00,cp01.00\r\n", b"ap01.00,bp01.00,cp01.00,dp01.00",
        b"ap01.00,bp01.00,cp01.00,dp01.00,\r\n", b"ap01.00,bp01.00,cp01.00,dp1.00\r\n",
        b"ap01.00,bp01.00,cp01.00,dp001.0\r\n", b"ap01.00,bp01.00,cp01.00,dp01,00\r\n",
        b"ap01.00,bp01.00,cp01.00,dpnanan\r\n", b"ap01.00,bp01.00,cp01.00,d-01.00\r\n",
        b"ap01.00,bp01.00,cp01.00,cp01.00\r\n", b"bp01.00,ap01.00,cp01.00,dp01.00\r\n",
        b"ap01.00 bp01.00,cp01.00,dp01.00\r\n", b"ap01.00, bp1.00,cp01.00,dp01.00\r\n",
        # Of two lines at once, the MCU would obey the first before the guard saw it.
        b"ap01.00,bp01.00,cp01.00,dp01.00\r\n" * 2,
        b"ap90.00,bp90.00,cp90.00,dp90.00\r\nap01.00,bp01.00,cp01.00,dp01.00\r\n",
    ],
)  # fmt: skip
def test_what_is_not_one_line_of_the_dialect_becomes_stop(data: bytes) -> None:
    assert Guarded().check(data) == DAMAGED


@each(
    "data",
    [
        b"lp01.00\r\n", b"lp01.00,rp01.00", b"lp01.00,rp01.00,\r\n", b"lp01.00,rp1.00\r\n",
        b"rp01.00,lp01.00\r\n", b"lp01.00,lp01.00\r\n", b"lp01.00, rp01.00\r\n",
        b"lp01.00,rp001.0\r\n", b"lp01.00,rpnanan\r\n", b"ap01.00,bp01.00\r\n",
        b"lp01.00,rp01.00,ap01.00,bp01.00\r\n", b"ap01.00,bp01.00,cp01.00,dp01.00\r\n",
        b"lp01.00,rp01.00\r\n" * 2, b"lp90.00,rp90.00\r\nlp01.00,rp01.00\r\n",
    ],
)  # fmt: skip
def test_what_is_not_one_line_of_two_motors_becomes_stop(data: bytes) -> None:
    assert Guarded(wheels=TWO).check(data) == DAMAGED


@settings(max_examples=100)
@given(data=st.binary(max_size=40).filter(lambda data: data != b"?\r\n"))
def test_noise_never_passes(data: bytes) -> None:
    for wheels in MAPS:
        assert Guarded(wheels=wheels).check(data) == DAMAGED


def test_a_question_passes_in_every_state_and_changes_no_speed() -> None:
    guarded = Guarded()
    assert guarded.check(b"?\r\n", "stopped", linked=False, age_ms=None) == ""
    guarded.sent(1.0)
    assert guarded.check(b"?\r\n") == ""
    guarded.sent()
    # Without a fresh command, a wheel may keep its speed but not get faster.
    assert guarded.check(line(1.0), age_ms=290) == ""
    assert guarded.check(line(1.1), age_ms=290) == GROWS


@each("wheels", MAPS)
@each("letters", [b"", b"S"])
@each("comma", [False, True])
def test_a_checksum_must_be_right_and_a_checked_link_needs_it(
    comma: bool, letters: bytes, wheels: WheelMap
) -> None:
    codec = Codec(wheels, comma)
    stop = codec.stop
    for sequence in (0, 7, 255):
        good = seal(codec.encode(WheelSpeeds(12.5, -8.75, 15.0, -10.25)), sequence, letters)
        assert Guarded(stop=stop, link_check="on", wheels=wheels).check(good) == ""
        for place in range(len(good)):
            for bit in range(8):
                bad = b"%b%c%b" % (good[:place], good[place] ^ 1 << bit, good[place + 1 :])
                assert Guarded(stop=stop, wheels=wheels).check(bad) == DAMAGED
    required, stop = Guarded(link_check="on", wheels=wheels), Codec(wheels).stop
    one, fast = line(1.0, wheels=wheels), line(41.0, wheels=wheels)
    assert (required.check(one), required.check(stop)) == ("guard_no_checksum", "")
    # A checked line keeps the same limits.
    assert required.check(seal(fast, 7)) == FAST
    assert required.check(seal(one, 7), linked=False) == NO_LINK
    assert required.coast(seal(one, 7)) == GROWS
    assert required.check(seal(stop, 7), "fault", linked=False) == ""


@each(
    ("suffix", "letters"),
    [(b"#07", b"Z"), (b"#07", b"SS"), (b"#0", b""), (b"#007", b""), (b"#0a", b""), (b",#07", b"")],
)
def test_an_unknown_suffix_is_refused_with_a_right_checksum(suffix: bytes, letters: bytes) -> None:
    body = line(1.0)[:-2] + suffix + letters
    closed = b"%b*%04X\r\n" % (body, binascii.crc_hqx(body, 0))
    assert Guarded().check(closed) == DAMAGED


# the speeds

MODES = ("inactive", "waiting", "ready", "driving", "stopped", "fault", "shutdown", "", "Driving")


@each("wheels", MAPS)
@each("limit", [0.1, 0.294, 0.295, 0.296, 1.005, 39.996, 40.0, 99.985, 99.99])
def test_no_wheel_may_be_faster_than_its_limit_however_it_is_rounded(
    limit: float, wheels: WheelMap
) -> None:
    for wheel in range(len(wheels.names)):
        for sign in (1.0, -1.0):
            speeds = [0.0, 0.0, 0.0, 0.0]
            speeds[wheel] = sign * limit
            assert Guarded(limit, wheels=wheels).check(line(*speeds, wheels=wheels)) == ""
            speeds[wheel] = sign * (limit + 0.02)
            if limit < 99.9:
                assert Guarded(limit, wheels=wheels).check(line(*speeds, wheels=wheels)) == FAST


@each("wheels", MAPS)
@each("mode", MODES)
def test_zero_passes_always_and_without_a_link_nothing_else(mode: str, wheels: WheelMap) -> None:
    def moving() -> Guarded:
        return Guarded(wheels=wheels).sent(10.0)

    for linked in (True, False):
        assert moving().check(Codec(wheels).stop, mode, linked, age_ms=None) == ""
    little, one = line(0.0, 0.01, 0.0, 0.01, wheels=wheels), line(1.0, wheels=wheels)
    assert moving().check(little, mode, linked=False) == NO_LINK
    assert Guarded(wheels=wheels).check(one, mode) == ("" if mode == "driving" else GROWS)


@each("wheels", MAPS)
@each(("before", "speed"), [(10.0, 10.01), (10.0, -0.01), (0.01, -0.01)])
def test_without_a_command_no_wheel_may_speed_up_or_reverse(
    before: float, speed: float, wheels: WheelMap
) -> None:
    for wheel in range(len(wheels.names)):
        for sign in (1.0, -1.0):
            speeds = [sign * min(9.0, before)] * 4
            speeds[wheel] = sign * speed
            guarded = Guarded(wheels=wheels).sent(sign * before)
            assert guarded.coast(line(*speeds, wheels=wheels)) == GROWS
    assert Guarded().sent(5.0, 0.0, -5.0, 0.0).coast(line(4.0, 0.0, -4.0, 0.0)) == ""


@each(
    ("source", "age_ms", "trip"),
    [
        ("app", 250, ""), ("app", 250.001, GROWS), ("slow", 1000, ""), ("slow", 1000.001, GROWS),
        ("app", None, GROWS), ("stranger", 0, GROWS), ("", 0, GROWS),
        ("app", -1, ""),  # it arrived while the step ran
        ("app", -1000, GROWS),
    ],
)  # fmt: skip
def test_a_wheel_may_speed_up_only_for_a_fresh_command_of_a_source(
    source: str, age_ms: float | None, trip: Trip
) -> None:
    assert Guarded().check(line(1.0), source=source, age_ms=age_ms) == trip


def test_a_line_is_compared_with_the_last_one_that_was_sent() -> None:
    guarded = Guarded().sent(5.0)
    assert guarded.check(line(6.0)) == guarded.coast(line(3.0)) == ""  # passed but not sent
    assert guarded.coast(line(6.0)) == GROWS  # nor is the STOP in its place
    assert guarded.coast(line(5.0)) == guarded.coast(line(3.0)) == ""
    guarded.sent()
    assert guarded.coast(line(3.01)) == GROWS
    guarded.sent()
    assert guarded.coast(line(1.0)) == GROWS


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
SHORT = LimitsConfig(linear_speed=0.4, angular_speed=0.4)  # 0.4 s


def clocked() -> Guarded:
    """Return a guard of `SLOW_TO_STOP` that has passed a line of a fresh command at 0 ms."""
    guarded = Guarded(limits=SLOW_TO_STOP)
    assert guarded.at(0, "driving") == ""
    return guarded


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
def test_the_longest_ramp_is_the_one_worked_by_hand(limits: LimitsConfig, ramp_ms: int) -> None:
    assert Guard(STOP, Config(limits=limits)).memory.ramp_ns // MS == ramp_ms
    if limits.linear_speed == 0.0:  # a wider track turns more slowly
        wide = Config(limits=limits, drive=DriveConfig(wheel_separation_multiplier=2.0))
        assert Guard(STOP, wide).memory.ramp_ns // MS == ramp_ms // 2


@each(
    ("mode", "ramp_ms"),
    [
        ("ready", 2000), ("waiting", 2000), ("inactive", 2000),
        ("stopped", 500), ("fault", 500), ("shutdown", 500),
    ],
)  # fmt: skip
def test_without_a_command_only_zero_passes_after_the_ramp(mode: str, ramp_ms: float) -> None:
    last_ms = ramp_ms + RAMP_MARGIN_NS / MS
    guarded = clocked()
    assert guarded.at(0, mode) == guarded.at(last_ms, mode) == ""
    assert guarded.at(last_ms + 0.000001, mode, 0.01) == LATE
    assert guarded.at(last_ms + 1, mode, 0.0) == ""
    assert guarded.at(last_ms + 2, mode) == GROWS  # no motion may start again


def test_a_stale_command_in_mode_driving_does_not_keep_the_robot_going() -> None:
    assert clocked().check(line(10.0), age_ms=251, at_ms=2301) == LATE
    guard = Guard(STOP, Config(), Memory(line(1.0)))  # motion before any command
    status = Status("ready", "no_command", "", "up")
    assert guard.check(line(1.0), NOW_NS, status, None) == (STOP, LATE)


@each(
    ("path", "last_ms"),
    [
        # Each fresh command begins the time again, and a stop has its own, but not a longer one.
        ([(ms, "driving") for ms in range(0, 10_000, 250)], 9750 + 2300),
        ([(1000, "ready"), (1100, "stopped")], 1900),
        ([(2000, "stopped")], 2300),
        # A stop that was cleared, or a second one.
        ([(0, "stopped"), (500, "ready"), (1000, "stopped")], 1800),
        ([(100, "stopped"), (600, "driving"), (1300, "stopped")], 2100),
    ],
)
def test_the_time_counts_from_the_last_command_and_from_the_stop(
    path: list[tuple[int, str]], last_ms: int
) -> None:
    guarded, mode = clocked(), path[-1][1].replace("driving", "ready")
    assert {guarded.at(ms, mode) for ms, mode in path} == {""}
    # Another guard goes on from the memory.
    guarded.guard = Guard(STOP, Config(limits=SLOW_TO_STOP), guarded.guard.memory)
    assert guarded.at(last_ms, mode) == ""
    assert guarded.at(last_ms + 1, mode) == LATE


@each(
    ("limits", "mode", "last_ms"),
    [
        (replace(SLOW_TO_STOP, linear_speed=0.1, linear_deceleration=5.0), "ready", 2300),
        (replace(SLOW_TO_STOP, linear_deceleration=0.25), "ready", 4300),
        (replace(SLOW_TO_STOP, linear_stop_deceleration=1.0), "stopped", 1300),
    ],
)
def test_new_settings_do_not_shorten_the_time_of_a_moving_robot(
    limits: LimitsConfig, mode: str, last_ms: int
) -> None:
    guarded = clocked()
    for ms in (0, 1, last_ms):
        guarded.guard.use(Config(limits=limits))
        assert guarded.at(ms, mode) == ""
    assert guarded.at(last_ms + 1, mode) == LATE


@each("at_rest_first", [True, False])
def test_at_rest_they_replace_it(at_rest_first: bool) -> None:
    guarded = clocked()
    for rest in (at_rest_first, not at_rest_first):
        if rest:
            assert guarded.at(100, "ready", 0.0) == ""
        else:
            guarded.guard.use(Config(limits=SHORT))
    assert guarded.at(1000, "driving") == guarded.at(1700, "ready") == ""
    assert guarded.at(1701, "ready") == LATE
