"""A recording of format 1 is read as by the code that wrote it.

Its old format is reported.
"""

from __future__ import annotations

import random
import zlib
from pathlib import Path

import msgspec
import pytest

from acsard.record import earlier
from acsard.record.batch import BatchError, decode
from acsard.record.file import Recording, rewrite
from acsard.record.replayed import live, steps
from acsard.record.steps import Step
from tests.vectors import FORMAT_1, FORMAT_1_SUM

COUNT = 2844


def said(step: Step) -> str:
    """Return a step's inputs and outputs as text that stays the same when fields are added."""
    i, o = step.inputs, step.said
    reads = [(read.at.mono_ns, read.at.wall_ns, read.data) for read in i.received]
    now = i.now.mono_ns, i.now.wall_ns, i.tick, i.missed, i.opened, i.port_trouble
    out = o.line, o.left, o.status, o.poses, o.checksum
    return repr((step.number, *now, reads, len(i.commands), len(i.requests), *out))


def checksum(path: Path) -> tuple[int, int]:
    """Return the number of steps and a checksum of their text."""
    count = value = 0
    for step in steps(Recording(path)):
        count, value = count + 1, zlib.crc32(said(step).encode(), value)
    return count, value


def test_every_step_is_as_the_code_of_then_read_it() -> None:
    assert Recording(FORMAT_1).about.format == "1"
    assert checksum(FORMAT_1) == (COUNT, FORMAT_1_SUM)


def test_it_is_lived_to_its_end() -> None:
    tally, trouble, _ = live(Recording(FORMAT_1))
    assert (tally.steps, trouble) == (COUNT, "")


def test_what_is_rewritten_stays_of_its_format(tmp_path: Path) -> None:
    new = tmp_path / "new.mcap"
    rewrite(Recording(FORMAT_1), new)
    assert Recording(new).about.format == "1"
    assert checksum(new) == (COUNT, FORMAT_1_SUM)


def test_bytes_that_are_none_of_it_are_refused_and_never_more() -> None:
    batches = [data for topic, _, data in Recording(FORMAT_1).messages() if topic == "steps"]
    dice = random.Random(1)
    for _ in range(300):
        data = bytearray(dice.choice(batches))
        for _ in range(dice.randint(1, 4)):
            data[dice.randrange(len(data))] = dice.randrange(256)
        try:
            decode(bytes(data[: dice.randint(1, 3 * len(data))]), form="1")
        except BatchError:
            pass
    with pytest.raises(BatchError):
        decode(batches[0])  # it is not a batch of the current format


@pytest.mark.parametrize("data", [b"", b"\0" * 16, b"\0" * 16 + b"\x09", b"\0" * 16 + b"\x01"])
def test_a_column_without_its_head_or_of_another_length_is_refused(data: bytes) -> None:
    with pytest.raises(ValueError, match="a column"):
        earlier.unpack(data, 2)


def test_a_batch_of_it_has_its_own_shape() -> None:
    batch = next(d for topic, _, d in Recording(FORMAT_1).messages() if topic == "steps")
    spread = earlier.spread(msgspec.msgpack.decode(batch, type=earlier.Batch1))
    assert spread.first == 0
    assert len(spread.times) == len(spread.shapes) == 200
    assert spread.times == sorted(spread.times)
