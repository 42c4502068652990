"""Tests of the simulator: it repeats a seed exactly, shrinks a plan and compares two checkouts.

The judges have no tests: each promise has a planted fault (`PLANTED.md`) that it must find, and
`test_corpus.py` plays plans of the sound product, in which it must find nothing.
"""

from __future__ import annotations

import json
import random
import re
import shutil
from collections import Counter
from functools import cache
from pathlib import Path

import pytest

from tests.scenarios.world import START
from tests.simulate import __main__ as main
from tests.simulate import pairs, shrink
from tests.simulate.actors import Result, Run, played
from tests.simulate.bad_moments import MOMENTS, NEW
from tests.simulate.board_inputs import kinds
from tests.simulate.pairs import OURS, Pair, Trace
from tests.simulate.plan import KINDS, LATER_KINDS, Plan, make_plan
from tests.simulate.product import problems
from tests.simulate.promises import BrokenError, Witness
from tests.simulate.roads import NS, messages
from tests.simulate.unjudged import Unjudged

ODD = {"odd configuration", "extreme timing", "other vehicle", "other dialect"}


def quiet() -> Plan:
    """Return a plan without senders and events. Only the lawful sender drives at its end."""
    plain = next(plan for plan in map(make_plan, range(99)) if ODD.isdisjoint(plan["kinds"]))
    return {
        "seed": 0, "seconds": 2.0, "kinds": [], "board": [], "senders": [], "events": [],
        "lawful": "a new client", "config": plain["config"],
    }  # fmt: skip


def made_up(plan: Plan, promise: str = "a made-up promise") -> Result:
    return Result(plan["seed"], promise, promise, 500 * NS, 1.0, 0.1, Counter())


# plans


@pytest.mark.slow
def test_a_seed_gives_the_same_bytes_again_also_when_its_plan_was_written_to_a_file() -> None:
    first, again = Trace(), Trace()
    plan = make_plan(4, 15.0)
    text = json.dumps(plan)
    assert text == json.dumps(make_plan(4, 15.0))
    results = [played(plan, first.step), played(json.loads(text), again.step)]
    assert first.hashes == again.hashes
    assert len(first.hashes) > 15
    assert results[0].finding == results[1].finding == ""


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
def test_a_plan_with_a_moment_is_legal_and_an_older_product_knows_its_faults(name: str) -> None:
    plan = plans_of_moments()[name]
    assert problems(plan["config"]) == []
    assert plan == json.loads(json.dumps(plan))
    less = pairs.comparable(plan)
    names = {event.get("fault", [event["do"]])[0] for event in less["events"]}
    assert not (names | {fault[0] for fault in less["board"]}) & NEW


# the command


@pytest.mark.slow
def test_a_seed_of_a_replay_is_played_and_reported(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(main, "make_plan", lambda seed: make_plan(seed, 3.0))
    assert main.replay("17") == 0
    assert " s simulated in " in capsys.readouterr().out
    monkeypatch.setattr(main, "played", lambda plan: made_up(plan, "a promise at 2.000 s: so"))
    assert main.replay("17") == 1
    assert " seed 17: a promise at 2.000 s: so\n" in capsys.readouterr().out


@pytest.mark.slow
def test_seeds_are_played_until_the_time_is_simulated_and_what_they_covered_is_printed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr(main, "make_plan", lambda seed: make_plan(seed, 3.0))
    assert main.explore(1, 0.012, 2) == 0
    out = capsys.readouterr().out
    assert re.search(r": \d runs from seed 1, 0\.0\d h simulated in .* 0 findings\n", out)
    assert re.search(r"^  way +\w+ \d", out, re.MULTILINE)


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


# pairs


@pytest.mark.slow
def test_a_paired_run_finds_no_difference_to_the_same_code_and_names_the_first_one_else(
    tmp_path: Path,
) -> None:
    # With the compiled modules, because compiling takes longer than the plan.
    shutil.copytree(OURS / "acsard", tmp_path / "acsard")
    plan = quiet()
    pair = Pair(OURS, tmp_path)
    assert pair.sides[1].package.is_relative_to(tmp_path)
    assert pair.differs(plan)[0] == ""
    pair.close()
    words = tmp_path / "acsard" / "core" / "codes.py"
    text = words.read_text(encoding="utf-8")
    words.write_text(text.replace("waiting for a command", "no command"), encoding="utf-8")
    pair = Pair(OURS, tmp_path)
    difference, _ = pair.differs(plan)
    pair.close()
    assert "reason: here 'waiting for a command" in difference
    assert "there 'no command" in difference


def test_an_event_that_is_left_out_of_pairs_is_in_no_plan_of_theirs() -> None:
    plan = next(
        p for p in map(make_plan, range(99)) if any(e["do"] == "restart" for e in p["events"])
    )
    less = pairs.comparable(plan, (("do", "restart", "it restarts in another way"),))
    names, left = ({event["do"] for event in plan_["events"]} for plan_ in (plan, less))
    assert names - left == {"restart"}


def test_a_pair_goes_on_behind_a_broken_promise_and_ends_at_an_exception_of_the_product(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    def broken(self: Witness, *_: object) -> None:
        raise BrokenError("a made-up promise", 0, "")

    monkeypatch.setattr(Witness, "step", broken)
    assert "a made-up promise" in played(quiet()).finding
    trace = Trace()
    assert Unjudged(quiet(), trace.step).played() == ""
    # The last step is in the second in which the plan ends.
    assert len(trace.hashes) == START.mono_ns // NS + quiet()["seconds"] + 1

    def fails(self: Run, true_ns: int) -> None:
        raise ZeroDivisionError("division by zero")

    monkeypatch.setattr(Run, "run_to", fails)
    assert Unjudged(quiet()).played() == "ZeroDivisionError: division by zero"


def test_a_listed_difference_is_taken_out_on_both_sides() -> None:
    listed = (("reason", "no command|waiting for a command", "X", "new words"),)
    steps = [
        pairs.rewritten({"at": 1, "reason": words}, listed)
        for words in ("waiting for a command: now", "no command: now")
    ]
    assert steps[0] == steps[1] == {"at": 1, "reason": "X: now"}
