"""Faults of processes, the kernel and the serial line (SAFETY section 2), with the real daemon."""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.system.bystander import lost
from tests.system.harness import (
    ZERO_LINE,
    Bus,
    Daemon,
    FarPeer,
    Peer,
    Program,
    ReceivedLine,
    until,
)
from tests.system.strangers import COMMANDER, command_line

pytestmark = pytest.mark.slow

TICK_S = 0.01

ZERO_TEXT = ZERO_LINE.strip()


def commander(daemon: Daemon, speed: float) -> Program:
    """Run a process that sends stamped commands at 20 Hz until it is ended."""
    return Program(command_line(COMMANDER, daemon.endpoint, "app", speed, 1), daemon.config.parent)


def text(speed: float) -> bytes:
    """Return the beginning of a line that drives straight at this speed, m/s."""
    return f"ap{speed / 0.05:05.2f},".encode()


def drives(peer: FarPeer, driver: Program, speed: float) -> None:
    """Wait for a line with this speed in m/s.

    If a busy machine has delayed the commander's first zero, the commander must send zeros again.
    """
    begun = said = time.monotonic()

    def look() -> bool:
        nonlocal said
        if time.monotonic() > said + 4.0 and len(driver.out) > 3:
            said = time.monotonic()
            driver.signal(signal.SIGUSR1)
        return any(entry.line.startswith(text(speed)) for entry in peer.since(begun))

    until(look, 10.0, f"{speed} m/s on the wire")


@pytest.fixture(scope="module")
def one_robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[tuple[FarPeer, Daemon]]:
    where = tmp_path_factory.mktemp("far")
    with FarPeer(where) as peer, Daemon(where, peer.path) as daemon:
        yield peer, daemon


@pytest.fixture
def far(one_robot: tuple[FarPeer, Daemon]) -> Iterator[tuple[FarPeer, Daemon]]:
    """Provide a daemon and its board at rest, so that the lines of two commanders do not mix.

    After the test, print the daemon's log of this test. pytest shows it if the test failed.
    """
    peer, daemon = one_robot
    began = len(daemon.err)
    until(lambda: [h.line for h in peer.lines[-1:]] == [ZERO_TEXT], 5.0, f"at rest\n{daemon}")
    yield one_robot
    print("\n".join(daemon.err[began:]))


def test_a_board_that_stops_reading_and_answering_is_sent_few_drive_lines_then_zeros(
    tmp_path: Path, peer: Peer
) -> None:
    with (
        Daemon(tmp_path, peer.path) as daemon,
        Bus(daemon.endpoint) as bus,
        bus.commanding(0.5),
    ):
        until(lambda: peer.lines[-1].line.startswith(text(0.5)), 5.0, "steady driving")
        with peer.deaf():
            begun, known = time.monotonic(), len(peer.lines)
            until(lambda: time.monotonic() > begun + 1.0, 5.0, "a second")
        until(lambda: len(peer.lines) > known, 5.0, "it reads again")
        end = peer.lines[known].at
        until(lambda: peer.lines[-1].at > end + 0.005, 5.0, "it has read what waited")
        lines = [entry.line for entry in peer.lines[known:] if entry.at < end + 0.005]
    drive = [line for line in lines if line != ZERO_LINE]
    first_zero = lines.index(ZERO_LINE)
    assert set(lines[first_zero:]) == {ZERO_LINE}
    assert len(drive) <= 10 + 2  # it is quiet after ten periods
    assert len(lines) - first_zero <= 10 * (end - begun) + 2  # zeros at 10 Hz


@contextmanager
def stalled(daemon: Daemon) -> Iterator[None]:
    """Stop the whole daemon process while the body runs."""
    daemon.signal(signal.SIGSTOP)
    try:
        yield
    finally:
        daemon.signal(signal.SIGCONT)


def no_burst(lines: list[ReceivedLine]) -> None:
    """Check that no tenth of a second has more lines than two or three above the control rate.

    More are allowed if the machine was busy, because the kernel's thread for the pty may deliver
    several lines at once. The line that waited longest was written that much earlier.
    """
    for first in lines:
        count = sum(first.at <= entry.at < first.at + 0.1 for entry in lines)
        if count > 14:
            assert count <= 16 + round(3 * lost(first.at - 0.5, first.at + 0.1) / TICK_S)


@pytest.mark.parametrize("gone", [True, False], ids=["has gone", "goes on"])
def test_after_a_stall_no_speed_is_resumed_and_no_line_comes_in_a_burst(
    far: tuple[FarPeer, Daemon], gone: bool
) -> None:
    """Half a second for a commander that has gone. One that goes on must be neutral first.

    A stall is shorter than the 2 s after which clients give the daemon up and reconnect.
    """
    peer, daemon = far
    with commander(daemon, 0.3) as driver:
        drives(peer, driver, 0.3)
        with stalled(daemon):
            begun, count = time.monotonic(), len(driver.out)
            until(lambda: len(driver.out) >= count + 3, 5.0, "commands pile up")
            if gone:
                driver.signal(signal.SIGKILL)
                driver.ended(5.0)
            until(lambda: time.monotonic() > begun + (0.5 if gone else 1.2), 5.0, "its time")
            woken = time.monotonic()
        until(lambda: len(peer.since(woken)) > 30, 5.0, "30 lines")
        no_burst(peer.since(woken))
        assert {entry.line for entry in peer.since(woken)} == {ZERO_TEXT}
        if not gone:
            with Bus(daemon.endpoint) as bus:
                until(lambda: bus.state()["code"] == "neutral", 5.0, "what it waits for")
            driver.signal(signal.SIGUSR1)
            peer.awaits(text(0.3), after=woken)
