"""The command line: exit codes, options, a cold start, and why a tool waits."""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import pytest
from msgspec.structs import replace

from acsard.bus.robot_discovery import Presence
from acsard.cli import drive, foxglove, main, move, parser, robot_options
from acsard.cli.command_line import VERBS
from acsard.cli.move import _parsed
from acsard.cli.robot_options import Silence
from acsard.client.follower import FIRST_STATE_TIMEOUT_S
from acsard.client.identity import ClientIdentity
from acsard.core.messages.schema import ServiceReply
from acsard.core.values import Pose
from acsard.host import errors
from acsard.host.errors import (
    MendableError,
    NotPermittedError,
    UsageError,
)
from acsard.top import terminal
from tests.each import each
from tests.unit.screens import STATE

PROMISED = [
    (errors.UsageError, ValueError, 2), (errors.ReplyError, RuntimeError, 1),
    (errors.NotDrivenError, RuntimeError, 1), (errors.RecordingError, ValueError, 1),
    (errors.NoPortError, FileNotFoundError, 66), (errors.UnreachableError, ConnectionError, 69),
    (errors.NoAnswerError, TimeoutError, 69), (errors.InUseError, OSError, 75),
    (errors.NotPermittedError, PermissionError, 77), (errors.CertificateError, ValueError, 78),
]  # fmt: skip
"""Error class, built-in base class and exit code, as section 6 of DESIGN lists them."""


@each(("kind", "builtin", "code"), PROMISED)
def test_each_error_has_a_builtin_base_class_and_an_exit_code(
    kind: type[MendableError], builtin: type[Exception], code: int
) -> None:
    error = kind("it is so; mend it")
    assert isinstance(error, builtin)
    assert error.code == code
    assert str(error) == "it is so; mend it"


def helped(known: argparse.ArgumentParser, path: str) -> Iterator[str]:
    """Yield the words of a help page and of those below, without the layout."""
    yield f"--- {path}"
    yield from filter(None, (known.description, known.epilog))
    for action in known._actions:
        if isinstance(action, argparse._SubParsersAction):
            yield from (f"{one.dest}: {one.help}" for one in action._choices_actions)
            for name, below in action.choices.items():
                yield from helped(below, f"{path} {name}")
        elif action.help not in ("show this help message and exit", argparse.SUPPRESS):
            names = ", ".join(action.option_strings) or str(action.metavar or action.dest)
            yield f"{names}: {action.help}"


def test_the_help_pages_have_the_approved_words(approved: Callable[[Path, str], None]) -> None:
    text = "\n".join(line.rstrip() for line in helped(parser(), "acsard")) + "\n"
    approved(Path(__file__).with_name("words") / "help.txt", text)


@each(
    ("between", "behind"),
    [
        ("recording export 1 --csv cal.csv", "recording export 1 cal.csv --csv"),
        ("recording report 1 --force x.html", "recording report 1 x.html --force"),
        ("call set_pose --json 1 -2 3", "call set_pose 1 -2 3 --json"),
        ("call set_pose 1 --id r1 -2 --json 3", "call set_pose 1 -2 3 --id r1 --json"),
        ("set limits.linear_speed --json 0.8", "set limits.linear_speed 0.8 --json"),
        (
            "set rates.telemetry 5 --id r1 log.level info",
            "set rates.telemetry 5 log.level info --id r1",
        ),
    ],
)
def test_an_option_may_stand_between_two_arguments(between: str, behind: str) -> None:
    known = parser(between.split()[:1])
    assert known.parse_args(between.split()) == known.parse_args(behind.split())


# Each takes 1 to 20 ms of processor time to load.
SLOW = {
    "acsard.bus.access_rules", "acsard.core.incoming.queries", "acsard.core.messages.json_schema",
    "asyncio", "concurrent.futures", "cryptography", "difflib", "hashlib", "logging", "numpy",
    "rich", "socket", "ssl", "structlog", "subprocess", "tempfile", "tomllib",
}  # fmt: skip


def test_call_loads_no_slow_library() -> None:
    code = "import sys; from acsard.cli import parser; parser(['call']); print(*sys.modules)"
    done = subprocess.run(
        [sys.executable, "-P", "-c", code], capture_output=True, text=True, check=True, timeout=60
    )
    assert SLOW & set(done.stdout.split()) == set()


