"""`acsard web`: what it says where nobody could come."""

from __future__ import annotations

from pathlib import Path

import pytest

from acsard.cli import main


def test_an_invitation_that_nobody_could_follow_names_the_file_that_was_read(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("acsard.toml").touch()  # as in a clone, and the service's is another
    assert main(["web", "--invite", "viewer"]) == 2
    told = capsys.readouterr().err
    assert "acsard.toml" in told
    assert "--config" in told
