"""The ways that `acsard move` takes."""

from __future__ import annotations

from contextlib import nullcontext
from types import SimpleNamespace

import pytest

from acsard.cli import main, move
from acsard.cli.move import _parsed
from acsard.core.values import Pose
from acsard.host.errors import UsageError
from tests.each import each


def test_ways_are_metres_and_degrees_in_their_directions() -> None:
    words = ["forward", "1", "left", "90", "back", "0.5", "right", "45"]
    assert _parsed(words) == [(False, 1.0), (True, 90.0), (False, -0.5), (True, -45.0)]


@each("words", ["up 1", "forward", "forward x", "forward -1", "left nan", "1 forward", "left 1 up"])
def test_other_words_are_refused_with_an_example(words: str) -> None:
    with pytest.raises(UsageError, match="acsard move forward 1 left 90"):
        _parsed(words.split())


def test_an_interrupted_drive_prints_how_far_it_came(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def driven(_: float, *, speed: float) -> None:
        raise KeyboardInterrupt

    robot = SimpleNamespace(move=driven, pose=lambda: Pose(0.53, 0.0, 0.0))
    monkeypatch.setattr(move, "connected", lambda *_: nullcontext())
    monkeypatch.setattr(move, "Client", lambda _: robot)
    assert main(["move", "forward", "1"]) == 130
    assert "+0.530 m" in capsys.readouterr().out
