"""Tests that determine the MCU's line format step by step, and the pace of its answers."""

from __future__ import annotations

from typing import Any, get_args

import pytest

from acsard.checkup import dialect
from acsard.checkup.board import Board
from acsard.checkup.findings import StoppedError
from acsard.checkup.outcomes import find
from acsard.core.config.settings import Config, McuConfig
from acsard.core.link.link_diagnosis import ReceivedCode
from tests.each import each
from tests.unit.checkup.robots import Checked, Robot


@pytest.mark.parametrize("rate", [9600, 19200, 38400, 57600])
def test_the_baud_rate_of_the_board_is_found_and_used(rate: Any) -> None:
    with Robot(config=Config(mcu=McuConfig(baud_rate=rate)), baud_rate=115200).board(
        rest=False
    ) as board:
        finding = dialect.baud(board)
        assert finding.verdict == "FAIL"
        assert finding.keys == {"mcu.baud_rate": rate}
        assert board.baud_rate == rate


def test_garbage_is_distinguished_from_silence() -> None:
    for fault, word in (("mute", "nothing"), ("noise", "other bytes"), ("partial_line", "pieces")):
        with Robot(fault).board(rest=False) as board, pytest.raises(StoppedError) as end:
            dialect.baud(board)
        assert end.value.finding.figure.startswith(word)


def test_a_board_that_sends_status_lines_but_receives_nothing_has_its_own_outcome() -> None:
    robot = Robot("estop")
    with (
        robot.mcu.lost_commands(every=1),
        robot.board(rest=False) as board,
        pytest.raises(StoppedError) as end,
    ):
        dialect.baud(board)
    assert end.value.finding.figure == "only status lines"
    assert "only status lines were received" in end.value.finding.text


def test_every_diagnosis_of_the_received_bytes_has_an_outcome_of_its_own() -> None:
    for code in get_args(ReceivedCode):
        finding = find(f"baud rate: {code}", heard="2 lines", configured=115200)
        assert finding.verdict == "FAIL", code


def test_a_board_passes_with_and_without_an_identification() -> None:
    with Robot().board() as board:
        assert dialect.identity(board).figure == "acsard-mcu 1"
        assert board.identity["counts"] == "3200"
    with Robot("plain_only").board() as board:
        assert dialect.identity(board).verdict == "PASS"
        assert board.identity == {}


@pytest.mark.parametrize(
    ("faults", "figure"),
    [
        ((), "as documented"),
        (("spaces",), "spaces"),
        (("unpadded", "trailing_comma"), "unpadded, trailing comma"),
    ],
)
def test_the_form_of_the_replies_is_reported(faults: tuple[str, ...], figure: str) -> None:
    with Robot(*faults).board() as board:
        assert dialect.replies(board).figure == figure


class Particular(Robot):
    """A robot that accepts lines only with a final comma, or only without one."""

    def __init__(self, comma: bool, **mcu: Any) -> None:
        super().__init__("plain_only", **mcu)
        self._comma = comma

    def send(self, data: bytes) -> None:
        lines = data.splitlines(keepends=True)
        super().send(b"".join(s for s in lines if s.endswith(b",\r\n") == self._comma))


def test_firmware_that_refuses_plain_lines_is_checked_to_the_end() -> None:
    class Refuses(Robot):
        def send(self, data: bytes) -> None:
            super().send(b"".join(s for s in data.splitlines(keepends=True) if b"p" not in s
                                  or b"#" in s))  # fmt: skip

    assert Checked(Refuses()).failed == []


@pytest.mark.parametrize("comma", [False, True])
def test_if_one_form_of_line_is_not_answered_the_other_form_is_used(comma: bool) -> None:
    with Particular(comma, trailing_comma=comma).board() as board:
        assert dialect.form(board) is None
    robot = Particular(comma)
    with robot.faulty(), Board(robot, McuConfig(trailing_comma=not comma), 100.0) as board:
        finding = dialect.form(board)
        assert finding is not None
        assert finding.keys == {"mcu.trailing_comma": comma}
        assert board.comma is comma


