"""Tests of the messages that the recorder's thread writes."""

from __future__ import annotations

import errno
import os
import random
from pathlib import Path

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config, RecordConfig
from acsard.core.values import Event, Received
from acsard.recording.file_replay import steps
from acsard.recording.mcap_directory import listed
from acsard.recording.mcap_file import Recording
from acsard.recording.mcap_records import MAX_MESSAGE_BYTES
from acsard.recording.step_writer import MAX_BATCH_STEPS, RETRY_ROUNDS, StepWriter
from tests.scenarios.taped import Tape
from tests.scenarios.world import World


def refuse(*_: object) -> None:
    raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))


def test_a_second_above_the_largest_message_is_divided_and_read_back(tmp_path: Path) -> None:
    """The reader refuses a larger message, and then also loses the rest of its chunk."""
    tape, dice, each = Tape(), random.Random(1), MAX_MESSAGE_BYTES // 40
    World(recorder=tape).run(0.5)
    items = [
        entry._replace(
            inputs=replace(
                entry.inputs, received=(Received(entry.inputs.now, dice.randbytes(each)),)
            )
        )
        for entry in tape.taken[:50]
    ]
    assert len(items) < MAX_BATCH_STEPS
    config = replace(Config(), record=RecordConfig(str(tmp_path), 100.0))
    writer = StepWriter(config, lambda event: None, lambda: None, 0)
    writer.write([*items], False)
    writer.write([*tape.taken[50:]], True)
    assert writer.lost == 0
    (path,) = listed(tmp_path)
    read = list(steps(Recording(path)))
    assert [step.number for step in read] == list(range(len(tape.taken)))
    assert [step.inputs.received for step in read[:50]] == [item.inputs.received for item in items]
    messages = [data for topic, _, data in Recording(path).messages() if topic == "steps"]
    assert len(messages) == 3


def test_no_recording_is_deleted_when_a_full_disk_has_room_again(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kept = tmp_path / "000001-20270115T080000Z.kept.mcap"
    kept.touch()
    tape = Tape()
    World(recorder=tape).run(0.5)
    config = replace(Config(), record=RecordConfig(str(tmp_path), 100.0))
    writer = StepWriter(config, lambda event: None, lambda: None, 0)
    real = os.statvfs(tmp_path)
    full = os.statvfs_result((*real[:3], 0, 0, *real[5:]))
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", refuse)
        patched.setattr(os, "statvfs", lambda _: full)
        writer.write([*tape.taken], False)
    assert writer.trouble.endswith("No space left on device")
    for _ in range(RETRY_ROUNDS + 1):
        writer.write([], False)
    assert kept.exists()


def test_a_deleted_recording_is_reported_even_if_the_disk_refuses_the_new_one(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = tmp_path / "000001-20270115T080000Z.mcap"
    old.touch()
    os.utime(old, ns=(0, 0))
    tape, events = Tape(), list[Event]()
    World(recorder=tape).run(0.5)
    config = replace(Config(), record=RecordConfig(str(tmp_path), 100.0))
    writer = StepWriter(config, events.append, lambda: None, 0)
    writer._refused = True
    with monkeypatch.context() as patched:
        patched.setattr(os, "fsync", refuse)
        writer.write([*tape.taken], True)
    assert not old.exists()
    assert [event.level for event in events] == ["warning", "warning"]
    assert any(f"1 recording deleted ({old.name}): " in event.text for event in events)
