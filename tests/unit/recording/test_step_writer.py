"""Tests of the messages that the recorder's thread writes."""

from __future__ import annotations

import random
from pathlib import Path

from msgspec.structs import replace

from acsard.core.config.settings import Config, RecordConfig
from acsard.core.values import Received
from acsard.recording.directory import listed
from acsard.recording.file import Recording
from acsard.recording.file_replay import steps
from acsard.recording.mcap_records import MAX_MESSAGE_BYTES
from acsard.recording.step_writer import MAX_BATCH_STEPS, StepWriter
from tests.scenarios.taped import Tape
from tests.scenarios.world import World


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
