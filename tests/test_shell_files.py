"""The script of a release writes a man page and completion scripts with all subcommands."""

from __future__ import annotations

import os
import pty
import re
import select
import shutil
import subprocess
import sys
import time
from pathlib import Path

import pytest

from acsard.cli import VERBS
from tests.each import each
from tests.pages import ROOT

# What a person types in each shell before `acsard call`, with the directory of the files.
BEFORE = {
    "bash": "PS1='> '; source {0}/acsard\n",
    "zsh": "PS1='> '; fpath=({0} $fpath); autoload -Uz compinit; compinit -u -D\n",
    "fish": "function fish_prompt; echo '> '; end; source {0}/acsard.fish\n",
}
QUIET = {
    "bash": ["--norc", "--noprofile", "-i"],
    "zsh": ["-f", "-i"],
    "fish": ["--no-config", "-i"],
}


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


@pytest.mark.slow
@each("shell", BEFORE)
def test_a_shell_completes_a_service_and_a_subcommand(shell: str, tmp_path: Path) -> None:
    if shutil.which(shell) is None:
        pytest.skip(f"no {shell}")
    words = [sys.executable, str(ROOT / "deploy/shell_files.py"), str(tmp_path)]
    subprocess.run(words, check=True, timeout=60.0)
    terminal, end = pty.openpty()
    home = {"HOME": str(tmp_path), "TERM": "dumb", "PATH": os.environ["PATH"]}
    process = subprocess.Popen(
        [shell, *QUIET[shell], "-i"], env=home, preexec_fn=lambda: os.login_tty(end)
    )
    os.close(end)

    def shows(what: str, seconds: float = 20.0) -> str:
        text, ends = "", time.monotonic() + seconds
        while not re.search(what, text) and time.monotonic() < ends:
            if select.select([terminal], [], [], 0.1)[0]:
                text += os.read(terminal, 4096).decode(errors="replace")
        assert re.search(what, text), text
        return text

    try:
        os.write(terminal, BEFORE[shell].format(tmp_path).encode())
        os.write(terminal, b"echo rea''dy\n")
        shows("ready")
        os.write(terminal, b"acsard doct\t")
        shows("doctor ")
        os.write(terminal, b"\x15acsard recording exp\t")
        shows("export ")
    finally:
        process.kill()
        process.wait()
        os.close(terminal)
