"""The command-line tools: their output, its stream (stdout or stderr), and their exit codes."""

from __future__ import annotations

import fcntl
import json
import math
import os
import pty
import re
import signal
import struct
import subprocess
import termios
import time
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from acsard.bus.robot_discovery import Presence, presence
from acsard.client import connect
from acsard.host.errors import Exit
from tests.each import each
from tests.scenarios.taped import Tape
from tests.scenarios.world import World
from tests.system.bystander import lost
from tests.system.harness import (
    Bus,
    Daemon,
    Finished,
    Program,
    acsard,
    environment,
    finish,
    free_endpoint,
    running,
    until,
)
from tests.system.terminals import (
    ON_TERMINAL,
    SCREEN,
    UNDER_A_SHELL,
    Terminal,
    at_terminal,
    key_held,
    screens,
)
from tests.system.typed import typed

WAITS = "waiting for a command"
"""The first words of the reason while no client drives the robot."""

VERBS = (
    "run",
    "sim",
    "check",
    "topics",
    "echo",
    "get",
    "top",
    "fleet",
    "foxglove",
    "drive",
    "move",
    "web",
    "call",
    "set",
)


def tool(shared: Daemon, *words: str) -> Finished:
    """Run a tool, with the address of the shared daemon, to its end."""
    return typed(*words, "--config", str(shared.config))


# help


def test_help_lists_the_verbs_the_exit_codes_and_examples(tmp_path: Path) -> None:
    ended = finish(acsard("--help"), tmp_path)
    assert (ended.code, ended.err) == (0, "")
    assert "gateway" not in ended.out
    for word in (*VERBS, "69", "75", "78", "try:"):
        assert word in ended.out
    print(f"--help: {ended.seconds:.2f} s")


@each("verb", VERBS)
def test_every_verb_has_a_help_with_its_usage(verb: str) -> None:
    ended = typed(verb, "--help")
    assert (ended.code, ended.err) == (0, "")
    assert ended.out.startswith(f"usage: acsard {verb}")
    assert "--config" in ended.out


def test_version_prints_the_name_and_ends_with_0() -> None:
    ended = typed("--version")
    assert (ended.code, ended.out.split()[0]) == (0, "acsard")


@each(
    "words",
    [
        ["dirve"],
        ["call", "stop", "now"],
        ["echo"],
        ["sim", "--fault", "x"],
        ["run", "--prot", "sim"],
    ],
)
def test_a_mistyped_command_ends_with_2(words: list[str]) -> None:
    ended = typed(*words)
    assert (ended.code, ended.out) == (2, "")
    assert "usage: acsard" in ended.err


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


def test_the_banner_names_the_simulator_the_bus_the_keys_and_three_commands(
    shared: Daemon,
) -> None:
    until(lambda: len(shared.out) >= 8, 5.0, "the whole banner")
    assert "SIMULATOR" in shared.out[1]
    assert shared.endpoint in shared.out[2]
    assert "acsard/acsar/" in shared.out[2]
    assert str(shared.config) in shared.out[3]
    assert sum(line.strip().startswith("acsard ") for line in shared.out[4:]) == 3


# topics and check need no daemon


def test_topics_lists_every_key_with_its_meaning(shared: Daemon) -> None:
    ended = tool(shared, "topics")
    assert (ended.code, ended.err) == (0, "")
    head, *rows = ended.out.splitlines()
    assert head.split() == ["KEY", "TYPE", "RATE", "MEANING"]
    assert any(row.startswith("acsard/acsar/odom ") and "Odometry" in row for row in rows)
    assert any(row.startswith("acsard/acsar/srv/stop ") for row in rows)


def test_topics_json_prints_the_answer_of_the_topics_key(shared: Daemon, bus: Bus) -> None:
    ended = tool(shared, "topics", "--json")
    assert ended.code == 0
    assert json.loads(ended.out) == bus.get("topics")


def test_check_prints_a_toml_document_that_checks_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    ended = typed("check")
    assert (ended.code, ended.err) == (0, "")
    assert ended.out.startswith("# effective configuration from built-in defaults")
    assert tomllib.loads(ended.out)["drive"]["wheel_radius"] == 0.05
    (tmp_path / "again.toml").write_text(ended.out)
    again = typed("check", "--config", str(tmp_path / "again.toml"))
    assert again.code == 0
    assert again.out.splitlines()[1:] == ended.out.splitlines()[1:]


