"""Tests that compare encoder counts with speeds."""

from __future__ import annotations

import math

import pytest

from acsard.checkup import encoder_counts, line_loss
from acsard.checkup.dialect import check, identity
from acsard.checkup.motion import BoardReply
from acsard.checkup.wheels import turn
from acsard.core.config.settings import Config, SimConfig
from acsard.core.link.checked_line import Reading
from tests.each import each
from tests.unit.checkup.robots import Robot


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


def test_too_short_a_turn_gives_no_counts_per_turn() -> None:
    assert encoder_counts.per_turn(replies(3200)[:20], [0]) is None
    assert encoder_counts.per_turn(replies(3200), [1]) is None
    assert encoder_counts.per_turn(replies(3200), []) is None


@pytest.mark.parametrize(
    ("configured", "identified", "verdict", "keys"),
    [
        (0, True, "PASS", {"mcu.encoder_counts": 3200}),
        (3200, True, "PASS", {"mcu.encoder_counts": 3200}),
        (1600, True, "FAIL", {"mcu.encoder_counts": 3200}),
        (3210, False, "PASS", {"mcu.encoder_counts": 3210}),
    ],
)
def test_configured_counts_pass_unless_they_differ_from_the_identified_counts(
    configured: int, identified: bool, verdict: str, keys: dict[str, object]
) -> None:
    with Robot(link_check="on", encoder_counts=configured).board() as board:
        check(board)
        if identified:
            identity(board)
        for motor in range(4):
            turn(board, motor, 3.0)
            board.stop_motors()
        finding = encoder_counts.finding(board, [0, 1, 2, 3])
    assert (finding.verdict, finding.keys) == (verdict, keys)


@pytest.mark.parametrize("counts", [16, 20, 40, 96])
def test_coarse_encoders_without_configured_counts_are_a_warning(counts: int) -> None:
    with Robot(config=Config(sim=SimConfig(encoder_counts=counts))).board() as board:
        for motor in range(4):
            turn(board, motor, 3.0)
            board.stop_motors()
        finding = encoder_counts.finding(board, [0, 1, 2, 3])
    assert (finding.verdict, finding.keys) == ("WARN", {})
    assert "write mcu.encoder_counts" in finding.mend
    about = int(finding.figure.split()[1])
    assert about == pytest.approx(counts, rel=0.2)


@pytest.mark.parametrize(("counts", "configured"), [(16, 16), (3200, 0)])
def test_configured_counts_and_fine_encoders_need_no_further_counts(
    counts: int, configured: int
) -> None:
    config = Config(sim=SimConfig(encoder_counts=counts))
    with Robot(config=config, encoder_counts=configured).board() as board:
        turn(board, 0, 3.0)
        assert encoder_counts.finding(board, [0]).verdict == "SKIPPED"


def test_counts_that_differ_from_the_identification_are_a_fault() -> None:
    with Robot(config=Config(sim=SimConfig(encoder_counts=2000))).board() as board:
        check(board)
        board.identity = {"counts": "3200"}
        turn(board, 0, 3.0)
        turn(board, 0, 3.0)
        finding = encoder_counts.finding(board, [0])
    assert finding.verdict == "FAIL"
    assert not finding.keys


def test_counts_that_run_against_the_speeds_are_a_fault() -> None:
    robot = Robot()
    with robot.board() as board:
        board.sampled = True
        board.replies = [BoardReply(r.at_s, (-3.0, 0.0, 0.0, 0.0), b"", r.reading)
                         for r in replies(3200)]  # fmt: skip
        assert "against" in encoder_counts.finding(board, [0]).text


@each(
    ("share", "words"),
    [(-1.0, "motor b (front left) run against"), (0.0, "do not change"), (2.0, "do not agree")],
)
def test_wrong_counts_of_one_motor_are_found(share: float, words: str) -> None:
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
    assert (finding.verdict, finding.keys) == ("FAIL", {})
    assert words in finding.text


def test_more_counts_than_the_host_accepts_are_a_warning() -> None:
    with Robot().board() as board:
        board.sampled, board.identity = True, {"counts": "400000"}
        assert encoder_counts.finding(board, []).verdict == "WARN"


@pytest.mark.parametrize(
    ("configured", "wrong"), [(1600, "100.0%"), (2700, "18.5%"), (3700, "13.5%"), (12800, "75.0%")]
)
def test_wrong_configured_counts_are_found_by_the_speeds_and_corrected(
    configured: int, wrong: str
) -> None:
    with Robot("no_sample", link_check="on", encoder_counts=configured).board() as board:
        board.sampled = True
        board.replies = replies(3200)
        finding = encoder_counts.finding(board, [0])
    assert (finding.verdict, finding.keys) == ("FAIL", {"mcu.encoder_counts": 3200})
    assert finding.figure == f"3200, not {configured}"
    assert f"every distance would be wrong by {wrong}" in finding.text


def test_counts_that_do_not_change_while_the_wheels_turn_are_to_be_switched_off() -> None:
    with Robot(encoder_counts=3200).board() as board:
        board.sampled = True
        board.replies = [BoardReply(r.at_s, r.motors, b"", Reading(20 * n % 65536, (7, 7, 7, 7)))
                         for n, r in enumerate(replies(3200))]  # fmt: skip
        finding = encoder_counts.finding(board, [0])
    assert (finding.verdict, finding.keys) == ("FAIL", {"mcu.encoder_counts": 0})


@pytest.mark.parametrize(
    ("configured", "verdict", "keys"),
    [
        (0, "SKIPPED", {}),
        (1600, "SKIPPED", {}),
        (3210, "PASS", {"mcu.encoder_counts": 3210}),
    ],
)
def test_if_lines_are_lost_only_configured_or_identified_counts_are_proposed(
    configured: int, verdict: str, keys: dict[str, object]
) -> None:
    with Robot("no_sample", link_check="on", encoder_counts=configured).board() as board:
        board.sampled, board.lost = True, line_loss.MAX_LOSS / 4
        board.replies = replies(3200)
        finding = encoder_counts.finding(board, [0])
        assert (finding.verdict, finding.keys) == (verdict, keys)
        if verdict == "SKIPPED":
            assert "0.5% of the lines are lost" in finding.text
        # a count that the board states itself needs no measurement
        board.identity = {"counts": "3200"}
        assert encoder_counts.finding(board, [0]).keys == {"mcu.encoder_counts": 3200}
        board.lost = 2 * line_loss.MAX_LOSS
        assert encoder_counts.finding(board, [0]).keys == {}
