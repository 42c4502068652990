"""One booted systemd for all tests of this directory, with a board, a commander and the unit."""

from __future__ import annotations

import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from tests.systemd.container import (
    PORT,
    Board,
    Container,
    Driver,
    unavailable,
)
from tests.systemd.image import UnavailableError, build, needs


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give each test of this directory a timeout that includes the making of the container.

    The first test makes it. If its time ran out there, all later tests would fail too.
    """
    for item in items:
        ours = item.path.is_relative_to(Path(__file__).parent)
        if ours and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(600))


@pytest.fixture(scope="session")
def rootfs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """Provide the root file system of a small Debian.

    It is kept in $ACSARD_TEST_ROOTFS if this variable is set. Otherwise it is temporary.
    """
    missing = needs()
    if missing:
        unavailable(missing)
    directory = os.environ.get("ACSARD_TEST_ROOTFS")
    where = Path(directory) if directory else tmp_path_factory.mktemp("debian") / "rootfs"
    try:
        yield build(where)
    except UnavailableError as why:
        unavailable(f"cannot make a root file system: {why}")
    finally:
        if not directory:
            shutil.rmtree(where, ignore_errors=True)


@pytest.fixture(scope="session")
def booted(rootfs: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Container]:
    """A systemd with the program and the unit installed."""
    with Container(rootfs, tmp_path_factory.mktemp("container")) as container:
        container.install()
        yield container


@pytest.fixture
def container(booted: Container) -> Iterator[Container]:
    """Provide the systemd with a stopped unit, its usual configuration and no failed units."""
    booted.reset()
    yield booted
    booted.reset()


@pytest.fixture
def board(container: Container) -> Iterator[Board]:
    """Provide a simulated board at the configured serial port, with reliable timestamps."""
    with Board(container) as board:
        yield board
    container.path(PORT).unlink(missing_ok=True)


@pytest.fixture
def driver(container: Container) -> Iterator[Driver]:
    """A client of the bus inside the container, which sends zeros until a test sets a speed."""
    with Driver(container) as driver:
        yield driver
