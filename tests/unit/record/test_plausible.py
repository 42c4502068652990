"""A batch of steps that no daemon can have recorded is refused."""

from __future__ import annotations

import math

import msgspec
import pytest
from msgspec.structs import replace

from acsard.record.batch import BatchError, decode, encode
from acsard.record.layout import Batch, Rare
from acsard.values import Command, GyroSample, Pose, Request, Twist
from tests.scenarios.taped import Tape
from tests.scenarios.world import World


@pytest.fixture(scope="module")
def batch() -> Batch:
    tape = Tape()
    World(recorder=tape).run(0.2)
    return msgspec.msgpack.decode(encode(0, tape.taken), type=Batch)


def steps_of(batch: Batch) -> int:
    return len(decode(msgspec.msgpack.encode(batch)))


@pytest.mark.parametrize("far", [1 << 62, (1 << 63) - 1, -(1 << 63)])
@pytest.mark.parametrize("name", ["mono_ns", "offset_ns"])
def test_a_time_that_no_clock_shows_is_refused(name: str, far: int, batch: Batch) -> None:
    with pytest.raises(BatchError, match="no clock"):
        steps_of(replace(batch, **{name: far}))


@pytest.mark.parametrize(
    "rare",
    [
        Rare(requests=(Request("set_pose", pose=Pose(0.0, math.inf)),)),
        Rare(gyro=(GyroSample(1, None, -math.inf),)),
        Rare(gyro=(GyroSample(1, None, 0.0, math.nan),)),
    ],
    ids=["pose", "rate", "variance"],
)
def test_a_number_that_no_step_gets_is_refused(rare: Rare, batch: Batch) -> None:
    with pytest.raises(BatchError, match="no number"):
        steps_of(replace(batch, rare=((3, rare),)))


def test_a_command_that_the_robot_refuses_itself_is_recorded(batch: Batch) -> None:
    assert steps_of(batch) > 10
    rare = Rare(commands=(Command("app", Twist(math.nan, 0.0), 1),))
    assert steps_of(replace(batch, rare=((3, rare),))) == steps_of(batch)
