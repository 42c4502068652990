"""A board that starts anew in the middle of the check is a finding of its own, whatever it says."""

from __future__ import annotations

import pytest

from acsard.checkup.motion import ZERO, Reply
from acsard.checkup.restarts import AHEAD_S, ASKED_S, CLOCK, UNANSWERED, Restarts
from acsard.config.settings import Config
from acsard.mcu.check import Reading
from acsard.mcu.session import IDENTITY
from tests.unit.checkup.robots import Checked, Robot

NAME = IDENTITY + b"1 counts=3200"
TEXT = b"Booting v2"


class Restarting(Robot):
    """Starts anew once, at this time."""

    def __init__(self, at_s: float, *faults: str) -> None:
        super().__init__(*faults)
        self._due_ns: int | None = int(at_s * 1e9)

    def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
        if self._due_ns is not None and self.now_ns() >= self._due_ns:
            self._due_ns = None
            self.mcu.reset(self.now_ns())
        return super().listen(until_ns)


@pytest.mark.parametrize("faults", [(), ("no_sample",), ("plain_only",)], ids=str)
@pytest.mark.parametrize(
    ("at_s", "when"),
    [
        (1.0, "everything stood"),
        pytest.param(3.5, "everything stood", marks=pytest.mark.slow),
        (6.0, "everything stood"),
        (9.0, "motor "),
        pytest.param(11.0, "motor ", marks=pytest.mark.slow),
        pytest.param(15.0, "motor ", marks=pytest.mark.slow),
        pytest.param(21.0, "", marks=pytest.mark.slow),
    ],
)
def test_a_board_that_starts_anew_fails_by_that_and_nothing_else_is_blamed(
    faults: tuple[str, ...], at_s: float, when: str
) -> None:
    checked = Checked(Restarting(at_s, *faults))
    assert checked.failed == ["restarts"]
    assert f"while {when}" in checked["restarts"].text
    assert "supply" in checked["restarts"].mend
    assert "DTR" in checked["restarts"].mend
    assert not checked.changes.keys() - {"mcu.link_check", "mcu.encoder_counts"}
    assert not checked.left_turning


def reply(at_s: float, mcu_ms: int) -> Reply:
    return Reply(at_s, ZERO, b"", Reading(mcu_ms % CLOCK, (0, 0, 0, 0)))


def heard(*replies: Reply) -> Restarts:
    """It answered so."""
    restarts = Restarts()
    for one in replies:
        assert restarts.look(b"", one.at_s, one) == ""
    return restarts


def test_what_it_says_when_the_port_was_opened_is_no_restart() -> None:
    assert Restarts().look(NAME, 2.0, None) == ""


def test_its_name_is_a_restart_unless_it_was_asked_for() -> None:
    restarts = heard(reply(0.0, 0))
    restarts.asked(1.0)
    assert restarts.look(NAME, 1.0 + ASKED_S, None) == ""
    assert restarts.look(NAME, 1.1 + ASKED_S, None) == "it named itself, unasked"
    why = restarts.look(NAME + b" trips=0 reset=brownout", 9.0, None)
    assert why == "it named itself, unasked (reset=brownout)"


def test_a_text_is_a_restart_after_a_silence_and_a_debug_print_before_one() -> None:
    restarts = heard(reply(0.0, 0))
    for _ in range(UNANSWERED - 1):
        restarts.sent(ZERO, 0.0)
    assert restarts.look(TEXT, 0.1, None) == ""
    restarts.sent(ZERO, 0.1)
    assert restarts.look(b"ap0\x00.00,b~p00.00#0AFFE", 0.2, None) == ""  # damaged, no text
    assert "text" in restarts.look(TEXT, 0.2, None)


@pytest.mark.parametrize("start_ms", [0, 40_000, CLOCK - 5_000])
@pytest.mark.parametrize("clock", [0.98, 1.0, 1.02])
def test_a_clock_that_runs_on_is_no_restart_at_any_pace_also_where_it_comes_round(
    start_ms: int, clock: float
) -> None:
    times = [n * 0.3 for n in range(100)]
    heard(*(reply(t, round(start_ms + 1000 * clock * t)) for t in times))


def test_replies_that_were_held_up_and_come_at_once_are_no_restart() -> None:
    late = [reply(1.5 + n / 1000, 100 + 100 * n) for n in range(14)]
    heard(reply(0.0, 0), *late, reply(1.6, 1600))
    assert AHEAD_S > 1.5


@pytest.mark.parametrize("before_ms", [3_000, 20_000, 40_000, CLOCK - 1])
def test_a_clock_that_began_again_is_a_restart(before_ms: int) -> None:
    restarts = heard(reply(10.0, before_ms))
    again = reply(12.1, 100)
    gone_ms = (100 - before_ms) % CLOCK
    assert ("began again" in restarts.look(b"", again.at_s, again)) == (gone_ms > 4100)


def test_it_is_told_what_turned_when_it_was_heard_last() -> None:
    restarts = heard(reply(10.0, 0))
    mcu = Config().mcu
    assert "while everything stood" in restarts.finding(mcu, "a sign").text
    restarts.sent((3.0, 0.0, 0.0, 0.0), 10.1)
    restarts.sent(ZERO, 11.0)
    assert "while motor a (front right) turned" in restarts.finding(mcu, "a sign").text


def test_nobody_asks_once_the_check_has_ended() -> None:
    restarts = heard(reply(0.0, 0))
    restarts.watched = False
    assert restarts.look(NAME, 9.0, None) == ""
