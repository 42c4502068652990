"""Each outcome of the check has a text, which tells the operator where to look."""

from __future__ import annotations

import re
from typing import Any

from acsard.checkup.motion import MAX_WATCHDOG_S
from acsard.checkup.outcomes import OUTCOMES, OUTCOMES_BY_NAME, find
from acsard.checkup.procedure import STEPS
from acsard.core.link.link_state import WATCHDOG_S
from tests.each import each


@each("outcome", OUTCOMES_BY_NAME)
def test_every_outcome_has_complete_texts(outcome: str) -> None:
    finding = find(outcome, {"mcu.baud_rate": 9600}, **dict.fromkeys(SEEN, AnyObservation()))
    assert finding.name == outcome.partition(":")[0]
    assert finding.keys == {"mcu.baud_rate": 9600}
    assert not {"{", "}", "  ", "->"} & {*finding.figure, *finding.text.split(" "), *finding.mend}
    if finding.verdict in ("FAIL", "WARN"):
        assert finding.text
        # These two outcomes have no repair text, because a look at the board would not help.
        assert finding.mend or outcome in ("encoder counts: many", "wheels: not lifted")


class AnyObservation(float):
    """A stand-in for any observation: a number or words."""

    def __format__(self, how: str) -> str:
        return "seen"

    def __repr__(self) -> str:
        return "seen"


SEEN = {part.partition("}")[0].partition(":")[0].partition("!")[0]
        for part in OUTCOMES.split("{")[1:]}  # fmt: skip


def test_the_advised_watchdog_time_is_that_of_the_contract() -> None:
    entries = [entry for name, entry in OUTCOMES_BY_NAME.items() if name.startswith("watchdog:")]
    text = " ".join(part for entry in entries for part in (entry.text, entry.mend))
    times = {f"{1000 * seconds:g}" for seconds in (WATCHDOG_S, MAX_WATCHDOG_S)}
    assert set(re.findall(r"(\d+) ms", text)) == times


def test_every_step_can_pass_or_be_skipped_and_can_fail_or_warn() -> None:
    for step in STEPS:
        name = "motor" if step == "motors" else step
        verdicts = {o.verdict for key, o in OUTCOMES_BY_NAME.items() if key.startswith(f"{name}:")}
        assert verdicts & {"PASS", "SKIPPED"}, step
        assert verdicts & {"FAIL", "WARN"}, step


def test_an_outcome_has_the_name_of_its_motor_and_its_figures_formatted() -> None:
    finding = find("motor: right", name="motor d (rear right)", figure="+3.00 -3.00 rad/s")
    assert (finding.name, finding.verdict) == ("motor d (rear right)", "PASS")
    finding = find("runaway: along", letter="a", told=3, seen=9.04, most=6.0, motor="motor a")
    assert finding.figure == "a: commanded 3.0, measured 9.0 rad/s"
    assert finding.text == "the encoder of motor a reports more than 6 rad/s"


def test_a_runaway_against_the_command_is_blamed_on_the_leads() -> None:
    fields: dict[str, Any] = {
        "letter": "b",
        "told": 3.0,
        "seen": -9.0,
        "most": 6.0,
        "motor": "motor b (front left)",
    }
    assert "leads" in find("runaway: against", **fields).mend
    assert "leads" not in find("runaway: along", **fields).mend
