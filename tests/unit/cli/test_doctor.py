"""`acsard doctor` prints the texts of a robot safely."""

from __future__ import annotations

import pytest

from acsard.cli import doctor, main
from acsard.machine.finding import Finding


def test_control_characters_of_a_robot_do_not_reach_the_terminal(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    finding = Finding("daemon", "ok", "ready: \x1b]0;owned\x07\nFAIL", "type\x1b[2J\n  a = 1")
    monkeypatch.setattr(doctor, "examine", lambda *_: [finding])
    assert main(["doctor"]) == 0
    text = capsys.readouterr().out
    assert (
        text == "ok    daemon: ready: \ufffd]0;owned\ufffd FAIL\n      -> type\ufffd[2J\n  a = 1\n"
    )
