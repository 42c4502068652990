"""The log of the real process names each caller, and each change with its reason.

It also reports how the process started and ended.
"""

from __future__ import annotations

import os
import re
import signal
import subprocess
from pathlib import Path
from typing import Any

import pytest

from acsard.bus import robot_discovery
from acsard.bus.address import Address
from acsard.client import connect
from acsard.client.connection import open_connection
from acsard.host.own_identity import own_name
from acsard.host.version import version
from tests.system.harness import Bus, Daemon, Peer, acsard, running, until


def by(daemon: Daemon, name: str) -> list[Any]:
    return [line["by"] for line in daemon.events(name)]


def test_the_log_names_the_client_of_each_call_by_its_own_name(shared: Daemon, bus: Bus) -> None:
    with connect(shared.endpoint) as robot:
        robot.call("set_pose", x=1.0, y=0.0, yaw=0.0)
        robot.name = "patrol \x1b[2J(native)"
        robot.call("stop")
    call = acsard("call", "clear", "--connect", shared.endpoint)
    subprocess.run(call, check=True, capture_output=True)
    bus.ask("srv/deactivate")
    until(lambda: shared.events("deactivate"), 5.0, "the last call is in the log")
    (pose,), (stop,), (clear,) = (by(shared, name) for name in ("set_pose", "stop", "clear"))
    me = f"@{os.uname().nodename.partition('.')[0]}"
    assert me in own_name()
    assert re.fullmatch(rf"{re.escape(own_name())}/[0-9a-f]{{16}} \(native\)", pose)
    assert re.fullmatch(r"patrol \?\?2J\?native\?/[0-9a-f]{16} \(native\)", stop)
    assert re.search(rf"{me} acsard call/[0-9a-f]{{16}} \(native\)$", clear)
    assert by(shared, "deactivate") == ["unnamed (native)"]


def test_one_program_that_puts_on_stop_and_calls_it_has_one_name(shared: Daemon, bus: Bus) -> None:
    stops = len(shared.events("stop"))
    with open_connection(Address(shared.endpoint, "acsar", "")) as robot:
        robot_discovery.stop(robot.session, ["acsar"], robot.caller)
        # Two stops that one step of a busy daemon reads are one event.
        until(lambda: len(shared.events("stop")) == stops + 1, 5.0, "the first is in the log")
        robot.call("stop")
        until(lambda: len(shared.events("stop")) == stops + 2, 5.0, "both stops are in the log")
        (name,) = {line["by"] for line in shared.events("stop")[stops:]}
        assert bus.state()["reason"].count(f"stopped by {name}") == 1
        robot.call("clear")


@pytest.mark.slow
def test_the_log_describes_a_run_from_its_start_to_its_totals(tmp_path: Path, peer: Peer) -> None:
    with running(tmp_path, peer.path) as (daemon, bus):
        bus.put("cmd/app", {"linear": {"x": 0.5}})
        with bus.commanding(0.5):
            until(lambda: peer.lines[-1].line.startswith(b"ap10.00"), 5.0, "steady driving")
        bus.ask("srv/stop")
        until(lambda: daemon.events("command_refused"), 5.0, "what was refused is in the log")
        daemon.signal(signal.SIGTERM)
        assert daemon.ended(5.0) == 0
        (started,), (ended,) = daemon.events("started"), daemon.events("ended")
        modes = [line["text"].partition(":")[0] for line in daemon.events("mode")]
        (commander,), (refused,) = daemon.events("commander"), daemon.events("command_refused")
        last = daemon.err[-1]
    assert (started["version"], started["robot"]) == (version(), "acsar")
    assert (started["port"], started["rate"]) == (str(peer.path), 100.0)
    assert modes[:2] == ["waiting -> ready", "ready -> driving"]
    assert modes[-2] in ("driving -> stopped", "ready -> stopped")
    assert modes[-1] == "stopped -> shutdown"
    assert commander["text"].startswith("no sender -> app (")
    assert refused["text"].startswith("wrong_shape: cmd/app: the message needs both")
    assert refused["level"] == "warning"
    assert '"ended"' in last
    assert ended["seconds"] > 0.1
    assert ended["metres"] > 0.01
    assert ended["lines_sent"] > 10
    assert ended["commands"] > 3
    assert ended["command_wrong_shape"] == 1
