"""The motors of robots with four driven wheels and with two.

`@four_and_two` runs a test with both, as `wheels`. A usual run tries one of them, `.ci/run` both.
"""

from __future__ import annotations

from typing import Any

import pytest

from acsard.core.config.settings import LimitsConfig, WheelMap

FOUR, TWO = WheelMap(), WheelMap(left="+l", right="+r")

MAPS = FOUR, TWO

STEADY = LimitsConfig(
    linear_acceleration=1.0,
    linear_deceleration=1.0,
    angular_acceleration=4.0,
    angular_deceleration=4.0,
)
"""Ramps of tests whose numbers follow from them, whatever the defaults are."""


def four_and_two(test: Any) -> Any:
    both = [pytest.param(FOUR, id="four"), pytest.param(TWO, id="two")]
    return pytest.mark.one_of_both(pytest.mark.parametrize("wheels", both)(test))
