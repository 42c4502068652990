"""Each family of errors has its exit code and a fitting built-in base class."""

from __future__ import annotations

from pathlib import Path

import pytest

from acsard.cli import main, parser
from acsard.host import errors
from acsard.host.errors import (
    EXIT_TEXTS,
    Exit,
    ExitError,
    MendableError,
)
from tests.each import each

PROMISED = [
    (errors.UsageError, ValueError, 2),
    (errors.ReplyError, RuntimeError, 1),
    (errors.NotDrivenError, RuntimeError, 1),
    (errors.RecordingError, ValueError, 1),
    (errors.NoPortError, FileNotFoundError, 66),
    (errors.UnreachableError, ConnectionError, 69),
    (errors.NoAnswerError, TimeoutError, 69),
    (errors.InUseError, OSError, 75),
    (errors.NotPermittedError, PermissionError, 77),
    (errors.CertificateError, ValueError, 78),
    (errors.RouterFileError, ValueError, 78),
]
"""Error class, built-in base class and exit code, as section 6 of DESIGN lists them."""


@each(("kind", "builtin", "code"), PROMISED)
def test_each_error_has_a_builtin_base_class_and_an_exit_code(
    kind: type[MendableError], builtin: type[Exception], code: int
) -> None:
    error = kind("it is so; mend it")
    assert isinstance(error, builtin)
    assert error.code == code
    assert str(error) == "it is so; mend it"


def test_every_error_class_has_an_exit_code() -> None:
    kinds = {kind for kind in vars(errors).values() if isinstance(kind, type)}
    families = {kind for kind in kinds if issubclass(kind, MendableError)} - {
        MendableError,
        ExitError,
    }
    assert families == {kind for kind, _, _ in PROMISED}


def test_the_help_names_every_code(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    output = capsys.readouterr().out
    assert all(f" {int(code)} " in output for code in Exit)
    assert all(f"{code} {words}" in " ".join(output.split()) for code, words in EXIT_TEXTS.items())
    assert set(EXIT_TEXTS) == set(Exit)


@each("code", list(Exit))
def test_a_verb_may_end_with_any_code(code: Exit) -> None:
    assert ExitError(code, "so").code is code


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


@each("word", ["\udcff", "x" * 4097])
def test_an_argument_that_no_message_could_contain_is_refused(
    word: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["get", word]) == Exit.USAGE
    text = capsys.readouterr().err
    assert ("not valid UTF-8" in text) == (len(word) == 1)
    assert ("longer than 4096 characters" in text) == (len(word) > 1)


@each("name", ["STATE_DIRECTORY", "XDG_STATE_HOME", "HOME", "ACSARD_CONFIG"])
def test_a_path_in_the_environment_that_is_not_utf_8_is_refused(
    name: str, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.MonkeyPatch.context() as patched:
        patched.setenv(name, "/var/lib/\udce4")
        assert main(["--config", "/missing"]) == Exit.USAGE
    assert f"the environment variable {name} is not valid UTF-8" in capsys.readouterr().err


def test_a_current_directory_that_is_not_utf_8_is_refused(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    where = tmp_path / "\udce4"
    where.mkdir()
    monkeypatch.chdir(where)
    with pytest.raises(SystemExit) as end:
        main(["call", "--help"])
    assert end.value.code == 0
    capsys.readouterr()
    assert main(["--config", "/missing"]) == Exit.USAGE
    assert "the path of the current directory is not valid UTF-8" in capsys.readouterr().err