def test_check_json_is_the_configuration_in_force(shared: Daemon, bus: Bus) -> None:
    ended = tool(shared, "check", "--json")
    assert ended.code == 0
    assert json.loads(ended.out) == bus.get("config")


# echo


def test_echo_prints_n_messages_as_json_lines_and_ends(shared: Daemon, bus: Bus) -> None:
    ended = tool(shared, "echo", "odom", "-n", "2")
    assert (ended.code, ended.err) == (0, "")
    first, second = map(json.loads, ended.out.splitlines())
    assert set(first) == {"header", "child_frame_id", "pose", "twist"}
    assert first["header"]["stamp"] != second["header"]["stamp"]
    print(f"echo odom -n 2: {ended.seconds:.2f} s")


def test_echo_state_says_the_mode_and_why(shared: Daemon, bus: Bus) -> None:
    def linked() -> Any:
        ended = tool(shared, "echo", "state", "-n", "1")
        state = json.loads(ended.out)
        return (ended.code, state) if state["link"] == "up" else None

    code, state = until(linked, 5.0, "a state with the link up")
    assert (code, state["mode"], state["code"]) == (0, "ready", "no_command")


def test_echo_tf_static_prints_the_latched_message_without_waiting_for_the_next(
    shared: Daemon, bus: Bus
) -> None:
    begun = time.monotonic()
    ended = tool(shared, "echo", "tf_static", "-n", "1")
    assert ended.code == 0
    assert json.loads(ended.out)["transforms"][0]["child_frame_id"] == "lidar_link"
    assert ended.seconds < 4.0 + lost(begun)


@pytest.mark.slow
def test_echo_shows_commands_of_other_programs_also_if_they_are_malformed(
    shared: Daemon, bus: Bus
) -> None:
    words = acsard("echo", "cmd/stranger", "-n", "2", "--config", str(shared.config))
    with Program(words, shared.config.parent) as echo:
        for payload in (b'{"linear": {}, "angular": {}}', b"\xff"):
            before = len(echo.out)

            def shown(payload: bytes = payload, before: int = before) -> bool:
                bus.session.put("acsard/acsar/cmd/stranger", payload)
                return len(echo.out) > before or echo.process.poll() is not None

            until(shown, 5.0, "the command at echo")
        assert echo.ended(5.0) == 0
    assert json.loads(echo.out[0]) == {"linear": {}, "angular": {}}


def test_echo_of_a_silent_key_ends_with_1_after_its_timeout(shared: Daemon) -> None:
    ended = tool(shared, "echo", "cmd/nobody", "--timeout", "0.3")
    assert (ended.code, ended.out) == (1, "")
    assert "but no program sends on the Zenoh key cmd/nobody now" in ended.err
    ended = tool(shared, "echo", "battery", "--timeout", "0.1")
    assert (ended.code, ended.out) == (1, "")
    assert "battery has a value only while the board reports the battery's " in ended.err


@pytest.mark.slow
@pytest.mark.parametrize(
    ("words", "why"),
    [
        (
            ["echo", "state", "--short", "--id", "acsra"],
            "there is no robot acsra. Robots here: acsar",
        ),
        (
            ["echo", "odom", "--rate", "--id", "acsra"],
            "there is no robot acsra. Robots here: acsar",
        ),
        (["echo", "cmd/nobody"], "but no program sends on the Zenoh key cmd/nobody now"),
    ],
)
@pytest.mark.nightly
def test_a_tool_that_waits_for_a_message_prints_the_reason_once_and_goes_on_waiting(
    shared: Daemon, bus: Bus, words: list[str], why: str
) -> None:
    typed = acsard(*words, "--config", str(shared.config))
    with Program(typed, shared.config.parent) as waiting:
        until(lambda: why in waiting.stderr, 10.0, "why nothing comes")
        assert waiting.process.poll() is None
        waiting.signal(signal.SIGINT)
        assert waiting.ended(5.0) == 0
    (line,) = waiting.stderr.splitlines()
    key = "state" if "state" in words else words[1]
    assert line.startswith("acsard: waiting for messages on acsard/acs")
    assert f"/{key}: " in line


@pytest.mark.slow
def test_a_waiting_client_notices_that_the_daemon_has_ended(tmp_path: Path) -> None:
    with Daemon(tmp_path) as daemon, connect(daemon.endpoint) as client:
        robot = client._connection

        def seen() -> Presence | None:
            return presence(robot.session, "acsar", daemon.endpoint)

        assert seen() == Presence(linked=True, here=True)
        daemon.signal(signal.SIGINT)
        daemon.ended(5.0)
        until(lambda: seen() == Presence(linked=False, here=False), 5.0, "that it is gone")


