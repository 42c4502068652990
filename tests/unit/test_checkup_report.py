"""The texts of the check, its summary, and the lines of acsard.toml that it suggests."""

from __future__ import annotations

import re
from typing import Any, get_args

import pytest

from acsard.checkup import checkup_report, lateness
from acsard.checkup.checkup_report import report, summary
from acsard.checkup.findings import SKIPPED_STEPS, Finding, motor_name, wheel_of
from acsard.checkup.motion import MAX_WATCHDOG_S
from acsard.checkup.outcomes import OUTCOMES, OUTCOMES_BY_CODE, Outcome, find
from acsard.core.config.contradictions import contradictions
from acsard.core.config.settings import Config, McuConfig, WheelMap
from acsard.core.link.link_state import WATCHDOG_S
from acsard.core.tables.finding_table import code_of
from tests.each import each
from tests.unit.checkup_robots import configured

RATE = Finding("baud rate", "PASS", keys={"mcu.baud_rate": 57600})


@pytest.mark.parametrize(
    ("more", "passed"),
    [
        ([], True),
        ([Finding("watchdog", "FAIL")], False),
        ([lateness.finding("watchdog", 0.08)], False),
        ([Finding(SKIPPED_STEPS, "SKIPPED", "2 steps", "the check ended early: link")], False),
        ([lateness.finding("trailing comma", 0.08), Finding("trailing comma", "PASS")], True),
        ([Finding("round trip", "SKIPPED")], True),
    ],
)
def test_a_check_with_a_step_not_judged_or_not_tried_has_not_passed(
    more: list[Finding], passed: bool
) -> None:
    assert report("sim", [RATE, *more], {}, "", "").passed is passed


def test_a_port_on_which_no_board_answered_is_not_proposed() -> None:
    nothing = [Finding("baud rate", "FAIL", "nothing received")]
    assert checkup_report.changes(nothing, Config(), "/dev/one") == {}
    assert not report("/dev/one", [Finding("baud rate", "PASS")], {}, "", "").passed


def test_the_summary_counts_the_steps_not_judged_and_advises_to_repeat() -> None:
    late = [lateness.finding(name, 0.08) for name in ("watchdog", "lost lines")]
    lines = summary(report("sim", [RATE, *late], {}, "", ""), "acsard.toml").splitlines()
    assert lines[1:3] == [
        "1 PASS, 2 WARN",
        "for 2 of the steps there is no result, so the check has not passed: repeat it when this "
        "computer is idle",
    ]


def test_the_summary_counts_the_verdicts_and_has_the_lines_of_toml() -> None:
    result = report("sim", [RATE, Finding("watchdog", "FAIL")], {"mcu.baud_rate": 57600}, "", "")
    text = "\n1 PASS, 1 FAIL\n\nfor acsard.toml:\n[mcu]\nbaud_rate = 57600"
    assert summary(result, "acsard.toml") == text
    text = summary(report("sim", [RATE], {}, "", ""), "/srv/robot.toml")
    assert text == "\n1 PASS\n/srv/robot.toml: nothing to change"


CHECKED = {"link_check": "on", "encoder_counts": 3200}


@each(
    ("found", "now", "port", "changes"),
    [
        ({"trailing_comma": True, "reply_period": 0.0}, {}, "/dev/one",
         {"mcu.trailing_comma": True}),
        ({"baud_rate": 115200}, {}, "/dev/one", {"mcu.port": "/dev/one"}),  # it answered there
        # Longer lines only where the wire has room; settings in use are not removed.
        (CHECKED, {}, "", {"mcu.link_check": "on", "mcu.encoder_counts": 3200}),
        (CHECKED, {"baud_rate": 57600}, "", {"mcu.link_check": "on"}),
        (CHECKED, {"baud_rate": 38400}, "", {}),
        (CHECKED | {"baud_rate": 38400}, CHECKED, "",
         {"mcu.baud_rate": 38400, "control.rate": "auto"}),
    ],
)  # fmt: skip
def test_what_differs_and_fits_the_wire_is_proposed(
    found: dict[str, object], now: dict[str, Any], port: str, changes: dict[str, object]
) -> None:
    config = configured(Config(), **now)
    findings = [
        Finding(name.replace("_", " "), "PASS", keys={f"mcu.{name}": value})
        for name, value in found.items()
    ]
    assert checkup_report.changes(findings, config, port) == changes


def test_a_change_that_is_applied_has_no_contradictions_or_is_refused() -> None:
    config = checkup_report.applied({"mcu.baud_rate": 9600, "control.rate": "auto"}, Config())
    assert config is not None
    assert contradictions(config) == []
    assert checkup_report.applied({"mcu.baud_rate": 300}, Config()) is None


class AnyObservation(float):
    """A stand-in for any observation: a number or words."""

    def __format__(self, how: str) -> str:
        return "seen"

    def __repr__(self) -> str:
        return "seen"


SEEN = {part.partition("}")[0].partition(":")[0].partition("!")[0]
        for part in OUTCOMES.split("{")[1:]}  # fmt: skip


@each("outcome", get_args(Outcome))
def test_every_outcome_has_complete_texts(outcome: Outcome) -> None:
    finding = find(outcome, {"mcu.baud_rate": 9600}, **dict.fromkeys(SEEN, AnyObservation()))
    assert f"{finding.name}: " == outcome[: len(finding.name) + 2]
    assert finding.code == code_of(outcome)
    assert finding.keys == {"mcu.baud_rate": 9600}
    assert not {"{", "}", "  ", "->"} & {*finding.figure, *finding.text.split(" "), *finding.mend}
    if finding.verdict in ("FAIL", "WARN"):
        assert finding.text
        # These two outcomes have no repair text, because a look at the board would not help.
        assert finding.mend or outcome in ("encoder_counts_many", "wheels_not_lifted")


def test_the_advised_watchdog_time_is_that_of_the_contract() -> None:
    entries = [entry for name, entry in OUTCOMES_BY_CODE.items() if name.startswith("watchdog_")]
    text = " ".join(part for entry in entries for part in (entry.text, entry.advice))
    times = {f"{1000 * seconds:g}" for seconds in (WATCHDOG_S, MAX_WATCHDOG_S)}
    assert set(re.findall(r"(\d+) ms", text)) == times


def test_the_wheel_and_sign_of_a_motor_are_the_configured_ones() -> None:
    turned = McuConfig(wheels=WheelMap("-c", "+d", "-a", "+b"))
    wheels = [("rear_left", -1), ("rear_right", 1), ("front_right", -1), ("front_left", 1)]
    assert [wheel_of(turned, motor) for motor in range(4)] == wheels
    assert motor_name(turned, 0) == "motor a (rear left)"
    two = McuConfig(wheels=WheelMap(left="-y", right="+x"))
    assert [wheel_of(two, motor) for motor in range(2)] == [("right", 1), ("left", -1)]
    assert motor_name(two, 1) == "motor y (left)"