@pytest.mark.parametrize("comma", [False, True])
def test_a_wrong_trailing_comma_is_not_reported_as_too_few_replies(comma: bool) -> None:
    checked = Checked(Particular(comma, trailing_comma=not comma))
    assert checked.failed == ["trailing comma"]
    assert checked.changes == {"mcu.trailing_comma": comma}
    assert checked["reply rate"].verdict == checked["round trip"].verdict == "PASS"


def test_rare_reports_by_the_boards_own_clock_are_not_taken_for_answers() -> None:
    for wait_ms in range(0, 400, 50):
        robot = Robot("plain_only")
        with robot.board() as board, robot.mcu.free_running(0.4):
            board.listen(wait_ms / 1000)
            assert dialect.form(board) is None
            assert not board.comma


@each(
    ("faults", "wanted", "verdict", "keys"),
    [
        ((), "off", "PASS", {"mcu.link_check": "on"}),
        ((), "on", "PASS", {"mcu.link_check": "on"}),
        (("no_sample",), "on", "PASS", {"mcu.link_check": "on"}),
        (("plain_only",), "off", "SKIPPED", {}),
        (("no_check",), "on", "FAIL", {"mcu.link_check": "off"}),
        (("comma_latched",), "on", "FAIL", {"mcu.link_check": "off"}),
    ],
)
def test_the_link_check_is_used_if_the_board_supports_it(
    faults: tuple[str, ...], wanted: str, verdict: str, keys: dict[str, object]
) -> None:
    with Robot(*faults, link_check=wanted).board() as board:
        finding = dialect.check(board)
        assert (finding.verdict, finding.keys) == (verdict, keys)
        assert board.sealed is (verdict == "PASS")
        assert board.sampled is (not faults)


@each(
    ("faults", "mcu", "verdict", "own"),
    [
        ((), {}, "PASS", False),
        (("sparse_replies",), {}, "FAIL", False),
        (("sparse_replies",), {"reply_period": 0.1}, "WARN", False),
        (("free_running",), {}, "FAIL", True),
        (("free_running",), {"reply_period": 0.1}, "PASS", True),
    ],
)
def test_the_reply_rate_is_judged_by_the_period_that_the_host_expects(
    faults: tuple[str, ...], mcu: dict[str, Any], verdict: str, own: bool
) -> None:
    with Robot(*faults, **mcu).board() as board:
        rate, trip = dialect.rate(board), dialect.trip(board)
        assert rate.verdict == verdict
        assert board.own_clock is own
        assert trip.verdict == ("SKIPPED" if own else "PASS")
        assert rate.keys == ({"mcu.reply_period": 0.1} if faults else {})


@pytest.mark.parametrize("period_s", [0.26, 0.74])
def test_a_reply_period_that_the_configuration_refuses_is_not_advised(period_s: float) -> None:
    with Robot().board() as board, board.wire.mcu.sparse_replies(period_s):  # type: ignore[attr-defined]
        board.armed = False
        rate = dialect.rate(board)
    assert (rate.verdict, rate.keys) == ("FAIL", {})
    assert "mcu.reply_period" not in rate.mend
    assert rate.mend.endswith("at least every 0.25 s")


def test_the_advised_reply_period_is_not_rounded_above_the_limit(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(dialect, "MAX_REPLY_PERIOD_S", 0.15)
    with Robot().board() as board, board.wire.mcu.sparse_replies(0.12):  # type: ignore[attr-defined]
        rate = dialect.rate(board)
    period = rate.keys["mcu.reply_period"]
    assert isinstance(period, float)
    assert 0.1 <= period <= 0.15


def test_a_slow_answer_is_a_warning() -> None:
    with Robot("slow_reply").board() as board:
        dialect.rate(board)
        trip = dialect.trip(board)
        assert trip.verdict == "WARN"
        assert "latency_timer" in trip.mend


def test_firmware_that_answers_nearly_nothing_fails() -> None:
    with Robot("plain_only").board() as board, board.wire.mcu.mute():  # type: ignore[attr-defined]
        board.armed = False
        rate, trip = dialect.rate(board), dialect.trip(board)
    assert (rate.verdict, trip.verdict) == ("FAIL", "SKIPPED")
