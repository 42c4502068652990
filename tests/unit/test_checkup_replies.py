"""What the check concludes from the replies: how often and when they come, and what they repeat."""

from __future__ import annotations

from typing import Any

from acsard.checkup import (
    dialect,
    line_loss,
    reply_times,
)
from acsard.checkup.findings import StoppedError
from acsard.checkup.repeats import MIN_REPEATED, Repeats
from acsard.core.link.link_diagnosis import Traffic
from tests.each import each
from tests.unit.checkup_robots import MS, Robot


class Seldom(Robot):
    """A robot that leaves out replies sooner than `gap_s` behind another one, and delays all."""

    def __init__(self, gap_s: float, late_s: float = 0.0, **mcu: Any) -> None:
        super().__init__("plain_only", **mcu)
        self._gap_ns, self._late_ns, self._last_ns = int(gap_s * 1e9), int(late_s * 1e9), 0
        self._held = list[tuple[int, bytes]]()

    def listen(self, until_ns: int) -> list[tuple[int, bytes]]:
        for at_ns, data in super().listen(until_ns):
            if at_ns - self._last_ns >= self._gap_ns:
                self._last_ns = at_ns
                self._held.append((at_ns + self._late_ns, data))
        pieces = [piece for piece in self._held if piece[0] <= until_ns]
        del self._held[: len(pieces)]
        return pieces


@each(
    ("gap_s", "period", "code", "key"),
    [
        (0.0, 0.0, "reply_rate_right", None),
        (0.025, 0.0, "reply_rate_lossy", None),  # within the silence of 0.1 s that is allowed
        (0.035, 0.0, "reply_rate_slow", 0.04),
        (0.035, 0.04, "reply_rate_lossy", 0.04),
        (0.2, 0.1, "reply_rate_slow", 0.2),
        (0.4, 0.0, "reply_rate_rare", None),
        (3.0, 0.0, "reply_rate_none", None),
    ],
)
def test_rare_replies_need_a_period_in_the_configuration(
    gap_s: float, period: float, code: str, key: float | None
) -> None:
    with Seldom(gap_s, reply_period=period).board(rest=False) as board:
        found = dialect.rate(board)
    assert found.code == code
    assert found.keys == ({} if key is None else {"mcu.reply_period": key})


@each(
    ("every", "code"), [(3, "reply_rate_lossy"), (4, "reply_rate_lossy"), (6, "reply_rate_right")]
)
def test_a_board_that_answers_less_than_four_of_five_lines_loses_some(
    every: int, code: str
) -> None:
    robot = Robot("plain_only")
    robot.mcu.switches.lose_reply = every
    with robot.board() as board:
        assert dialect.rate(board).code == code


def test_replies_that_come_late_are_no_reports_of_a_clock_of_the_board() -> None:
    with Seldom(0.0, late_s=0.15).board() as board:
        board.drive(board.zero, 1.0)
        dialect.rate(board)
        assert not board.own_clock
        assert dialect.trip(board).code == "round_trip_slow"


def test_too_few_replies_show_no_times() -> None:
    with Seldom(0.25).board() as board:
        board.paced = True
        assert reply_times.finding(board) is None


def test_a_board_that_falls_silent_has_no_round_trip() -> None:
    robot = Robot("plain_only")
    with robot.board() as board:
        dialect.rate(board)
        with robot.mcu.fault("mute"):
            assert dialect.trip(board).code == "round_trip_none"


@each("end", [b"\r", b"\n"])
def test_noise_before_the_question_spoils_no_answer_whatever_ends_a_line(end: bytes) -> None:
    class Ends(Robot):
        """A robot whose firmware takes this character for the end of a line."""

        noise = b"~"
        asked = 0

        def send(self, data: bytes) -> None:
            lines = (self.noise + data).split(end)
            self.asked += sum(line.strip() == b"?" for line in lines[:-1])
            super().send(data)

    robot = Ends()
    with robot.board() as board:
        assert dialect.identity(board).code == "identification_named"
    assert robot.asked == 1


def test_a_port_that_is_opened_at_another_rate_begins_anew() -> None:
    """Opening it restarts many boards, which then print a text."""
    robot = Robot("plain_only")
    with robot.board() as board:
        board.drive(board.zero, 0.3)
        board.wire.send(b"ap0")
        board.open(board.baud_rate)
        assert (board.replies, board.traffic.counted) == ([], Traffic().counted)
        robot.mcu.reset(robot.now_ns(), 200 * MS)
        board.listen(0.1)
        for _ in range(6):
            board.zeros()
        pieces = iter([b"Booting v2\r\n"])
        vars(robot)["listen"] = lambda until_ns: [(robot.now_ns(), next(pieces))]
        assert board._receive(robot.now_ns()) == []
        del vars(robot)["listen"]
        assert board.comes_back()


@each(("repeated", "stops"), [(MIN_REPEATED - 1, False), (MIN_REPEATED, True)])
def test_a_few_replies_with_the_commanded_speed_are_a_coincidence(
    repeated: int, stops: bool
) -> None:
    for encoders, measured, code in (
        (True, 0, "replies_set_points"),
        (True, 20, ""),
        (False, 0, "measured_speeds_set_points"),
    ):
        repeats = Repeats(encoders)
        for n in range(repeated):
            before, command = (float(n),), (n + 1.0,)
            repeats.record([command if n % 2 else before] if n else [command], before, command)
        for _ in range(measured):
            repeats.record([(0.3,)], (0.2,), (0.4,))
        try:
            repeats.check()
            found = repeats.finding()
        except StoppedError as end:
            found = end.finding
        assert (found.code if found else "") == (code if stops else "")


def test_few_lines_of_a_slow_board_are_counted_for_ten_seconds() -> None:
    robot = Seldom(0.095)
    robot.mcu.switches.lose_reply = 3
    with robot.board() as board:
        board.paced, board.gap_s = True, 0.1
        began_s = board.now_s
        assert line_loss.finding(board).verdict == "FAIL"
        assert 9.0 < board.now_s - began_s < 12.0
