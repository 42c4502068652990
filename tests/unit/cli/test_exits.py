"""Each family of errors has its exit code and a fitting built-in base class."""

from __future__ import annotations

import pytest

from acsard.cli import main
from acsard.host import errors
from acsard.host.errors import (
    WORDS,
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
def test_an_error_is_of_a_family_of_pythons_and_has_its_code(
    kind: type[MendableError], builtin: type[Exception], code: int
) -> None:
    error = kind("it is so; mend it")
    assert isinstance(error, builtin)
    assert error.code == code
    assert str(error) == "it is so; mend it"


def test_no_family_is_without_a_code() -> None:
    kinds = {kind for kind in vars(errors).values() if isinstance(kind, type)}
    families = {kind for kind in kinds if issubclass(kind, MendableError)} - {
        MendableError,
        ExitError,
    }
    assert families == {kind for kind, _, _ in PROMISED}


def test_the_help_names_every_code(capsys: pytest.CaptureFixture[str]) -> None:
    with pytest.raises(SystemExit):
        main(["--help"])
    told = capsys.readouterr().out
    assert all(f" {int(code)} " in told for code in Exit)
    assert all(f"{code} {words}" in " ".join(told.split()) for code, words in WORDS.items())
    assert set(WORDS) == set(Exit)


@each("code", list(Exit))
def test_a_verb_may_end_with_any_code(code: Exit) -> None:
    assert ExitError(code, "so").code is code


def test_an_unknown_option_names_the_help_that_lists_the_known_ones(
    capsys: pytest.CaptureFixture[str],
) -> None:
    with pytest.raises(SystemExit) as ended:
        main(["recording", "show", "--stops"])
    assert ended.value.code == Exit.USAGE
    told = "unrecognized arguments: --stops; `acsard recording --help` lists the options"
    assert told in capsys.readouterr().err
