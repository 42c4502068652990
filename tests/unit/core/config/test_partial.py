"""Tests of a configuration in which some keys could not be read."""

from __future__ import annotations

import pytest

from acsard.core.config.partial import InvalidKeyError, mistakes, view_without
from acsard.core.config.settings import Config


def test_valid_keys_are_readable_beside_invalid_ones() -> None:
    view = view_without(Config(), {"mcu.wheels.front_left", "limits"})
    assert view.mcu.baud_rate == 115200
    assert view.mcu.wheels.front_right == "+a"
    assert view.drive is view.drive


@pytest.mark.parametrize(
    "read",
    [
        lambda config: config.mcu.baud_rate,
        lambda config: config.mcu.line_bytes,  # a property that reads this key and two more
        lambda config: config.limits.linear_speed,
    ],
)
def test_invalid_keys_and_values_derived_from_them_cannot_be_read(read: object) -> None:
    view = view_without(Config(), {"mcu.baud_rate", "mcu.link_check", "limits"})
    assert callable(read)
    with pytest.raises(InvalidKeyError):
        read(view)


def test_rules_that_need_no_invalid_key_are_applied() -> None:
    rules = (lambda c: [str(c.mcu.line_bytes)], lambda c: [c.robot.id], lambda c: [c.log.level])
    assert mistakes(rules, view_without(Config(), {"mcu.link_check"})) == ["acsar", "info"]
