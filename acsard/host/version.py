"""Finds the version of this program and the commit of its source.

This module uses only the standard library, because `deploy/build_hook.py` imports it.
"""

from __future__ import annotations

import re
from functools import lru_cache
from pathlib import Path

from acsard import __version__

_PACKAGE = Path(__file__).parents[1]

COMMIT_FILE = "commit"  # made by `deploy/build_hook.py`; it contains the git commit

HASH_DIGITS = 9


@lru_cache(1)
def version() -> str:
    """Return the version, such as `0.1.0+g1a2b3c4d5`, or `0.1.0` if the commit is not known."""
    commit = source()
    return f"{__version__}+g{commit[:HASH_DIGITS]}" if commit else __version__


def source() -> str:
    """Return the commit of this program's source; "" if unknown."""
    return _text(_PACKAGE / COMMIT_FILE) or commit_of(_PACKAGE.parent)


def commit_of(clone: Path) -> str:
    """Return the commit that is checked out in `clone`; "" if it is no git clone.

    This reads git's files, because a computer that runs the daemon may have no git.
    """
    git = clone / ".git"
    if git.is_file():  # the directory is a worktree
        git = clone / _text(git).removeprefix("gitdir:").strip()
    head = _text(git / "HEAD")
    if not head.startswith("ref: "):
        return head
    name = head.removeprefix("ref: ")
    common = git / (_text(git / "commondir") or ".")
    packed = [line.partition(" ") for line in _text(common / "packed-refs").splitlines()]
    return _text(common / name) or next((commit for commit, _, ref in packed if ref == name), "")


_NUMBER = re.compile(r"([0-9]{1,6})\.([0-9]{1,6})\.([0-9]{1,6})(?:(\.dev|rc)([0-9]{1,6}))?(?=\+|$)")
_PHASES = (".dev", "rc", None)


def order(version: str) -> tuple[int, ...]:
    """Return a key that sorts versions from old to new; () if `version` is not a version.

    The commits of one number have the same key, because hashes do not sort.
    """
    match = _NUMBER.match(version)
    if match is None:
        return ()
    major, minor, patch, phase, step = match.groups()
    return int(major), int(minor), int(patch), _PHASES.index(phase), int(step or 0)


def _text(path: Path) -> str:
    try:
        return path.read_text().strip()
    except (OSError, ValueError):
        return ""
