"""The version has the commit of the source, and sorts by its number."""

from __future__ import annotations

import subprocess
from pathlib import Path

import pytest

from acsard import __version__
from acsard.host.version import commit_of, full_version, order, source_of, version
from tests.each import each
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


def test_a_changed_clone_is_dirty_and_an_ignored_file_changes_nothing(
    clone: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commit = commit_of(clone)
    (clone / ".git/info/exclude").write_text("ignored\n")
    (clone / "ignored").touch()
    assert source_of(clone) == commit
    (clone / "new").touch()
    assert source_of(clone) == f"{commit}.dirty"
    monkeypatch.setenv("PATH", "")
    assert source_of(clone) == commit, "without git, the commit is still known"


COMMIT = "1a2b3c4d5" + "0" * 31


@each(
    ("number", "commit", "full"),
    [
        ("0.2.0.dev0", COMMIT, "0.2.0.dev0+g1a2b3c4d5"),
        ("0.2.0.dev0", f"{COMMIT}.dirty", "0.2.0.dev0+g1a2b3c4d5.dirty"),
        ("0.2.0.dev0", "", "0.2.0.dev0"),
        ("0.2.0rc1", COMMIT, "0.2.0rc1"),
        ("0.2.0", COMMIT, "0.2.0"),
        ("0.2.0", f"{COMMIT}.dirty", "0.2.0+g1a2b3c4d5.dirty"),
    ],
)
def test_only_a_release_is_the_number_alone(number: str, commit: str, full: str) -> None:
    assert full_version(number, commit) == full


def test_versions_sort_as_their_numbers_and_the_commits_of_a_number_are_equal() -> None:
    ages = ["0.2.0.dev0", "0.2.0.dev1", "0.2.0rc1", "0.2.0", "0.2.1.dev0", "0.10.0", "1.0.0"]
    keys = [order(text) for text in ages]
    assert keys == sorted(set(keys))
    assert order("0.2.0.dev0+g1a2b3c4d5.dirty") == order("0.2.0.dev0+gfedcba987")
    assert {order(text) for text in ("", "?", "0.2", "0.2.0a", "9" * 99 + ".0.0")} == {()}


def test_this_program_has_the_version_of_its_clone() -> None:
    assert version() == full_version(__version__, source_of(ROOT))
