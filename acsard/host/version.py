"""Finds the version of this program, and says which of two versions is older.

The number stands in `acsard/__init__.py`. The commit of the source follows it, as in
`0.2.0.dev0+g1a2b3c4d5`, and `.dirty` if files differ from that commit. A release, which is a number
without `.dev` from an unchanged source, is the number alone.

This module uses only the standard library, because the build reads it.
"""

from __future__ import annotations

import re
import subprocess
from functools import lru_cache
from pathlib import Path

from acsard import __version__

_PACKAGE = Path(__file__).parents[1]

COMMIT_FILE = "commit"  # `deploy/build_hook.py` puts it into wheel and sdist

HASH_DIGITS = 9

DIRTY = ".dirty"

GIT_TIMEOUT_S = 10.0  # the first look at a large clone on an SD card takes seconds

_NUMBER = re.compile(r"([0-9]{1,6})\.([0-9]{1,6})\.([0-9]{1,6})(?:(\.dev|rc)([0-9]{1,6}))?(?=\+|$)")
_PHASES = (".dev", "rc", None)


@lru_cache(1)
def version() -> str:
    """Return the version, or the number alone if the commit is not known."""
    return full_version(__version__, source())


def full_version(number: str, commit: str) -> str:
    """Return the version of a source that `source()` describes."""
    if not commit or (".dev" not in number and not commit.endswith(DIRTY)):
        return number
    return f"{number}+g{commit[:HASH_DIGITS]}{DIRTY if commit.endswith(DIRTY) else ''}"


def source() -> str:
    """Return the commit of this program's source, with `.dirty` if files differ; "" if unknown."""
    built = _text(_PACKAGE / COMMIT_FILE)
    return built or source_of(_PACKAGE.parent)


def source_of(clone: Path) -> str:
    """Return the commit that is checked out in `clone`, with `.dirty` if files differ from it.

    "" if it is no clone, or without git. A clone of another user is read too.
    """
    if not (clone / ".git").exists():
        return ""  # git would look in the directories above
    git = ["git", "--no-optional-locks", "-c", "safe.directory=*", "-C", str(clone)]
    try:
        done = subprocess.run(
            [*git, "status", "--porcelain=v2", "--branch"],
            stdin=subprocess.DEVNULL, capture_output=True, text=True, timeout=GIT_TIMEOUT_S,
            check=True,
        )  # fmt: skip
    except (OSError, subprocess.SubprocessError):
        return ""
    lines = done.stdout.splitlines()
    commit = lines[0].removeprefix("# branch.oid ")
    return commit + DIRTY if any(line[0] != "#" for line in lines) else commit


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
