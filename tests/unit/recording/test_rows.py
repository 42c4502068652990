"""A stored batch of steps gives back exactly the same inputs and outputs.

The reader refuses a batch that no daemon can have recorded.
"""

from __future__ import annotations

import math
import random
from functools import cache
from typing import get_args

import msgspec
import pytest
import zstandard
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.codes import GUARD_CODES, RefusalCode
from acsard.core.config.settings import Config
from acsard.core.robot import Robot
from acsard.core.values import (
    Command,
    Event,
    GyroSample,
    Inputs,
    Instant,
    Pose,
    Received,
    Refusal,
    Request,
    SpeedCap,
    Twist,
)
from acsard.recording.recorded_steps import FinishedStep, micropose, status_of
from acsard.recording.rows import (
    MAX_ROWS,
    Batch,
    BatchError,
    OccasionalFields,
    decode,
    encode,
    first_of,
)
from acsard.recording.stepped_robot import SteppedRobot
from tests.each import each
from tests.scenarios.taped import Tape, drive_through_faults
from tests.scenarios.world import World

INSTANTS = st.builds(Instant, st.integers(0, 1 << 60), st.integers(0, 1 << 60))
READS = st.builds(Received, INSTANTS, st.binary(max_size=9))
TEXT = st.text(max_size=20)
COMMANDS = st.builds(
    Command,
    source=TEXT,
    twist=st.builds(Twist, st.floats(-9, 9), st.floats(-9, 9)),
    arrived_ns=st.integers(0, 1 << 60),
    stamp_ns=st.none() | st.integers(-(1 << 61), 1 << 61),
    sender=TEXT,
    sequence=st.none() | st.integers(0, (1 << 63) - 1),
    cancelled=st.booleans(),
    shared=st.booleans(),
)
REQUESTS = st.builds(
    Request,
    verb=st.sampled_from(["stop", "clear", "set_pose"]),
    id=st.integers(0, 1 << 40),
    pose=st.none() | st.builds(Pose, st.floats(-9, 9)),
    by=TEXT,
)
PARTS: dict[str, st.SearchStrategy[object]] = {
    "now": INSTANTS,
    "tick": st.booleans(),
    "port_open": st.booleans(),
    "opened": st.integers(0, 3),
    "port_trouble": st.sampled_from(["", "gone"]),
    "received": st.lists(READS, max_size=3).map(tuple),
    "commands": st.lists(COMMANDS, max_size=2).map(tuple),
    "requests": st.lists(REQUESTS, max_size=2).map(tuple),
    "gyro": st.lists(
        st.builds(GyroSample, st.integers(0, 1 << 60), st.none(), st.floats(-1, 1)), max_size=2
    ).map(tuple),
    "refusals": st.lists(
        st.builds(Refusal, st.sampled_from(get_args(RefusalCode)), TEXT), max_size=2
    ).map(tuple),
    "guard_trip": st.sampled_from(["", *GUARD_CODES]),
    "superseded": st.booleans(),
    "missed": st.integers(0, 5),
    "events": st.lists(st.builds(Event, st.just("imu_refused"), TEXT), max_size=1).map(tuple),
    "at_once": st.booleans(),
    "shutting_down": st.booleans(),
    "late_ns": st.integers(0, 1 << 61),
    "speed_cap": st.none() | st.builds(SpeedCap, st.none() | st.floats(0, 9), TEXT),
}
INPUTS = st.builds(Inputs, **PARTS)


def test_every_field_of_the_inputs_is_recorded() -> None:
    assert set(PARTS) == set(Inputs.__struct_fields__)


@pytest.mark.slow
@given(st.lists(INPUTS, min_size=1, max_size=6), st.integers(0, 1 << 40))
def test_all_inputs_are_read_back(inputs: list[Inputs], first: int) -> None:
    outputs = SteppedRobot(Robot(Config())).step(Inputs(Instant(1, 2), True, True))
    steps = decode(encode(first, [FinishedStep(item, outputs, b"other") for item in inputs]))
    assert [step.inputs for step in steps] == inputs
    assert [step.number for step in steps] == [first + n for n in range(len(inputs))]
    assert {step.recorded.sent for step in steps} == {b"other"}


@cache
def driven() -> list[FinishedStep]:
    """Return the steps of a drive with several faults."""
    tape = Tape()
    drive_through_faults(World(recorder=tape), 3.0)
    return tape.taken


def test_all_outputs_are_read_back() -> None:
    for at in range(0, len(driven()), 100):
        batch = driven()[at : at + 100]
        for original, step in zip(batch, decode(encode(at, batch)), strict=True):
            record, outputs = step.recorded, original.outputs
            assert (record.line, record.sent) == (outputs.line, original.sent)
            assert record.status == status_of(outputs)
            assert record.poses == tuple(map(micropose, outputs.estimates))
            assert record.events == outputs.events


