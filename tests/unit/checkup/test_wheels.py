"""Tests of the step that turns each motor, and of its findings about motors and encoders."""

from __future__ import annotations

import pytest
from msgspec import structs

from acsard.checkup import dialect, motion, wheels
from acsard.checkup.motion import SHORT_MEASUREMENT_S, SLOWING_TIMEOUT_S, SPEED
from acsard.checkup.wheels import Channel, Kind, encoder_finding, wheel_map
from acsard.core.config.settings import Config, McuConfig, SimConfig, WheelMap
from acsard.core.link.codec import Motors
from acsard.core.values import WHEELS
from tests.each import each
from tests.unit.checkup.robots import Robot

MCU = McuConfig()


def channel_of(motor: int, encoder: int, forth: float = 3.0, back: float = -3.0) -> Channel:
    def speeds(value: float) -> Motors:
        a, b, c, d = (value if index == encoder else 0.0 for index in range(4))
        return a, b, c, d

    return Channel(motor, speeds(forth), speeds(back))


@each(
    ("channel", "kind"),
    [
        (channel_of(0, 0), "right"),
        (channel_of(0, 0, 3.1, -2.9), "right"),
        (channel_of(0, 0, 3.7, -2.3), "off"),
        (channel_of(0, 0, 2.4, -2.4), "off"),
        (channel_of(0, 0, 2.9, -3.2), "off"),
        (channel_of(0, 0, 4.0, -3.0), "size"),
        (channel_of(0, 0, 2.0, -2.0), "size"),
        (channel_of(0, 0, -3.0, 3.0), "reversed"),
        (channel_of(0, 0, 3.0, 3.0), "size"),
        (channel_of(0, 0, 0.0, 0.0), "dead"),
        (channel_of(0, 0, 3.0, 0.0), "one way"),
        (channel_of(0, 2), "other"),
        (channel_of(0, 2, -3.0, 3.0), "other"),
        (Channel(1, (3.0, 3.0, 0.0, 0.0), (-3.0, -3.0, 0.0, 0.0)), "several"),
        (Channel(1, (3.0, 0.0, 0.0, 0.0), (0.0, -3.0, 0.0, 0.0)), "several"),
    ],
)
def test_the_speeds_of_the_encoders_decide_the_kind_and_verdict_of_a_motor(
    channel: Channel, kind: Kind
) -> None:
    assert channel.kind == kind
    finding = encoder_finding(MCU, channel)
    assert finding.verdict == {"right": "PASS", "off": "WARN"}.get(kind, "FAIL")
    assert bool(finding.mend) is (kind != "right")


def test_a_swapped_encoder_that_counts_back_is_also_called_reversed() -> None:
    assert "reversed" in encoder_finding(MCU, channel_of(0, 1, -3.0, 3.0)).text
    assert "reversed" not in encoder_finding(MCU, channel_of(0, 1)).text


def test_findings_name_the_configured_wheel_of_a_motor() -> None:
    mcu = McuConfig(wheels=WheelMap("-d", "+b", "+c", "+a"))
    assert encoder_finding(mcu, channel_of(0, 0)).name == "motor a (rear right)"
    assert encoder_finding(mcu, channel_of(3, 3)).name == "motor d (front right)"


def test_a_map_needs_a_person_for_every_motor() -> None:
    channels = [
        Channel(m, channel_of(m, m).forth, channel_of(m, m).back, WHEELS[m]) for m in range(4)
    ]
    assert wheel_map(MCU, channels).verdict == "PASS"
    assert wheel_map(MCU, [*channels[:3], channel_of(3, 3)]).verdict == "SKIPPED"


def test_a_wheel_that_was_seen_for_two_motors_fails_the_wheel_map() -> None:
    channels = [
        Channel(m, channel_of(m, m).forth, channel_of(m, m).back, WHEELS[min(m, 2)])
        for m in range(4)
    ]
    finding = wheel_map(MCU, channels)
    assert (finding.verdict, finding.keys) == ("FAIL", {})
    assert "rear left" in finding.text


