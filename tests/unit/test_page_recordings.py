"""The page lists the recordings of its robot."""

from __future__ import annotations

import os
import threading
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from acsard.recording.file import FrameWriter, Head
from acsard.web import recordings
from acsard.web.answers import TroubleError
from acsard.web.callers import RequestRefusedError
from acsard.web.recordings import BlackBox, Recording, rows


def test_a_recording_is_listed_with_its_beginning_and_its_duration(tmp_path: Path) -> None:
    path = tmp_path / "000001-20261121T070027Z.rec.zst"
    path.write_bytes(b"1234")
    begin = 1_795_244_427.0
    os.utime(path, (begin, begin + 60.0))
    assert rows([path]) == [Recording(path.name, begin, 60.0, 4, being_recorded=False)]
    os.utime(path)
    (row,) = rows([path])
    assert row.being_recorded


@pytest.mark.parametrize("recorded", ["acsar", "robot2"])
async def test_the_recordings_of_another_robot_are_not_shown_as_those_of_this_one(
    tmp_path: Path, recorded: str
) -> None:
    """A daemon behind a router on this machine has its recordings on a machine of its own."""
    path = tmp_path / "000001-20261121T070027Z.rec.zst"
    with path.open("wb") as file:
        FrameWriter(file).begin(Head("0", recorded, 0, 1, 1))
    box = BlackBox(robot_with(str(tmp_path)))
    if recorded == "acsar":
        assert [row.name for row in await box.rows()] == [path.name]
        assert await box.find(path.name) == path
        return
    with pytest.raises(TroubleError, match="has the recordings of robot2"):
        await box.rows()
    with pytest.raises(TroubleError, match="has the recordings of robot2"):
        await box.find(path.name)


async def test_a_recording_that_has_just_begun_is_listed(tmp_path: Path) -> None:
    path = tmp_path / "000001-20261121T070027Z.rec.zst"
    path.touch()
    box = BlackBox(robot_with(str(tmp_path)))
    assert [(row.name, row.bytes) for row in await box.rows()] == [(path.name, 0)]
    assert await box.find(path.name) == path


def robot_with(directory: str) -> Any:
    about = SimpleNamespace(recordings=directory)
    return SimpleNamespace(id="acsar", endpoint="tcp/127.0.0.1:7447", about=about)


@pytest.mark.parametrize("directory", ["", "record"])
async def test_a_fresh_robot_has_an_empty_list_of_recordings(
    tmp_path: Path, directory: str
) -> None:
    box = BlackBox(robot_with(directory and str(tmp_path / directory)))
    assert await box.rows() == []
    with pytest.raises(RequestRefusedError, match="does not exist"):
        await box.find("000001-20261121T070027Z.rec.zst")


async def test_recordings_that_cannot_be_read_are_explained(tmp_path: Path) -> None:
    file = tmp_path / "record"
    file.touch()
    away = robot_with(str(tmp_path))
    away.endpoint = "tcp/192.168.1.7:7447"
    for robot, why in ((away, "on another machine"), (robot_with(str(file)), "Not a directory")):
        for look in (BlackBox(robot).rows(), BlackBox(robot).find("x")):
            with pytest.raises(TroubleError, match=why):
                await look


async def test_a_disk_that_does_not_answer_is_named(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    released = threading.Event()
    monkeypatch.setattr(recordings, "READ_TIMEOUT_S", 0.01)
    monkeypatch.setattr(recordings, "listed", lambda _: [released.wait(20.0)][:0])
    with pytest.raises(TroubleError, match="the disk does not answer; try again") as raised:
        await BlackBox(robot_with(str(tmp_path))).rows()
    released.set()
    assert raised.value.status == 503


def test_a_recording_whose_name_has_no_time_is_listed_without_one(tmp_path: Path) -> None:
    path = tmp_path / "000001-later.rec.zst"
    path.touch()
    (row,) = rows([path, tmp_path / "deleted"])
    assert (row.begin, row.seconds) == (None, None)