def test_a_second_at_rest_takes_few_bytes() -> None:
    tape = Tape()
    World(recorder=tape).run(3.0)
    batch = tape.taken[-200:]
    assert len(zstandard.compress(encode(0, batch))) < 5 * len(batch)


def test_steps_with_equal_times_keep_their_order() -> None:
    tick, other = Inputs(Instant(5, 5), True, True), Inputs(Instant(5, 5), False, True)
    outputs = SteppedRobot(Robot(Config())).step(tick)
    for inputs in ([tick, other, other], [other, tick], [tick, other, tick, other]):
        steps = decode(encode(0, [FinishedStep(item, outputs, None) for item in inputs]))
        assert [step.inputs for step in steps] == inputs


def test_damaged_bytes_raise_only_batch_errors() -> None:
    whole, dice = encode(0, driven()[:100]), random.Random(1)
    for _ in range(500):
        data = bytearray(whole)
        for _ in range(dice.randint(1, 4)):
            data[dice.randrange(len(data))] = dice.randrange(256)
        try:
            decode(bytes(data[: dice.randint(1, 3 * len(data))]))
        except BatchError:
            pass
    for other in (b"", b"\x90", msgspec.msgpack.encode({"first": 1})):
        with pytest.raises(BatchError):
            decode(other)


def test_the_number_of_the_first_step_is_read_alone() -> None:
    tape = Tape()
    World(recorder=tape).run(0.5)
    assert [first_of(encode(number, tape.taken)) for number in (0, 7)] == [0, 7]
    assert first_of(b"none") is None


@pytest.fixture(scope="module")
def batch() -> Batch:
    return msgspec.msgpack.decode(encode(0, driven()[:100]), type=Batch)


def steps_of(batch: Batch) -> int:
    return len(decode(msgspec.msgpack.encode(batch)))


def with_rare(batch: Batch, rare: OccasionalFields) -> Batch:
    """Return the batch with these values in its fourth step."""
    rows = list(batch.rows)
    rows[3] = replace(rows[3], rare=rare)
    return replace(batch, rows=tuple(rows))


@each("far", [1 << 62, (1 << 63) - 1, -(1 << 63)])
@each("name", ["mono_ns", "offset_ns", "unit"])
def test_a_time_out_of_range_is_refused(name: str, far: int, batch: Batch) -> None:
    with pytest.raises(BatchError, match=r"out of range|>= 1"):
        steps_of(replace(batch, **{name: far}))


def test_a_read_with_an_age_out_of_range_is_refused(batch: Batch) -> None:
    rows = list(batch.rows)
    index = next(index for index, row in enumerate(rows) if row.reads)
    read = rows[index].reads[0]
    rows[index] = replace(rows[index], reads=(read._replace(age=(1 << 61) // batch.unit + 1),))
    with pytest.raises(BatchError, match="out of range"):
        steps_of(replace(batch, rows=tuple(rows)))


@pytest.mark.parametrize(
    "rare",
    [
        OccasionalFields(requests=(Request("set_pose", pose=Pose(0.0, math.inf)),)),
        OccasionalFields(gyro=(GyroSample(1, None, -math.inf),)),
        OccasionalFields(gyro=(GyroSample(1, None, 0.0, math.nan),)),
    ],
    ids=["pose", "rate", "variance"],
)
def test_a_number_that_is_not_finite_is_refused(rare: OccasionalFields, batch: Batch) -> None:
    with pytest.raises(BatchError, match="is not finite"):
        steps_of(with_rare(batch, rare))


def test_a_command_that_the_robot_refuses_is_recorded(batch: Batch) -> None:
    rare = OccasionalFields(commands=(Command("app", Twist(math.nan, 0.0), 1),))
    assert steps_of(with_rare(batch, rare)) == steps_of(batch) == 100


def test_a_batch_with_an_incomplete_first_step_or_too_many_steps_is_refused(
    batch: Batch,
) -> None:
    assert batch.rows[0].rare is not None
    for rows in ((), batch.rows[1:], (batch.rows[1],) * (MAX_ROWS + 1)):
        with pytest.raises(BatchError):
            steps_of(replace(batch, rows=rows))


def test_a_line_that_was_not_sent_or_was_replaced_is_read_back() -> None:
    tick = Inputs(Instant(5, 5), True, True)
    outputs = SteppedRobot(Robot(Config())).step(tick)
    sent = [None, b"", outputs.line, b"other"]
    steps = decode(encode(0, [FinishedStep(tick, outputs, left) for left in sent]))
    assert [step.recorded.sent for step in steps] == sent
