"""Tests of the words after `acsard set`, which give settings as key=value."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from acsard.cli import main, parser
from acsard.cli.set import pairs
from acsard.core.messages.schema import ServiceReply
from acsard.host.errors import Exit, UsageError
from tests.each import each


@each(
    ("word", "value"),
    [
        ("0.8", 0.8),
        ("-1", -1),
        ("true", True),
        ("debug", "debug"),
        ('"debug"', "debug"),
        ("[1, 2.5]", [1, 2.5]),
        ("nan and more", "nan and more"),
        ("1\nother = 2", "1\nother = 2"),
        ("", ""),
        ("'", "'"),
        ("2026-01-01", "2026-01-01"),
        ("{a = 1}", "{a = 1}"),
    ],
)
def test_a_value_is_written_as_in_the_file_and_a_bare_word_is_a_text(
    word: str, value: object
) -> None:
    settings = pairs(["log.level", word])
    assert settings == {"log.level": value}
    assert type(settings["log.level"]) is type(value)


def test_several_settings_are_a_list_of_key_value_pairs() -> None:
    assert pairs(["rates.state", "5", "log.level", "info"]) == {
        "rates.state": 5,
        "log.level": "info",
    }
    assert pairs([]) == {}


def test_a_key_without_a_value_is_refused_with_the_syntax() -> None:
    with pytest.raises(UsageError, match=r"pairs of KEY VALUE"):
        pairs(["limits.linear_speed"])


@each("word", ["nan", "-inf", "1e400", "[1, inf]"])
def test_a_number_that_is_not_finite_is_refused_with_its_key(word: str) -> None:
    words = rf"^limits\.linear_speed = {re.escape(word)}: a number must be finite"
    with pytest.raises(UsageError, match=words):
        pairs(["rates.state", "5", "limits.linear_speed", word])


def test_the_help_and_the_ros_page_say_what_write_does_not_write(
    capsys: pytest.CaptureFixture[str],
) -> None:
    """Both pages say that `--write` refuses a source's timeout, which `set` alone accepts."""
    with pytest.raises(SystemExit):
        parser().parse_args(["set", "--help"])
    page = (Path(__file__).parents[3] / "deploy" / "ros2" / "README.md").read_text()
    exception = r"--write`? cannot write a source's timeout: edit `?\[\[commands\.sources\]\]"
    for text in (capsys.readouterr().out, page):
        assert re.search(exception, " ".join(text.split()))


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ([], "name one robot in --id to list its settings"),
        (["rates.state", "5", "--write"], "--write changes only the configuration file"),
    ],
)
def test_several_robots_are_refused_for_a_list_and_for_the_local_file(
    words: list[str], why: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["set", *words, "--id", "a,b"]) == Exit.USAGE
    assert why in capsys.readouterr().err


def test_the_answer_says_how_long_the_setting_lasts(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    answer = "rates.state = 5.0 (was 10.0)"

    class Robot:
        def __enter__(self) -> Robot:
            return self

        def __exit__(self, *words: object) -> None: ...

        def set(self, settings: dict[str, object], *, keep: bool) -> ServiceReply:
            return ServiceReply(True, f"{answer}; written to robot.toml" if keep else answer)

    monkeypatch.setattr("acsard.cli.connection.connect", lambda *words, **more: Robot())
    outputs: tuple[tuple[list[str], str], ...] = (
        ([], f"{answer}; a set lasts until the daemon's next start"),
        (["--keep"], f"{answer}; written to robot.toml"),
    )
    for words, output in outputs:
        args = parser().parse_args(["set", "rates.state", "0.5", *words])
        assert args.main(args) == 0
        assert capsys.readouterr().out == f"{output}\n"


def test_keep_needs_a_setting(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["set", "--keep"]) == Exit.USAGE
    assert "acsard set limits.linear_speed 0.8 --keep" in capsys.readouterr().err
