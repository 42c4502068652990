"""The firmware reads its inputs, sends status lines between its replies, and stops the motors."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import pytest

from acsard.core.link.board_status import STATUS, BoardStatus, decode_status
from tests.firmware.board import (
    MS,
    STOP,
    Board,
    Host,
    Reply,
    Speeds,
    checked,
    passes,
    read_reply,
    speeds_line,
)
from tests.firmware.conftest import BATTERY, BUMPERS, CURRENT, DRIVER, ESTOP, wired_board
from tests.system.harness import until

pytestmark = pytest.mark.firmware


DRIVE: Speeds = (10.0, -5.0, 20.0, -30.0)

FREE = BoardStatus(estop=False, bumpers=(False,) * 4)


@pytest.fixture
def board(runner: Path, wired: dict[int, Path]) -> Iterator[Board]:
    with wired_board(runner, wired) as board:
        yield board


@pytest.fixture
def host(board: Board) -> Iterator[Host]:
    with Host(board.path) as host:
        host.says(b"!status")  # the first line that comes may have lost its beginning
        yield host


def reports(host: Host) -> list[BoardStatus]:
    """Return the status lines that the host has received since the last call."""
    return [decode_status(line, True) for _, line in host.lines() if line.startswith(STATUS)]


def awaited(host: Host, wanted: BoardStatus) -> None:
    """Wait for a status line with exactly these fields."""
    until(lambda: wanted in reports(host), 5.0, f"{wanted}")


def asks(board: Board, host: Host, speeds: Speeds, ms: float) -> None:
    """Send these speeds every 20 ms for `ms` of the board's simulated time."""
    end = board.status().virtual_ns + ms * MS
    while (due := board.status().virtual_ns + 20 * MS) < end:
        host.send(speeds_line(speeds))
        while board.status().virtual_ns < due:
            host.lines(0.002)


# inputs


def test_each_input_is_reported_in_its_field(board: Board, host: Host) -> None:
    awaited(host, FREE)
    for place, pin in enumerate((ESTOP, *BUMPERS)):
        board.command(f"contact {pin} open")
        bumpers = tuple(number == place - 1 for number in range(4))
        awaited(host, BoardStatus(estop=place == 0, bumpers=bumpers))
        board.command(f"contact {pin} closed")
        awaited(host, FREE)
    for action, fault in (("closed", True), ("open", False)):
        board.command(f"contact {DRIVER} {action}")
        until(lambda: any(s.driver_fault is fault for s in reports(host)), 5.0, f"fault {fault}")  # noqa: B023


def test_the_battery_s_voltage_is_that_at_the_divider(board: Board, host: Host) -> None:
    """The divider has 56 kilohms above 10 kilohms. One step of the converter is 0.03 V."""
    volts = 29.4
    board.command(f"analog {BATTERY} 4454")
    passes(board, 1000)
    reports(host)
    (sample,) = until(lambda: [s for s in reports(host) if s.volts is not None], 5.0, "volts")[-1:]
    print(f"{volts} V: reported {sample.volts} V")
    assert sample.volts == pytest.approx(volts, abs=0.07)


def test_the_reported_current_has_the_sign_of_its_direction(board: Board, host: Host) -> None:
    for millivolts, amps in ((2100, -10.0), (2700, 5.0)):
        board.command(f"analog {CURRENT} {millivolts}")
        passes(board, 1000)
        reports(host)
        (sample,) = until(lambda: [s for s in reports(host) if s.amps is not None], 5.0, "amps")[
            -1:
        ]
        assert sample.amps == pytest.approx(amps, abs=0.25)


def test_a_restart_reports_no_false_press(board: Board, host: Host) -> None:
    board.command("reset")
    assert b"reset=pin" in host.says(b"!acsard")
    passes(board, 500)
    presses = [status.estop for status in reports(host) if status.estop is not None]
    assert presses == [False] * len(presses)
    assert len(presses) >= 4


# motors


