"""Replaces a file completely or not at all, and waits for the disk."""

from __future__ import annotations

import os
import stat
import tempfile
from pathlib import Path

NEW_MODE = 0o644
"""Mode of a new file. No file that is written this way holds secrets, and the service's own user
reads them."""


def replace(file: Path, text: str, *, synced: bool = True) -> None:
    """Replace the file by one with this text; its owner and its mode stay.

    Args:
        file: The file. Other processes find the old one or the new one, never a part of it.
        text: The new content.
        synced: True waits for the disk before the rename, so that a power cut leaves the old file
            or the new one. After False a power cut may leave a part of the new one until `sync`.
    """
    before = file.stat() if file.exists() else None
    handle, name = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name}.")
    try:
        with os.fdopen(handle, "w", encoding="utf-8", newline="") as new:
            new.write(text)
            new.flush()
            os.fchmod(new.fileno(), stat.S_IMODE(before.st_mode) if before else NEW_MODE)
            try:
                if before:
                    os.fchown(new.fileno(), before.st_uid, before.st_gid)
            except PermissionError:
                # The file of another user in a directory of ours becomes ours.
                pass
            if synced:
                os.fsync(new.fileno())
        os.replace(name, file)
    except BaseException:
        os.unlink(name)
        raise


def sync(file: Path) -> None:
    """Wait until the disk has the file and its name."""
    for path in (file, file.parent):
        handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
        try:
            os.fsync(handle)
        finally:
            os.close(handle)
