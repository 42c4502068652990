"""The configuration file: what is written, kept or refused, and never half."""

from __future__ import annotations

import errno
import os
import stat
import threading
import time
import tracemalloc
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
from tomlkit.exceptions import NonExistentKey

from acsard.bus.address import address_by_environment
from acsard.core.config.parsing import ConfigError, parse
from acsard.host import atomic_file, config_file
from acsard.host.atomic_file import NEW_MODE, replace, sync
from acsard.host.config_file import change, find, require_changeable
from acsard.host.errors import MendableError, UsageError

REFERENCE = Path(__file__).parents[2] / "acsard.toml"

KEYS: dict[str, object] = {
    "mcu.baud_rate": 57600,
    "mcu.trailing_comma": True,
    "mcu.reply_period": 0.1,
    "mcu.wheels.rear_left": "-c",
    "control.rate": 50.0,
}


def changed(file: Path) -> list[tuple[str, str]]:
    """Return the lines that differ from those of the reference file."""
    pairs = zip(REFERENCE.read_text().splitlines(), file.read_text().splitlines(), strict=True)
    return [(before, after) for before, after in pairs if before != after]


def test_a_change_of_the_reference_file_changes_only_the_values(tmp_path: Path) -> None:
    file = tmp_path / "acsard.toml"
    file.write_text(REFERENCE.read_text())
    file.chmod(0o640)
    change(file, KEYS)
    assert [after for _, after in changed(file)] == [
        "baud_rate = 57600",
        "trailing_comma = true",
        "reply_period = 0.1",
        'rear_left = "-c"',
        "rate = 50.0",
    ]
    assert file.stat().st_mode & 0o777 == 0o640
    assert os.listdir(tmp_path) == ["acsard.toml"]


