"""The log of the real process says how it started, each change with its reason, and its end."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest

from acsard.host.version import version
from tests.system.harness import Peer, running, until


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