def test_echo_into_a_reader_that_leaves_ends_quietly(shared: Daemon, bus: Bus) -> None:
    script = '{ "$@"; echo "code $?" >&2; } | head -n 1'
    echo = acsard("echo", "odom", "--config", str(shared.config))
    ended = finish(["sh", "-c", script, "sh", *echo], shared.config.parent, 5.0)
    assert set(json.loads(ended.out)) == {"header", "child_frame_id", "pose", "twist"}
    assert ended.err == "code 0"


@pytest.mark.parametrize("words", [["topics"], ["--help"]])
def test_printing_to_a_reader_that_has_left_ends_quietly(tmp_path: Path, words: list[str]) -> None:
    env = {key: value for key, value in environment().items() if key != "PYTHONUNBUFFERED"}
    reader, writer = os.pipe()
    os.close(reader)
    with (
        os.fdopen(writer, "wb") as closed,
        Program(acsard(*words), tmp_path, env, stdout=closed) as p,
    ):
        assert p.ended(5.0) == 0
    assert p.stderr == ""


def test_a_failure_keeps_its_exit_code_when_the_reader_of_the_output_has_left(
    shared: Daemon,
) -> None:
    env = {key: value for key, value in environment().items() if key != "PYTHONUNBUFFERED"}
    reader, writer = os.pipe()
    os.close(reader)
    words = acsard("get", "info", "--id", "acsar,other", "--config", str(shared.config))
    with (
        os.fdopen(writer, "wb") as closed,
        Program(words, shared.config.parent, env, stdout=closed) as get,
    ):
        assert get.ended(10.0) == Exit.UNREACHABLE
    assert "Traceback" not in get.stderr


def test_a_replay_fails_if_the_reader_of_its_output_has_left(tmp_path: Path) -> None:
    env = {key: value for key, value in environment().items() if key != "PYTHONUNBUFFERED"}
    tape, path = Tape(), tmp_path / "drive.rec.zst"
    World(recorder=tape).run(0.5)
    tape.save(path)
    words = acsard("recording", "replay", str(path))
    assert finish(words, tmp_path, 10.0).code == Exit.OK
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "wb") as closed, Program(words, tmp_path, env, stdout=closed) as replay:
        assert replay.ended(10.0) == Exit.FAILURE
    assert replay.stderr == ""


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
def test_echo_measures_a_hundred_messages_per_second(shared: Daemon, bus: Bus) -> None:
    begun = time.monotonic()
    ended = tool(shared, "echo", "odom", "--rate", "-n", "2")
    late = lost(begun)
    assert ended.code == 0
    first, second = (line.split() for line in ended.out.splitlines())
    assert int(second[-1]) > int(first[-1])
    # Measured over a second. A message that comes late at one end may also have come late at the
    # other.
    assert float(second[0]) == pytest.approx(100.0, abs=3.0 + 100.0 * late)


@pytest.mark.variations(2)
@pytest.mark.parametrize("words", [["echo", "odom"], ["top"], ["call", "stop"]])
def test_without_a_daemon_a_tool_ends_with_69_and_suggests_acsard_run(
    shared: Daemon, words: list[str]
) -> None:
    endpoint, begun = free_endpoint(), time.monotonic()
    ended = tool(shared, *words, "--connect", endpoint)
    assert (ended.code, ended.out) == (69, "")
    (line,) = ended.err.splitlines()
    assert endpoint in line
    assert "acsard run" in line
    assert ended.seconds < 4.0 + lost(begun)


def test_a_robot_of_another_id_is_not_reached_and_that_is_reported(shared: Daemon) -> None:
    ended = tool(shared, "call", "stop", "--id", "other")
    assert (ended.code, ended.out) == (69, "")
    assert "other" in ended.err
    assert "Robots here: acsar; use --id acsar" in ended.err


def test_echo_for_many_waits_for_each_and_says_which_is_missing(shared: Daemon) -> None:
    ended = tool(shared, "echo", "odom", "-n", "2", "--id", "*")
    assert (ended.code, len(ended.out.splitlines())) == (0, 2)
    ended = tool(shared, "echo", "odom", "-n", "1", "--timeout", "0.5", "--id", "acsar,other")
    assert (ended.code, len(ended.out.splitlines())) == (1, 1)
    assert "following acsar; not present: other" in ended.err


# names that do not exist


