"""Tests of motor names that follow from the configuration."""

from __future__ import annotations

import pytest

from acsard.checkup.findings import Finding, StoppedError, motor_name, wheel_of
from acsard.core.config.settings import McuConfig, WheelMap

TURNED = McuConfig(wheels=WheelMap("-c", "+d", "-a", "+b"))


@pytest.mark.parametrize(
    ("motor", "wheel"),
    list(enumerate([("rear_left", -1), ("rear_right", 1), ("front_right", -1), ("front_left", 1)])),
)
def test_the_wheel_and_sign_of_a_motor_are_the_configured_ones(
    motor: int, wheel: tuple[str, int]
) -> None:
    assert wheel_of(TURNED, motor) == wheel
    assert motor_name(TURNED, motor) == f"motor {'abcd'[motor]} ({wheel[0].replace('_', ' ')})"


def test_the_error_that_ends_the_check_has_its_finding() -> None:
    finding = Finding("runaway", "FAIL", text="why")
    assert StoppedError(finding).finding is finding
    assert str(StoppedError(finding)) == "why"
