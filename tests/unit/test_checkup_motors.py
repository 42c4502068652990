"""What the check concludes from the measured speeds of the motors."""

from __future__ import annotations

import math

import pytest
from msgspec import structs

from acsard.checkup import motion
from acsard.checkup.motion import SHORT_MEASUREMENT_S, BoardReply
from acsard.checkup.motor_channels import Channel, Kind, encoder_finding, probe, run_up
from acsard.checkup.outcomes import TimingFinding
from acsard.core.config.settings import Config, McuConfig, SimConfig
from acsard.core.link.checked_line import Reading
from acsard.core.link.codec import Motors
from tests.each import each
from tests.unit.checkup_robots import FOUR_AND_TWO, Robot

# Speeds.


def course(
    speed: float, per_turn: int, period_ms: int = 20, seconds: float = 1.0, sampled: bool = False
) -> list[BoardReply]:
    """Return replies in which the speed of motor b follows from its whole counts."""
    series, before = [], 0
    for n in range(1, int(seconds * 1000 / period_ms)):
        counts = math.floor(speed * n * period_ms / 1000 / math.tau * per_turn)
        velocity = (counts - before) / per_turn * math.tau / period_ms * 1000
        reading = Reading(n * period_ms, (0, counts % 65536, 0, 0)) if sampled else None
        series.append(BoardReply(n * period_ms / 1000, (0.0, velocity, 0.0, 0.0), b"", reading))
        before = counts
    return series


@pytest.mark.variations(4)
@pytest.mark.parametrize("sampled", [False, True])
@pytest.mark.parametrize("per_turn", [16, 24, 48, 64, 96, 3200])
@pytest.mark.parametrize("period_ms", [10, 20, 100])
def test_a_coarse_encoder_is_not_a_runaway_but_a_real_runaway_is_found(
    sampled: bool, per_turn: int, period_ms: int
) -> None:
    for speed in (3.0, -3.0):
        good = course(speed, per_turn, period_ms, 3.0, sampled)
        for n in range(1, len(good)):
            assert motion.runaway(good[:n]) is None
    runaway = motion.runaway(course(-9.0, per_turn, period_ms, 1.0, sampled))
    assert runaway is not None
    assert runaway[0] == 1
    assert -10.0 < runaway[1] < -6.0


@each("wrong", [60.0, -60.0])
@each("place", [3, 20])
def test_one_wrong_reply_is_no_runaway_in_either_direction(wrong: float, place: int) -> None:
    series = course(3.0, 3200)
    series[place] = structs.replace(series[place], motors=(0.0, wrong, 0.0, 0.0))
    for n in range(1, len(series)):
        assert motion.runaway(series[:n]) is None


def test_the_trend_compares_the_last_half_second_with_the_one_before() -> None:
    def trend(*speeds: float) -> float:
        """Return the trend of motor b, whose speed changes each half second."""
        series = [
            BoardReply(0.5 * n + 0.02 * k - 0.01, (0.0, speed, 0.0, 0.0), b"")
            for n, speed in enumerate(speeds)
            for k in range(1, 26)
        ]
        now_s = 0.5 * len(speeds)
        standing, own, *_ = motion.trend(series, (0.0,) * 4, now_s, 0.02)
        assert standing == 1.0
        return own

    assert trend(0.0, 0.0, 3.0, 3.0) == pytest.approx(1.0)
    assert trend(3.0, 3.0, 3.0, 2.7) == pytest.approx(0.9)
    assert trend(3.0, 3.0, -2.7, -3.0) == pytest.approx(1.11, abs=0.01)
    assert trend(3.0, 3.0, 3.0, 0.0) == trend(0.0, 0.0, 0.0, 3.0) == 1.0


# Motors.


@each(
    ("lag", "fault", "speed", "at_most_s"),
    [
        (0.05, (), 3.0, 1.0),
        # A wheel that still speeds up is waited for, and one that stays weak is not.
        (1.5, (), 3.0, 7.0),
        (0.05, ("bias=a:0.6",), 1.8, 2.6),
        (0.05, ("stuck_encoder=a",), 0.0, 1.2),
    ],
)
def test_a_motor_has_time_as_long_as_its_speed_rises(
    lag: float, fault: tuple[str, ...], speed: float, at_most_s: float
) -> None:
    robot = Robot("plain_only", *fault, config=Config(sim=SimConfig(motor_time_constant=lag)))
    with robot.board() as board:
        began_s = board.now_s
        (means, *_) = run_up(board, board.only([0]))
        assert means == pytest.approx(speed, abs=0.35)
        assert board.now_s - began_s < at_most_s


