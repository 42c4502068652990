"""Long commands show their progress on one terminal line, which they erase at the end."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from acsard.cli import main
from tests.scenarios.taped import Tape
from tests.scenarios.world import World
from tests.unit.cli.test_mcu import on_terminal

SLOW = pytest.mark.slow


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of this version, which is long enough to show progress."""
    tape = Tape()
    World(recorder=tape).drive(0.5, 0.3, seconds=8.0)
    return tape.save(tmp_path_factory.mktemp("recorded") / "drive.rec.zst")


@pytest.mark.slow
@pytest.mark.parametrize(
    "verb", ["replay", pytest.param("report", marks=SLOW), pytest.param("export", marks=SLOW)]
)
def test_the_progress_is_shown_on_a_terminal(
    verb: str, recorded: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    words = [
        "recording",
        verb,
        str(recorded),
        *([] if verb == "replay" else [str(tmp_path / "new")]),
    ]
    output = on_terminal(80, lambda: main(words), monkeypatch)
    assert re.match(r"(\r2027-01-15 \d\d:00:0\d)+", output)
    assert output.endswith("\r\x1b[K")


def test_no_progress_is_written_into_a_pipe(
    recorded: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["recording", "replay", str(recorded)]) == 0
    assert capsys.readouterr().err == ""
