"""`acsard service` on a robot whose service comes from the Debian package."""

from __future__ import annotations

from pathlib import Path

import pytest

from acsard.cli import main
from acsard.machine import versions
from tests.each import each


@each("action", ["install", "uninstall"])
def test_the_service_of_the_debian_package_is_left_to_apt(
    action: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:
    (tmp_path / versions.PACKAGE).mkdir(exist_ok=True)
    monkeypatch.setattr(versions, "HOME", tmp_path)
    assert main(["service", action, "--dry-run"]) == 1
    shown = capsys.readouterr()
    assert "`sudo apt remove acsard` removes it" in shown.err
    assert shown.out == ""
