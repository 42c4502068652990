"""Tests of the values that a report reads from the replayed robot."""

from __future__ import annotations

import math
from collections.abc import Iterator
from contextlib import contextmanager

import pytest
from msgspec.structs import replace

from acsard.core.values import Outputs, Twist
from acsard.host.errors import RecordingError
from acsard.report.robot_reader import RobotReader
from tests.scenarios.world import World


@contextmanager
def errors() -> Iterator[None]:
    """Convert a TypeError of a robot to a RecordingError, as a replay does."""
    try:
        yield
    except TypeError as error:
        raise RecordingError(str(error)) from error


def outputs() -> Outputs:
    world, results = World(), list[Outputs]()
    world.watch = results.append
    world.drive(0.5, seconds=0.1)
    return results[-1]


def test_a_speed_that_is_not_a_number_is_an_error_of_the_robot() -> None:
    fast = replace(outputs(), applied=Twist("fast", 0.0))  # type: ignore[arg-type]
    with pytest.raises(RecordingError):
        RobotReader(errors).check(fast)


def test_a_speed_that_is_nan_or_infinite_is_not_an_error_of_the_robot() -> None:
    RobotReader(errors).check(replace(outputs(), applied=Twist(math.nan, math.inf)))