@pytest.mark.variations(3)
@pytest.mark.parametrize(
    ("words", "suggestion"),
    [
        (["get", "inof"], "info"),
        (["echo", "oddom", "--timeout", "0.01"], "odom"),
        (["echo", "diagnostic", "--rate", "-n", "1"], "diagnostics"),
        (["set", "linear_speed", "0.5"], "limits.linear_speed"),
        (["call", "stpo"], "stop"),
        (["dirve"], "drive"),
    ],
)
def test_a_misspelt_key_service_setting_or_verb_gets_a_suggestion(
    shared: Daemon, bus: Bus, words: list[str], suggestion: str
) -> None:
    ended = tool(shared, *words)
    assert f"did you mean {suggestion}?" in ended.out + ended.err
    assert ended.code != 0 or "--rate" in words


def test_an_unknown_key_without_a_suggestion_names_the_topics_verb(shared: Daemon) -> None:
    ended = tool(shared, "get", "nonsense")
    assert (ended.code, ended.out) == (69, "")
    assert "`acsard topics`" in ended.err


# call


def test_call_prints_the_answer_and_ends_with_1_when_refused(shared: Daemon, bus: Bus) -> None:
    stop = tool(shared, "call", "stop")
    assert (stop.code, stop.out) == (0, "stopped and latched; srv/clear releases it")
    assert bus.state()["mode"] == "stopped"
    assert tool(shared, "call", "activate").code == 1
    clear = tool(shared, "call", "clear", "--json")
    assert clear.code == 0
    assert json.loads(clear.out)["success"] is True
    bus.comes_to("ready")
    again = tool(shared, "call", "clear")
    assert (again.code, "nothing to clear" in again.out) == (0, True)


def test_call_clear_with_numbers_releases_exactly_these_causes(shared: Daemon, bus: Bus) -> None:
    first, second = (
        json.loads(tool(shared, "call", "stop", "--json").out)["data"]["numbers"][0] for _ in "ab"
    )
    released = tool(shared, "call", "clear", str(first), "--json")
    assert json.loads(released.out)["data"]["numbers"] == [first]
    assert [cause["number"] for cause in bus.state()["causes"]] == [second]
    assert tool(shared, "call", "clear", str(second)).code == 0
    bus.comes_to("ready")
    wrong = tool(shared, "call", "clear", "1.5")
    assert (wrong.code, "`acsard get state` lists them" in wrong.err) == (Exit.USAGE, True)


def test_fleet_prints_an_empty_list_of_json_if_no_robot_is_there(shared: Daemon) -> None:
    nobody = tool(shared, "fleet", "--json", "--id", "nobody")
    assert (nobody.code, nobody.out) == (Exit.UNREACHABLE, "[]")
    assert "none of the robots" in nobody.err


@pytest.mark.parametrize(
    "pose", [("1", "2", "0.5"), ("-1.5", "-2", "-0.5"), ("-1e-3", "0", "-.5E+0")]
)
def test_call_set_pose_sets_it(shared: Daemon, bus: Bus, pose: tuple[str, ...]) -> None:
    ended = tool(shared, "call", "set_pose", *pose)
    state = bus.state()
    assert ended.code == 0
    assert [state["x"], state["y"], state["yaw"]] == pytest.approx([float(value) for value in pose])
    assert tool(shared, "call", "reset_odometry").code == 0
    assert bus.state()["x"] == 0.0


def test_call_set_pose_with_an_out_of_range_pose_is_refused(shared: Daemon, bus: Bus) -> None:
    before = bus.state()
    ended = tool(shared, "call", "set_pose", "1e7", "0", "0")
    assert ended.code == 1
    assert bus.state()["x"] == before["x"]


@pytest.mark.parametrize(
    "words", [["set_pose"], ["set_pose", "1", "2"], ["stop", "1"], ["set_pose", "1", "2", "east"]]
)
def test_call_with_wrong_values_ends_with_2_and_prints_the_usage(
    shared: Daemon, bus: Bus, words: list[str]
) -> None:
    ended = tool(shared, "call", *words)
    assert (ended.code, ended.out) == (2, "")
    assert f"acsard call {words[0]}" in ended.err or "usage: acsard call" in ended.err
    bus.comes_to("ready")


# set


