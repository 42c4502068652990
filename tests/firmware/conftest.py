"""Fixtures: the firmware, its library and the simulator, each built once per session."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from functools import cache
from pathlib import Path

import pytest

from tests.firmware.board import (
    Board,
    Chip,
    Host,
    Library,
    build_core,
    build_firmware,
    build_runner,
    build_sketch,
    missing,
)

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


def wire(board: Board) -> None:
    """Connect every input: closed contacts, a battery of 24 V and a current of 0 A."""
    for pin in (ESTOP, *BUMPERS):
        board.command(f"contact {pin} closed")
    board.command(f"analog {BATTERY} 3636")
    board.command(f"analog {CURRENT} 2500")
    released = " estop=ok"
    board.waits(lambda status: released in status.from_board.last, "the stop is released", 5000.0)


@pytest.fixture(scope="session")
def build(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Library]:
    """Return a function that builds the library with these definitions, once each."""
    lacking = [tool for tool in ("make", "gcc") if shutil.which(tool) is None]
    if lacking:
        pytest.skip(f"no {' and no '.join(lacking)}")
    return cache(lambda *defines: Library(tmp_path_factory.mktemp("host"), *defines))


@pytest.fixture(scope="session")
def library(build: Callable[..., Library]) -> Library:
    """The hardware-independent part of the firmware, with its usual settings."""
    return build()


@pytest.fixture(scope="session")
def coarse_library(build: Callable[..., Library]) -> Library:
    """The same library for an encoder with 96 counts per turn.

    The definition is a product, as a user may write it.
    """
    return build("-DCOUNTS_PER_TURN=2 * 4 * 12")


@pytest.fixture(scope="session")
def firmware(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The firmware's ELF file, built with the default settings."""
    lacking = missing()
    if lacking:
        pytest.skip(lacking)
    return build_firmware(tmp_path_factory.mktemp("firmware"))


@pytest.fixture(scope="session")
def sketch(firmware: Path, tmp_path_factory: pytest.TempPathFactory) -> Callable[..., Path]:
    """Return a function that builds the sketch for a chip, with these changes, once each."""
    core = cache(lambda chip: build_core(tmp_path_factory.mktemp("core"), chip))

    def build(chip: Chip, *changes: tuple[str, str], more: str = "") -> Path:
        where = tmp_path_factory.mktemp(f"sketch_{chip.board}")
        return build_sketch(core(chip), where, chip, *changes, more=more)

    return cache(build)


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
def host(runner: Path, firmware: Path) -> Iterator[Host]:
    """A test program at a board with the C firmware, whose motors have different free speeds."""
    with Board(runner, firmware, "--free-speed", FREE_SPEEDS) as board, Host(board) as host:
        yield host
