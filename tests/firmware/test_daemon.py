"""The real daemon on the real firmware: it drives it, and each catches the end of the other."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.firmware.board import Board, Status
from tests.system.harness import Bus, Daemon, until

pytestmark = pytest.mark.firmware

MS = 1_000_000


@pytest.fixture
def daemon(board: Board, tmp_path: Path) -> Iterator[Daemon]:
    """A daemon with its usual configuration at the board's port."""
    with Daemon(tmp_path, board.path) as daemon:
        yield daemon


@pytest.fixture
def bus(daemon: Daemon) -> Iterator[Bus]:
    """A client of it, with the link up."""
    with Bus(daemon.endpoint) as bus:
        bus.linked()
        yield bus


def turns(board: Board, speed: float) -> Status | None:
    """The state when all wheels have that speed."""
    status = board.status()
    return status if all(abs(motor.speed - speed) < 0.1 for motor in status.motors) else None


def test_a_speed_on_the_bus_is_a_speed_of_the_wheels(board: Board, bus: Bus) -> None:
    with bus.commanding(0.5):
        until(lambda: turns(board, 0.5 / 0.05), 5.0, "0.5 m/s on wheels of 50 mm")
        assert bus.state()["mode"] == "driving"
        counted = [motor.counts for motor in board.status().motors]
        until(lambda: board.status().motors[0].counts > counted[0] + 3200, 5.0, "one turn")
        assert bus.state()["mode"] == "driving", "and no fault meanwhile"
    bus.at_rest()
    until(lambda: turns(board, 0.0), 3.0, "the wheels stand")


def test_a_daemon_that_is_killed_is_caught_by_the_board(
    board: Board, daemon: Daemon, bus: Bus
) -> None:
    with bus.commanding(0.5):
        until(lambda: turns(board, 10.0), 5.0, "it drives")
        daemon.signal(signal.SIGKILL)
        killed = time.monotonic_ns()
        status = until(lambda: None if (s := board.status()).running else s, 3.0, "motors off")
    wall = (status.base_ns + status.off_ns - killed) / MS
    silent = (status.off_ns - status.heard_ns) / MS
    print(f"SIGKILL -> motors off: {wall:.0f} ms; {silent:.1f} ms after the last byte")
    assert 250 <= silent <= 350


def test_a_board_that_resets_stands_until_the_daemon_has_seen_it(board: Board, bus: Bus) -> None:
    with bus.commanding(0.5):
        until(lambda: turns(board, 10.0), 5.0, "it drives")
        board.command("reset")
        assert not board.status().running
    bus.at_rest()
    with bus.commanding(0.5):
        until(lambda: turns(board, 10.0), 5.0, "it drives again")
