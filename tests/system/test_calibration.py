"""`acsard calibrate` at a terminal, with the real daemon and the simulated robot."""

from __future__ import annotations

import json
import time
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path

import msgspec
import pytest
import zenoh

from acsard.bus.zenoh_sessions import client_session
from acsard.calibration.leg import Sensor, place_and_yaw
from acsard.core.messages.encodings import FORMATS, encode
from acsard.core.messages.schema import Odometry, PoseStamped
from tests.system.bystander import lost
from tests.system.harness import (
    Bus,
    Daemon,
    Peer,
    Program,
    acsard,
    free_endpoint,
    running,
    until,
)  # fmt: skip
from tests.system.terminals import Terminal, at_terminal
from tests.system.typed import typed

SKIDDING: dict[str, dict[str, object]] = {
    "odometry": {"gyro": True},
    "sim": {"track_multiplier": 1.6},
}


@pytest.fixture
def free() -> str:
    return free_endpoint()


@contextmanager
def router(endpoint: str) -> Iterator[zenoh.Session]:
    """Run a Zenoh router in this process, through which a positioning system can publish."""
    config = zenoh.Config()
    config.insert_json5("mode", '"router"')
    config.insert_json5("listen/endpoints", json.dumps([endpoint]))
    config.insert_json5("scouting/multicast/enabled", "false")
    with zenoh.open(config) as session:
        yield session


STARTS = "Enter starts this drive"
RIDES_S = 120.0


@contextmanager
def calibrating(daemon: Daemon, *words: str) -> Iterator[tuple[Terminal, Program]]:
    """Run `acsard calibrate` at a separate terminal. Its results go into a pipe."""
    arguments = ("calibrate", "drive", "--config", str(daemon.config), *words)
    with at_terminal(daemon.config.parent, *arguments, piped="stdout") as pair:
        yield pair


def asks(terminal: Terminal, program: Program, words: str, times: int, within: float) -> None:
    """Wait until the screen has shown these words `times` times. Fails if the program ends."""

    def look() -> bool:
        assert program.process.poll() is None, terminal.screen
        return screen_text(terminal).count(words) >= times

    until(look, within, f"{words!r} for the {times}. time")


def begun(terminal: Terminal, program: Program, bus: Bus, starts: int = 1) -> int:
    """Start the first leg and wait until the robot moves. Return the number of starts.

    `starts` is the number of times that the calibration will have asked for one.

    If a busy machine disturbs the leg, it is started again.
    """
    asks(terminal, program, STARTS, starts, 10.0)
    terminal.press("\n")

    def moves() -> bool:
        nonlocal starts
        assert program.process.poll() is None, terminal.screen
        if screen_text(terminal).count(STARTS) > starts:
            terminal.press("\n")
            starts += 1
        return bool((bus.state()["linear"] or 0.0) > 0.25)

    until(moves, 20.0, "the first leg moves")
    assert bus.state()["source"] == "app"
    return starts


def screen_text(terminal: Terminal) -> str:
    """Return the whole screen as one line."""
    return " ".join(terminal.screen.split())


@pytest.mark.slow
def test_space_stops_a_leg_within_the_ramp_which_may_then_be_repeated(
    tmp_path: Path,
) -> None:
    with running(tmp_path, config=SKIDDING) as (daemon, bus):
        before = daemon.config.read_bytes()
        with calibrating(daemon, "--write") as (terminal, program):
            starts = begun(terminal, program, bus)
            pressed = time.monotonic()
            terminal.press(" ")
            bus.stands()
            took = time.monotonic() - pressed
            print(f"space -> at rest: {took:.2f} s")
            # 0.3 m/s at 1 m/s2, and a part of the way.
            assert took < 0.3 + 0.4 + lost(pressed, pressed + took)
            asks(terminal, program, STARTS, starts + 1, 10.0)
            assert "a key was pressed" in terminal.screen
            terminal.press("q")
            assert program.ended(5.0) == 1, terminal.screen
        assert daemon.config.read_bytes() == before


