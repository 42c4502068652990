"""One booted systemd for all tests here, and in it a board, a commander and the unit."""

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
    UnavailableError,
    build,
    needs,
    unavailable,
)


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Give each test here the time in which a busy machine makes the container.

    The first test makes it. If that took too long, all tests would fail with the first.
    """
    for item in items:
        ours = item.path.is_relative_to(Path(__file__).parent)
        if ours and not item.get_closest_marker("timeout"):
            item.add_marker(pytest.mark.timeout(600))


@pytest.fixture(scope="session")
def rootfs(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Path]:
    """A small Debian: kept where $ACSARD_TEST_ROOTFS says, else made and removed again."""
    missing = needs()
    if missing:
        unavailable(missing)
    kept = os.environ.get("ACSARD_TEST_ROOTFS")
    where = Path(kept) if kept else tmp_path_factory.mktemp("debian") / "rootfs"
    try:
        yield build(where)
    except UnavailableError as why:
        unavailable(f"cannot make a root file system: {why}")
    finally:
        if not kept:
            shutil.rmtree(where, ignore_errors=True)


@pytest.fixture(scope="session")
def booted(rootfs: Path, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Container]:
    """A systemd with the program and the unit installed."""
    try:
        container = Container(rootfs, tmp_path_factory.mktemp("container"))
        with container:
            container.install()
            yield container
    except UnavailableError as why:
        unavailable(why)


@pytest.fixture
def container(booted: Container) -> Iterator[Container]:
    """That systemd with the unit stopped, its usual configuration and no record of failures."""
    booted.reset()
    yield booted
    booted.reset()


@pytest.fixture
def board(container: Container) -> Iterator[Board]:
    """A serial board at the configured port, whose times are reliable."""
    with Board(container) as board:
        yield board
    container.path(PORT).unlink(missing_ok=True)


@pytest.fixture
def driver(container: Container) -> Iterator[Driver]:
    """A client of the bus inside the container, which sends zeros until a test sets a speed."""
    with Driver(container) as driver:
        yield driver
