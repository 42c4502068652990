"""Writes a file or a directory atomically, and never over a recording.

The content is written beside the target under another name and renamed at the end, so the target is
complete or absent. With `force` an existing target is replaced, but only if it is a plain file or a
ROS bag. A recording, or a directory that holds anything else, is never replaced.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from errno import EEXIST
from pathlib import Path
from typing import BinaryIO

from acsard.host.errors import RecordingError
from acsard.recording.file import Recording

METADATA = "metadata.yaml"

OF_A_BAG = (".mcap", ".db3")
"""Suffixes of the data files of a rosbag2 directory."""


@contextmanager
def beside(new: Path, force: bool) -> Iterator[Path]:
    """Yield the path to write to, and rename it to `new` when the block succeeds.

    Raises `FileExistsError` if `new` must not be replaced, and any other `OSError`. After an error
    `new` is unchanged and no temporary file is left.
    """
    _require_free(new, force)
    part = _near(new, "part")
    try:
        yield part
        _require_free(new, force)
        _put(part, new)
    except BaseException:
        _remove(part)
        raise


def synced(stream: BinaryIO) -> None:
    """Flush the stream and sync its file to the disk."""
    stream.flush()
    os.fsync(stream.fileno())


def _put(part: Path, new: Path) -> None:
    """Rename `part` to `new`.

    A directory cannot be replaced in one call, so the old one is deleted after the new one is in
    place.
    """
    if not new.is_dir():
        os.replace(part, new)
        return
    old = _near(new, "old")
    os.rename(new, old)
    try:
        os.rename(part, new)
    except BaseException:
        os.rename(old, new)
        raise
    _remove(old)


def _near(new: Path, ending: str) -> Path:
    return new.with_name(f".{new.name}.{os.getpid()}.{ending}")


def _require_free(new: Path, force: bool) -> None:
    if not (new.exists() or new.is_symlink()):
        return
    if new.is_dir():
        _require_bag(new)
    elif new.exists() and not new.is_file():
        raise FileExistsError(EEXIST, "it is a device or a pipe, not a file; name a file")
    elif new.is_file() and _is_recording(new):
        raise FileExistsError(EEXIST, "it is a recording; name another file")
    if not force:
        raise FileExistsError(EEXIST, "it exists; --force overwrites it")


def _require_bag(directory: Path) -> None:
    if not (directory / METADATA).is_file():
        raise FileExistsError(EEXIST, "it is a directory, but not a bag")
    for one in sorted(directory.iterdir()):
        ours = one.name == METADATA or one.suffix in OF_A_BAG
        if one.is_symlink() or not one.is_file() or not ours:
            raise FileExistsError(EEXIST, f"it is a directory with {one.name}, and not only a bag")
        if one.suffix == ".mcap" and _is_recording(one):
            raise FileExistsError(
                EEXIST, f"it contains a recording, {one.name}; name another directory"
            )


def _is_recording(path: Path) -> bool:
    try:
        Recording(path)
    except RecordingError:
        return False
    return True


def _remove(path: Path) -> None:
    """Remove a file, or a bag's directory file by file.

    A recursive delete could remove more than a bag.
    """
    if path.is_dir() and not path.is_symlink():
        for one in path.iterdir():
            one.unlink()
        path.rmdir()
    else:
        path.unlink(missing_ok=True)
