"""`acsard bench` on the simulator, and on the serial port of an independent simulated board."""

from __future__ import annotations

import json
import os
import signal
from pathlib import Path
from typing import Any

import pytest
from msgspec.structs import replace

from acsard.bench.measure import bench_config, measure
from acsard.core.config.settings import Config, ControlConfig
from acsard.host.errors import Exit, MendableError
from tests.each import each
from tests.system.harness import (
    ZERO_LINE,
    Daemon,
    Peer,
    Program,
    acsard,
    children,
    finish,
    until,
)
from tests.system.typed import typed

CHECKED = """\
[mcu]
link_check = "auto"
encoder_counts = 3200
[control]
auto_activate = false
"""


@pytest.mark.slow
def test_bench_measures_the_simulator_and_moves_nothing_on_a_real_port(
    tmp_path: Path, peer: Peer
) -> None:
    """Run the two benchmarks at the same time, because they share nothing."""
    (tmp_path / "acsard.toml").write_text(CHECKED)
    (tmp_path / "real").mkdir()
    words = acsard("bench", "--seconds", "3", "--json")
    simulated = Program(words, tmp_path)
    real = Program([*words, "--port", str(peer.path)], tmp_path / "real")
    with simulated, real:
        assert simulated.ended(30.0) == 0, simulated
        assert real.ended(30.0) == 0, real
    is_sane(json.loads(simulated.stdout))
    says_what_it_could_not_see(json.loads(real.stdout))
    assert len(peer.lines) > 200
    assert {entry.line for entry in peer.lines} <= {ZERO_LINE, b"\r\n"}


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
    # No line arrives before it was sent, and no median takes longer than a period.
    assert result["outside"]["command_to_wire"]["p50"] < 10_000
    assert result["lines_sent"] > 200
    assert result["missed_periods"] < result["lines_sent"]
    assert 0 < result["cpu_percent_following"] < 100
    assert result["resident_mb"] > 10
    assert 50 < result["start_up_ms"] < 10_000


def says_what_it_could_not_see(result: dict[str, Any]) -> None:
    assert not result["simulated"]
    assert set(result["outside"]) == {"read_to_odometry"}
    assert result["commands_sent"] > 30
    for hidden in ("commands_seen", "lines_said", "lines_waiting_max", "start_up_ms"):
        assert result[hidden] is None


def test_bench_on_a_port_that_does_not_exist_ends_with_66(tmp_path: Path) -> None:
    done = typed("bench", "--port", str(tmp_path / "nothing"))
    assert (done.code, done.out) == (66, "")
    assert "does not exist" in done.err


@each("what", ["/tmp", "/etc/passwd"])
def test_bench_on_a_path_that_is_not_a_device_ends_with_66(what: str) -> None:
    done = typed("bench", "--port", what)
    assert (done.code, done.out) == (66, "")
    assert done.err.startswith(f"acsard: {what} is not a serial port")


@pytest.mark.slow
def test_bench_gives_the_daemons_reason_if_no_command_reaches_the_wire() -> None:
    config = bench_config(Config(), simulated=True)
    config = replace(config, control=ControlConfig(auto_activate=False))
    with pytest.raises(
        MendableError, match=r"none of the \d+ commands, .* reports: switched off"
    ) as error:
        measure(config, "", 1.0)
    assert error.value.code == Exit.FAILURE


@pytest.mark.parametrize(
    ("words", "process"),
    [
        ("acsard run", "the daemon"),
        ("acsard.bench.far_end", "the simulated microcontroller's process"),
    ],
)
def test_bench_names_its_child_process_that_was_killed(
    tmp_path: Path, words: str, process: str
) -> None:
    with Program(acsard("bench", "--seconds", "30"), tmp_path) as bench:
        pid = until(lambda: next(iter(children(bench.pid, words)), None), 15.0, words)
        os.kill(pid, signal.SIGKILL)
        assert bench.ended(20.0) == 1
        assert bench.err == [f"acsard: {process} was ended by signal 9"]


@pytest.mark.slow
def test_bench_on_a_port_that_a_daemon_holds_ends_with_75_and_names_the_process(
    tmp_path: Path, peer: Peer
) -> None:
    with Daemon(tmp_path, peer.path) as daemon:
        done = finish(acsard("bench", "--port", str(peer.path)), tmp_path)
        assert done.code == 75
        assert f"in use by process {daemon.pid}" in done.err
