"""Tests of the rate and the delay of the MCU's answers."""

from __future__ import annotations

from typing import Any

import pytest

from acsard.checkup import pace
from tests.unit.checkup.robots import Robot


@pytest.mark.parametrize(
    ("faults", "mcu", "verdict", "own"),
    [
        ((), {}, "PASS", False),
        (("sparse_replies",), {}, "FAIL", False),
        (("sparse_replies",), {"reply_period": 0.1}, "WARN", False),
        (("unprompted",), {}, "FAIL", True),
        (("unprompted",), {"reply_period": 0.1}, "PASS", True),
    ],
)
def test_the_pace_is_judged_by_what_the_host_waits_for(
    faults: tuple[str, ...], mcu: dict[str, Any], verdict: str, own: bool
) -> None:
    with Robot(*faults, **mcu).board() as board:
        rate, trip = pace.rate(board), pace.trip(board)
        assert rate.verdict == verdict
        assert board.own_clock is own
        assert trip.verdict == ("SKIPPED" if own else "PASS")
        assert rate.keys == ({"mcu.reply_period": 0.1} if faults else {})


@pytest.mark.parametrize("period_s", [0.26, 0.74])
def test_no_setting_is_advised_that_would_be_refused(period_s: float) -> None:
    with Robot().board() as board, board.wire.mcu.sparse_replies(period_s):  # type: ignore[attr-defined]
        board.armed = False
        rate = pace.rate(board)
    assert (rate.verdict, rate.keys) == ("FAIL", {})
    assert "mcu.reply_period" not in rate.mend
    assert rate.mend.endswith("every 0.25 s or sooner")


def test_what_is_advised_is_never_rounded_above_the_limit() -> None:
    with Robot().board() as board, board.wire.mcu.sparse_replies(0.12):  # type: ignore[attr-defined]
        board.longest_reply_s = 0.15
        rate = pace.rate(board)
    period = rate.keys["mcu.reply_period"]
    assert isinstance(period, float)
    assert 0.1 <= period <= 0.15


def test_a_slow_answer_is_a_warning() -> None:
    with Robot("slow_reply").board() as board:
        pace.rate(board)
        trip = pace.trip(board)
        assert trip.verdict == "WARN"
        assert "latency_timer" in trip.mend


def test_firmware_that_answers_nearly_nothing_fails() -> None:
    with Robot("plain_only").board() as board, board.wire.mcu.mute():  # type: ignore[attr-defined]
        board.armed = False
        rate, trip = pace.rate(board), pace.trip(board)
    assert (rate.verdict, trip.verdict) == ("FAIL", "SKIPPED")
