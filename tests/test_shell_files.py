"""The script of a release writes a man page and completion scripts with all subcommands."""

from __future__ import annotations

import shutil
import subprocess
import sys
from pathlib import Path

from acsard.cli import VERBS
from tests.pages import ROOT


def test_the_release_script_writes_the_man_page_and_the_completions(tmp_path: Path) -> None:
    words = [sys.executable, str(ROOT / "deploy/shell_files.py"), str(tmp_path)]
    subprocess.run(words, check=True, timeout=60.0)
    page = (tmp_path / "acsard.1").read_text().replace("\\-", "-").replace("\\", "")
    assert page.startswith(".TH ACSARD")
    assert all(words in page for words in ("acsard service uninstall", "--purge", "exit codes:"))
    for shell, name in {"bash": "acsard", "zsh": "_acsard", "fish": "acsard.fish"}.items():
        text = (tmp_path / name).read_text()
        assert all(verb in text for verb in {*VERBS, "purge", "set_pose"})
        if shutil.which(shell):
            subprocess.run([shell, "-n", str(tmp_path / name)], check=True, timeout=30.0)
