"""A tool explains once in each silence why it waits, and only if no message arrives."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest

from acsard.cli import connection
from acsard.cli.connection import Silence
from acsard.client.follower import FIRST_STATE_TIMEOUT_S


@pytest.fixture(name="reasons")
def _reasons(monkeypatch: pytest.MonkeyPatch) -> dict[str, str]:
    """Return the reasons that a look finds for a first and for a later silence."""
    reasons = {"first": "waiting for\x1b[2J acsard/ghost/state", "later": "the way to it is cut"}
    monkeypatch.setattr(connection, "_none_yet", lambda *_: reasons["first"])
    monkeypatch.setattr(connection, "_ceased", lambda _: reasons["later"])
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


def test_a_silence_without_a_found_cause_is_looked_at_again(
    reasons: dict[str, str], capsys: pytest.CaptureFixture[str]
) -> None:
    silence = Silence(ROBOT, "")
    reasons["later"] = ""
    silence.look(FIRST_STATE_TIMEOUT_S)
    reasons["later"] = "its certificate has ended"
    silence.look(1.9 * FIRST_STATE_TIMEOUT_S)
    assert capsys.readouterr().err == ""
    silence.look(2 * FIRST_STATE_TIMEOUT_S)
    silence.explain()  # the timeout ends it
    assert capsys.readouterr().err == "acsard: its certificate has ended\n"
