"""How often and how soon the MCU answers."""

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
