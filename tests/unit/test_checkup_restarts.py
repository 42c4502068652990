"""A restart of the board is a finding of its own, and the interrupted step is repeated."""

from __future__ import annotations

from collections.abc import Sequence

import pytest

from acsard.checkup import procedure
from acsard.checkup.findings import Finding
from acsard.checkup.motion import BoardReply
from acsard.checkup.procedure import AGAIN, MOST
from acsard.checkup.restarts import (
    CLOCK_RANGE_MS,
    RESTART_UNANSWERED_LINES,
    Restart,
    Restarts,
    finding,
)
from acsard.core.config.settings import Config
from acsard.core.link.board_status import IDENTITY
from acsard.core.link.checked_line import Reading
from tests.each import each
from tests.unit.checkup_robots import MS, Checked, Nobody, Robot

NAME = IDENTITY + b"1 counts=3200"


ZERO = (0.0, 0.0, 0.0, 0.0)

TEXT = b"Booting v2"


class Restarting(Robot):
    """A robot that restarts at these times."""

    def __init__(self, at_s: Sequence[float], *faults: str) -> None:
        super().__init__(*faults)
        self._due_ns = [int(time_s * 1e9) for time_s in at_s]

    def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
        if self._due_ns and self.now_ns() >= self._due_ns[0]:
            self._due_ns.pop(0)
            self.mcu.reset(self.now_ns())
        return super().listen(until_ns)


DIALECTS = pytest.mark.parametrize("faults", [(), ("no_sample",), ("plain_only",)], ids=str)


@DIALECTS
def test_restarts_are_counted_and_reported_with_the_motor_that_turned(
    faults: tuple[str, ...],
) -> None:
    checked = Checked(Restarting([1.0, 9.0, 20.0], *faults))
    assert checked.failed == ["restarts"]
    assert checked["restarts"].figure == "restarted, 3 times"
    assert "no motor turned" in checked["restarts"].text
    assert "motor " in checked["restarts"].text
    assert not checked.left_turning


@pytest.mark.parametrize("every_s", [1.0, 4.0])
def test_a_board_that_keeps_restarting_ends_the_check_soon(every_s: float) -> None:
    robot = Restarting([2.0 + every_s * n for n in range(60)])
    checked = Checked(robot)
    assert checked.failed == ["restarts"]
    assert checked.findings[-1].verdict == "SKIPPED"
    assert "the check ended early: restarts" in checked.findings[-1].text
    assert len(robot._due_ns) >= 60 - MOST - 5
    assert not checked.left_turning


class Weak(Robot):
    """A robot whose supply voltage drops whenever this wheel turns."""

    def __init__(self, wheel: int) -> None:
        super().__init__()
        self.wheel, self.starts = wheel, 0

    def send(self, data: bytes) -> None:
        super().send(data)
        if abs(self.mcu.vehicle.speeds[self.wheel]) > 2.0:
            self.starts += 1
            self.mcu.reset(self.now_ns())


def test_a_supply_that_drops_each_time_a_motor_turns_is_named_after_few_tries() -> None:
    robot = Weak(1)
    checked = Checked(robot)
    assert checked.failed == ["restarts"]
    assert checked["motor a"].verdict == "PASS"
    assert robot.starts == 1 + AGAIN
    result = checked["restarts"]
    assert result.figure == "restarted, twice"
    assert "twice while motor b (front left) turned" in result.text
    assert result.mend.startswith("use a separate supply for the board")


class Resetting(Robot):
    """A robot whose watchdog restarts the whole board when no line arrives."""

    silence_ns = 500 * MS
    spoken_ns = 0

    def send(self, data: bytes) -> None:
        self.spoken_ns = self.now_ns()
        super().send(data)

    def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
        chunks, due_ns = [], self.spoken_ns + self.silence_ns
        if self.now_ns() < due_ns <= until_ns:
            chunks = super().listen(due_ns)
            self.mcu.reset(self.now_ns(), 200 * MS)
        return chunks + super().listen(until_ns)


def test_a_watchdog_that_restarts_the_whole_board_is_named() -> None:
    checked = Checked(Resetting())
    assert checked.failed == ["restarts"]
    assert "let that watchdog only stop the motors" in checked["restarts"].mend
    assert "sent nothing for" in checked["restarts"].text


def test_a_board_that_restarts_once_in_each_part_ends_the_check_at_the_fifth() -> None:
    robot, findings, parts = Robot(), list[Finding](), list[str]()

    class Watches(Nobody):
        def doing(self, text: str) -> None:
            if text not in parts and "restarted" not in text:
                parts.append(text)
                if len(parts) > 1:  # in the first part, a board boots because the port opens
                    robot.mcu.reset(robot.now_ns())

    procedure.run(robot, Watches(), robot.config, findings.append, fast=True)
    *_, found, rest = findings
    assert (found.figure, rest.verdict) == ("restarted, 5 times", "SKIPPED")


