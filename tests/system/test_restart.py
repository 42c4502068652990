"""Who keeps the latches of a robot: one daemon at a time, and not the built-in simulator.

`tests/systemd/test_restart.py` has each end of the unit, `scenarios/test_restart.py` the disk.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.system.harness import (
    Bus,
    Daemon,
    Peer,
    acsard,
    finish,
    free_endpoint,
    until,
    write_config,
)


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
