"""Tests of the basic types: wheel order, immutability, and the common base of all errors."""

from __future__ import annotations

import msgspec
import pytest

from acsard.core import values
from acsard.core.config.parsing import ConfigError
from acsard.core.link.codec import FrameError
from acsard.core.messages.encodings import DecodeError
from acsard.core.values import WHEELS, AcsardError, WheelSpeeds
from tests.each import each

STRUCTS = [
    thing
    for thing in vars(values).values()
    if isinstance(thing, type) and issubclass(thing, msgspec.Struct) and thing is not msgspec.Struct
]


def test_four_wheel_values_are_in_the_order_of_wheels() -> None:
    speeds = WheelSpeeds(rear_right=4.0, rear_left=3.0, front_left=2.0, front_right=1.0)
    assert speeds.as_tuple() == (1.0, 2.0, 3.0, 4.0)
    assert speeds.as_tuple() == tuple(getattr(speeds, wheel) for wheel in WHEELS)


@each("cls", STRUCTS)
def test_every_value_type_is_frozen(cls: type[msgspec.Struct]) -> None:
    assert cls.__struct_config__.frozen


@pytest.mark.parametrize("error", [ConfigError, FrameError, DecodeError])
def test_every_error_raised_on_purpose_is_an_acsard_error(error: type[Exception]) -> None:
    assert issubclass(error, AcsardError)