def test_a_board_that_starts_while_pressed_moves_nothing_until_a_zero_after_the_release(
    board: Board, host: Host
) -> None:
    board.command(f"contact {ESTOP} open")
    board.command("reset")
    host.says(b"!acsard")
    host.send(STOP)
    asks(board, host, DRIVE, 300)
    board.command(f"contact {ESTOP} closed")
    asks(board, host, DRIVE, 300)
    assert board.status().on_ns == 0
    host.send(STOP)
    asks(board, host, DRIVE, 300)
    assert board.status().running


def test_bumpers_and_the_driver_s_fault_do_not_remove_the_voltage(board: Board, host: Host) -> None:
    """The board only reports bumpers and driver faults. The daemon decides how to react."""
    host.send(STOP)
    for pin in BUMPERS:
        board.command(f"contact {pin} open")
    board.command(f"contact {DRIVER} closed")
    asks(board, host, DRIVE, 300)
    assert board.status().running


# the wire


@pytest.mark.variations(6)
@pytest.mark.parametrize(
    ("baud", "period", "letters", "least"),
    [(115200, 10, None, 9), (115200, 10, "", 9), (115200, 10, "S", 9),
     (9600, 100, None, 9), (9600, 100, "", 9), (9600, 100, "S", 6)],
)  # fmt: skip
def test_each_line_has_its_reply_and_no_status_line_is_within_one(
    runner: Path, wired: dict[int, Path], baud: int, period: int, letters: str | None, least: int
) -> None:
    """The host sends plain lines, checked lines, and checked lines that ask for counts.

    At 9600 baud the replies with counts leave little room for status lines.
    """
    with wired_board(runner, wired, baud) as board, Host(board.path) as host:
        host.says(b"!status")
        sent, replies, statuses, pressed = 0, list[Reply](), list[BoardStatus](), False
        start = board.status().virtual_ns

        def take(wait: float) -> None:
            for at, line in host.lines(wait):
                if line.startswith(STATUS):
                    statuses.append(decode_status(line, True))
                else:
                    replies.append(read_reply(line, at))

        while (due := board.status().virtual_ns + period * MS) < start + 3000 * MS:
            line = speeds_line(DRIVE) if sent else STOP
            host.send(line if letters is None else checked(line, sent % 256, letters))
            sent += 1
            if sent % 5 == 0:
                pressed = not pressed
                board.command(f"contact {BUMPERS[0]} {'open' if pressed else 'closed'}")
            while board.status().virtual_ns < due:
                take(0.002)
        passes(board, 500)
        take(0)
        seconds = (board.status().virtual_ns - start) / 1e9
        contacts = sum(status.estop is not None for status in statuses)
        values = sum(status.volts is not None for status in statuses)
        print(f"{baud} baud, each {period} ms, {letters!r}: {sent} lines, {len(replies)} "
              f"replies, {contacts} lines of contacts and {values} of values in "
              f"{seconds:.1f} s")  # fmt: skip
        assert len(replies) == sent
        assert contacts >= least * seconds
        assert values >= 2


def test_no_status_line_takes_the_place_of_a_reply(board: Board, host: Host) -> None:
    """The host sends lines without pauses, so the board always has a reply to send.

    It sends the status lines when the host pauses.
    """
    host.send(STOP)
    host.write((checked(STOP, 0, "S") + b"\r\n") * 250)
    passes(board, 1200)
    board.command(f"contact {ESTOP} open")
    lines = [line for _, line in host.lines()]
    answers = [place for place, line in enumerate(lines) if not line.startswith(STATUS)]
    lengths = {len(read_reply(lines[place]).line) for place in answers}
    print(f"{len(answers)} replies to 251 lines in a second, "
          f"{answers[-1] + 1 - len(answers)} status lines between them")  # fmt: skip
    assert lengths == {31, 60}
    assert len(answers) > 150
    assert answers[-1] + 1 - len(answers) <= 2
    awaited(host, BoardStatus(estop=True, bumpers=(False,) * 4))