def test_a_board_that_does_not_come_back_is_reported() -> None:
    class Dies(Robot):
        dead = False

        def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
            if not self.dead and self.now_ns() >= 6_000 * MS:
                self.dead, self.mcu.switches.muted = True, True
                self.mcu.reset(self.now_ns(), 100 * MS)
            return super().listen(until_ns)

    checked = Checked(Dies())
    assert checked.failed == ["restarts"]
    assert "did not answer again within 3 s" in checked["restarts"].text


@each(
    ("cause", "mend"),
    [
        ("brown-out", "use a separate supply for the board"),
        ("power", "use a separate supply for the board"),
        ("watchdog", "where does the firmware wait"),
        ("pin", "does a second program open the port"),
        ("unknown", "is the supply weak"),
    ],
)
def test_the_boot_cause_that_the_board_states_decides_the_remedy(cause: str, mend: str) -> None:
    restarts = detector_after(reply(0.0, 0))
    name = NAME + b" trips=0 reset=" + cause.encode()
    restart = restarts.check_line(name, 9.0, None)
    assert restart is not None
    assert restart.cause == cause
    result = finding(Config().mcu, [restart])
    assert result.mend.startswith(mend)
    assert f"(reset={cause})" in result.text


TURNED = (0.0, 3.0, 0.0, 0.0)


@each(
    ("code", "restarts"),
    [
        ("restarts_seen", [Restart("x", TURNED)]),
        ("restarts_motors", [Restart("x", TURNED), Restart("x", TURNED)]),
        ("restarts_seen", [Restart("x", TURNED), Restart("x")]),
        ("restarts_silence", [Restart("x", silent_s=0.25), Restart("x", silent_s=0.5)]),
        ("restarts_seen", [Restart("x", silent_s=0.24), Restart("x", silent_s=0.5)]),
        ("restarts_watchdog", [Restart("x", silent_s=0.5, cause="watchdog")]),
        # It restarts in each silence, so its watchdog restarts the whole board.
        ("restarts_silence", [Restart("x", silent_s=0.5, cause="watchdog")] * 2),
        ("restarts_supply", [Restart("x", TURNED, cause="brown-out"), Restart("x", cause="power")]),
        ("restarts_seen", [Restart("x", cause="pin"), Restart("x", cause="power")]),
    ],
)
def test_one_restart_proves_less_than_several(code: str, restarts: list[Restart]) -> None:
    assert finding(Config().mcu, restarts).code == code
    assert finding(Config().mcu, restarts, back=False).code == "restarts_gone"


def reply(at_s: float, mcu_ms: int) -> BoardReply:
    return BoardReply(at_s, ZERO, b"", Reading(mcu_ms % CLOCK_RANGE_MS, (0, 0, 0, 0)))


def detector_after(*replies: BoardReply) -> Restarts:
    """Return a restart detector that has received these replies."""
    restarts = Restarts()
    for answer in replies:
        assert restarts.check_line(b"", answer.at_s, answer) is None
    return restarts


def sign(restart: Restart | None) -> str:
    return "" if restart is None else restart.sign


def test_a_text_is_a_restart_after_a_silence_and_a_debug_print_otherwise() -> None:
    restarts = detector_after(reply(0.0, 0))
    for _ in range(RESTART_UNANSWERED_LINES - 1):
        restarts.record_speeds(ZERO, 0.0)
    assert restarts.check_line(TEXT, 0.1, None) is None
    restarts.record_speeds(ZERO, 0.1)
    assert restarts.check_line(TEXT, 0.2, None) is None  # the board prints it now and then
    # a damaged line is not taken for text
    assert restarts.check_line(b"ap0\x00.00,b~p00.00#0AFFE", 0.2, None) is None
    assert "text" in sign(restarts.check_line(b"Starting motors", 0.2, None))


@each("start_ms", [0, 40_000, CLOCK_RANGE_MS - 5_000])
@each("clock", [0.98, 1.0, 1.02])
def test_a_clock_that_continues_is_not_a_restart_at_any_pace_or_at_its_overflow(
    start_ms: int, clock: float
) -> None:
    times = [n * 0.3 for n in range(100)]
    detector_after(*(reply(t, round(start_ms + 1000 * clock * t)) for t in times))


@pytest.mark.parametrize("before_ms", [3_000, 20_000, 40_000, CLOCK_RANGE_MS - 1])
def test_a_clock_that_restarted_is_a_restart_of_the_board(before_ms: int) -> None:
    restarts = detector_after(reply(10.0, before_ms))
    again = reply(12.1, 100)
    gone_ms = (100 - before_ms) % CLOCK_RANGE_MS
    assert ("started again" in sign(restarts.check_line(b"", again.at_s, again))) == (
        gone_ms > 4100
    )
