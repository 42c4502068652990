"""A real daemon ends in every way and starts again while a commander sends without a pause.

The commander sends zeros for 0.3 s every second and a speed in between. It therefore arms itself
after every start, and only a latch prevents the robot from driving. `tests/systemd` tests the ways
to end that need systemd.
"""

from __future__ import annotations

import json
import signal
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any, Literal, NamedTuple

import pytest

from tests.system.harness import (
    ROOT,
    ZERO_LINE,
    Bus,
    Daemon,
    Peer,
    Program,
    acsard,
    environment,
    finish,
    free_endpoint,
    plain_reply,
    running,
    until,
    write_config,
)
from tests.system.strangers import STOP_AND_GO, command_line

Kind = Literal["stop", "fault", "inactive"]
Way = Literal["kill", "crash", "abort", "term"]

MODES = {"stop": "stopped", "fault": "fault", "inactive": "inactive"}

CYCLE_S = 1.0
"""Time in which the commander sends its zeros once and then a speed."""

CRASH = """\
import os, signal
from acsard.core.robot import Robot
whole, crashes = Robot.hear, []
signal.signal(signal.SIGUSR2, lambda *_: crashes.append(1))
def hear(robot, now, heard):
    news = whole(robot, now, heard)
    if crashes:
        raise ZeroDivisionError("a bug")
    return news
Robot.hear = hear
"""
"""Put into the daemon: SIGUSR2 makes the next control step raise an exception."""

SIGNALS = {
    "kill": signal.SIGKILL,
    "crash": signal.SIGUSR2,
    "abort": signal.SIGABRT,
    "term": signal.SIGTERM,
}


class Robot(NamedTuple):
    """A board, an endpoint and a directory that all daemons of a test use one after the other."""

    where: Path
    peer: Peer
    endpoint: str
    env: dict[str, str]

    def daemon(self) -> Daemon:
        return Daemon(self.where, self.peer.path, endpoint=self.endpoint, env=self.env)

    @property
    def file(self) -> Path:
        return self.where / "daemon.states" / "acsar.latches.json"

    def moved(self, since: float) -> bool:
        """Return whether a line after the time `since` turns a wheel."""
        lines = (entry for session in self.peer.sessions for entry in list(session.lines))
        return any(entry.at > since and entry.line.strip(b"\r\n") not in STILL for entry in lines)


STILL = (ZERO_LINE.strip(b"\r\n"), b"")


@pytest.fixture
def robot(tmp_path: Path, peer: Peer) -> Iterator[Robot]:
    """Provide a board and a stop-and-go commander that run on while daemons end and start."""
    (bug := tmp_path / "bug").mkdir()
    (bug / "sitecustomize.py").write_text(CRASH)
    endpoint = free_endpoint()
    with Program(command_line(STOP_AND_GO, endpoint), tmp_path):
        yield Robot(tmp_path, peer, endpoint, environment(PYTHONPATH=f"{bug}:{ROOT}"))


def drives(robot: Robot, bus: Bus) -> None:
    """Wait until the commander drives the robot. A latch would prevent this."""
    since = time.monotonic()
    until(lambda: robot.moved(since), 2 * CYCLE_S, "the commander drives")


def latch(robot: Robot, bus: Bus, kind: Kind) -> None:
    match kind:
        case "stop":
            assert bus.get("srv/stop")["success"]
        case "inactive":
            assert bus.get("srv/deactivate")["success"]
        case "fault":
            robot.peer.reply = lambda speeds: plain_reply((99.0, 99.0, 99.0, 99.0))
            until(lambda: bus.state()["mode"] == "fault", 5.0, "a fault")
            robot.peer.reply = plain_reply
            # The fault has no caller, so no answer waits for the file.
            until(lambda: is_latched(robot, kind), 1.0, "the fault is in the file")


def is_latched(robot: Robot, kind: Kind) -> bool:
    """Return whether the latch file contains a cause of this kind."""
    causes = json.loads(robot.file.read_bytes())["causes"]
    return kind in [cause["kind"] for cause in causes]


def check_at_rest(robot: Robot, bus: Bus, mode: str, since: float) -> Any:
    """Wait for one and a half cycles of the commander, and check that the robot stood in this mode.

    Returns the last state.
    """
    bus.linked()
    linked = time.monotonic()
    until(lambda: time.monotonic() > linked + 1.5 * CYCLE_S, 1.5 * CYCLE_S, "the time is over")
    state = bus.state()
    assert not robot.moved(since), (mode, state)
    assert state["mode"] == mode, state
    return state


def release(bus: Bus, kind: Kind) -> None:
    """Release a latch of this kind.

    After a stop or a fault a second release is answered with "nothing to clear".
    """
    if kind == "inactive":
        assert bus.get("srv/activate")["success"]
        return
    numbers = [cause["number"] for cause in bus.state()["causes"]]
    assert bus.get("srv/clear", {"numbers": numbers})["success"]
    assert bus.get("srv/clear")["success"]