MCU = McuConfig()


def channel_of(motor: int, encoder: int, forth: float = 3.0, back: float = -3.0) -> Channel:
    def speeds(value: float) -> Motors:
        a, b, c, d = (value if index == encoder else 0.0 for index in range(4))
        return a, b, c, d

    return Channel(motor, speeds(forth), speeds(back))


@each(
    ("channel", "kind"),
    [
        (channel_of(0, 0), "right"), (channel_of(0, 0, 3.1, -2.9), "right"),
        (channel_of(0, 0, 3.7, -2.3), "off"), (channel_of(0, 0, 2.4, -2.4), "off"),
        (channel_of(0, 0, 2.9, -3.2), "off"),
        (structs.replace(channel_of(0, 0, 3.0, -2.75), unsure=0.05), "right"),
        (channel_of(0, 0, 4.0, -3.0), "size"), (channel_of(0, 0, 2.0, -2.0), "size"),
        (channel_of(0, 0, -3.0, 3.0), "reversed"), (channel_of(0, 0, -3.0, 0.8), "reversed"),
        (channel_of(0, 0, 0.7, -0.7), "dead"), (channel_of(0, 0, 3.0, 3.0), "no sign"),
        (channel_of(0, 0, 0.0, 0.0), "dead"), (channel_of(0, 0, 3.0, 0.0), "one way"),
        (channel_of(0, 2), "other"), (channel_of(0, 2, -3.0, 3.0), "other"),
        (Channel(1, (3.0, 3.0, 0.0, 0.0), (-3.0, -3.0, 0.0, 0.0)), "several"),
        (Channel(1, (3.0, 0.0, 0.0, 0.0), (0.0, -3.0, 0.0, 0.0)), "several"),
    ],
)  # fmt: skip
def test_the_speeds_of_the_encoders_decide_the_kind_and_verdict_of_a_motor(
    channel: Channel, kind: Kind
) -> None:
    assert channel.kind == kind
    finding = encoder_finding(MCU, channel)
    assert finding.verdict == {"right": "PASS", "off": "WARN"}.get(kind, "FAIL")
    assert bool(finding.mend) is (kind != "right")
    assert structs.replace(channel, judged=False).kind == "late"


@each(("speed", "beyond"), [(2.0, 1 / 3 - 0.25), (4.2, 0.4 - 0.25)])
def test_a_late_computer_explains_a_small_error_of_the_speed_only(
    speed: float, beyond: float
) -> None:
    """A wrong time in a measurement of 0.2 s is a wrong speed."""
    found = encoder_finding(MCU, channel_of(0, 0, speed, -speed))
    assert isinstance(found, TimingFinding)
    assert found.margin_s == pytest.approx(0.4 * beyond)


@FOUR_AND_TWO
def test_a_probe_is_short_and_commands_a_dead_motor_at_most_3_rad_s(config: Config) -> None:
    letter = config.mcu.wheels.letters[1]
    robot = Robot("plain_only", f"dead_motor={letter}", config=config)
    with robot.board() as board:
        began, before = robot.now_ns(), len(robot.sent)
        assert probe(board, 1) == board.zero
        lines = [line for line in robot.sent[before:] if f"{letter}p00.00".encode() not in line]
        assert {line[8:15].decode() for line in lines} == {f"{letter}p01.50", f"{letter}p03.00"}
        assert len(lines) <= 2 * (SHORT_MEASUREMENT_S / board.period_s + 1)
        assert robot.now_ns() - began < 3e9
        assert probe(board, 0) is None


@pytest.mark.parametrize("per_turn", [16, 24, 48, 3200])
@pytest.mark.parametrize("lag", [0.0, 0.3, 1.0])
def test_a_probe_distinguishes_a_motor_that_follows_from_a_reversed_encoder(
    per_turn: int, lag: float
) -> None:
    config = Config(sim=SimConfig(motor_time_constant=lag, encoder_counts=per_turn))
    for fault, follows in ((), True), (("reversed_encoder=c",), False):
        robot = Robot("plain_only", *fault, config=config)
        with robot.board() as board:
            speeds = probe(board, 2)
            assert (speeds is None) is follows
            if speeds is not None:
                channel = Channel(2, speeds, (0.0, 0.0, 0.0, 0.0), probed=True)
                assert channel.kind == "reversed"
