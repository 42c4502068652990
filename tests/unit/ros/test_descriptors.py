"""Tests of the description of a parameter that an operator reads before setting it."""

from __future__ import annotations

import pytest

from acsard.config.live import flat, live
from acsard.config.parsing import effective
from acsard.config.settings import Config
from acsard.ros.descriptors import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    described,
)

KEYS = [key for key, _ in flat(effective(Config()))]
DOUBLE, INTEGER = 3, 2


def test_what_can_be_set_says_what_it_is_its_range_and_when() -> None:
    assert described("limits.linear_stop_deceleration", DOUBLE) == ParameterDescriptor(
        "limits.linear_stop_deceleration",
        DOUBLE,
        "braking by a stop or a fault: a number from 0.01 to 100 m/s2",
        "lowered only while the robot stands",
        read_only=False,
        floating_point_range=[FloatingPointRange(0.01, 100.0, 0.0)],
    )


def test_what_takes_a_start_is_read_only_and_says_so() -> None:
    assert described("mcu.encoder_counts", INTEGER) == ParameterDescriptor(
        "mcu.encoder_counts",
        INTEGER,
        "a whole number from 0 to 100000 per wheel turn (0 = do not ask for them)",
        "acsard.toml and a start",
        integer_range=[IntegerRange(0, 100_000, 1)],
    )


def test_a_source_is_described_by_its_name() -> None:
    found = described("commands.sources.nav.timeout", DOUBLE)
    assert found.floating_point_range == [FloatingPointRange(0.02, 10.0, 0.0)]
    assert (found.read_only, found.additional_constraints) == (
        False,
        "only while the robot stands",
    )


def test_a_choice_names_what_there_is() -> None:
    found = described("log.level", 4)
    assert found.description == (
        'the least that the log tells: one of "debug", "error", "info", "warning"'
    )


@pytest.mark.parametrize("key", KEYS)
def test_every_key_has_words_and_is_read_only_unless_it_can_be_set(key: str) -> None:
    found = described(key, DOUBLE)
    assert found.description
    assert found.read_only == (live(key) is None)


def test_what_is_not_there_has_none() -> None:
    assert described("no.such", 0) == ParameterDescriptor("no.such", 0)
