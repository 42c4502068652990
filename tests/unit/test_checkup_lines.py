"""What the check concludes from counts, the watchdog's time, and lost and damaged lines."""

from __future__ import annotations

import math
import re
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from msgspec import structs

from acsard.checkup import (
    damage,
    dialect,
    encoder_counts,
    line_loss,
    motion,
    watchdog,
)
from acsard.checkup.board import Board
from acsard.checkup.findings import StoppedError
from acsard.checkup.motion import SPEED, BoardReply
from acsard.checkup.motor_channels import turn
from acsard.core.config.settings import Config, McuConfig, SimConfig, WheelMap
from acsard.core.link.checked_line import Reading
from acsard.core.simulator import protocol
from tests.each import each
from tests.unit.checkup_robots import FOUR_AND_TWO, Robot
from tests.unit.test_checkup_motors import course

# Counts.


def replies(per_turn: float, speed: float = 3.0, start: int = 65000) -> list[BoardReply]:
    series = []
    for n in range(100):
        turned = round(n * 0.02 * speed / math.tau * per_turn)
        reading = Reading((65500 + 20 * n) % 65536, ((start + turned) % 65536, 0, 0, 0))
        series.append(BoardReply(n * 0.02, (speed, 0.0, 0.0, 0.0), b"", reading))
    return series


@each("per_turn", [64, 3200, 40000])
@each("speed", [3.0, -3.0])
def test_counts_per_turn_are_measured_over_wraps_of_clock_and_counts(
    per_turn: int, speed: float
) -> None:
    measured = encoder_counts.per_turn(replies(per_turn, speed), [0])
    assert measured == pytest.approx(per_turn, rel=0.02)


@each(
    ("share", "words", "figure"),
    [
        (-1.0, "motor b (front left) run against", "-3200 per turn"),
        (0.0, "do not change", "0 per turn"),
        (2.0, "do not agree", "a 3200, b 6400 per turn"),
    ],
)
def test_wrong_counts_of_one_motor_are_found(share: float, words: str, figure: str) -> None:
    with Robot().board() as board:
        board.sampled = True
        board.replies = []
        for reply in replies(3200):
            assert reply.reading is not None
            count, speed = reply.reading.counts[0], reply.motors[0]
            counts = (count, round(share * (count - 65000)) % 65536, 0, 0)
            motors = (speed, speed, 0.0, 0.0)
            reading = Reading(reply.reading.mcu_ms, counts)
            board.replies.append(BoardReply(reply.at_s, motors, b"", reading))
        finding = encoder_counts.finding(board, [0, 1])
    assert (finding.verdict, finding.figure, finding.keys) == ("FAIL", figure, {})
    assert words in finding.text


@each(
    ("counts", "named", "configured", "lost", "code", "key"),
    [
        ((3200, 3200), "", 0, 0.0, "encoder_counts_right", 3200),
        ((3170, 3190), "", 3200, 0.0, "encoder_counts_right", 3200),
        ((3000, 3000), "", 3200, 0.0, "encoder_counts_wrong", 3000),
        # A damaged reply may have wrong counts.
        ((3000, 3000), "", 3200, 0.01, "encoder_counts_damaged", None),
        ((3170, 3190), "", 3200, 0.01, "encoder_counts_right", 3200),
        ((3200, 3200), "", 3200, 0.03, "encoder_counts_damaged", None),
        ((3200, 3200), "3200", 3200, 0.01, "encoder_counts_right", 3200),
        ((3170, 3190), "3200", 0, 0.0, "encoder_counts_right", 3200),
        ((3200, 3200), "3200", 1600, 0.0, "encoder_counts_wrong", 3200),
        ((2000, 2000), "3200", 0, 0.0, "encoder_counts_misnamed", None),
        ((3200, 3200), "many", 3200, 0.0, "encoder_counts_right", 3200),
        ((3200, 2500), "", 2850, 0.0, "encoder_counts_right", 2850),
        ((3200, 2200), "", 3200, 0.0, "encoder_counts_unequal", 0),
        ((100000, 100000), "100000", 0, 0.0, "encoder_counts_right", 100000),
        ((100001, 100001), "100001", 0, 0.0, "encoder_counts_many", None),
        ((), "", 3200, 0.0, "encoder_counts_not_turned", None),
        ((), "3200", 0, 0.0, "encoder_counts_right", 3200),
    ],
)
def test_measured_named_and_configured_counts_are_compared(
    counts: tuple[int, ...], named: str, configured: int, lost: float, code: str, key: int | None
) -> None:
    with Robot(encoder_counts=configured).board() as board:
        board.sampled, board.lost = True, lost
        board.identity = {"counts": named} if named else {}
        board.replies = []
        for many in (replies(per_turn) for per_turn in counts):
            for n, reply in enumerate(many):
                assert reply.reading is not None
                if len(board.replies) <= n:
                    board.replies.append(structs.replace(reply, motors=(3.0, 3.0, 0.0, 0.0)))
                else:  # of the second motor
                    first = board.replies[n].reading
                    assert first is not None
                    both = (first.counts[0], reply.reading.counts[0], 0, 0)
                    reading = structs.replace(first, counts=both)
                    board.replies[n] = structs.replace(board.replies[n], reading=reading)
        found = encoder_counts.finding(board, [0, 1][: len(counts)])
    assert found.code == code
    assert found.keys == ({} if key is None else {"mcu.encoder_counts": key})


