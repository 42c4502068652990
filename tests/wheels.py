"""The motors of robots with four driven wheels and with two.

`@four_and_two` runs a test with both, as `wheels`.
"""

from __future__ import annotations

import pytest

from acsard.core.config.settings import WheelMap

FOUR, TWO = WheelMap(), WheelMap(left="+l", right="+r")

MAPS = FOUR, TWO

four_and_two = pytest.mark.parametrize(
    "wheels", [pytest.param(FOUR, id="four"), pytest.param(TWO, id="two")]
)
