"""What the tools say of several robots, when some or all of them cannot be reached."""

from __future__ import annotations

import sys
from contextlib import nullcontext
from pathlib import Path
from typing import cast

import pytest

from acsard.cli import get, main
from acsard.cli.replies import Replies, of_each, print_each
from acsard.client.connection import Connection
from acsard.core.messages.schema import ServiceReply
from acsard.host.errors import Exit, NoAnswerError, NotPermittedError
from tests.system.harness import free_endpoint
from tests.system.typed import typed

DONE, REFUSED = ServiceReply(True, "done"), ServiceReply(False, "refused")
SILENT, BARRED = NoAnswerError("nobody"), NotPermittedError("role operator")


@pytest.mark.parametrize(
    ("replies", "code"),
    [
        ({"a": DONE}, Exit.OK),
        ({"a": DONE, "b": REFUSED}, Exit.FAILURE),
        ({"a": REFUSED, "b": BARRED}, Exit.NO_PERMISSION),
        ({"a": BARRED, "b": SILENT}, Exit.UNREACHABLE),
    ],
)
def test_a_refused_permission_is_no_silence(
    replies: Replies, code: Exit, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = cast("Connection", None)
    assert print_each(replies, robot, [*replies], "NO ANSWER", as_json=False) == code
    lines = capsys.readouterr().out.splitlines()
    assert ("b: NOT ALLOWED: role operator" in lines) == (replies.get("b") is BARRED)
    assert ("b: NO ANSWER" in lines) == (replies.get("b") is SILENT)


class Sibling:
    """A robot of a fleet, of which `b` is silent."""

    def __init__(self, robot_id: str = "") -> None:
        self.robot_id = robot_id
        self.sibling = Sibling

    def reply(self, key: str) -> tuple[str, bytes]:
        if self.robot_id == "b":
            raise SILENT
        return "application/json", b'{"key":"%b"}' % key.encode()

    def call(self) -> ServiceReply:
        self.reply("")
        return DONE


def test_each_robot_of_a_fleet_is_called_and_a_silent_one_hides_no_other() -> None:
    replies = of_each(cast("Connection", Sibling()), "abc", Sibling.call)  # type: ignore[arg-type]
    assert replies == {"a": DONE, "b": SILENT, "c": DONE}


@pytest.mark.parametrize(
    ("ids", "code", "lines"),
    [
        ("", Exit.OK, ['{"key":"state"}']),
        ("ac", Exit.OK, [f'{{"robot":"{name}","message":{{"key":"state"}}}}' for name in "ac"]),
        ("ab", Exit.UNREACHABLE, ['{"robot":"a","message":{"key":"state"}}']),
    ],
)
def test_get_prints_the_answer_of_each_robot_and_fails_if_one_is_silent(
    ids: str, code: Exit, lines: list[str],
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    monkeypatch.setattr(get, "connected_to_many", lambda _: nullcontext((Sibling(), tuple(ids))))
    assert main(["get", "state"]) == code
    out, err = capsys.readouterr()
    assert out.splitlines() == lines
    assert ("b: NO ANSWER: nobody" in err) == (code != Exit.OK)
    monkeypatch.setattr(sys.stdout, "isatty", lambda: True)
    main(["get", "state"])
    assert "\n" in capsys.readouterr().out.strip(), "a person gets a line for each field"


def test_a_cause_that_several_robots_have_is_printed_once(
    capsys: pytest.CaptureFixture[str],
) -> None:
    silent = {name: NoAnswerError(f"no answer of {name}") for name in ("a1", "a2", "a3")}
    replies: Replies = silent | {"a2": NoAnswerError("closed")}
    print_each(replies, cast("Connection", None), [*replies], "NO ANSWER", as_json=False)
    out, err = capsys.readouterr()
    assert out.splitlines() == [f"{name}: NO ANSWER" for name in replies]
    assert err.splitlines() == ["acsard: a1: no answer of a1", "acsard: a2: closed"]


@pytest.mark.parametrize(
    ("words", "code", "text"),
    [
        (("call", "stop"), Exit.UNREACHABLE, "NO ROBOT WAS STOPPED: robot1, robot2"),
        (("get", "state"), Exit.USAGE, "add one of [fleet] robots, such as `--id robot1`"),
        (("move", "forward", "1"), Exit.USAGE, "add one of [fleet] robots, such as `--id robot1`"),
    ],
)
def test_a_computer_of_a_fleet_asks_for_the_robot_but_stops_all(
    words: tuple[str, ...], code: Exit, text: str, tmp_path: Path
) -> None:
    config = tmp_path / "acsard.toml"
    config.write_text('[fleet]\nrobots = ["robot1", "robot2"]\n')
    ended = typed(*words, "--config", str(config), "--connect", free_endpoint())
    assert ended.code == code
    assert text in ended.out + ended.err


@pytest.mark.parametrize(
    ("words", "begin"),
    [
        (
            ("call", "stop", "--id", "*"),
            "acsard: NO ROBOT WAS STOPPED: robot1, robot2: go to them. Is",
        ),
        (("fleet", "--once"), "acsard: NO ROBOT WAS REACHED: robot1, robot2. Is the router"),
    ],
)
def test_without_the_router_every_expected_robot_is_named(
    words: tuple[str, ...], begin: str, tmp_path: Path
) -> None:
    config = tmp_path / "acsard.toml"
    config.write_text('[fleet]\nrobots = ["robot1", "robot2"]\n')
    ended = typed(*words, "--config", str(config), "--connect", free_endpoint())
    assert ended.code == Exit.UNREACHABLE
    assert ended.err.startswith(begin)
    assert "systemctl status acsard-router" in ended.err
