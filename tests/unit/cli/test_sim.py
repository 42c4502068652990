"""Tests of the help of `acsard sim`."""

from __future__ import annotations

import pytest

from acsard.cli import main
from acsard.core.config.named_faults import ARGUMENTS
from tests.each import each


@pytest.fixture
def words(capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch) -> list[str]:
    """Return the words of the help."""
    monkeypatch.setenv("COLUMNS", "200")
    with pytest.raises(SystemExit):
        main(["sim", "--help"])
    return [word.rstrip(",;") for word in capsys.readouterr().out.split()]


@each("name", ARGUMENTS)
def test_the_help_names_each_argument_of_a_fault(name: str, words: list[str]) -> None:
    (named,) = [word for word in words if word.startswith(f"{name}=")]
    arguments = named.partition("=")[2].split(":")
    assert len(arguments) == len(ARGUMENTS[name])
    assert "NUMBER" not in arguments
