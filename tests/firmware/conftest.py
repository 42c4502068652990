"""Fixtures: the firmware, its library and the simulator, each built once per session."""

from __future__ import annotations

import ctypes
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest

from tests.firmware.board import (
    Board,
    Host,
    build_firmware,
    build_library,
    build_runner,
    build_sketch,
    missing,
)
from tests.system.harness import until

FREE_SPEEDS = "50,45,55,48"
"""Free speeds in rad/s: no motor is as the firmware's constants say."""

ALL_INPUTS = (
    "-DESTOP_INPUT=1", "-DBUMPER_INPUTS=4", "-DDRIVER_INPUT=1", "-DBATTERY_TOP_OHM=56000L",
    "-DCURRENT_UV_PER_A=40000L",
)  # fmt: skip
"""Definitions of a build with every input."""

ESTOP, BUMPERS, DRIVER = 37, (36, 35, 34, 33), 32
"""Pins of the Mega."""

BATTERY, CURRENT = 0, 1
"""Analog pins of the Mega."""


@contextmanager
def wired_board(runner: Path, wired: dict[int, Path], baud: int = 115200) -> Iterator[Board]:
    """Run a board that has every input, a battery of 24 V and a current of 0 A.

    The body runs after the board has reported that the emergency stop is not pressed.
    """
    with Board(runner, wired[baud], "--baud", str(baud)) as board:
        for pin in (ESTOP, *BUMPERS):
            board.command(f"contact {pin} closed")
        board.command(f"analog {BATTERY} 3636")
        board.command(f"analog {CURRENT} 2500")
        until(lambda: " estop=ok" in board.status().from_board.last, 5.0, "it is released")
        yield board


@pytest.fixture(scope="session")
def library(tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """The hardware-independent part of the firmware, compiled for this machine."""
    lacking = [tool for tool in ("make", "gcc") if shutil.which(tool) is None]
    if lacking:
        pytest.skip(f"no {' and no '.join(lacking)}")
    return ctypes.CDLL(str(build_library(tmp_path_factory.mktemp("host"))))


@pytest.fixture(scope="session")
def coarse_library(library: ctypes.CDLL, tmp_path_factory: pytest.TempPathFactory) -> ctypes.CDLL:
    """The same library for an encoder with 96 counts per turn.

    The definition is a product (`2 * 4 * 12`), as a user may write it.
    """
    where = tmp_path_factory.mktemp("coarse")
    return ctypes.CDLL(str(build_library(where, "'-DCOUNTS_PER_TURN=2 * 4 * 12'")))


@pytest.fixture(scope="session")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The firmware's ELF file, built with the default settings."""
    lacking = missing()
    if lacking:
        pytest.skip(lacking)
    return build_firmware(tmp_path_factory.mktemp("firmware"))


@pytest.fixture(scope="session")
def sketch(firmware: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ELF file of the Arduino sketch."""
    return build_sketch(tmp_path_factory.mktemp("sketch"))


@pytest.fixture(scope="session")
def wired_sketch(firmware: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ELF file of the sketch with an emergency stop."""
    return build_sketch(tmp_path_factory.mktemp("wired"), ("ESTOP = -1", f"ESTOP = {ESTOP}"))


@pytest.fixture(scope="session")
def hanging_firmware(firmware: Path, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The ELF file of a firmware with test code: on a command its main loop hangs."""
    return build_firmware(tmp_path_factory.mktemp("hanging"), "-DTEST_HANG")


@pytest.fixture(scope="session")
def wired(firmware: Path, tmp_path_factory: pytest.TempPathFactory) -> dict[int, Path]:
    """The ELF files of the firmware with every input, by baud rate."""
    return {
        baud: build_firmware(
            tmp_path_factory.mktemp(f"wired_{baud}"), *ALL_INPUTS, f"-DBAUD_RATE={baud}UL"
        )
        for baud in (115200, 9600)
    }


@pytest.fixture(scope="session")
def runner(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The program that simulates the board."""
    lacking = missing()
    if lacking:
        pytest.skip(lacking)
    return build_runner(tmp_path_factory.mktemp("runner"))


@pytest.fixture
def board(runner: Path, firmware: Path) -> Iterator[Board]:
    """A simulated board that has just booted. Its four motors have different free speeds."""
    with Board(runner, firmware, "--free-speed", FREE_SPEEDS) as board:
        yield board


@pytest.fixture
def host(board: Board) -> Iterator[Host]:
    """A test program at the serial port of `board`."""
    with Host(board.path, board) as host:
        yield host


@pytest.fixture
def in_steps(board: Board) -> Iterator[None]:
    """Let the simulated time of `board` pass only when the test program waits."""
    with board.in_steps():
        yield
