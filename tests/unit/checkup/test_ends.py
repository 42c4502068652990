"""Each end of a check says what to look at."""

from __future__ import annotations

from acsard.checkup import ends
from acsard.config.settings import McuConfig

MCU = McuConfig()


def test_a_runaway_against_the_command_is_crossed_leads() -> None:
    assert "leads" in ends.runaway(MCU, 1, 3.0, -9.0, 6.0).finding.mend
    assert "leads" not in ends.runaway(MCU, 1, 3.0, 9.0, 6.0).finding.mend


def test_the_motors_are_named() -> None:
    for end in (
        ends.runaway(MCU, 3, 3.0, 9.0, 6.0),
        ends.stays_turning(MCU, [3], 4.0),
        ends.silent(MCU, [3], 0.5),
    ):
        assert end.finding.verdict == "FAIL"
        assert "motor d (rear right)" in end.finding.text