def test_a_motor_a_fifth_weak_is_reported_with_its_share() -> None:
    finding = encoder_finding(MCU, channel_of(2, 2, 2.4, -2.45))
    assert "20% slower than the commanded 3 rad/s" in finding.text
    assert "faster" in encoder_finding(MCU, channel_of(2, 2, 3.3, -3.3)).text
    assert "turn freely" in finding.mend


def test_the_uncertainty_of_a_coarse_encoder_is_not_blamed_on_the_motor() -> None:
    channel = channel_of(0, 0, 3.0, -2.75)
    assert channel.kind == "off"
    assert structs.replace(channel, unsure=0.05).kind == "right"


@pytest.mark.parametrize("motor", range(4))
def test_only_the_commanded_motor_turns(motor: int) -> None:
    robot = Robot("plain_only")
    with robot.board() as board:
        means, _ = wheels.turn(board, motor, -SPEED)
        assert means[motor] == pytest.approx(-SPEED, abs=0.1)
        assert [m for m in range(4) if means[m]] == [motor]


def test_the_speed_is_ramped() -> None:
    robot = Robot("plain_only")
    with robot.board() as board:
        before = len(robot.sent)
        wheels.run_up(board, motion.only([0]))
        speeds = [float(line[2:7]) for line in robot.sent[before:]]
    assert speeds[:9] == sorted(speeds[:9])
    assert speeds[0] <= SPEED / 5
    assert max(speeds) == SPEED


def test_a_motor_without_measured_speed_is_driven_only_briefly() -> None:
    robot = Robot("plain_only", "stuck_encoder=1".replace("1", "b"))
    with robot.board() as board:
        began = robot.now_ns()
        wheels.run_up(board, motion.only([1]))
        assert robot.now_ns() - began < 1e9


def test_every_motor_that_turns_as_commanded_is_right() -> None:
    with Robot("plain_only").board() as board:
        channels = [wheels.channel(board, motor) for motor in range(4)]
        comma = dialect.comma(board, channels[-1].kind == "dead")
    assert [channel.kind for channel in channels] == ["right"] * 4
    assert (comma.verdict, comma.figure) == ("PASS", "not needed")


def test_a_probe_is_short_and_commands_a_dead_motor_at_most_3_rad_s() -> None:
    robot = Robot("plain_only", "dead_motor=b")
    with robot.board() as board:
        began, before = robot.now_ns(), len(robot.sent)
        assert wheels.probe(board, 1) == (0.0, 0.0, 0.0, 0.0)
        lines = [line for line in robot.sent[before:] if b"bp00.00" not in line]
        assert {line[8:15] for line in lines} == {b"bp01.50", b"bp03.00"}
        assert len(lines) <= 2 * (SHORT_MEASUREMENT_S / board.period_s + 1)
        assert robot.now_ns() - began < 3e9
        assert wheels.probe(board, 0) is None


@pytest.mark.parametrize("per_turn", [16, 24, 48, 3200])
@pytest.mark.parametrize("lag", [0.0, 0.3, 1.0])
def test_a_probe_distinguishes_a_motor_that_follows_from_a_reversed_encoder(
    per_turn: int, lag: float
) -> None:
    config = Config(sim=SimConfig(motor_time_constant=lag, encoder_counts=per_turn))
    for fault, follows in ((), True), (("reversed_encoder=c",), False):
        robot = Robot("plain_only", *fault, config=config)
        with robot.board() as board:
            speeds = wheels.probe(board, 2)
            assert (speeds is None) is follows
            if speeds is not None:
                channel = Channel(2, speeds, (0.0, 0.0, 0.0, 0.0), probed=True)
                assert channel.kind == "reversed"


def test_a_motor_that_still_accelerates_is_driven_on_for_a_limited_time() -> None:
    for lag, speed in ((1.0, 2.7), (2.0, 2.0)):
        robot = Robot("plain_only", config=Config(sim=SimConfig(motor_time_constant=lag)))
        with robot.board() as board:
            began = robot.now_ns()
            assert wheels.run_up(board, motion.only([0]))[0] > speed
            assert robot.now_ns() - began < 1.2e9 * SLOWING_TIMEOUT_S