def test_set_changes_the_robot_that_runs_and_with_keep_the_file(
    shared: Daemon, bus: Bus, tmp_path: Path
) -> None:
    file = tmp_path / "mine.toml"
    text = shared.config.read_text(encoding="utf-8")
    file.write_text(f"{text}\n[rates]\ntelemetry = 10.0  # often\n", encoding="utf-8")
    words = ("set", "rates.telemetry", "5", "log.level", "debug", "--config", str(file))
    try:
        ended = typed(*words)
        assert (ended.code, ended.out) == (
            0,
            'rates.telemetry = 5.0 (was 0.0), log.level = "debug" (was "info"); '
            "a set lasts until the daemon's next start",
        )
        assert bus.get("config")["rates"]["telemetry"] == 5.0
        assert "telemetry = 10.0  # often" in file.read_text(encoding="utf-8")
        ended = typed("set", "rates.telemetry", "4", "--keep", "--config", str(file))
        assert (ended.code, ended.out) == (
            0, f"rates.telemetry = 4.0 (was 5.0); written to {file}",
        )  # fmt: skip
        assert "telemetry = 4 # often" in file.read_text(encoding="utf-8").replace("  #", " #")
    finally:
        assert tool(shared, "set", "rates.telemetry", "0", "log.level", "info").code == 0


def test_set_without_arguments_lists_the_settings_and_when_they_can_change(
    shared: Daemon, bus: Bus
) -> None:
    listing = tool(shared, "set")
    assert listing.code == 0
    assert "highest speed, forwards and backwards: a number from 0 to 10 m/s" in listing.out
    assert "only while the robot stands" in listing.out
    settings = json.loads(tool(shared, "set", "--json").out)
    assert settings["limits.linear_speed"] == bus.get("config")["limits"]["linear_speed"]
    assert "mcu.port" not in settings


@pytest.mark.parametrize(
    ("words", "code", "reason"),
    [
        (("limits.linear_speed", "20"), 1, "expected a number from 0 to 10 m/s"),
        (("mcu.port", "/dev/x"), 1, "read only when the daemon starts"),
        (("limits.linear_speed",), 2, "pairs of KEY VALUE"),
        (("commands.sources.nav.timeout", "0.5", "--keep"), 2, "output of `acsard check`"),
        (("--keep",), 2, "--keep needs a setting"),
    ],
)
def test_a_setting_that_cannot_be_set_is_refused_with_the_reason_and_changes_nothing(
    shared: Daemon, bus: Bus, words: tuple[str, ...], code: int, reason: str
) -> None:
    before, text = bus.get("config"), shared.config.read_text(encoding="utf-8")
    ended = tool(shared, "set", *words)
    assert ended.code == code
    assert reason in ended.out + ended.err
    assert (bus.get("config"), shared.config.read_text(encoding="utf-8")) == (before, text)


# sim and run in two processes


@pytest.mark.slow
def test_a_separate_simulator_process_is_driven_through_the_printed_port(tmp_path: Path) -> None:
    with Program(acsard("sim", "--link", "mcu"), tmp_path) as sim:
        port = sim.says("acsard run --port").split()[-1]
        assert port == "mcu"
        with running(tmp_path, port) as (daemon, bus):
            assert bus.get("info")["simulated"] is False
            with connect(daemon.endpoint) as robot:
                begun = time.monotonic()
                robot.drive(0.5, seconds=0.6)
                until(lambda: robot.get("state").linear == 0.0, 3.0, "at rest")
                # If a message comes late, the robot drives on meanwhile: 0.5 m/s.
                assert robot.pose().x == pytest.approx(0.3, abs=0.05 + 0.5 * lost(begun))
        sim.signal(signal.SIGTERM)
        assert sim.ended(2.0) == 0
    assert "valid lines" in sim.stderr
    assert "Traceback" not in sim.stderr
    assert not (tmp_path / "mcu").is_symlink()


@pytest.mark.slow
def test_a_faulty_simulator_misbehaves_and_says_so(tmp_path: Path) -> None:
    with Program(acsard("sim", "--fault", "mute"), tmp_path) as sim:
        port = sim.says("acsard run --port").split()[-1]
        assert port.startswith("/dev/pts/")
        with Daemon(tmp_path, port) as daemon, Bus(daemon.endpoint) as bus:
            until(lambda: bus.count("lines_sent") > 5, 5.0, "lines to the mute one")
            state = bus.state()
            assert (state["link"], state["mode"]) == ("booting", "waiting")
            assert state["counters"]["lines"] == 0
    assert "faults: mute" in sim.stderr