@pytest.mark.slow
def test_a_stop_and_a_daemon_that_dies_cost_only_their_leg(tmp_path: Path) -> None:
    endpoint = free_endpoint()
    with ExitStack() as robot:
        daemon, bus = robot.enter_context(running(tmp_path, config=SKIDDING, endpoint=endpoint))
        with calibrating(daemon) as (terminal, program):
            starts = begun(terminal, program, bus)
            bus.put("stop", {})
            asks(terminal, program, STARTS, starts + 1, 10.0)
            assert "has ended early: stopped by" in screen_text(terminal)
            terminal.press("\n")  # before somebody clears the stop
            asks(terminal, program, STARTS, starts + 2, 10.0)
            until(lambda: bus.ask("srv/clear")[0].ok, 5.0, "the stop is cleared")
            starts = begun(terminal, program, bus, starts + 2)
            robot.close()
            asks(terminal, program, STARTS, starts + 1, 15.0)
            assert "nothing received from the daemon" in screen_text(terminal)
            _, bus = robot.enter_context(running(tmp_path, config=SKIDDING, endpoint=endpoint))
            begun(terminal, program, bus, starts + 1)


@pytest.mark.slow
@pytest.mark.nightly
@pytest.mark.timeout(300)
def test_the_simulator_is_calibrated_by_its_true_pose_without_a_person(tmp_path: Path) -> None:
    with running(tmp_path, config=SKIDDING) as (daemon, _):
        words = ["calibrate", "drive", "--poses", "sim/pose", "--yes", "--json"]
        with Program(acsard(*words, "--config", str(daemon.config)), tmp_path) as program:
            assert program.ended(2 * RIDES_S) == 0, program.stderr
        results = json.loads(program.stdout)
    assert results["reference"] == "positions and headings"
    assert abs(results["found"]["wheel_separation_multiplier"] - 1.6) < 0.02
    assert results["found"]["left_wheel_radius_multiplier"] == pytest.approx(1.0, abs=0.002)


POSE = {
    "position": {"x": 1.5, "y": -2.0, "z": 0.0},
    "orientation": {"x": 0, "y": 0, "z": 0, "w": 1},
}
HEADER = {"stamp": {"sec": 7, "nanosec": 0}, "frame_id": "map"}
AS_POSE = {"header": HEADER, "pose": POSE}
AS_ODOMETRY = {
    "header": HEADER, "child_frame_id": "base_link",
    "pose": {"pose": POSE, "covariance": [0.0] * 36},
    "twist": {"twist": {"linear": {}, "angular": {}}, "covariance": [0.0] * 36},
}  # fmt: skip


def test_poses_of_another_program_are_received_as_both_types_in_every_encoding(free: str) -> None:
    with router(free) as sender, client_session(free, "") as receiver:
        for cls, value in ((PoseStamped, AS_POSE), (Odometry, AS_ODOMETRY)):
            message = msgspec.convert(value, cls)
            for form in FORMATS:
                key = f"slam/{cls.__name__}/{form}"
                sensor = poses(receiver, key)

                def came() -> bool:
                    sender.put(key, encode(message, form))  # noqa: B023
                    return sensor.receive(9.0) > 0  # noqa: B023

                until(came, 5.0, f"a pose on {key}")
                assert sensor.rows[0] == (9.0, 7.0, 1.5, -2.0, 0.0)


def poses(receiver: zenoh.Session, key: str) -> Sensor:
    return Sensor(receiver, key, (Odometry, PoseStamped), place_and_yaw, ("x", "y", "yaw"))


@pytest.mark.slow
def test_calibrate_moves_no_real_robot_without_a_person(tmp_path: Path, peer: Peer) -> None:
    with running(tmp_path, port=peer.path) as (daemon, _):
        for words, why in ((["--yes"], "this robot is real"), ([], "terminal")):
            ended = typed("calibrate", "drive", *words, "--config", str(daemon.config))
            assert ended.code == 2
            assert why in ended.err