@each(("per_turn", "coarse"), [(24, True), (64, True), (170, True), (200, False), (3200, False)])
def test_an_encoder_without_counts_is_coarse_if_its_speeds_jump(
    per_turn: int, coarse: bool
) -> None:
    about = encoder_counts.coarse(course(1.3 if per_turn > 64 else 3.0, per_turn, seconds=3.0), [1])
    assert about == (pytest.approx(per_turn) if coarse else None)
    # Rare replies jump because the motor speeds up.
    assert encoder_counts.coarse(course(3.0, per_turn, 60, 3.0), [1]) is None


# The watchdog.


class ByItsOwnClock(Robot):
    """A robot whose firmware measures each speed over one of its own fixed control periods."""

    def __init__(self, *faults: str, config: Config | None = None) -> None:
        super().__init__(*faults, config=config)
        self.mcu._speeds = lambda now_ns: [  # type: ignore[method-assign]
            sign * self.mcu.vehicle.speeds[wheel] for (wheel, *_), sign in self.mcu._wiring
        ]


@contextmanager
def turned(robot: Robot) -> Iterator[Board]:
    """Run the steps before the watchdog test, and yield the board with motors at rest."""
    with robot.board() as board:
        dialect.rate(board)
        dialect.check(board)
        for motor in range(len(board.letters)):
            turn(board, motor, 3.0)
            board.stop_motors()
        yield board
        assert motion.turning(board.replies, board.now_s) == []


def measured(robot: Robot) -> tuple[str, str]:
    with turned(robot) as board:
        finding = watchdog.finding(board, range(len(board.letters)))
    assert robot.later() == [0.0] * 4
    return finding.verdict, finding.figure


@pytest.mark.variations(3)
@FOUR_AND_TWO
@pytest.mark.parametrize("kind", [("plain_only",), ("no_sample",), (), ("free_running",)])
@pytest.mark.parametrize("time_ms", [120, 450])
@pytest.mark.parametrize("robot", [Robot, ByItsOwnClock])
def test_a_watchdog_time_within_the_contract_is_measured_and_passes(
    kind: tuple[str, ...], time_ms: int, robot: type[Robot], config: Config
) -> None:
    instance = robot(*kind, config=config)
    instance.mcu.switches.watchdog_ns = time_ms * 1_000_000
    verdict, figure = measured(instance)
    value, _, about = figure.partition(" ms")
    assert int(value) == pytest.approx(time_ms, abs=60 if about else 20)
    assert verdict == "PASS"


def test_a_watchdog_too_short_for_any_host_is_a_warning() -> None:
    robot = Robot()
    robot.mcu.switches.watchdog_ns = 40_000_000
    assert measured(robot)[0] == "WARN"


@FOUR_AND_TWO
def test_firmware_that_obeys_broken_lines_never_gets_more_than_the_commanded_speed(
    config: Config,
) -> None:
    robot = Robot("comma_latched", config=config, trailing_comma=True)
    with robot.board() as board:
        figure = watchdog.finding(board, range(len(board.letters))).figure
        assert figure.endswith("damaged lines keep it from acting")
    letters = robot.mcu.letters
    commands = [protocol.latched(line, letters).values.values() for _, line in robot.mcu.heard]
    assert max(abs(value) for values in commands for value in values) == SPEED