@pytest.mark.slow
def test_a_simulator_does_not_remove_the_link_of_the_one_that_replaced_it(tmp_path: Path) -> None:
    link = tmp_path / "mcu"
    with Program(acsard("sim", "--link", "mcu"), tmp_path) as first:
        first.says("acsard run --port mcu")
        before = os.readlink(link)
        with Program(acsard("sim", "--link", "mcu"), tmp_path) as second:
            second.says("acsard run --port mcu")
            assert f"no longer to {before}" in second.stderr
            first.signal(signal.SIGINT)
            assert first.ended(3.0) == 0
            assert os.readlink(link) != before
            second.signal(signal.SIGINT)
            assert second.ended(3.0) == 0
    assert not link.is_symlink()


# get


def test_get_prints_the_answer_of_a_query_key_on_one_line_of_json(shared: Daemon) -> None:
    ended = tool(shared, "get", "info")
    assert (ended.code, ended.err) == (0, "")
    (line,) = ended.out.splitlines()
    assert json.loads(line)["pid"] == shared.pid


@each("key", ["config", "schema/Odometry", "state", "odom"])
def test_get_answers_on_every_kind_of_key(shared: Daemon, key: str) -> None:
    ended = tool(shared, "get", key)
    assert (ended.code, ended.err) == (0, "")
    assert isinstance(json.loads(ended.out), dict)


def test_get_of_several_robots_names_the_one_that_does_not_answer(shared: Daemon) -> None:
    ended = tool(shared, "get", "info", "--id", "acsar,other")
    assert ended.code == Exit.UNREACHABLE
    (line,) = ended.out.splitlines()
    assert json.loads(line)["robot"] == "acsar"
    assert ended.err.startswith("other: NO ANSWER: no answer on the Zenoh key acsard/other/info")


def test_get_of_a_service_does_not_call_it(shared: Daemon, bus: Bus) -> None:
    ended = tool(shared, "get", "srv/stop")
    assert (ended.code, ended.out) == (2, "")
    assert "acsard call stop" in ended.err
    assert bus.state()["mode"] != "stopped"


# move


def test_move_drives_the_ways_one_after_the_other_and_prints_the_pose(
    shared: Daemon, bus: Bus
) -> None:
    bus.at_rest()
    bus.get("srv/reset_odometry")
    ended = tool(shared, "move", "forward", "0.1", "left", "20", "back", "0")
    assert ended.code == 0, ended
    assert re.fullmatch(r"x +\+0\.(09|10)\d m  y +[+-]0\.00\d m  yaw +\+(19|20)\.\d°", ended.out)
    assert bus.state()["yaw"] == pytest.approx(math.radians(20), abs=math.radians(1.0))


def test_move_of_a_stopped_robot_fails_with_the_reason(shared: Daemon, bus: Bus) -> None:
    bus.get("srv/stop")
    ended = tool(shared, "move", "forward", "1")
    bus.get("srv/clear")
    assert (ended.code, ended.out) == (1, "")
    assert "stopped" in ended.err


# drive


@contextmanager
def driving(
    shared: Daemon, *words: str, how: str = ON_TERMINAL, columns: int = 80
) -> Iterator[tuple[Terminal, Program]]:
    """Run `acsard drive` at a terminal of this width."""
    drive = ("drive", "--config", str(shared.config), *words)
    with at_terminal(
        shared.config.parent, *drive, how=how, term=SCREEN, columns=columns, piped="stderr"
    ) as (terminal, program):
        until(lambda: [screen for screen in screens(terminal) if WAITS in screen], 10.0, "it")
        yield terminal, program


@pytest.mark.variations(2)
@pytest.mark.parametrize("columns", [40, 80])
def test_drive_shows_reason_pose_and_help_on_a_screen_of_any_width(
    shared: Daemon, bus: Bus, columns: int
) -> None:
    with driving(shared, columns=columns) as (terminal, _):
        with key_held(terminal, "i"):
            until(lambda: "DRIVING" in screens(terminal)[-1], 5.0, "driving")
        frames = screens(terminal)
    assert all("u  i  o" in frame for frame in frames if "as teleop" in frame)
    screen = next(frame for frame in frames if WAITS in frame)
    content = " ".join(screen.split())
    for text in ("READY", "no source has sent a usable one within", "yaw", "rad/s", "u i o"):
        assert text in content
    assert all(len(line.rstrip()) <= columns for line in screen.split("\r\n"))
    # Each screen overwrites the one before: nothing scrolls.
    assert "\x1b[?1049h" in terminal.screen
    assert all(frame.count("\n") < 24 for frame in frames)


