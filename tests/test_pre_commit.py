"""After `pre-commit install`, git runs every check before a commit, using `.venv`."""

from __future__ import annotations

import os
import re
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]

CHECKS = ["ruff check .", "ruff format --check .", "mypy", "lint-imports"]

TOOL = """\
#!/bin/sh
echo "${{0##*/}}${{*:+ $*}}" >>"{log}"
"""


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    """Create a repository with the hooks. Each tool in it is a stand-in that logs its call."""
    if shutil.which("git") is None:
        pytest.skip("no git")
    place = tmp_path / "clone"
    (place / ".venv/bin").mkdir(parents=True)
    for name in {check.split()[0] for check in CHECKS}:
        tool = place / ".venv/bin" / name
        tool.write_text(TOOL.format(log=tmp_path / "log"))
        tool.chmod(0o755)
    (place / ".gitignore").write_text(".venv/\n")
    shutil.copy(ROOT / ".pre-commit-config.yaml", place)
    run(place, "git", "init", "--quiet")
    run(place, "git", "add", ".")
    run(place, sys.executable, "-m", "pre_commit", "install")
    return place


def run(place: Path, *words: str) -> None:
    """Run a command without the project's tools on PATH and without a git identity."""
    env = {"PATH": os.defpath, "HOME": str(place.parent), "PRE_COMMIT_HOME": str(place.parent)}
    for role in ("AUTHOR", "COMMITTER"):
        env |= {f"GIT_{role}_NAME": "a", f"GIT_{role}_EMAIL": "a@example.org"}
    done = subprocess.run(
        words, cwd=place, env=env, capture_output=True, text=True, timeout=60.0, check=False
    )
    assert done.returncode == 0, done


@pytest.mark.slow
@pytest.mark.parametrize("name", ["acsard/new.py", "pyproject.toml"])
def test_a_commit_of_code_or_of_the_contract_runs_every_check(clone: Path, name: str) -> None:
    (clone / name).parent.mkdir(exist_ok=True)
    (clone / name).write_text("")
    run(clone, "git", "add", name)
    run(clone, "git", "commit", "--message", "one")
    assert (clone.parent / "log").read_text().splitlines() == CHECKS


def test_these_are_the_checks_that_a_change_must_pass() -> None:
    script = (ROOT / ".ci/run").read_text(encoding="utf-8")
    pattern = r"^ *\.venv/bin/((?:ruff|mypy|lint-imports)[^|\n]*?)(?: \|\|.*)?$"
    commands = re.findall(pattern, script, re.M)
    assert set(commands) == set(CHECKS)
