"""The version contains the commit of the clone from which the code runs or was installed."""

from __future__ import annotations

import subprocess
import sys
import zipfile
from pathlib import Path

import pytest

from acsard import __version__
from acsard.host.version import COMMIT_FILE, HASH_DIGITS, commit_of, version
from tests.pages import ROOT


def git(where: Path, *words: str) -> str:
    options = ("-c", "user.name=a", "-c", "user.email=a@b", "-c", "init.defaultBranch=main")
    done = subprocess.run(
        ["git", "-C", where, *options, *words], capture_output=True, text=True, check=True
    )
    return done.stdout.strip()


@pytest.fixture
def clone(tmp_path: Path) -> Path:
    where = tmp_path / "clone"
    where.mkdir()
    git(where, "init", "-q")
    git(where, "commit", "-q", "--allow-empty", "-m", "first")
    return where


def test_the_commit_equals_that_of_git_in_each_layout_of_a_clone(clone: Path) -> None:
    for words in (
        ["checkout", "-q", "-b", "a/b"],
        ["pack-refs", "--all"],
        ["checkout", "--detach"],
    ):
        git(clone, *words)
        assert commit_of(clone) == git(clone, "rev-parse", "HEAD")
    git(clone, "worktree", "add", "-q", "-b", "other", "../tree")
    tree = clone.parent / "tree"
    git(tree, "commit", "-q", "--allow-empty", "-m", "second")
    assert commit_of(tree) == git(tree, "rev-parse", "HEAD") != commit_of(clone)


def test_without_a_readable_clone_the_commit_is_empty(tmp_path: Path) -> None:
    assert commit_of(tmp_path) == ""
    (tmp_path / ".git").mkdir()
    (tmp_path / ".git" / "HEAD").write_bytes(b"\xff\xfe")
    assert commit_of(tmp_path) == ""
    (tmp_path / ".git" / "HEAD").write_text("ref: refs/heads/none\n")
    assert commit_of(tmp_path) == ""


def test_the_version_of_a_clone_names_its_commit() -> None:
    commit = commit_of(ROOT)
    assert version() == (f"{__version__}+g{commit[:HASH_DIGITS]}" if commit else __version__)


@pytest.mark.slow
def test_a_wheel_has_the_commit_of_its_source(tmp_path: Path) -> None:
    pytest.importorskip("hatchling", reason="only the build needs it")
    words = [sys.executable, "-m", "hatchling", "build", "-t", "wheel", "-d", str(tmp_path)]
    subprocess.run(words, cwd=ROOT, check=True, capture_output=True)
    (wheel,) = tmp_path.glob("*.whl")
    with zipfile.ZipFile(wheel) as files:
        has = f"acsard/{COMMIT_FILE}" in files.namelist()
        assert has == bool(commit_of(ROOT))
        assert not has or files.read(f"acsard/{COMMIT_FILE}").decode().strip() == commit_of(ROOT)
