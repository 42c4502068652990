"""The stick of the page keeps the same time limits as the Python programs that drive."""

from __future__ import annotations

import re

import pytest

from acsard.client.ride import GRACE_S, SEND_PERIOD_S
from acsard.web.answers import PAGE_DIRECTORY


@pytest.mark.parametrize(("name", "limit_s"), [("PERIOD", SEND_PERIOD_S), ("GRACE", GRACE_S)])
def test_the_page_has_the_time_limits_of_a_ride(name: str, limit_s: float) -> None:
    script = (PAGE_DIRECTORY / "commander.js").read_text(encoding="utf-8")
    found = re.search(rf"^const {name} = (\d+);", script, re.MULTILINE)
    assert found is not None
    assert int(found[1]) == 1000 * limit_s
