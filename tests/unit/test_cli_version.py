"""The version, extras that are missing, and the modes of a terminal."""

from __future__ import annotations

import json
import os
import pty
import select
import shlex
import subprocess
import sys
import termios
from collections.abc import Iterator
from importlib import metadata
from pathlib import Path
from typing import TextIO, get_args

import pytest

from acsard.core.config.settings import LogConfig
from acsard.core.values import Event
from acsard.host import extras
from acsard.host.extras import Extra, install
from acsard.host.logs import Log
from acsard.host.terminal_modes import single_key_mode
from acsard.host.version import full_version, order, source_of
from tests.each import each


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
        assert source_of(clone) == git(clone, "rev-parse", "HEAD")
    git(clone, "worktree", "add", "-q", "-b", "other", "../tree")
    tree = clone.parent / "tree"
    git(tree, "commit", "-q", "--allow-empty", "-m", "second")
    (tree / "below").mkdir()
    assert source_of(tree / "below") == "", "installed in a clone of another program"
    assert source_of(tree) == git(tree, "rev-parse", "HEAD") != source_of(clone)


def test_a_changed_clone_is_dirty_and_an_ignored_file_changes_nothing(
    clone: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    commit = source_of(clone)
    (clone / ".git/info/exclude").write_text("ignored\n")
    (clone / "ignored").touch()
    assert source_of(clone) == commit
    (clone / "new").touch()
    assert source_of(clone) == f"{commit}.dirty"
    monkeypatch.setenv("PATH", "")
    assert source_of(clone) == "", "without git"


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


PIP = [sys.executable, "-m", "pip", "install"]
WHEEL = "file:///tmp/acsard-0.2.0-py3-none-any.whl"


class Installed:
    def __init__(self, url: str) -> None:
        self._url = url

    def read_text(self, name: str) -> str | None:
        return json.dumps({"url": self._url}) if self._url else None


@each("extra", get_args(Extra))
@each(
    ("url", "what"),
    [
        ("file:///home/ann/acsard", ".[{}]"),
        (WHEEL, f"acsard[{{}}] @ {WHEEL}"),
        ("", "acsard[{}]"),
    ],
)
@each(
    ("file", "command"),
    [
        ("", PIP),
        ("uv-receipt.toml", ["uv", "tool", "install"]),
        ("pipx_metadata.json", ["pipx", "install", "--force"]),
    ],
)
def test_the_advised_command_installs_the_extra_as_acsard_was_installed(
    extra: Extra,
    url: str,
    what: str,
    file: str,
    command: list[str],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(metadata, "distribution", lambda name: Installed(url))
    monkeypatch.setattr(extras, "find_spec", lambda library: None)
    prefix = tmp_path / (file or "venv")
    prefix.mkdir(exist_ok=True)
    monkeypatch.setattr(sys, "prefix", str(prefix))
    if file:
        (prefix / file).touch()
    words = shlex.split(install(extra).split("`")[1])
    assert words == [*command, what.format(extra)]


@each("file", ["uv-receipt.toml", "pipx_metadata.json"])
def test_uv_and_pipx_keep_the_other_extra(
    file: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(extras, "find_spec", lambda library: library == "aiohttp" or None)
    monkeypatch.setattr(sys, "prefix", str(tmp_path))
    (tmp_path / file).touch()
    assert "[foxglove,tools]" in install("foxglove")


@pytest.fixture(name="terminal")
def _terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, TextIO]]:
    """Yield both ends of a terminal that supports colours."""
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")
    ours, theirs = os.openpty()
    with os.fdopen(theirs, "w") as stream:
        yield ours, stream
    os.close(ours)


@pytest.mark.parametrize("wanted", [True, False])
def test_the_log_of_a_terminal_is_coloured_unless_no_color_is_set(
    terminal: tuple[int, TextIO], monkeypatch: pytest.MonkeyPatch, wanted: bool
) -> None:
    if not wanted:
        monkeypatch.setenv("NO_COLOR", "1")
    ours, stream = terminal
    logs = Log(LogConfig(), stream)
    logs.event(Event("stop", "stopped"))
    logs.close()
    assert (b"\x1b[" in os.read(ours, 4096)) is wanted


CTRL_S = b"\x13"


def test_ctrl_s_is_read_as_a_key_and_the_terminal_modes_are_restored_afterwards(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    master, slave = pty.openpty()
    with os.fdopen(slave) as terminal, os.fdopen(master, "rb", 0) as far:
        monkeypatch.setattr(sys, "stdin", terminal)
        before = termios.tcgetattr(terminal)
        assert before[0] & termios.IXON
        with single_key_mode():
            os.write(far.fileno(), CTRL_S)
            assert os.read(terminal.fileno(), 9) == CTRL_S
            os.write(terminal.fileno(), b"written")
            assert select.select([far], [], [], 5.0)[0]
            assert far.read(9) == b"written"
        assert termios.tcgetattr(terminal) == before
