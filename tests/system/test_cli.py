"""The command-line tools: their output, its stream (stdout or stderr), and their exit codes."""

from __future__ import annotations

import json
import math
import os
import re
import signal
import time
from pathlib import Path

import pytest

from acsard.client import connect
from acsard.core.values import TWO_WHEELS as TWO
from acsard.core.values import WHEELS
from acsard.host.errors import Exit
from tests.system.bystander import lost
from tests.system.harness import (
    TWO_WHEELS,
    Bus,
    Daemon,
    Finished,
    Program,
    Tables,
    acsard,
    environment,
    finish,
    free_endpoint,
    running,
    until,
)
from tests.system.typed import typed


def tool(shared: Daemon, *words: str) -> Finished:
    """Run a tool, with the address of the shared daemon, to its end."""
    return typed(*words, "--config", str(shared.config))


def test_without_a_verb_the_daemon_runs_with_the_options_and_the_local_acsard_toml(
    tmp_path: Path,
) -> None:
    endpoint = free_endpoint()
    (tmp_path / "acsard.toml").write_text('[robot]\nid = "handy"\n')
    with Program(acsard("--listen", endpoint), tmp_path) as daemon:
        line = daemon.says("bus ")
        assert (endpoint in line, "acsard/handy/" in line) == (True, True)
        assert "SIMULATOR" in daemon.stdout
        daemon.signal(signal.SIGINT)
        assert daemon.ended(3.0) == 0


def test_echo_into_a_reader_that_leaves_ends_without_a_traceback(shared: Daemon, bus: Bus) -> None:
    script = '{ "$@"; echo "code $?" >&2; } | head -n 1'
    echo = acsard("echo", "odom", "--config", str(shared.config))
    ended = finish(["sh", "-c", script, "sh", *echo], shared.config.parent, 5.0)
    assert set(json.loads(ended.out)) == {"header", "child_frame_id", "pose", "twist"}
    assert ended.err == "code 1"


@pytest.mark.parametrize("word", ["topics", "--help"])
def test_printing_to_a_reader_that_has_left_fails_quietly(tmp_path: Path, word: str) -> None:
    env = {key: value for key, value in environment().items() if key != "PYTHONUNBUFFERED"}
    reader, writer = os.pipe()
    os.close(reader)
    with (
        os.fdopen(writer, "wb") as closed,
        Program(acsard(word), tmp_path, env, stdout=closed) as p,
    ):
        assert p.ended(5.0) == Exit.FAILURE
    assert p.stderr == ""


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_ends_echo_within_2_s(shared: Daemon, bus: Bus, number: signal.Signals) -> None:
    words = acsard("echo", "odom", "--config", str(shared.config))
    with Program(words, shared.config.parent) as echo:
        echo.says("header")
        sent = time.monotonic()
        echo.signal(number)
        assert echo.ended(2.0) == (0 if number == signal.SIGINT else -signal.SIGTERM)
        assert time.monotonic() - sent < 2.0 + lost(sent)
    assert echo.stderr == ""


@pytest.mark.slow
def test_a_kept_setting_survives_a_restart_and_its_comments_stay(tmp_path: Path) -> None:
    endpoint, key = free_endpoint(), "limits.linear_speed"
    with Daemon(tmp_path, config={"limits": {"linear_speed": 0.5}}, endpoint=endpoint) as daemon:
        file = daemon.config
        file.write_text(f"# the first line\n{file.read_text()}")
        ended = tool(daemon, "set", key, "0.45", "--keep")
        assert (ended.code, ended.out) == (0, f"{key} = 0.45 (was 0.5); written to {file}")
        assert file.read_text().startswith("# the first line\n")
        kept = file.read_bytes()
        assert "lasts until the daemon's next start" in tool(daemon, "set", key, "0.4").out
        assert file.read_bytes() == kept
    with Program(acsard("run", "--config", str(file)), tmp_path) as again:
        again.says("acsard ")
        with connect(endpoint) as robot:
            assert robot.get("config")["limits"]["linear_speed"] == 0.45


# sim and run in two processes


@pytest.mark.slow
def test_a_separate_simulator_process_is_driven_through_the_printed_port(tmp_path: Path) -> None:
    with Program(acsard("sim", "--link", "mcu"), tmp_path) as sim:
        port = sim.says("acsard run --port").split()[-1]
        assert port == "mcu"
        with running(tmp_path, port) as (daemon, bus):
            assert bus.get("info")["simulated"] is False
            with connect(daemon.endpoint) as robot:

                def drives() -> bool:
                    """Drive for 0.3 m. A simulator that waits for a core loses the link."""
                    robot.drive(0.5, seconds=0.6)
                    return robot.pose().x > 0.25

                until(drives, 5.0, "it drives")
                until(lambda: robot.get("state").linear == 0.0, 3.0, "at rest")
        sim.signal(signal.SIGTERM)
        assert sim.ended(2.0) == 0
    assert "valid lines" in sim.stderr
    assert "Traceback" not in sim.stderr
    assert not (tmp_path / "mcu").is_symlink()


JOINTS = [f"{wheel}_wheel_joint" for wheel in (*WHEELS, *TWO)]


@pytest.mark.slow
@pytest.mark.parametrize(("wheels", "joints"), [({}, JOINTS[:4]), (TWO_WHEELS, JOINTS[4:])])
def test_a_robot_moves_as_told_and_its_recording_replays_and_has_each_of_its_wheels(
    wheels: Tables, joints: list[str], tmp_path: Path
) -> None:
    place = tmp_path / "recorded"
    tables = {**wheels, "record": {"directory": str(place)}}
    with running(tmp_path, config=tables) as (daemon, bus):
        begun = time.monotonic()
        ended = tool(daemon, "move", "forward", "0.3", "left", "90", "--angular", "2")
        late = lost(begun)  # of it, the odometry of a plain link knows nothing
        assert ended.code == 0, ended
        assert re.fullmatch(
            r"x +\+0\.(299|30\d) m  y +[+-]0\.00\d m  yaw +\+(89|90)\.\d°", ended.out
        )
        true = bus.get("sim/pose")["pose"]
        turned = 2 * math.atan2(true["orientation"]["z"], true["orientation"]["w"])
        where = true["position"]["x"], true["position"]["y"]
        print(f"off by {1000 * math.dist(where, (0.3, 0)):.2f} mm, {math.degrees(turned) - 90:.3f}")
        # On a quiet machine it is 1 mm and 0.1 degrees.
        assert where == pytest.approx((0.3, 0.0), abs=0.01 + 0.5 * late)
        assert math.degrees(turned) == pytest.approx(90.0, abs=1.5 + math.degrees(2.0 * late))
        states = bus.get("wheel_states")
        assert (states["name"], len(states["velocity"])) == (joints, len(joints))
        daemon.signal(signal.SIGINT)
        assert daemon.ended(5.0) == 0
    (file,) = map(str, place.iterdir())
    replay = typed("recording", "replay", file)
    assert replay.code == 0, replay
    table = str(tmp_path / "drive.csv")
    assert typed("recording", "export", "--csv", file, table).code == 0
    header = Path(table).read_text().partition(",yaw_rate,")[0]
    assert header == ("t,fr,fl,rl,rr" if len(joints) == 4 else "t,right,left")
