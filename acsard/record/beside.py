"""A file made of a recording stands there whole or not at all: it is written beside its name and
gets it at the end. What stood there before goes only by force, and only if it can have been such a
file or a bag: never a recording, nor a directory with anything else in it.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from errno import EEXIST
from pathlib import Path
from typing import BinaryIO

from acsard.host.errors import RecordingError
from acsard.record.file import Recording

METADATA = "metadata.yaml"

OF_A_BAG = (".mcap", ".db3")
"""What else the directory of a rosbag2 holds."""


@contextmanager
def beside(new: Path, force: bool) -> Iterator[Path]:
    """Where to write what is to be `new`, which it is at the end, if all went well.

    Raises `FileExistsError` where something is there that must not go, any other `OSError` too;
    then `new` is as it was and nothing is left behind.
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
    """What was written is on the disk."""
    stream.flush()
    os.fsync(stream.fileno())


def _put(part: Path, new: Path) -> None:
    """What replaces a directory cannot do so at once: the old one goes when the new is there."""
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
        raise FileExistsError(EEXIST, "it is no file but a device or a pipe; name a file")
    elif new.is_file() and _is_recording(new):
        raise FileExistsError(EEXIST, "it is a recording; name another file")
    if not force:
        raise FileExistsError(EEXIST, "it exists; --force writes it anew")


def _require_bag(directory: Path) -> None:
    if not (directory / METADATA).is_file():
        raise FileExistsError(EEXIST, "it is a directory, and no bag")
    for one in sorted(directory.iterdir()):
        ours = one.name == METADATA or one.suffix in OF_A_BAG
        if one.is_symlink() or not one.is_file() or not ours:
            raise FileExistsError(EEXIST, f"it is a directory with {one.name}, not only a bag")
        if one.suffix == ".mcap" and _is_recording(one):
            raise FileExistsError(EEXIST, f"it has a recording, {one.name}; name another directory")


def _is_recording(path: Path) -> bool:
    try:
        Recording(path)
    except RecordingError:
        return False
    return True


def _remove(path: Path) -> None:
    """File by file: what is more than a bag is not removed."""
    if path.is_dir() and not path.is_symlink():
        for one in path.iterdir():
            one.unlink()
        path.rmdir()
    else:
        path.unlink(missing_ok=True)