def test_a_failed_edit_changes_nothing(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    file = tmp_path / "acsard.toml"
    file.write_text("[mcu]\n")

    def fails(text: str) -> None:
        raise NonExistentKey("mcu")

    for wish in (300, 57600):
        with pytest.raises(MendableError, match="was not changed"):
            change(file, {"mcu.baud_rate": wish})
        monkeypatch.setattr("tomlkit.parse", fails)
    assert file.read_text() == "[mcu]\n"
    monkeypatch.undo()
    file.write_bytes(b"# caf\xe9\n")  # by an editor that does not write UTF-8
    with pytest.raises(MendableError, match="was not changed"):
        change(file, KEYS)
    assert file.read_bytes() == b"# caf\xe9\n"
    assert os.listdir(tmp_path) == ["acsard.toml"]


@pytest.mark.parametrize("new", [False, True])
def test_a_change_through_a_symbolic_link_keeps_the_link(tmp_path: Path, new: bool) -> None:
    if not new:
        (tmp_path / "real.toml").write_text("# mine\n")
    link = tmp_path / "acsard.toml"
    link.symlink_to("real.toml")
    change(link, {"mcu.trailing_comma": True}, new=new)
    assert link.is_symlink()
    assert "trailing_comma = true" in (tmp_path / "real.toml").read_text()


def test_a_missing_file_is_created_only_if_the_caller_permits_it(tmp_path: Path) -> None:
    file = tmp_path / "acsard.toml"
    with pytest.raises(MendableError):
        change(file, KEYS)
    assert change(file, KEYS, new=True) == KEYS
    assert parse(file.read_bytes()).mcu.baud_rate == 57600
    assert file.stat().st_mode & 0o777 == 0o644
    assert os.listdir(tmp_path) == ["acsard.toml"]


def connect_with(file: Path) -> None:
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("ACSARD_CONFIG", str(file))
        address_by_environment(None, None, None)


USES: dict[str, Callable[[Path], object]] = {
    "the daemon starts with it": lambda file: parse(find(str(file))[1]),
    "a program connects with it": connect_with,
    "a command edits it": lambda file: change(file, KEYS),
    "a command makes it": lambda file: change(file, KEYS, new=True),
    "a command will edit it": lambda file: require_changeable(file, KEYS),
}


@pytest.mark.parametrize("use", [*USES][:3])
def test_a_huge_file_is_refused_without_being_read_to_its_end(tmp_path: Path, use: str) -> None:
    """`truncate -s 1G acsard.toml` must not take the memory or the time of a running daemon."""
    file = tmp_path / "acsard.toml"
    # The limit lies within a character, which must not hide the cause.
    file.write_text("é" * 40_000)
    os.truncate(file, 1 << 26)
    errors, words = (ConfigError, MendableError, UsageError), "too large for a configuration"
    tracemalloc.start()
    try:
        with pytest.raises(errors, match=words):
            USES[use](file)
        assert tracemalloc.get_traced_memory()[1] < 1 << 23
    finally:
        tracemalloc.stop()


@pytest.mark.parametrize("use", [*USES][2:])
def test_a_pipe_in_the_place_of_the_file_is_neither_read_nor_replaced(
    use: str, tmp_path: Path
) -> None:
    pipe = tmp_path / "acsard.toml"
    os.mkfifo(pipe)
    with pytest.raises(MendableError, match="was not changed: it is not a regular file; edit the"):
        USES[use](pipe)
    assert pipe.is_fifo()


def test_two_changes_at_once_lose_neither(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """A slow disk keeps the first change waiting for its sync while the second one begins."""
    file, syncs = tmp_path / "robot.toml", threading.Event()
    file.touch()
    real = atomic_file.replace

    def slow(place: Path, content: bytes) -> None:
        syncs.set()
        time.sleep(0.2)
        real(place, content)

    monkeypatch.setattr(config_file, "replace", slow)
    first = threading.Thread(target=change, args=(file, {"limits.linear_speed": 0.5}))
    first.start()
    assert syncs.wait(10.0)
    change(file, {"limits.angular_speed": 0.7})
    first.join(10.0)
    limits = parse(file.read_bytes()).limits
    assert (limits.linear_speed, limits.angular_speed) == (0.5, 0.7)
    assert os.listdir(tmp_path) == ["robot.toml"]


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


def test_the_content_is_written_byte_for_byte_with_the_old_mode_or_a_given_one(file: Path) -> None:
    replace(file, NEW)
    assert (file.read_bytes(), mode_of(file)) == (NEW, 0o640)
    assert os.listdir(file.parent) == [file.name]
    replace(file, NEW, mode=0o600)
    assert mode_of(file) == 0o600


def test_a_new_file_can_be_read_by_all_unless_another_mode_is_given(tmp_path: Path) -> None:
    (tmp_path / "link").symlink_to("/dev/null")  # whose mode it does not get
    before = os.umask(0o077)
    try:
        replace(tmp_path / "link", NEW)
        replace(tmp_path / "secret", NEW, mode=0o600)
    finally:
        os.umask(before)
    assert not (tmp_path / "link").is_symlink()
    assert (mode_of(tmp_path / "link"), mode_of(tmp_path / "secret")) == (NEW_MODE, 0o600)


@pytest.mark.skipif(os.geteuid() != 0, reason="only root may give a file away")
def test_a_file_keeps_its_owner_unless_another_is_given(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def owner() -> tuple[int, int]:
        return file.stat().st_uid, file.stat().st_gid

    os.chown(file, 7, 8)
    replace(file, NEW)
    assert owner() == (7, 8)
    replace(file, NEW, owner=(9, 10))
    assert owner() == (9, 10)
    fchown = os.fchown

    def as_user(handle: int, user: int, group: int) -> None:
        if user != -1:
            raise PermissionError(errno.EPERM, os.strerror(errno.EPERM))
        fchown(handle, user, group)

    # Another user cannot give the file away, and keeps its group.
    monkeypatch.setattr(os, "fchown", as_user)
    replace(file, NEW)
    assert owner() == (os.geteuid(), 10)
    with pytest.raises(PermissionError):
        replace(file, OLD, owner=(1, 1))
    assert file.read_bytes() == NEW


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


def test_a_sync_that_fails_is_reported_and_leaves_no_descriptor_or_file(
    file: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fails(handle: int) -> None:
        for left in file.parent.glob(f".{file.name}.*"):
            left.unlink()  # a temporary file that is gone does not hide the error
        fail()

    monkeypatch.setattr(os, "fsync", fails)
    before = len(os.listdir("/proc/self/fd"))
    with pytest.raises(OSError, match="No space left"):
        sync(file)
    with pytest.raises(OSError, match="No space left"):
        replace(file, b"new")
    assert len(os.listdir("/proc/self/fd")) == before
