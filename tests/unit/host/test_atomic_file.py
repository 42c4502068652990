"""A file is replaced completely or not at all, and keeps its owner and its mode."""

from __future__ import annotations

import errno
import os
import stat
from pathlib import Path
from typing import Any

import pytest

from acsard.host.atomic_file import NEW_MODE, replace, sync

OLD, NEW = b"old\r\n", b"new\r\n\xff\0"


@pytest.fixture
def file(tmp_path: Path) -> Path:
    path = tmp_path / "file"
    path.write_bytes(OLD)
    path.chmod(0o640)
    return path


def mode_of(path: Path) -> int:
    return stat.S_IMODE(path.stat().st_mode)


def fail(*_: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_the_content_is_written_byte_for_byte_and_nothing_else_is_left(file: Path) -> None:
    replace(file, NEW)
    assert file.read_bytes() == NEW
    assert os.listdir(file.parent) == [file.name]


def test_a_file_keeps_its_mode_unless_another_is_given(file: Path) -> None:
    replace(file, NEW)
    assert mode_of(file) == 0o640
    replace(file, NEW, mode=0o600)
    assert mode_of(file) == 0o600


def test_a_file_that_replaces_a_link_to_a_device_does_not_get_the_mode_of_the_device(
    tmp_path: Path,
) -> None:
    link = tmp_path / "link"
    link.symlink_to("/dev/null")
    replace(link, NEW)
    assert not link.is_symlink()
    assert mode_of(link) == NEW_MODE


def test_a_new_file_can_be_read_by_all_unless_another_mode_is_given(tmp_path: Path) -> None:
    before = os.umask(0o077)
    try:
        replace(tmp_path / "public", NEW)
        replace(tmp_path / "secret", NEW, mode=0o600)
    finally:
        os.umask(before)
    assert (mode_of(tmp_path / "public"), mode_of(tmp_path / "secret")) == (NEW_MODE, 0o600)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give a file away")
def test_a_file_keeps_its_owner_unless_another_is_given(file: Path) -> None:
    os.chown(file, 7, 8)
    replace(file, NEW)
    assert (file.stat().st_uid, file.stat().st_gid) == (7, 8)
    replace(file, NEW, owner=(9, 10))
    assert (file.stat().st_uid, file.stat().st_gid) == (9, 10)


def test_a_replaced_file_of_another_user_belongs_to_the_present_user(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def refuse(*_: int) -> None:
        raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))

    monkeypatch.setattr(os, "fchown", refuse)
    replace(file, NEW)
    assert (file.read_bytes(), file.stat().st_uid) == (NEW, os.geteuid())
    with pytest.raises(PermissionError):
        replace(file, OLD, owner=(1, 1))
    assert file.read_bytes() == NEW


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give a file to another group")
def test_a_file_of_another_user_stays_in_its_group(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    os.chown(file, 7, 8)
    fchown = os.fchown

    def as_user(handle: int, user: int, group: int) -> None:
        if user != -1:
            raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))
        fchown(handle, user, group)

    monkeypatch.setattr(os, "fchown", as_user)
    replace(file, NEW)
    assert (file.stat().st_uid, file.stat().st_gid) == (os.geteuid(), 8)


@pytest.mark.parametrize("call", ["fchmod", "fsync", "replace"])
def test_after_an_error_only_the_old_file_exists(
    file: Path, monkeypatch: pytest.MonkeyPatch, call: str
) -> None:
    monkeypatch.setattr(os, call, fail)
    with pytest.raises(OSError, match="No space left"):
        replace(file, NEW)
    assert (file.read_bytes(), mode_of(file)) == (OLD, 0o640)
    assert os.listdir(file.parent) == [file.name]


def test_the_new_content_is_on_the_disk_before_it_gets_the_name(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    calls, fsync, rename = [], os.fsync, os.replace

    def synced(handle: int) -> None:
        path = os.readlink(f"/proc/self/fd/{handle}")
        assert Path(path).read_bytes() == NEW
        calls.append(("sync", path))
        fsync(handle)

    def renamed(old: str, new: Any) -> None:
        calls.append(("rename", old))
        rename(old, new)

    monkeypatch.setattr(os, "fsync", synced)
    monkeypatch.setattr(os, "replace", renamed)
    replace(file, NEW)
    (_, written), (_, moved) = calls
    assert [name for name, _ in calls] == ["sync", "rename"]
    assert written == moved


def test_a_caller_that_does_not_wait_for_the_disk_syncs_file_and_directory_later(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    synced = []
    monkeypatch.setattr(
        os, "fsync", lambda handle: synced.append(os.readlink(f"/proc/self/fd/{handle}"))
    )
    replace(file, NEW, synced=False)
    assert synced == []
    for path in (file, file.parent):
        sync(path)
    assert synced == [str(file), str(file.parent)]


def test_a_sync_that_fails_is_reported_and_leaves_no_descriptor_open(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "fsync", fail)
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(OSError, match="No space left"):
        sync(file)
    assert len(os.listdir("/proc/self/fd")) == before


def test_a_temporary_file_that_is_gone_does_not_hide_the_error(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(handle: int) -> None:
        for left in file.parent.glob(f".{file.name}.*"):
            left.unlink()
        raise OSError(5, "Input/output error")

    monkeypatch.setattr(os, "fsync", fails)
    with pytest.raises(OSError, match="Input/output error"):
        replace(file, b"new")