@pytest.mark.slow
def test_a_drive_that_is_suspended_stops_gives_the_terminal_back_and_goes_on(
    shared: Daemon, bus: Bus
) -> None:
    with Terminal() as fresh:
        usual = fresh.settings
    with driving(shared) as (terminal, program), bus.follow("cmd/teleop") as commands:
        during = terminal.settings
        assert during != usual
        with key_held(terminal, "i"):
            until(lambda: (bus.state()["linear"] or 0.0) > 0.1, 5.0, "moving")
        suspended = time.monotonic()
        program.signal(signal.SIGTSTP)
        until(lambda: terminal.settings == usual, 5.0, "the terminal as it was")
        commands.find(lambda value: value["linear"]["x"] == 0, 2.0, "a zero", after=suspended)
        bus.at_rest()
        program.signal(signal.SIGCONT)
        until(lambda: terminal.settings == during, 5.0, "the screen again")
        terminal.press("\x03")
        assert program.ended(3.0) == 0


@pytest.mark.slow
def test_a_drive_ends_with_a_line_that_the_robot_is_at_rest(shared: Daemon, bus: Bus) -> None:
    with driving(shared) as (terminal, program):
        with key_held(terminal, "i"):
            until(lambda: (bus.state()["linear"] or 0.0) > 0.2, 5.0, "moving")
        terminal.press("\x03")
        assert program.ended(5.0) == 0
        words = "drive ended: the robot stands still; ready: "
        until(lambda: words in terminal.screen, 2.0, "the last word")
    assert "forward +0.00 m/s" in terminal.screen.partition("drive ended: ")[2]


@pytest.mark.slow
def test_a_terminal_closed_under_a_shell_stops_its_drive_by_a_zero_not_by_silence(
    shared: Daemon, bus: Bus
) -> None:
    # The program gets the signal twice: from its keys or its shell, and once more while it sends
    # its zeros.
    with (
        bus.follow("cmd/teleop") as commands,
        driving(shared, how=UNDER_A_SHELL) as (terminal, _),
    ):
        with key_held(terminal, "i"):
            until(lambda: (bus.state()["linear"] or 0.0) > 0.2, 5.0, "moving")
        closed = time.monotonic()
        terminal.close()
        commands.find(lambda value: value["linear"]["x"] == 0, 1.0, "a zero", after=closed)
    bus.at_rest()


@pytest.mark.slow
def test_a_held_key_drives_and_its_release_stops_the_robot(shared: Daemon, bus: Bus) -> None:
    with driving(shared) as (terminal, program):
        with key_held(terminal, "i"):
            until(lambda: bus.state()["linear"] == pytest.approx(0.5, abs=0.01), 5.0, "0.5 m/s")
            assert bus.state()["source"] == "teleop"
        released = time.monotonic()
        bus.at_rest()
        took = time.monotonic() - released
        print(f"key let go -> at rest: {took:.2f} s")
        # 0.6 s of hold, 0.5 s of ramp, and a part of the way.
        assert 0.6 < took < 1.5 + 0.3 + lost(released, released + took)
        assert program.process.poll() is None


@pytest.mark.slow
def test_space_stops_the_robot_within_the_ramp(shared: Daemon, bus: Bus) -> None:
    with driving(shared) as (terminal, _):
        with key_held(terminal, "i"):
            until(lambda: bus.state()["linear"] == pytest.approx(0.5, abs=0.01), 5.0, "0.5 m/s")
        pressed = time.monotonic()
        terminal.press(" ")
        bus.stands()
        took = time.monotonic() - pressed
        print(f"space -> at rest: {took:.2f} s")
        # The ramp alone is 0.5 s.
        assert took < 0.5 + 0.4 + lost(pressed, pressed + took)


ARROWS = {"A": (1, 0), "B": (-1, 0), "D": (0, 1), "C": (0, -1)}


@pytest.mark.slow
def test_arrows_drive_forward_back_left_and_right(shared: Daemon, bus: Bus) -> None:
    with driving(shared) as (terminal, _):
        for letter, (ahead, left) in ARROWS.items():
            with key_held(terminal, f"\x1b[{letter}"):

                def right_way(ahead: int = ahead, left: int = left) -> bool:
                    state = bus.state()
                    along, about = state["linear"] * ahead, state["angular"] * left
                    return bool(along > 0.05 or about > 0.1)

                until(right_way, 5.0, f"moving by arrow {letter}")
            terminal.press(" ")
            bus.at_rest()


