"""Replaces files atomically, waits until the disk has stored them, and follows links."""

from __future__ import annotations

import os
import stat
from contextlib import suppress
from pathlib import Path

NEW_MODE = 0o644  # other users may read it: the systemd service may run as another user


def real_path(path: Path, new: bool = False) -> Path:
    """Return the path without symbolic links; `new` permits a missing one. Raises `OSError`."""
    # `Path.resolve` of Python 3.11 raises a RuntimeError for a loop of links.
    try:
        return Path(os.path.realpath(path, strict=True))
    except FileNotFoundError:
        if not new:
            raise
        return Path(os.path.realpath(path))


def replace(
    file: Path,
    content: bytes,
    *,
    mode: int | None = None,
    owner: tuple[int, int] | None = None,
    synced: bool = True,
) -> None:
    """Replace the content of a file, or create the file; a reader sees the old or the new content.

    `mode` None keeps the mode of an existing regular file (else `NEW_MODE`), and `owner` None its
    uid and gid, as far as permitted. Only the owner can read the new file until its mode is set.
    With `synced` a power cut, too, leaves the complete old or new file. Raises `OSError`, and then
    leaves the old file unchanged.
    """
    # A device, which a symbolic link may name, has a mode and an owner for other purposes.
    before = file.stat() if file.is_file() else None
    if mode is None:
        mode = NEW_MODE if before is None else stat.S_IMODE(before.st_mode)
    import tempfile  # readers do not need it

    handle, name = tempfile.mkstemp(dir=file.parent, prefix=f".{file.name}.")
    try:
        with os.fdopen(handle, "wb") as new:
            new.write(content)
            new.flush()
            os.fchmod(new.fileno(), mode)
            if owner is not None:
                os.fchown(new.fileno(), *owner)
            elif before is not None:
                _keep_owner(new.fileno(), before)
            if synced:
                os.fsync(new.fileno())
        os.replace(name, file)
    except BaseException:
        with suppress(OSError):
            os.unlink(name)
        raise


def _keep_owner(handle: int, before: os.stat_result) -> None:
    try:
        os.fchown(handle, before.st_uid, before.st_gid)
    except PermissionError:
        # This process may not give a file to another user, so its own user owns the new file. The
        # file keeps its group if this user is a member of the group.
        with suppress(PermissionError):
            os.fchown(handle, -1, before.st_gid)


def sync(path: Path) -> None:
    """Wait until the disk has stored a file's content, or the entries of a directory."""
    handle = os.open(path, os.O_RDONLY | os.O_CLOEXEC)
    try:
        os.fsync(handle)
    finally:
        os.close(handle)
