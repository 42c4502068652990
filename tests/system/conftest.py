"""Fixtures of the system tests."""

from __future__ import annotations

import importlib.util
from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import pytest

from acsard.machine.authority import Authority
from tests.system.browser import NAME, Page
from tests.system.builds import ros2dds_bridge
from tests.system.bystander import standing_by
from tests.system.chromium import PHONE, Browser, browsing
from tests.system.fast_dds import python_with_rclpy
from tests.system.harness import Bus, Daemon, Peer, until
from tests.system.hosts import Hosts, two_hosts
from tests.system.phone_page import Phone, Robot, running

if TYPE_CHECKING:
    from tests.system.dds import DdsDomain, NewDomain


@pytest.fixture(scope="session", autouse=True)
def bystander() -> Iterator[None]:
    """Run a bystander during the whole session, so that `bystander.lost` works."""
    with standing_by():
        yield


@pytest.fixture(scope="session")
def kept(request: pytest.FixtureRequest) -> Path:
    """Return a directory for builds that take long. It outlives the test run."""
    cache = request.config.cache
    assert cache is not None
    return Path(cache.mkdir("languages"))


@pytest.fixture(scope="session")
def dds(kept: Path) -> NewDomain:
    """Return a function that creates a DDS domain with bridges. Its argument is a directory."""
    # A test of the mark `bridge` was asked for by its name, so what it lacks is a failure.
    if importlib.util.find_spec("cyclonedds") is None:
        pytest.fail("no Cyclone DDS for Python: .venv/bin/pip install -e '.[test,dds]'")
    from tests.system.dds import DdsDomain

    return partial(DdsDomain, ros2dds_bridge(kept))


@pytest.fixture(scope="session")
def rclpy(kept: Path) -> str:
    """Return a Python with rclpy on Fast DDS. The first run installs it."""
    return python_with_rclpy(kept)


@pytest.fixture(scope="module")
def shared(
    request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[Daemon]:
    """A daemon on the simulator for all tests of a module, with the module's `CONFIG`, if any."""
    config = getattr(request.module, "CONFIG", None)
    with Daemon(tmp_path_factory.mktemp("shared"), config=config) as daemon:
        yield daemon


@pytest.fixture(scope="module")
def domain(
    shared: Daemon, dds: NewDomain, tmp_path_factory: pytest.TempPathFactory
) -> Iterator[DdsDomain]:
    """A DDS domain with a bridge to `shared`."""
    with dds(tmp_path_factory.mktemp("dds")) as domain, domain.bridge(shared.endpoint):
        yield domain


@pytest.fixture
def bus(shared: Daemon) -> Iterator[Bus]:
    """A plain client of `shared`, with the link up."""
    with Bus(shared.endpoint) as bus:
        # A query is faster than waiting for `state`, whose next message may be 0.1 s away.
        until(lambda: bus.state()["link"] == "up", 5.0, "link up")
        yield bus


@pytest.fixture
def peer(tmp_path: Path) -> Iterator[Peer]:
    """A simulated board on a pty, independent of acsard's simulator, at `tmp_path/mcu`."""
    with Peer(tmp_path / "mcu") as peer:
        yield peer


@pytest.fixture(scope="module")
def hosts() -> Iterator[Hosts]:
    """The robot's host and another one. Skips if the machine does not allow namespaces."""
    yield from two_hosts()


@pytest.fixture(scope="module")
def daemon(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Daemon]:
    """A daemon on the simulator that records, for the tests of its page."""
    where = tmp_path_factory.mktemp("daemon")
    with Daemon(where, config={"record": {"directory": str(where / "record")}}) as daemon:
        yield daemon


@pytest.fixture(scope="module")
def page(daemon: Daemon, tmp_path_factory: pytest.TempPathFactory) -> Iterator[Page]:
    """The page of `daemon`, over HTTP here and over HTTPS for other hosts."""
    where = tmp_path_factory.mktemp("page")
    Authority.make(where / "tls", "test", 1, [NAME]).issue(where / "tls", "robot", [NAME], 1)
    with Page(daemon, where) as page:
        yield page


@pytest.fixture
def standing(daemon: Daemon) -> Iterator[Bus]:
    """A Zenoh client of `daemon`, whose robot is ready and at rest."""
    with Bus(daemon.endpoint) as bus:
        bus.ask("srv/clear")
        bus.at_rest()
        yield bus


@pytest.fixture(scope="module")
def browser() -> Iterator[Browser]:
    with browsing() as browser:
        yield browser


@pytest.fixture(scope="module")
def common_robot(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Robot]:
    """The robot for all tests that change only its latch. Starting it takes 1 s."""
    with running(tmp_path_factory.mktemp("common")) as robot:
        yield robot


@pytest.fixture
def own_robot(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[Robot]:
    """Run a new robot. A test may choose its configuration as the parameter of this fixture."""
    with running(tmp_path, getattr(request, "param", None)) as robot:
        yield robot


@pytest.fixture
def phone(request: pytest.FixtureRequest, browser: Browser) -> Iterator[Phone]:
    """The newly opened page of a robot that is at rest and may be driven."""
    own = "own_robot" in request.fixturenames
    robot: Robot = request.getfixturevalue("own_robot" if own else "common_robot")
    phone = Phone(*robot, browser)
    robot.bus.ask("srv/clear")
    robot.bus.ask("srv/activate")
    robot.bus.at_rest()
    browser.size(*PHONE)
    browser.said.clear()
    browser.open(robot.server.here)
    phone.shows("mode", "READY")
    phone.shows("age", "live")
    yield phone
    browser.lift()
    browser.open("about:blank")
