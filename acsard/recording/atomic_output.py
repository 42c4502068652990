"""Writes a file or a directory atomically, and protects recordings from being overwritten.

Data is complete before its temporary path gets the final name. A file or ROS bag is replaced only
with `force`, and a recording only if `may_replace` permits it too.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from errno import EEXIST
from pathlib import Path
from typing import BinaryIO

from acsard.host.errors import RecordingError
from acsard.recording.mcap_file import Recording
from acsard.recording.mcap_records import MAGIC

PROFILE, HEADER_BYTES = b"acsard", 64  # MCAP profile of every recording, within its first bytes

METADATA = "metadata.yaml"  # describes a ROS bag

BAG_SUFFIXES = (".mcap", ".db3")  # data files of a ROS bag


def never(recording: Recording) -> bool:
    """Return False: the default of `may_replace`."""
    return False


@contextmanager
def replacing(
    new: Path, force: bool, may_replace: Callable[[Recording], bool] = never
) -> Iterator[Path]:
    """Yield a temporary path for a file or directory, and rename it to `new` after the block.

    If the block fails, `new` is unchanged and the temporary path removed. `may_replace` is asked
    only about a recording at `new`. Raises `FileExistsError` if `new` must not be replaced.
    """
    _require_free(new, force, may_replace)
    part = _hidden_sibling(new, "part")
    try:
        yield part
        _require_free(new, force, may_replace)
        _replace(part, new)
    except BaseException:
        _remove(part)
        raise


def synced(stream: BinaryIO) -> None:
    stream.flush()
    os.fsync(stream.fileno())


def _replace(part: Path, new: Path) -> None:
    # No system call replaces a directory with files, so `new` first gets another name.
    if not new.is_dir():
        os.replace(part, new)
        return
    old = _hidden_sibling(new, "old")
    os.rename(new, old)
    try:
        os.rename(part, new)
    except BaseException:
        os.rename(old, new)
        raise
    _remove(old)


def _hidden_sibling(new: Path, ending: str) -> Path:
    return new.with_name(f".{new.name}.{os.getpid()}.{ending}")


def _require_free(new: Path, force: bool, may_replace: Callable[[Recording], bool]) -> None:
    if not (new.exists() or new.is_symlink()):
        return
    if new.is_dir():
        _require_bag(new)
    elif new.exists() and not new.is_file():
        raise FileExistsError(EEXIST, "this path is a device or a pipe, not a file; name a file")
    elif new.is_file() and (recording := _recording(new)) and not may_replace(recording):
        raise FileExistsError(
            EEXIST,
            "this file is a recording of acsard, and would be overwritten; name another file",
        )
    if not force:
        raise FileExistsError(EEXIST, "this path exists already; --force overwrites it")


def _require_bag(directory: Path) -> None:
    if not (directory / METADATA).is_file():
        raise FileExistsError(
            EEXIST, "this path is a directory, but not a ROS bag; name another path"
        )
    for path in sorted(directory.iterdir()):
        of_bag = path.name == METADATA or path.suffix in BAG_SUFFIXES
        if path.is_symlink() or not path.is_file() or not of_bag:
            raise FileExistsError(
                EEXIST,
                f"this directory contains {path.name}, which is not a part of a ROS bag; name "
                "another directory",
            )
        if path.suffix == ".mcap" and _recording(path):
            raise FileExistsError(
                EEXIST,
                f"this directory contains {path.name}, which is a recording of acsard; name "
                "another directory",
            )


def _recording(path: Path) -> Recording | None:
    # A ROS bag may be larger than the memory, so check the beginning of the file first.
    with path.open("rb") as stream:
        begin = stream.read(HEADER_BYTES)
    if not (begin.startswith(MAGIC) and PROFILE in begin):
        return None
    try:
        return Recording(path)
    except RecordingError:
        return None


def _remove(path: Path) -> None:
    # A bag has no subdirectory, so a subdirectory raises `OSError`.
    if path.is_dir() and not path.is_symlink():
        for file in path.iterdir():
            file.unlink()
        path.rmdir()
    else:
        path.unlink(missing_ok=True)
