"""A latched robot stands until its release, in whichever way systemd ends and restarts the unit.

A commander sends zeros for 0.3 s every 2 s and a speed in between. It therefore arms itself, and
only the latch prevents the robot from driving.
"""

from __future__ import annotations

import os
import signal
import time
from contextlib import ExitStack
from pathlib import Path
from typing import Literal

import pytest

from tests.system.harness import ReceivedLine, until
from tests.systemd.container import (
    ACSARD,
    CONFIG,
    LIES,
    STATES,
    UNIT,
    USUAL,
    ZERO,
    Board,
    Container,
    Driver,
    UnavailableError,
    unavailable,
)

pytestmark = pytest.mark.systemd

Kind = Literal["stop", "fault", "inactive"]
Way = Literal["kill", "watchdog", "restart"]

MODES = {"stop": "stopped", "fault": "fault", "inactive": "inactive"}

CYCLE_S = 2.0

FILE = f"{STATES}/acsard/acsar.latches.json"


def moves(board: Board, since: float) -> list[ReceivedLine]:
    """Return the lines after this time that turn a wheel."""
    return [entry for entry in board.since(since) if entry.line not in (ZERO, b"-")]


def drives(board: Board) -> None:
    since = time.monotonic()
    until(lambda: moves(board, since), 2 * CYCLE_S, "the commander drives")


def has_mode(driver: Driver, mode: str) -> None:
    since = time.monotonic()
    until(lambda: mode in [now for _, now in driver.states(since)], 5.0, f"mode {mode}")


def call(container: Container, verb: str) -> None:
    done = container.run(ACSARD, "call", verb)
    assert done.code == 0, done.err


def latch(container: Container, board: Board, driver: Driver, kind: Kind) -> float:
    """Latch the robot while it drives. Return the time of the first zero line, when it stands."""
    if kind == "fault":
        container.write(LIES, "")
        has_mode(driver, "fault")
        container.path(LIES).unlink()
    else:
        call(container, "stop" if kind == "stop" else "deactivate")
    has_mode(driver, MODES[kind])
    # The ramp to zero only falls: from its first zero line on the robot stands.
    return board.awaits(ZERO, after=time.monotonic()).at


def check_at_rest(
    container: Container, board: Board, driver: Driver, kind: Kind, since: float
) -> None:
    """Check that the robot stands although the commander has tried to drive it."""
    has_mode(driver, MODES[kind])
    up = time.monotonic()
    until(lambda: time.monotonic() > up + 1.5 * CYCLE_S, 1.5 * CYCLE_S, "the time is over")
    assert not moves(board, since)
    assert "before the restart" in container.show("StatusText")


def end(container: Container, way: Way) -> None:
    container.run("systemctl", "reset-failed", UNIT)  # the start limit has a test of its own
    if way == "restart":
        assert container.run("systemctl", "restart", UNIT).code == 0
        return
    restarts = int(container.show("NRestarts"))
    number = signal.SIGKILL if way == "kill" else signal.SIGSTOP
    os.kill(container.main_pid(), number)
    container.is_active_again(restarts)


@pytest.mark.parametrize(
    ("kind", "way", "times"),
    [
        ("stop", "watchdog", 1),
        pytest.param("fault", "kill", 1, marks=pytest.mark.nightly),
        pytest.param("inactive", "restart", 1, marks=pytest.mark.nightly),
        *(
            pytest.param(kind, way, 8, marks=pytest.mark.soak)
            for kind in MODES
            for way in ("kill", "watchdog", "restart")
        ),
    ],
)
@pytest.mark.timeout(900)
def test_a_latched_robot_stays_at_rest_after_the_unit_ended_until_it_is_released(
    container: Container, board: Board, driver: Driver, kind: Kind, way: Way, times: int
) -> None:
    assert container.start().code == 0
    driver.patrols()
    for _ in range(times):
        drives(board)
        since = latch(container, board, driver, kind)
        end(container, way)
        check_at_rest(container, board, driver, kind, since)
        call(container, "activate" if kind == "inactive" else "clear")
        drives(board)
    end(container, way)
    drives(board)


@pytest.mark.parametrize("kind", ["stop", pytest.param("fault", marks=pytest.mark.soak)])
def test_a_latched_robot_stays_at_rest_after_a_reboot_until_it_is_released(
    rootfs: Path, tmp_path: Path, kind: Kind
) -> None:
    (keeps := tmp_path / "states").mkdir(mode=0o700)
    for boot in (1, 2):
        (scratch := tmp_path / str(boot)).mkdir()
        with ExitStack() as stack:
            try:
                made = Container(rootfs, scratch, "acsard-reboot", keeps)
                container = stack.enter_context(made)
            except UnavailableError as why:
                unavailable(why)
            container.install()
            container.write(CONFIG, USUAL)
            board = stack.enter_context(Board(container))
            driver = stack.enter_context(Driver(container))
            driver.patrols()
            since = time.monotonic()
            assert container.start().code == 0
            if boot == 2:
                check_at_rest(container, board, driver, kind, since)
                call(container, "clear")
            drives(board)
            latch(container, board, driver, kind)
            # It is as if the power failed: the services get no signal to end.
            os.kill(container.main_pid(), signal.SIGKILL)


def test_on_a_read_only_disk_the_robot_starts_stopped_and_clear_releases_it(
    container: Container, board: Board, driver: Driver
) -> None:
    container.drop_in("read-only.conf", f"[Service]\nReadOnlyPaths={STATES}/acsard\n")
    since = time.monotonic()
    assert container.start().code == 0
    driver.patrols()
    has_mode(driver, "stopped")
    assert "Read-only file system" in container.show("StatusText")
    assert not moves(board, since)
    call(container, "clear")
    drives(board)


def test_the_state_file_belongs_to_the_service_s_user_and_root_can_read_it(
    container: Container, board: Board
) -> None:
    assert container.start().code == 0
    owner = container.run("stat", "-c", "%u %a", FILE).out.split()
    directory = container.run("stat", "-c", "%u", f"{STATES}/acsard").out.strip()
    assert owner == [directory, "644"]
