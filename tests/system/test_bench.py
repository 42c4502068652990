"""`acsard bench` on the simulator, and on a port that is not ours."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from tests.system.harness import ZERO_LINE, Daemon, Peer, Program, acsard, finish


def test_it_measures_the_simulator_and_moves_nothing_on_a_real_port(
    tmp_path: Path, peer: Peer
) -> None:
    """Both at once: they share nothing."""
    simulated = Program(acsard("bench", "--seconds", "3", "--json"), tmp_path)
    real = Program(acsard("bench", "--seconds", "3", "--json", "--port", str(peer.path)), tmp_path)
    with simulated, real:
        assert simulated.ended(30.0) == 0, simulated
        assert real.ended(30.0) == 0, real
    is_sane(json.loads(simulated.stdout))
    says_what_it_could_not_see(json.loads(real.stdout))
    assert len(peer.lines) > 200
    assert {heard.line for heard in peer.lines} <= {ZERO_LINE, b"\r\n"}


def is_sane(result: dict[str, Any]) -> None:
    assert result["simulated"]
    assert result["machine"]["cpu"]
    assert result["commands_sent"] > 30
    assert result["commands_seen"] == result["commands_sent"]
    assert result["lines_told"] > 200
    assert result["lines_told"] >= 0.95 * result["lines_said"]
    for name in ("command_to_wire", "feedback_to_odometry", "read_to_odometry"):
        figure = result["outside"][name]
        assert 0 < figure["p50"] <= figure["p99"] <= figure["max"]
    # Nothing arrives before it was sent, and no median takes longer than a period.
    assert result["outside"]["command_to_wire"]["p50"] < 10_000
    begun = result["own"]["period_lateness"]["count"]
    assert begun + result["missed_periods"] == result["periods"] > 200
    assert 0 < result["cpu_percent_following"] < 100
    assert result["resident_mb"] > 10
    assert 50 < result["start_up_ms"] < 10_000


def says_what_it_could_not_see(result: dict[str, Any]) -> None:
    assert not result["simulated"]
    assert set(result["outside"]) == {"read_to_odometry"}
    assert result["commands_sent"] > 30
    for hidden in ("commands_seen", "lines_said", "lines_waiting_max", "start_up_ms"):
        assert result[hidden] is None


def test_a_port_that_is_not_there_is_66(tmp_path: Path) -> None:
    done = finish(acsard("bench", "--port", str(tmp_path / "nothing")), tmp_path)
    assert (done.code, done.out) == (66, "")
    assert "is not there" in done.err


def test_a_port_that_a_daemon_has_is_75_and_says_whose(tmp_path: Path, peer: Peer) -> None:
    with Daemon(tmp_path, peer.path) as daemon:
        done = finish(acsard("bench", "--port", str(peer.path)), tmp_path)
        assert done.code == 75
        assert f"in use by process {daemon.pid}" in done.err