@pytest.fixture(name="reasons")
def _reasons(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Return the reasons that a look finds for a first and for a later silence."""
    reasons = {"first": "waiting for\x1b[2J acsard/ghost/state", "later": "the way to it is cut"}
    monkeypatch.setattr(robot_options, "_none_yet", lambda *_: reasons["first"])
    monkeypatch.setattr(robot_options, "_ceased", lambda _: reasons["later"])
    return reasons


ROBOT: Any = SimpleNamespace()


def test_each_silence_is_explained_once(
    reasons: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    silence = Silence(ROBOT, "state")
    silence.look(0.9 * FIRST_STATE_TIMEOUT_S)
    assert capsys.readouterr().err == ""
    for quiet_s in range(2, 20):
        silence.look(quiet_s)
    told = capsys.readouterr().err
    assert told.startswith("acsard: waiting for")
    assert (told.count("\n"), told.strip().isprintable()) == (1, True)
    for _ in range(2):
        silence.heard()
        for quiet_s in range(20):
            silence.look(quiet_s)
        assert capsys.readouterr().err == "acsard: the way to it is cut\n"


def test_the_reason_of_a_silence_is_looked_for_every_two_seconds(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    looks = list[str]()

    def none_yet(_: object, key: str) -> str:
        looks.append(key)
        return ""

    monkeypatch.setattr(robot_options, "_none_yet", none_yet)
    silence = Silence(ROBOT, "state")
    for tenths in range(100):
        silence.look(tenths / 10)
    assert len(looks) == int(9.9 / FIRST_STATE_TIMEOUT_S)


@each(
    ("status", "trouble", "words"),
    [
        (None, "", ""),
        (Presence(linked=True, here=True), "", "robot ghost is there, but state does not arrive"),
        (Presence(linked=False, here=False), "", "the connection to tls/x:1 is lost"),
        (Presence(linked=False, here=False), "no route", "/state: no route"),
        (Presence(linked=True, here=False), "no route", "robot ghost is not visible"),
    ],
)
def test_the_reason_of_a_first_silence_is_the_network_or_what_the_bus_shows(
    status: Presence | None, trouble: str, words: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    where = SimpleNamespace(robot_id="ghost", endpoint="tls/x:1", tls="")
    robot: Any = SimpleNamespace(where=where, session=None, key=lambda key: f"acsard/ghost/{key}")
    monkeypatch.setattr(robot_options, "presence", lambda *_: status)
    monkeypatch.setattr(robot_options, "_of_link", lambda _: trouble)
    reason = robot_options._none_yet(robot, "state")
    assert words in reason
    assert reason.startswith("waiting for messages on acsard/ghost/state: ") == bool(words)


def test_ways_are_metres_and_degrees_in_their_directions() -> None:
    words = ["forward", "1", "left", "90", "back", "0.5", "right", "45"]
    assert _parsed(words) == [(False, 1.0), (True, 90.0), (False, -0.5), (True, -45.0)]


@each("words", ["up 1", "forward", "forward x", "forward -1", "left nan", "1 forward", "left 1 up"])
def test_other_words_are_refused_with_an_example(words: str) -> None:
    with pytest.raises(UsageError, match="acsard move forward 1 left 90"):
        _parsed(words.split())


class Called:
    """A robot that takes every call."""

    def __init__(self) -> None:
        self.calls: list[tuple[str, dict[str, object]]] = []

    def __enter__(self) -> Called:
        return self

    def __exit__(self, *_: object) -> None: ...

    def call(self, verb: str, **fields: object) -> ServiceReply:
        self.calls.append((verb, fields))
        return ServiceReply(True, "done")


@each(
    ("words", "fields"),
    [
        ("clear", {}),
        ("clear 7 9007199254740991", {"numbers": [7, (1 << 53) - 1]}),
        ("activate 0", {"numbers": [0]}),
        ("set_pose 1 -2 3", {"x": 1.0, "y": -2.0, "yaw": 3.0}),
    ],
)
def test_a_call_has_the_numbers_that_were_typed(
    words: str, fields: dict[str, object], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = Called()
    monkeypatch.setattr(robot_options, "open_connection", lambda *_, **__: robot)
    assert main(["call", *words.split()]) == 0
    assert robot.calls == [(words.split()[0], fields)]


@each(
    ("words", "why"),
    [
        ("clear 9007199254740992", "is not the number of a cause"),
        ("clear 0.5", "is not the number of a cause"),
        ("clear -1", "is not the number of a cause"),
        ("set_pose 1 2", "acsard call set_pose X Y YAW"),
        ("set_pose 1 2 nan", "YAW = nan: the number must be finite"),
        ("set 1", "a setting is changed with `acsard set KEY VALUE`"),
    ],
)
def test_a_call_with_other_numbers_is_refused_before_it_is_sent(
    words: str,
    why: str,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    monkeypatch.setattr(robot_options, "open_connection", lambda *_, **__: pytest.fail("sent"))
    assert main(["call", *words.split()]) == 2
    assert why in capsys.readouterr().err


@each(("role", "code"), [("viewer", 77), ("", 69)])
def test_a_keyboard_whose_certificate_may_not_drive_is_refused_before_the_screen_opens(
    role: Any, code: int, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    us = ClientIdentity(role, "ann", "0123")
    robot = SimpleNamespace(where=SimpleNamespace(tls="tls"), whoami=lambda: us)
    monkeypatch.setattr(robot_options, "open_connection", lambda *_, **__: nullcontext(robot))
    monkeypatch.setenv("TERM", "xterm")
    for stream in (sys.stdin, sys.stdout):
        monkeypatch.setattr(stream, "isatty", lambda: True)
    monkeypatch.setattr(terminal, "drive", lambda _: pytest.fail("the screen opened"))
    assert main(["drive"]) == code
    assert us.describe() in capsys.readouterr().err


def test_the_screen_of_a_drive_has_the_limits_if_the_client_may_read_them() -> None:
    limits = {"limits": {"linear_speed": 0.5, "angular_speed": 2.0}}
    robot: Any = SimpleNamespace(get={"config": limits}.get)
    assert drive._limits(robot) == "0.50 m/s, 2.00 rad/s"
    robot.get = Mock(side_effect=NotPermittedError("for maintainers"))
    assert drive._limits(robot) == ""


def test_an_interrupted_drive_prints_how_far_it_came_and_what_is_wrong(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def driven(_: float, *, speed: float) -> None:
        raise KeyboardInterrupt

    state = replace(STATE, wheel_fault="the rear left wheel does not turn")
    robot = SimpleNamespace(move=driven, pose=lambda: Pose(0.53, 0.0, 0.0), get=lambda _: state)
    monkeypatch.setattr(move, "connected", lambda *_: nullcontext())
    monkeypatch.setattr(move, "Client", lambda _: robot)
    assert main(["move", "forward", "1"]) == 130
    out, err = capsys.readouterr()
    assert "+0.530 m" in out
    assert "WARNING: wheel fault: the rear left wheel does not turn" in err


# the address: viewers may connect only from this machine


@pytest.mark.parametrize(
    ("text", "address"),
    [
        (foxglove.DEFAULT_ADDRESS, ("127.0.0.1", 8765)),
        ("localhost:9000", ("127.0.0.1", 9000)),
        ("127.1.2.3:1", ("127.1.2.3", 1)),
    ],
)
def test_an_address_of_this_machine_is_taken(text: str, address: tuple[str, int]) -> None:
    assert foxglove.loopback(text) == address


def test_an_argument_that_is_not_utf_8_is_named(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["run", "--id", "a\udcff"]) == 2
    assert "an argument is not valid UTF-8: 'a\\udcff'" in capsys.readouterr().err


def test_each_subcommand_is_called_by_a_test() -> None:
    tests = Path(__file__).parents[1]
    calls = "\n".join(p.read_text() for p in (tests / "unit/words/transcripts").glob("*.txt"))
    sources = "\n".join(p.read_text() for p in tests.rglob("*.py"))
    untried = [
        verb for verb in VERBS if f"$ acsard {verb}" not in calls and f'"{verb}"' not in sources
    ]
    assert not untried, f"write a transcript in tests/unit/words/transcripts, or a test: {untried}"
