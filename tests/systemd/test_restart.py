"""A latched robot stands until its release, however systemd ends and restarts the unit.

A commander sends zeros for 0.3 s every second and a speed in between. It therefore arms itself, and
only the latch prevents the robot from driving.
"""

from __future__ import annotations

import os
import signal
import time
from contextlib import ExitStack
from pathlib import Path

import pytest

from tests.system.harness import until
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
)

pytestmark = pytest.mark.systemd

CYCLE_S = 1.0
FILE = f"{STATES}/acsard/acsar.latches.json"
MODES = {"stop": "stopped", "fault": "fault", "deactivate": "inactive"}
ENDS = {"kill": "fault", "watchdog": "stop", "restart": "deactivate"}
"""How the unit ends, and what has latched the robot before."""


def moves(board: Board, since: float) -> bool:
    return any(entry.line not in (ZERO, b"-") for entry in board.since(since))


def drives(board: Board) -> None:
    since = time.monotonic()
    until(lambda: moves(board, since), 3 * CYCLE_S, "the commander drives")


def has_mode(driver: Driver, mode: str) -> None:
    since = time.monotonic()
    until(lambda: mode in [now for _, now in driver.states(since)], 5.0, f"mode {mode}")


def call(container: Container, verb: str) -> None:
    done = container.run(ACSARD, "call", verb)
    assert done.code == 0, done.err


def latch(container: Container, board: Board, driver: Driver, cause: str) -> float:
    """Latch the robot while it drives. Return the time of the first zero line, when it stands."""
    if cause == "fault":
        container.write(LIES, "")
        has_mode(driver, "fault")
        container.path(LIES).unlink()
    else:
        call(container, cause)
    has_mode(driver, MODES[cause])
    # The ramp to zero only falls: from its first zero line on the robot stands.
    return board.awaits(ZERO, after=time.monotonic()).at


def check_at_rest(
    container: Container, board: Board, driver: Driver, cause: str, since: float
) -> None:
    """Check that the robot stands although the commander has tried to drive it."""
    has_mode(driver, MODES[cause])
    time.sleep(2 * CYCLE_S)
    assert not moves(board, since)
    assert "before the restart" in container.show("StatusText")


def end(container: Container, how: str) -> None:
    container.run("systemctl", "reset-failed", UNIT)  # the start limit has a test of its own
    if how == "restart":
        assert container.run("systemctl", "restart", UNIT).code == 0
        return
    restarts = int(container.show("NRestarts"))
    os.kill(container.main_pid(), signal.SIGKILL if how == "kill" else signal.SIGSTOP)
    container.is_active_again(restarts)


def test_a_latched_robot_stays_at_rest_after_each_end_of_the_unit_until_it_is_released(
    container: Container, board: Board, driver: Driver
) -> None:
    assert container.start().code == 0
    owner = container.run("stat", "-c", "%u", f"{STATES}/acsard").out.strip()
    assert container.run("stat", "-c", "%u %a", FILE).out.split() == [owner, "644"]
    driver.patrols()
    for how, cause in ENDS.items():
        drives(board)
        since = latch(container, board, driver, cause)
        end(container, how)
        check_at_rest(container, board, driver, cause, since)
        call(container, "activate" if cause == "deactivate" else "clear")
    drives(board)


def test_a_stopped_robot_stays_at_rest_after_a_reboot_until_it_is_released(
    rootfs: Path, tmp_path: Path
) -> None:
    (keeps := tmp_path / "states").mkdir(mode=0o700)
    for boot in (1, 2):
        (scratch := tmp_path / str(boot)).mkdir()
        with ExitStack() as stack:
            made = Container(rootfs, scratch, "acsard-reboot", keeps)
            container = stack.enter_context(made)
            container.install()
            container.write(CONFIG, USUAL)
            board = stack.enter_context(Board(container))
            driver = stack.enter_context(Driver(container))
            driver.patrols()
            since = time.monotonic()
            assert container.start().code == 0
            if boot == 2:
                check_at_rest(container, board, driver, "stop", since)
                call(container, "clear")
            drives(board)
            latch(container, board, driver, "stop")
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
