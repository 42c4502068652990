"""`set --keep` writes settings into the configuration file of the robot on which it is typed."""

from __future__ import annotations

import tomllib
from pathlib import Path

import pytest

from acsard.client import connect
from tests.system.harness import (
    Daemon,
    Finished,
    Program,
    acsard,
    free_endpoint,
)
from tests.system.typed import typed

PERIOD_S = 0.01

KEY, VALUE = "limits.linear_speed", "0.45"


def tool(daemon: Daemon, *words: str) -> Finished:
    return typed("set", *words, "--connect", daemon.endpoint, "--config", str(daemon.config))


@pytest.mark.slow
def test_a_kept_setting_survives_a_restart_and_its_comments_stay(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    with Daemon(tmp_path, config={"limits": {"linear_speed": 0.5}}, endpoint=endpoint) as daemon:
        file = daemon.config
        file.write_text(f"# the first line\n{file.read_text()}")
        ended = tool(daemon, KEY, VALUE, "--keep")
        output = f"{KEY} = {VALUE} (was 0.5); written to {file}"
        assert (ended.code, ended.out, ended.err) == (0, output, "")
        assert file.read_text().startswith("# the first line\n")
        assert tomllib.loads(file.read_text())["limits"]["linear_speed"] == float(VALUE)
    with Program(acsard("run", "--config", str(file)), tmp_path) as again:
        again.says("acsard ")
        with connect(endpoint) as robot:
            assert robot.get("config")["limits"]["linear_speed"] == float(VALUE)


def test_set_without_keep_does_not_change_the_file(tmp_path: Path) -> None:
    with Daemon(tmp_path, config={"limits": {"linear_speed": 0.5}}) as daemon:
        before = daemon.config.read_bytes()
        assert "; a set lasts until the daemon's next start" in tool(daemon, KEY, VALUE).out
        assert daemon.config.read_bytes() == before


@pytest.mark.slow
def test_keep_leaves_the_file_if_the_robot_refuses_the_setting(tmp_path: Path) -> None:
    with Daemon(tmp_path) as daemon:
        before = daemon.config.read_bytes()
        ended = tool(daemon, "limits.linear_sped", "1", "--keep")
        assert ended.code == 1
        assert "unknown key" in ended.out
        assert daemon.config.read_bytes() == before
        assert tool(daemon, "--keep").code == 2