@pytest.mark.slow
@pytest.mark.parametrize("fault", [(), ("no_check",)])
@pytest.mark.parametrize("per_turn", [16, 24, 48, 96])
@pytest.mark.parametrize("time_s", [0.3, 0.52])
def test_a_time_measured_too_coarsely_to_judge_does_not_pass(
    fault: tuple[str, ...], per_turn: int, time_s: float
) -> None:
    robot = Robot(*fault, config=Config(sim=SimConfig(encoder_counts=per_turn)))
    robot.mcu.switches.watchdog_ns = int(time_s * 1e9)
    verdict, figure = measured(robot)
    middle, _, about = figure.removesuffix(" ms").partition(" ms ± ")
    assert int(middle) == pytest.approx(1000 * time_s, abs=int(about) + 15)
    reaches = int(middle) + int(about) > 500
    if verdict == "PASS":
        assert time_s == 0.3
        assert not reaches
    else:
        assert reaches
        assert time_s != 0.3 or verdict == "WARN"


# Lines.


@FOUR_AND_TWO
def test_a_last_motor_that_runs_on_for_want_of_a_comma_is_stopped_with_one(config: Config) -> None:
    with Robot("comma_latched", config=config).board(rest=False) as board:
        tokens = "".join(f"{letter}p00.00," for letter in board.letters)
        board.wire.send(tokens.removesuffix("0.00,").encode() + b"2.00,\r\n")
        board.listen(0.2)
        board.stop_motors()
        assert (board.comma, board.latched) == (True, True)


@each("wheels", [WheelMap(), WheelMap("+x", "+w", "+v", "+z"), WheelMap(left="+x", right="+y")])
@each("comma", [False, True])
def test_each_damaged_line_turns_motors_and_is_invalid_as_its_name_says(
    wheels: WheelMap, comma: bool
) -> None:
    letters = wheels.letters
    with Robot(config=Config(mcu=McuConfig(wheels=wheels, trailing_comma=comma))).board() as board:
        board.sealed = True
        lines = damage.broken_lines(board, range(len(letters)))
    assert len({line for _, line in lines}) == len(lines) == 12
    for name, line in lines:
        assert b"p03" in line
        assert line.endswith(b"\r\n")
        assert protocol.reference(line, letters) is None, name
        if name.startswith("cut"):
            assert re.search(rb"[a-z]p[0-9.]{1,4}\r\n", line), name
        if name in ("cut inside the last number", "a wrong letter", "a bad digit"):
            assert line.rstrip(b",\r\n").count(b",") == len(letters) - 1


def run_earlier_steps(board: Board) -> None:
    """Run the steps of the check that come before the count of lost lines."""
    for step in (dialect.baud, dialect.rate, dialect.check):
        step(board)


@pytest.mark.parametrize(("every", "verdict"), [(25, "FAIL"), (40, "FAIL"), (70, "PASS")])
@pytest.mark.parametrize("way", ["lose_reply", "lose_command"])
def test_a_loss_of_more_than_two_percent_fails(way: str, every: int, verdict: str) -> None:
    robot = Robot()
    setattr(robot.mcu.switches, way, every)
    with robot.board() as board:
        run_earlier_steps(board)
        began_s = board.now_s
        assert line_loss.finding(board).verdict == verdict
        assert board.now_s - began_s < 5.0, "300 lines are enough"


def test_a_board_whose_plain_lines_arrive_damaged_ends_the_check_before_motors_turn() -> None:
    class Noisy(Robot):
        pieces = 0

        def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
            chunks = super().listen(until_ns)
            self.pieces += len(chunks)
            return [
                (at, d[:9] + b"\xae" + d[10:] if self.pieces % 9 == 0 else d) for at, d in chunks
            ]

    robot = Noisy("plain_only")
    with robot.board() as board:
        run_earlier_steps(board)
        with pytest.raises(StoppedError) as end:
            line_loss.finding(board)
    assert "arrived damaged from the board, the last one is `" in end.value.finding.text
    assert "ground" in end.value.finding.mend
    assert robot.mcu.vehicle.angles == [0.0] * 4
