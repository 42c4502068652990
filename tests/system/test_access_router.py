"""Stories of the router of deploy/zenoh with two robots, and its files.

The router is the Zenoh library in router mode with router.json5. Only addresses and files differ,
and a few lines of code replace the storage plugin. `test_access.py` tries the permissions.
"""

from __future__ import annotations

import signal
import time
from collections.abc import Iterator

import pytest

from acsard.core.config.contradictions import warnings
from acsard.core.config.parsing import parse
from tests.permissions import TWIST
from tests.system.fleet_router import ROBOT_FILE, Fleet
from tests.system.harness import Bus, until

pytestmark = pytest.mark.network

ONE, TWO = "acsard/robot1", "acsard/robot2"


@pytest.fixture(scope="module")
def fleet(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Fleet]:
    with Fleet(tmp_path_factory.mktemp("fleet")) as fleet:
        yield fleet


def test_on_a_robot_that_is_a_peer_programs_need_no_router_and_reach_no_other_robot(
    fleet: Fleet,
) -> None:
    first, two = fleet.robots
    with Bus(fleet.daemons[1].endpoint, "robot2") as here, here.commanding(0.1):
        until(lambda: (here.state()["linear"] or 0.0) > 0.05, 3.0, "robot2 drives")
        before = first.count("commands")
        for key in ("cmd/app", "stop"):
            here.session.put(f"{ONE}/{key}", TWIST)
        replies = here.session.get(f"{ONE}/srv/stop", timeout=5.0)
        # On a busy machine Zenoh itself ends a query that nobody answers, with this error.
        assert {b"Timeout"} >= {
            (reply.ok or reply.err).payload.to_bytes()  # type: ignore[union-attr]
            for reply in replies
        }
        two.ask("info")
        sent = first.count("lines_sent")
        until(lambda: first.count("lines_sent") > sent + 5, 5.0, "five periods")
        first.comes_to("ready")
        assert first.count("commands") == before
    two.at_rest()


@pytest.mark.nightly
@pytest.mark.parametrize("key", ["stop", "srv/stop"])
def test_a_stop_that_a_stalled_robot_reads_late_is_obeyed(fleet: Fleet, key: str) -> None:
    daemon, robot = fleet.daemons[0], fleet.robots[0]
    with fleet.member("viewer") as viewer, robot.commanding(0.1):
        until(lambda: robot.state()["mode"] == "driving", 3.0, "robot1 drives")
        daemon.signal(signal.SIGSTOP)
        try:
            if key == "stop":
                viewer.put(key, {})
            else:
                replies = viewer.session.get(f"{ONE}/{key}", timeout=10.0)
            time.sleep(4.0)
        finally:
            daemon.signal(signal.SIGCONT)
        until(lambda: robot.state()["mode"] == "stopped", 3.0, "robot1 is stopped")
        robot.stands()
        assert [cause["code"] for cause in robot.state()["causes"]] == ["stopped"]
        if key != "stop":
            assert [reply.ok is not None for reply in replies] == [True]
    assert robot.get("srv/clear")["success"]
    robot.at_rest()


# the files


def test_the_robot_configuration_of_the_manual_is_valid_without_warnings() -> None:
    config = parse(ROBOT_FILE.read_bytes())
    assert not warnings(config)
    assert config.bus.mode == "client"
    router = config.bus.connect[0].removeprefix("tls/").partition(":")[0]
    assert config.access.maintainers == (router,)  # `tls add NAME` makes it valid for that name
