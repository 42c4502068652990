"""A robot writes settings into its own configuration file while it drives."""

from __future__ import annotations

import time
import tomllib
from pathlib import Path

import pytest

from acsard.client import connect
from tests.system.bystander import lost
from tests.system.harness import (
    ROOT,
    Bus,
    Daemon,
    Finished,
    Program,
    acsard,
    free_endpoint,
    until,
)
from tests.system.typed import typed

PERIOD_S = 0.01

DEFAULT_ENDPOINT = "tcp/127.0.0.1:7448"

KEY, VALUE = "limits.linear_speed", "0.45"


def tool(daemon: Daemon, *words: str) -> Finished:
    return typed("set", *words, "--connect", daemon.endpoint)


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
        (event,) = [entry for entry in daemon.events("set") if "written" in entry["text"]]
        assert event["text"] == f"written: {KEY} to {file}"
        assert event["by"]
        with Bus(endpoint) as bus:
            until(lambda: bus.state()["settings_differ"] == "", 5.0, "no difference")
    with Program(acsard("run", "--config", str(file)), tmp_path) as again:
        again.says("acsard ")
        with connect(endpoint) as robot:
            assert robot.get("config")["limits"]["linear_speed"] == float(VALUE)


def test_set_without_keep_does_not_change_the_file(tmp_path: Path) -> None:
    with Daemon(tmp_path, config={"limits": {"linear_speed": 0.5}}) as daemon:
        before = daemon.config.read_bytes()
        assert "; a lowered limit survives a restart" in tool(daemon, KEY, VALUE).out
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
        assert tool(daemon, KEY, "1", "--keep", "--write").code == 2


@pytest.mark.slow
def test_keeping_settings_costs_no_control_period(tmp_path: Path) -> None:
    """Writing a file like the reference takes 0.1 s, so a separate process does it."""
    endpoint, file = free_endpoint(), tmp_path / "robot.toml"
    text = (ROOT / "acsard.toml").read_text()
    file.write_text(text.replace(DEFAULT_ENDPOINT, endpoint))
    with Program(acsard("run", "--config", str(file)), tmp_path) as program:
        program.says("acsard ")
        with connect(endpoint) as robot:
            before, began_s = robot.get("state"), time.monotonic()
            for speed in (0.4, 0.5, 0.6, 0.7, 0.8):
                assert robot.set({KEY: speed}, keep=True).success
            after = robot.get("state")
    missed = [state.counters.get("missed_periods", 0) for state in (before, after)]
    assert (missed[1] - missed[0]) * PERIOD_S <= PERIOD_S + lost(began_s)
    changed = file.read_text().splitlines()
    assert len([line for line in text.splitlines() if line not in changed]) <= 3
