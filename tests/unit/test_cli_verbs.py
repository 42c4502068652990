"""Each verb with a robot that pretends: what it prints, and its exit code."""

from __future__ import annotations

import sys
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any, cast

import msgspec
import pytest

from acsard.bus import robot_discovery
from acsard.cli import call, doctor, drive, echo, fleet, main, move, replies, robot_options, top
from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config
from acsard.core.messages.schema import ServiceReply
from acsard.core.values import Pose
from acsard.host.errors import Exit, NoAnswerError
from acsard.machine.finding import Finding
from acsard.top import terminal
from acsard.top.roster import Row
from tests.each import each
from tests.system.typed import typed
from tests.unit.screens import STATE


class Robot:
    """A robot of a fleet in which `ghost` is silent."""

    session, caller = None, "me/1"

    def __init__(self, robot_id: str = "acsar", tls: str = "") -> None:
        self.where = SimpleNamespace(robot_id=robot_id, endpoint="tcp/127.0.0.1:1", tls=tls)
        self.identity = ""

    def __enter__(self) -> Robot:
        return self

    def __exit__(self, *_: object) -> None: ...

    def sibling(self, robot_id: str) -> Robot:
        return Robot(robot_id)

    def whoami(self) -> Any:
        return SimpleNamespace(silence=self.identity)

    def get(self, key: str) -> Any:
        return {"state": STATE, "config": effective(Config())}[key]

    def set(self, settings: dict[str, object]) -> ServiceReply:
        if self.where.robot_id == "ghost":
            raise NoAnswerError("no answer of ghost")
        return ServiceReply(True, f"{settings}")

    def call(self, verb: str) -> ServiceReply:
        self.set({})
        return ServiceReply(self.where.robot_id != "stuck", f"{verb}ped")

    def samples(self, key: str, look: object) -> Iterator[Any]:
        yield sample(self.where.robot_id)


def sample(robot_id: str) -> Any:
    payload = SimpleNamespace(to_bytes=lambda: b"{}")
    return SimpleNamespace(
        key_expr=f"acsard/{robot_id}/state", encoding="application/json", payload=payload
    )


@pytest.fixture
def robot(monkeypatch: pytest.MonkeyPatch) -> Robot:
    """Let every verb connect to this robot, on a bus where `a`, `b` and `stuck` run."""
    robot = Robot()
    monkeypatch.setattr(robot_options, "open_connection", lambda *_, **__: robot)
    for module in (echo, replies):
        monkeypatch.setattr(module, "running_robots", lambda *_: ["a", "b", "stuck"])
    return robot


