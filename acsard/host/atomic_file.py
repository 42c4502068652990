"""Replaces a file completely or not at all, and waits for the disk."""

from __future__ import annotations

import os
import stat
import tempfile
from contextlib import suppress
from pathlib import Path

NEW_MODE = 0o644
"""Default mode of a new file: 0o644, because the user of the systemd service must be able to read
the file."""


def replace(
    file: Path,
    content: bytes,
    *,
    mode: int | None = None,
    owner: tuple[int, int] | None = None,
    synced: bool = True,
) -> None:
    """Replace a file by a new one. If that fails, raise `OSError` and leave the old file unchanged.

    Args:
        file: The file. Other processes find the old file or the new one, never a part of it.
        content: The new content. Only the owner can read the file until its mode is set.
        mode: The mode. None keeps that of the old file, and gives a new file `NEW_MODE`.
        owner: The user and the group. None keeps those of the old file, if this process may.
        synced: True waits for the disk before the rename, so that a power cut leaves the old or the
            new file. If False, a power cut before `sync` may leave a part of the new file.
    """
    kept = owner
    if file.exists():
        before = file.stat()
        mode = stat.S_IMODE(before.st_mode) if mode is None else mode
        kept = owner or (before.st_uid, before.st_gid)
    handle, name = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name}.")
    try:
        with os.fdopen(handle, "wb") as new:
            new.write(content)
            new.flush()
            os.fchmod(new.fileno(), NEW_MODE if mode is None else mode)
            try:
                if kept:
                    os.fchown(new.fileno(), *kept)
            except PermissionError:
                # This process may not give a file to another user, so its own user owns the new
                # file. The file keeps its group if this user is a member of the group.
                if owner or kept is None:
                    raise
                with suppress(PermissionError):
                    os.fchown(new.fileno(), -1, kept[1])
            if synced:
                os.fsync(new.fileno())
        os.replace(name, file)
    except BaseException:
        os.unlink(name)
        raise


def sync(path: Path) -> None:
    """Wait until the disk has stored the content of this file, or the entries of this directory."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
