"""Removes each part of a plan that is not needed to break the same promise.

The method is delta debugging (Zeller & Hildebrandt, 2002). A part is a sender, an event, a phase of
a sender or a setting, and is identified by its path. Each sender has a random generator that
depends on its name, so the other senders stay the same when one is removed.
"""

from __future__ import annotations

import json
from collections.abc import Callable
from copy import deepcopy
from pathlib import Path
from typing import Any

from tests.simulate.actors import Result, played
from tests.simulate.plan import Plan
from tests.simulate.product import problems

Part = tuple[Any, ...]

MOST_RUNS = 400
"""Number of plans that are tried. The plan is small enough to read then."""


class _Search:
    def __init__(self, plan: Plan, promise: str, report: Callable[[str], None]) -> None:
        self.plan, self.promise, self.report = plan, promise, report
        self.runs = 0

    def holds(self, plan: Plan) -> Result | None:
        """Return the result if this plan still breaks the same promise."""
        self.runs += 1
        if self.runs > MOST_RUNS or problems(plan["config"]):
            return None
        result = played(plan)
        return result if result.promise == self.promise else None

    def drop(self, kind: Callable[[Plan], list[Part]]) -> None:
        """Remove all unneeded parts of one kind: first halves, then quarters, then single ones."""
        parts = kind(self.plan)
        size = max(1, len(parts) // 2)
        while parts:
            for begin in range(0, len(parts), size):
                less = without(self.plan, parts[begin : begin + size])
                result = self.holds(less)
                if result is not None:
                    self.plan = less
                    self.cut(result)
                    parts = kind(self.plan)
                    self.report(f"{self.runs} runs, {len(parts)} parts left: {result.finding}")
                    size = max(1, min(size, len(parts) // 2))
                    break
            else:
                if size == 1:
                    return
                size = max(1, size // 2)

    def cut(self, result: Result) -> None:
        """End the plan shortly after the broken promise, if that is before the plan's end."""
        at = result.at_ns / 1e9
        if at < self.plan["seconds"]:
            self.plan = ended(self.plan, at)


def ended(plan: Plan, at: float) -> Plan:
    """Return the plan without events and phases that begin after this time."""
    less = deepcopy(plan)
    less["seconds"] = round(at + 0.5, 3)
    less["events"] = [event for event in less["events"] if event["at"] <= at]
    for sender in less["senders"]:
        sender["phases"] = [phase for phase in sender["phases"] if phase[0] <= at]
    return less


def large(plan: Plan) -> list[Part]:
    """Return the paths of the senders and events of a plan."""
    return [(kind, n) for kind in ("senders", "events") for n in range(len(plan[kind]))]


def small(plan: Plan) -> list[Part]:
    """Return the paths of the phases, congestions, clock changes and losses of all senders."""
    lists = ("phases", "congestion", "clock", "away")
    return [
        ("senders", n, name, place)
        for n, sender in enumerate(plan["senders"])
        for name in lists
        for place in range(len(sender.get(name, ())))
    ]


def settings(plan: Plan) -> list[Part]:
    """Return the paths of the settings that can be removed, so that their defaults apply.

    The simulator needs the other settings itself.
    """
    needed = ("limits", "commands")
    return [
        ("config", table, key)
        for table, keys in plan["config"].items()
        for key in keys
        if table not in needed and key != "port"
    ]


def without(plan: Plan, parts: list[Part]) -> Plan:
    """Return the plan without these parts."""
    less = deepcopy(plan)
    for part in sorted(
        parts, key=lambda part_path: [str(x).zfill(6) for x in part_path], reverse=True
    ):
        inner: Any = less
        for name in part[:-1]:
            inner = inner[name]
        del inner[part[-1]]
    return less


def shrunk(plan: Plan, result: Result, report: Callable[[str], None] = lambda text: None) -> Plan:
    """Return a smaller plan that breaks the same promise."""
    search = _Search(plan, result.promise, report)
    first = deepcopy(plan)
    search.cut(result)
    if search.holds(search.plan) is None:
        search.plan = first
    for kind in (large, small, settings, large):
        search.drop(kind)
    return search.plan


def written(plan: Plan, result: Result, commit: str) -> str:
    """Return a corpus file as text."""
    record = {"promise": result.promise, "found": f"{commit} seed {result.seed}", "plan": plan}
    return json.dumps(record, indent=1) + "\n"


def write_corpus_file(plan: Plan, result: Result, commit: str, path: Path) -> str:
    """Write a corpus file, which `test_corpus.py` then plays. Return a message with its path."""
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(written(plan, result, commit), encoding="utf-8")
    return f"{path}: commit it with the change that mends this"


def load(path: Path) -> Plan:
    """Return the plan of a corpus file."""
    plan: Plan = json.loads(path.read_text(encoding="utf-8"))["plan"]
    return plan