@pytest.mark.parametrize(
    ("ids", "lines", "words"),
    [
        ("a,ghost", ["a", "ghost"], "following a, b, stuck; not present: ghost"),
        ("*", ["a", "b", "stuck"], "following a, b, stuck"),
    ],
)
def test_echo_of_several_robots_names_those_that_are_there(
    robot: Robot, ids: str, lines: list[str], words: str,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    followed = list[Sequence[str]]()

    def follow(_: object, many: Sequence[str], key: str) -> Any:
        followed.append(many)
        return SimpleNamespace(until_silence=lambda *_: map(sample, lines))

    monkeypatch.setattr(echo, "follow", follow)
    assert main(["echo", "state", "-n", "1", "--id", ids]) == 0
    out, err = capsys.readouterr()
    assert [msgspec.json.decode(line)["robot"] for line in out.splitlines()] == lines
    assert err == f"acsard: {words}\n"
    assert followed == [tuple(ids.split(","))]


def test_echo_waits_for_robots_if_the_bus_cannot_tell_which_are_there(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def unknown(*_: object) -> None:
        raise NoAnswerError("no robot is visible.")

    monkeypatch.setattr(echo, "running_robots", unknown)
    assert echo._expected(cast(Any, robot), ("a", "b")) == ("a", "b")
    assert capsys.readouterr().err == "acsard: no robot is visible. Waiting.\n"


@pytest.mark.parametrize("silence", ["", "your certificate is not listed"])
def test_echo_over_tls_says_at_once_that_a_role_may_be_missing(
    robot: Robot, silence: str, capsys: pytest.CaptureFixture[str]
) -> None:
    robot.where.tls, robot.identity = "certificates", silence
    assert main(["echo", "state", "-n", "1"]) == 0
    out, err = capsys.readouterr()
    assert out == "{}\n"
    assert err == (f"acsard: {silence}. Waiting.\n" if silence else "")


@pytest.mark.parametrize(
    ("ids", "code", "words"),
    [
        ("a,b", Exit.OK, ""),
        ("a,stuck", Exit.FAILURE, "NOT STOPPED: stuck: go to them"),
        ("a,ghost", Exit.UNREACHABLE, "NOT STOPPED: ghost: go to them"),
        ("*", Exit.FAILURE, "NOT STOPPED: stuck"),
    ],
)
def test_a_stop_of_several_robots_names_each_that_did_not_stop(
    robot: Robot, ids: str, code: Exit, words: str,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    stopped = list[Sequence[str]]()
    monkeypatch.setattr(robot_discovery, "stop", lambda _, ids, who: stopped.append(ids))
    monkeypatch.setattr(call, "robot_discovery", robot_discovery)
    assert main(["call", "stop", "--id", ids]) == code
    out, err = capsys.readouterr()
    assert words in err
    assert ("NOT STOPPED" in err) == bool(words)
    assert stopped == [tuple(ids.split(","))], "before any answer"
    assert "a: stopped" in out
    assert ("ghost: NO ANSWER: go to the robot" in out) == ("ghost" in ids)


def test_a_setting_of_several_robots_is_changed_on_each(
    robot: Robot, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["set", "rates.telemetry", "5", "--id", "a,ghost"]
    assert main(words) == Exit.UNREACHABLE
    a, ghost = capsys.readouterr().out.splitlines()
    assert a == "a: {'rates.telemetry': 5}; a set lasts until the daemon's next start"
    assert ghost == "ghost: NO ANSWER"
    assert main([*words, "--json"]) == Exit.UNREACHABLE
    a, _ = map(msgspec.json.decode, capsys.readouterr().out.splitlines())
    assert a["robot"] == "a"
    assert a["message"]["message"] == "{'rates.telemetry': 5}"


def test_the_settings_that_may_change_are_listed_with_their_values(
    robot: Robot, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["set"]) == 0
    text = capsys.readouterr().out
    assert f"limits.linear_speed = {Config().limits.linear_speed}\n    " in text
    assert "mcu.port" not in text
    assert main(["set", "--json"]) == 0
    listed = msgspec.json.decode(capsys.readouterr().out)
    assert listed["limits.linear_speed"] == Config().limits.linear_speed
    assert "mcu.port" not in listed


def test_move_drives_each_way_in_turn_and_prints_where_the_robot_is(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    driven: list[tuple[str, float, float]] = []
    client = SimpleNamespace(
        move=lambda way, speed: driven.append(("move", way, speed)),
        turn=lambda way, speed: driven.append(("turn", way, speed)),
        pose=lambda: Pose(0.53, -1.0, 0.0),
        get=robot.get,
    )
    monkeypatch.setattr(move, "Client", lambda _: client)
    words = "move forward 1 left 90 back 0.5 --linear 0.2 --angular 0.7"
    assert main(words.split()) == 0
    assert driven == [("move", 1.0, 0.2), ("turn", 90.0, 0.7), ("move", -0.5, 0.2)]
    assert capsys.readouterr() == ("x   +0.530 m  y   -1.000 m  yaw   +0.0°\n", "")


def test_top_prints_one_screen_into_a_pipe(
    robot: Robot, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(top, "Feed", lambda followed: followed)
    monkeypatch.setattr(terminal, "one_screen", lambda feed: f"screen of {feed.where.robot_id}")
    monkeypatch.setattr(terminal, "show_live", lambda _: pytest.fail("a pipe is no screen"))
    for words in ([], ["--once"]):
        assert main(["top", *words]) == 0
        assert capsys.readouterr().out == "screen of acsar\n"


def test_drive_ends_its_ride_and_says_at_last_where_the_robot_is(
    robot: Robot, monkeypatch: pytest.MonkeyPatch
) -> None:
    did = list[str]()
    ride = SimpleNamespace(end=lambda: did.append("end"))
    monkeypatch.setattr(drive, "KeyboardDrive", lambda _, keyboard, limits: ride)
    monkeypatch.setattr(terminal, "drive", lambda _: did.append("drive"))
    monkeypatch.setattr(terminal, "print_last_report", lambda _: did.append("report"))
    monkeypatch.setenv("TERM", "xterm")
    for stream in (sys.stdin, sys.stdout):
        monkeypatch.setattr(stream, "isatty", lambda: True)
    assert main(["drive"]) == 0
    assert did == ["drive", "end", "report"]


HERE = Row("a", True, STATE, 0.1)


@pytest.mark.parametrize(
    ("rows", "code", "words"),
    [
        ([HERE], Exit.OK, ""),
        ([HERE, Row("b", False, None, float("inf"))], Exit.UNREACHABLE, "gone or silent: b"),
        ([HERE, Row("b", True, STATE, 9.0, silent=True)], Exit.UNREACHABLE, "gone or silent: b"),
        ([HERE, Row("c", False, STATE, 9.0)], Exit.OK, ""),  # nobody named it
        ([Row("b", False, None, float("inf"))], Exit.UNREACHABLE, "is the router running?"),
        ([], Exit.UNREACHABLE, "is the router running?"),
    ],
)
@pytest.mark.parametrize("form", ["--once", "--json"])
def test_a_fleet_is_listed_and_a_named_robot_that_is_lost_is_a_failure(
    robot: Robot, rows: list[Row], code: Exit, words: str, form: str,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    roster = SimpleNamespace(
        gather=lambda: rows, hint=lambda: "is the router running?", presence_text="2 robots"
    )
    monkeypatch.setattr(fleet, "Roster", lambda *_: roster)
    assert main(["fleet", form, "--id", "a,b"]) == code
    out, err = capsys.readouterr()
    assert words in err
    lost = "is the router" in words
    assert ("2 robots" in err) == (form == "--once" and not lost)
    if form == "--json":
        assert [row["robot_id"] for row in msgspec.json.decode(out)] == [r.robot_id for r in rows]
    else:
        assert all(row.robot_id in out for row in rows)


@each(("level", "code"), [("ok", 0), ("warning", 0), ("failure", 1)])
def test_the_doctor_s_exit_code_is_that_of_its_worst_finding(
    level: Any, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    found = [
        Finding("port", "port_open", "ok", "it is open"),
        Finding("router", "router_absent", level, "it is\x1b[2J off", "switch it on"),
    ]
    monkeypatch.setattr(doctor, "examine", lambda *_: iter(found))
    assert main(["doctor"]) == code
    text = capsys.readouterr().out
    mark, _ = doctor.LEVEL_MARKS[level]
    assert "ok    port: it is open" in text
    assert f"{mark}  router: it is" in text
    assert "-> switch it on" in text
    assert "\x1b[2J" not in text
    assert main(["doctor", "--json"]) == code
    assert [row["level"] for row in msgspec.json.decode(capsys.readouterr().out)] == ["ok", level]


def test_topics_are_a_table_or_json() -> None:
    table = typed("topics")
    assert (table.code, table.out.splitlines()[0].split()) == (
        0,
        ["KEY", "TYPE", "RATE", "MEANING"],
    )
    listed = msgspec.json.decode(typed("topics", "--json").out)["topics"]
    assert {"acsard/acsar/odom", "acsard/acsar/srv/stop"} <= {row["key"] for row in listed}
    ros = msgspec.json.decode(typed("topics", "--json", "--ros").out)["topics"]
    assert "/cmd_vel" in {row["key"] for row in ros}


@pytest.mark.parametrize(
    ("words", "library", "extra"),
    [
        (["foxglove"], "acsard.foxglove.bridge", "foxglove-sdk"),
        (["web", "tokens"], "aiohttp", "aiohttp, prometheus-client or segno"),
    ],
)
def test_a_verb_without_its_library_names_it(
    words: list[str], library: str, extra: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setitem(sys.modules, library, None)
    ended = typed(*words)
    assert ended.code != 0
    assert extra in ended.err


@pytest.mark.parametrize("verb", [["drive"], ["mcu", "check", "--port", "sim"]])
def test_a_verb_that_needs_a_person_asks_for_a_terminal(verb: list[str]) -> None:
    ended = typed(*verb)
    assert (ended.code, ended.out) == (Exit.USAGE, "")
    assert "in a terminal" in ended.err


def test_a_new_configuration_that_cannot_be_written_is_named(tmp_path: Path) -> None:
    ended = typed("check", "--new", str(tmp_path / "none" / "acsard.toml"))
    assert ended.code == Exit.FAILURE
    assert "No such file or directory" in ended.err
    ended = typed("check", "--new", str(tmp_path / "acsard.toml"))
    assert ended.out == f"{tmp_path / 'acsard.toml'} has all settings with their defaults"
    ended = typed("check", "--config", str(tmp_path / "acsard.toml"), "--json")
    assert msgspec.json.decode(ended.out)["robot"] == {"id": "acsar"}


def test_an_empty_command_line_is_the_daemon_s(monkeypatch: pytest.MonkeyPatch) -> None:
    ran = list[str]()

    def run(args: Any) -> int:
        ran.append(args.verb)
        return 0

    module = SimpleNamespace(
        __doc__="", add_options=lambda known: known.add_argument("--id"), main=run
    )
    monkeypatch.setattr("acsard.cli.command_line._module", lambda _: module)
    assert main([]) == 0
    monkeypatch.setattr(sys, "argv", ["acsard", "top"])
    assert main() == 0
    assert main(["--id", "robot1"]) == 0
    assert ran == ["run", "top", "run"]


@pytest.mark.parametrize(
    ("word", "begins"), [("--version", "acsard "), ("--help", "usage: acsard")]
)
def test_an_option_of_acsard_itself_is_not_the_daemon_s(word: str, begins: str) -> None:
    ended = typed(word)
    assert ended.code == 0
    assert ended.out.startswith(begins)
    assert "usage: acsard run" not in ended.out
