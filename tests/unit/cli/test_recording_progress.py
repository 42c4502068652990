"""Long commands show their progress on one terminal line, which they erase at the end."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from acsard.cli import main
from tests.unit.cli.test_mcu import on_terminal

QUIET = Path(__file__).parents[2] / "recordings" / "quiet.mcap"


SLOW = pytest.mark.slow


@pytest.mark.parametrize(
    "verb", ["replay", pytest.param("report", marks=SLOW), pytest.param("export", marks=SLOW)]
)
def test_it_says_how_far_it_is(verb: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    words = ["recording", verb, str(QUIET), *([] if verb == "replay" else [str(tmp_path / "new")])]
    told = on_terminal(80, lambda: main(words), monkeypatch)
    assert re.match(r"\r0 of \d s\r\d of \d s", told)
    assert told.endswith("\r\x1b[K")


def test_into_a_pipe_it_says_nothing_of_it(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["recording", "replay", str(QUIET)]) == 0
    assert capsys.readouterr().err == ""
