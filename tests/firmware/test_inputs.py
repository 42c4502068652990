"""The C firmware reads its inputs and sends status lines between its replies."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from acsard.core.link.board_status import STATUS, BoardStatus, decode_status
from tests.firmware.board import DRIVE, STOP, Board, Host, checked, read_reply
from tests.firmware.conftest import BATTERY, BUMPERS, CURRENT, DRIVER, ESTOP, wire

pytestmark = pytest.mark.firmware

FREE = BoardStatus(estop=False, bumpers=(False,) * 4)


@pytest.fixture
def host(runner: Path, wired: dict[int, Path]) -> Iterator[Host]:
    with Board(runner, wired[115200]) as board, Host(board, plain=True) as host:
        wire(board)
        host.lines(100)
        yield host


def reports(host: Host, ms: float) -> list[BoardStatus]:
    """Return the status lines of the next `ms`."""
    return [decode_status(line, True) for line in host.lines(ms) if line.startswith(STATUS)]


def test_each_input_is_reported_in_its_field(host: Host) -> None:
    board = host.board
    assert FREE in reports(host, 200)
    for place, pin in enumerate((ESTOP, *BUMPERS)):
        board.command(f"contact {pin} open")
        bumpers = tuple(number == place - 1 for number in range(4))
        assert BoardStatus(estop=place == 0, bumpers=bumpers) in reports(host, 200)
        board.command(f"contact {pin} closed")
        assert FREE in reports(host, 200)
    for action, fault in (("closed", True), ("open", False)):
        board.command(f"contact {DRIVER} {action}")
        board.passes(1000)
        assert reports(host, 1100)[-1].driver_fault in (None, fault)
        host.lines()
        assert [s.driver_fault for s in reports(host, 1000) if s.driver_fault is not None] == [
            fault
        ]


@pytest.mark.parametrize(
    ("battery_mv", "volts", "current_mv", "amps"),
    [(4454, 29.4, 2100, -10.0), (3636, 24.0, 2700, 5.0)],
)
def test_volts_and_amperes_are_those_at_the_pins(
    host: Host, battery_mv: int, volts: float, current_mv: int, amps: float
) -> None:
    """The divider has 56 kilohms above 10 kilohms. One step of the converter is 0.03 V or 0.1 A."""
    host.board.command(f"analog {BATTERY} {battery_mv}")
    host.board.command(f"analog {CURRENT} {current_mv}")
    host.lines(1000)
    (values,) = (status for status in reports(host, 1000) if status.volts is not None)
    assert values.volts == pytest.approx(volts, abs=0.07)
    assert values.amps == pytest.approx(amps, abs=0.25)


def test_a_restart_reports_no_false_press(host: Host) -> None:
    host.board.command("reset")
    assert b"reset=pin" in host.says(b"!acsard")
    presses = [status.estop for status in reports(host, 500) if status.estop is not None]
    assert presses == [False] * len(presses)
    assert len(presses) >= 4


def test_bumpers_and_the_driver_s_fault_do_not_remove_the_voltage(host: Host) -> None:
    """The board only reports bumpers and driver faults. The daemon decides how to react."""
    for pin in BUMPERS:
        host.board.command(f"contact {pin} open")
    host.board.command(f"contact {DRIVER} closed")
    host.drive(DRIVE, 0.3)
    assert host.board.status().running


@pytest.mark.variations(6)
@pytest.mark.parametrize(
    ("baud", "period", "letters", "least"),
    [(115200, 0.01, None, 9), (115200, 0.01, "", 9), (115200, 0.01, "S", 9),
     (9600, 0.1, None, 9), (9600, 0.1, "", 9), (9600, 0.1, "S", 6)],
)  # fmt: skip
def test_each_line_has_its_reply_and_no_status_line_is_within_one(
    runner: Path, wired: dict[int, Path], baud: int, period: float, letters: str | None, least: int
) -> None:
    """The host sends plain lines, checked lines, and checked lines that ask for counts.

    At 9600 baud the replies with counts leave little room for status lines.
    """
    words = ("--baud", str(baud))
    with Board(runner, wired[baud], *words) as board, Host(board, letters is None) as host:
        wire(board)
        host.lines(200)
        host.stop()
        replies = []
        for fifth in range(6):
            board.command(f"contact {BUMPERS[0]} {'closed' if fifth % 2 else 'open'}")
            replies += host.drive(DRIVE, 0.5, letters or "", period)
        host.others += (rest := host.lines(300))
        assert len(replies) + sum(not line.startswith(STATUS) for line in rest) == 3.0 / period
        statuses = [decode_status(line, True) for line in host.others if line.startswith(STATUS)]
        contacts = sum(status.estop is not None for status in statuses)
        print(f"{baud} baud, each {period} s, {letters!r}: {contacts} lines of contacts")
        assert contacts >= least * 3.3
        assert sum(status.volts is not None for status in statuses) >= 2


def test_no_status_line_takes_the_place_of_a_reply(host: Host) -> None:
    """The host sends lines without pauses, so the board always has a reply to send.

    It sends the status lines when the host pauses.
    """
    host.send(STOP)
    host.write((checked(STOP, 0, "S") + b"\r\n") * 250)
    lines = host.lines(1200)
    host.board.command(f"contact {ESTOP} open")
    answers = [place for place, line in enumerate(lines) if not line.startswith(STATUS)]
    lengths = {len(read_reply(lines[place]).line) for place in answers}
    between = answers[-1] + 1 - len(answers)
    print(f"{len(answers)} replies to 251 lines in a second, {between} status lines between them")
    assert lengths == {31, 60}
    assert len(answers) > 150
    assert between <= 2
    assert BoardStatus(estop=True, bumpers=(False,) * 4) in reports(host, 200)
