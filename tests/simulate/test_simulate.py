"""The simulator repeats a seed exactly, and draws every kind of trouble.

The judges have no tests: each promise has a planted fault (`PLANTED.md`) that it must find, and
`test_corpus.py` plays plans of the sound product, in which it must find nothing.
"""

from __future__ import annotations

import itertools
import json
from collections import Counter

import pytest

from tests.each import each
from tests.simulate.actors import Run, digest, played
from tests.simulate.board_inputs import kinds
from tests.simulate.plan import KINDS, LATER_KINDS, make_plan
from tests.simulate.product import problems
from tests.simulate.wiring import letters, wheels


@pytest.mark.slow
def test_a_seed_gives_the_same_bytes_again_also_when_its_plan_was_written_to_a_file() -> None:
    plan = make_plan(4, 15.0)
    text = json.dumps(plan)
    assert text == json.dumps(make_plan(4, 15.0))
    assert digest(plan) == digest(json.loads(text)) != digest(make_plan(4, 14.0))


@pytest.mark.slow
def test_every_plan_is_legal_and_every_kind_of_trouble_is_drawn() -> None:
    plans = [make_plan(seed) for seed in range(200)]
    assert [problems(plan["config"]) for plan in plans] == [[]] * 200
    assert {kind for plan in plans for kind in plan["kinds"]} == {*KINDS, *LATER_KINDS}
    assert {kind for plan in plans for kind in kinds(plan)} == {
        "estop", "stop", "away", "battery", "driver_fault"
    }  # fmt: skip
    assert {len(wheels(plan["config"])) for plan in plans} == {2, 4}
    assert {letters(plan["config"]) == "abcd" for plan in plans} == {True, False}
    lawful = sum(bool(Run(plan).liveness.lawful) for plan in plans if "moment" not in plan)
    assert lawful > 20


HAPPENS = {
    "forward and back": {"commands that turn": 100, "stuck wheels": 1000},
    "dropouts": {"link is stale while moving": 20},
    "clock that is slewed": {"slewed commands": 200, "lawful looks": 1000},
    "short-lived publishers": {"senders": 20, "lawful looks": 200},
    "late network": {"moving lines": 500, "clear": 1},
}
"""What happens at least so often in three plans with each of these moments."""


@pytest.mark.slow
@each("moment", HAPPENS)
def test_a_moment_that_is_drawn_really_happens(moment: str) -> None:
    plans = (
        plan for seed in itertools.count(1) if (plan := make_plan(seed)).get("moment") == moment
    )
    results = [played(plan) for plan in itertools.islice(plans, 3)]
    assert [result.finding for result in results] == [""] * 3
    counts = sum((result.counts for result in results), Counter())
    assert counts[f"moment {moment}"] == 3
    assert {
        name: counts[name] for name in HAPPENS[moment] if counts[name] < HAPPENS[moment][name]
    } == {}