@pytest.mark.slow
def test_speed_keys_change_the_speed_of_the_next_key(shared: Daemon, bus: Bus) -> None:
    with driving(shared, "--linear", "0.2") as (terminal, _):
        terminal.press("w")
        until(lambda: "0.22 m/s" in terminal.screen, 3.0, "the new speed on the screen")
        with key_held(terminal, "i"):
            until(lambda: bus.state()["linear"] == pytest.approx(0.22, abs=0.005), 5.0, "0.22 m/s")
    bus.at_rest()


@pytest.mark.slow
def test_ctrl_c_while_driving_stops_and_leaves_with_0_and_the_terminal_as_it_was(
    shared: Daemon, bus: Bus
) -> None:
    with driving(shared) as (terminal, program):
        during = terminal.settings
        with key_held(terminal, "i"):
            until(lambda: (bus.state()["linear"] or 0.0) > 0.3, 5.0, "moving")
        with bus.follow("cmd/teleop") as commands:
            terminal.press("\x03")
            left = time.monotonic()
            assert program.ended(3.0) == 0
            commands.find(lambda value: value["linear"]["x"] == 0, 2.0, "a zero", after=left)
        bus.at_rest()
        after = terminal.settings
    assert "Traceback" not in terminal.screen + program.stderr
    assert during != after
    with Terminal() as fresh:
        assert after == fresh.settings


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGHUP, signal.SIGQUIT])
def test_a_drive_that_is_ended_from_outside_leaves_the_terminal_as_it_was(
    shared: Daemon, bus: Bus, number: signal.Signals
) -> None:
    with driving(shared) as (terminal, program):
        program.signal(number)
        program.ended(3.0)
        after = terminal.settings
    with Terminal() as fresh:
        assert after == fresh.settings


@pytest.mark.slow
def test_a_stranger_s_put_on_the_robot_s_topics_does_not_end_a_drive(
    shared: Daemon, bus: Bus
) -> None:
    with driving(shared) as (terminal, program):
        for payload in (b"\xff", b"{}", b""):
            for name in ("state", "odom", "cmd_vel_out", "events", "beat"):
                bus.session.put(f"acsard/*/{name}", payload)
        with key_held(terminal, "i"):
            until(
                lambda: (bus.state()["linear"] or 0.0) > 0.2 or program.process.poll() is not None,
                5.0,
                "driving on",
            )
        assert program.process.poll() is None, program.stderr
    bus.at_rest()


def test_drive_without_a_terminal_ends_with_2(shared: Daemon) -> None:
    ended = tool(shared, "drive")
    assert (ended.code, ended.out) == (2, "")
    assert "terminal" in ended.err


def test_drive_at_a_terminal_without_a_screen_ends_with_2(shared: Daemon) -> None:
    words = ("drive", "--config", str(shared.config))
    with at_terminal(shared.config.parent, *words, piped="stderr") as (_, program):
        assert program.ended(10.0) == 2
    assert "TERM" in program.stderr


@each("words", [["mcu", "check", "--port", "sim", "--yes"]])
def test_a_judging_command_fails_if_the_reader_of_its_output_leaves(
    tmp_path: Path, words: list[str]
) -> None:
    script = '{ "$@"; echo "code $?" >&2; } | head -n 1'
    ended = finish(["sh", "-c", script, "sh", *acsard(*words)], tmp_path, 30.0)
    assert ended.err.splitlines()[-1] == "code 1"


def test_a_drive_ends_with_zeros_although_its_terminal_reads_nothing(shared: Daemon) -> None:
    terminal, other = pty.openpty()
    fcntl.ioctl(other, termios.TIOCSWINSZ, struct.pack("HHHH", 50, 250, 0, 0))
    words = acsard("drive", "--config", str(shared.config))
    env = environment() | {"TERM": "xterm"}
    with (
        connect(shared.endpoint) as robot,
        subprocess.Popen(words, stdin=other, stdout=other, stderr=other, env=env) as process,
    ):
        os.close(other)
        try:
            until(lambda: len(os.read(terminal, 4096)) > 100, 10.0, "the first screen")

            def drives() -> bool:
                os.write(terminal, b"i")
                time.sleep(0.05)
                return (robot.get("state").linear or 0.0) > 0.1

            until(drives, 10.0, "that the key drives the robot")
            # The screen is drawn four times a second, so it fills the terminal's buffer soon.
            end = time.monotonic() + 4.0
            while time.monotonic() < end:
                drives()
            process.send_signal(signal.SIGTERM)
            assert process.wait(10.0) == 0
            assert not robot.get("state").linear
        finally:
            process.kill()
            os.close(terminal)
