"""Tests of the simulator: it repeats a seed exactly and shrinks a plan.

The judges have no tests: each promise has a planted fault (`PLANTED.md`) that it must find, and
`test_corpus.py` plays plans of the sound product, in which it must find nothing.
"""

from __future__ import annotations

import json
import random
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

from tests.simulate import __main__ as main
from tests.simulate import shrink
from tests.simulate.actors import Result, Run, digest
from tests.simulate.bad_moments import MOMENTS
from tests.simulate.board_inputs import kinds
from tests.simulate.plan import KINDS, LATER_KINDS, Plan, make_plan
from tests.simulate.product import problems
from tests.simulate.roads import NS, messages


def made_up(plan: Plan, promise: str = "a made-up promise") -> Result:
    return Result(plan["seed"], promise, promise, 500 * NS, 1.0, 0.1, Counter())


# plans


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
    lawful = sum(bool(Run(plan).liveness.lawful) for plan in plans if "moment" not in plan)
    assert lawful > 20


@cache
def plans_of_moments() -> dict[str, Plan]:
    """Return, for each moment of `bad_moments.py`, the first plan that has it."""
    plans: dict[str, Plan] = {}
    for plan in map(make_plan, range(2000)):
        plans.setdefault(plan.get("moment", ""), plan)
        if plans.keys() >= MOMENTS.keys():
            break
    return plans


@pytest.mark.slow
@pytest.mark.parametrize("name", MOMENTS)
def test_a_plan_with_a_moment_is_legal(name: str) -> None:
    plan = plans_of_moments()[name]
    assert problems(plan["config"]) == []
    assert plan == json.loads(json.dumps(plan))


# the command


@pytest.mark.slow
def test_the_plan_of_each_finding_is_kept_and_the_first_ones_are_shrunk(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(shrink, "played", made_up)
    seeds = range(main.MOST_SHRUNK + 1)
    main.keep_plans([made_up({"seed": seed}) for seed in seeds], tmp_path / "findings")
    plans = [shrink.load(tmp_path / "findings" / f"{seed}.json") for seed in seeds]
    assert [plan["senders"] for plan in plans[:-1]] == [[]] * main.MOST_SHRUNK
    assert plans[-1] == json.loads(json.dumps(make_plan(main.MOST_SHRUNK)))


# shrinking


def test_a_sender_sends_the_same_without_the_other_senders() -> None:
    plan = next(p for p in map(make_plan, range(20)) if len(p["senders"]) > 2)
    alone = shrink.without(plan, [("senders", 0)])
    both = [
        messages(plan_["senders"][place], plan_["seed"], plan["seconds"], 0)
        for plan_, place in ((plan, 1), (alone, 0))
    ]
    assert both[0] == both[1] != []


@pytest.mark.slow
def test_shrinking_leaves_what_the_finding_needs(monkeypatch: pytest.MonkeyPatch) -> None:
    def broken(plan: Plan) -> Result:
        verbs = [event.get("verb") for event in plan["events"]]
        fails = "clear" in verbs and any(s["phases"] for s in plan["senders"])
        return made_up(plan, "a made-up promise" if fails else "")

    monkeypatch.setattr(shrink, "played", broken)
    large = next(
        p for p in map(make_plan, range(99)) if any(e.get("verb") == "clear" for e in p["events"])
    )
    random.Random(1).shuffle(large["events"])
    small = shrink.shrunk(large, broken(large))
    assert [event.get("verb") for event in small["events"]] == ["clear"]
    assert [len(sender["phases"]) for sender in small["senders"]] == [1]
    assert not problems(small["config"])
