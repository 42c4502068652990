"""What the check concludes from the measured speeds of the motors."""

from __future__ import annotations

import math

import pytest
from msgspec import structs

from acsard.checkup import motion
from acsard.checkup.motion import SHORT_MEASUREMENT_S, BoardReply
from acsard.checkup.motor_channels import Channel, Kind, encoder_finding, probe
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


# Motors.


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
        (channel_of(0, 0, -3.0, 3.0), "reversed"), (channel_of(0, 0, 3.0, 3.0), "no sign"),
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