def check_and_release_latch(robot: Robot, bus: Bus, before: End, since: float) -> None:
    """Check that the latch of the previous daemon still stops the robot, and release it."""
    state = check_at_rest(robot, bus, MODES[before.kind], since)
    assert "before the restart" in state["reason"]
    release(bus, before.kind)


def restarted(robot: Robot, *ends: End) -> None:
    """Run one daemon for each `End`: latch the robot, and end the daemon.

    Each next daemon must find that latch. The robot drives again after its release.
    """
    before: End | None = None
    for end in (*ends, None):
        started = time.monotonic()
        with robot.daemon() as daemon, Bus(robot.endpoint) as bus:
            if before:
                check_and_release_latch(robot, bus, before, started)
            else:
                bus.linked()
            drives(robot, bus)
            if end:
                latch(robot, bus, end.kind)
            daemon.signal(SIGNALS[end.way if end else "kill"])
            assert (daemon.ended(5.0) == 0) is (end is not None and end.way == "term")
        if end:
            assert is_latched(robot, end.kind), end
        before = end
    with robot.daemon(), Bus(robot.endpoint) as bus:
        bus.linked()
        drives(robot, bus)


class End(NamedTuple):
    """How one daemon ends: the kind of its latch, and the signal."""

    kind: Kind
    way: Way


@pytest.mark.slow
def test_a_latched_robot_stays_at_rest_after_each_restart_until_it_is_released(
    robot: Robot,
) -> None:
    restarted(robot, End("stop", "kill"), End("fault", "crash"), End("inactive", "abort"))


SLOW_DISK = """\
import os, time
replace = os.replace
def slow(source, target):
    if os.path.exists(os.environ["SLOW"]):
        time.sleep(0.5)
    replace(source, target)
os.replace = slow
"""
"""Put into the daemon: while the file $SLOW exists, each replacement of a file takes 0.5 s."""


@pytest.mark.nightly
@pytest.mark.slow
def test_the_answer_of_a_stop_says_that_a_slow_disk_has_not_stored_it_yet(
    tmp_path: Path, peer: Peer
) -> None:
    (disk := tmp_path / "disk").mkdir()
    (disk / "sitecustomize.py").write_text(SLOW_DISK)
    slow = tmp_path / "slow"
    env = environment(PYTHONPATH=f"{disk}:{ROOT}", SLOW=str(slow))
    with Daemon(tmp_path, peer.path, env=env) as daemon, Bus(daemon.endpoint) as bus:
        bus.linked()
        slow.touch()
        answer = bus.get("srv/stop")
        assert answer["success"]
        assert "not on the disk yet" in answer["message"]
        slow.unlink()
        file = daemon.states / "acsar.latches.json"
        until(lambda: "stopped by" in file.read_text(), 5.0, "the disk has the stop")
        assert "not on the disk yet" not in bus.get("srv/stop")["message"]


@pytest.mark.slow
def test_a_state_directory_that_takes_no_file_starts_the_robot_stopped_and_says_so(
    tmp_path: Path, peer: Peer
) -> None:
    config = {"control": {"state_directory": "/sys/acsard"}}
    with running(tmp_path, peer.path, config) as (daemon, bus):
        state = bus.state()
        assert state["mode"] == "stopped"
        assert "a stop would not survive a restart: the latch file (/sys/acsard/" in state["reason"]
        assert state["latch_file_error"].startswith("a stop would not survive")
        until(lambda: daemon.events("latch_file"), 5.0, "the log says so")
        release(bus, "stop")
        bus.comes_to("ready")


@pytest.mark.slow
def test_a_second_daemon_of_the_same_robot_on_another_bus_ends_with_75(
    tmp_path: Path, peer: Peer
) -> None:
    with Daemon(tmp_path, peer.path) as daemon, Peer(tmp_path / "other") as other:
        tables: dict[str, dict[str, object]] = {
            "mcu": {"port": str(other.path)},
            "bus": {"listen": [free_endpoint()]},
            "control": {"state_directory": str(daemon.states)},
        }
        path = write_config(tmp_path / "second.toml", tables)
        second = finish(acsard("run", "--config", str(path)), tmp_path)
    assert second.code == 75
    assert "another daemon stores the stop of robot acsar" in second.err


@pytest.mark.slow
def test_the_built_in_simulator_keeps_no_latch_over_a_restart(tmp_path: Path) -> None:
    states = {"control": {"state_directory": str(tmp_path / "states")}}
    with Daemon(tmp_path, config=states) as daemon, Bus(daemon.endpoint) as bus:
        assert bus.get("srv/stop")["success"]
    with Daemon(tmp_path, config=states) as daemon, Bus(daemon.endpoint) as bus:
        until(lambda: bus.state()["mode"] == "ready", 5.0, "ready")
    assert not (tmp_path / "states").exists()
