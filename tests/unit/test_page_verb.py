"""`acsard web` makes and lists tokens."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

from acsard.cli import main
from acsard.machine.authority import Authority


@pytest.fixture
def told(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> Callable[..., str]:
    """Return a function that runs `acsard web` with exit code 0 and returns its output.

    It uses a temporary certificate and state directory.
    """
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    Authority.make(Path("tls"), "test", 1).issue(Path("tls"), "robot", ["localhost"], 1)
    where = ["--tls", "tls", "--address", "https://127.0.0.1:8443"]

    def called(*words: str, robot: str = "robot1") -> str:
        capsys.readouterr()
        assert main(["web", *where, "--id", robot, *words]) == 0
        return capsys.readouterr().out

    return called


def test_a_visitor_is_invited_for_an_hour_which_the_link_and_the_list_say(
    told: Callable[..., str],
) -> None:
    assert ", for 1 h; the link" in told("invite", "viewer", "--hours", "1")
    assert ", for 30 d; the link" in told("invite", "operator")
    rows = told("tokens").splitlines()
    assert [row.rpartition(", ")[2] for row in rows] == ["1 h left", "30 d left"]
