"""Plays the same plans on two checkouts and compares their steps bit by bit.

Each side is a separate process that imports the `acsard` of its checkout. The other side also uses
the virtual world and the `product.py` of its checkout if they exist, because both depend on the
structure of the product. A side answers a plan with a hash for each simulated second. If the hashes
of a second differ, both sides play the plan again and return the steps of that second.
"""

from __future__ import annotations

import hashlib
import json
import os
import re
import subprocess
import sys
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from functools import lru_cache
from pathlib import Path
from typing import Any

import msgspec

from tests.simulate import bad_moments, board_inputs
from tests.simulate.differences import DIFFERENCES, LEFT_OUT
from tests.simulate.plan import Plan, make_plan

OURS = Path(__file__).parents[2]

BOOT = """
import importlib.util, sys
tree, ours, adapter = sys.argv[1:4]
sys.path.insert(0, tree)
import acsard
sys.path[0] = ours
import tests, tests.scenarios, tests.simulate
from pathlib import Path
if (Path(tree) / "tests/scenarios/world.py").exists():
    tests.scenarios.__path__[:] = [str(Path(tree) / "tests/scenarios")]
product = Path(adapter or Path(tree) / "tests/simulate/product.py")
if product.exists():
    spec = importlib.util.spec_from_file_location("tests.simulate.product", product)
    module = sys.modules[spec.name] = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
from tests.simulate.pairs import serve
serve(Path(acsard.__file__))
"""
"""Program of the process of one side. `tree` is a checkout, or the directory of a wheel."""

Step = dict[str, Any]


def serve(where: Path) -> None:
    """Play each plan from standard input, and print its hashes, until the input ends."""
    from tests.simulate.actors import collect_seldom
    from tests.simulate.unjudged import Unjudged

    collect_seldom()
    print(json.dumps(str(where)), flush=True)
    for line in sys.stdin:
        asked = json.loads(line)
        trace = Trace(asked.get("second"))
        run = Unjudged(asked["plan"], trace.step)
        error = run.played()
        answer = {
            "hashes": trace.hashes, "steps": trace.steps, "error": error,
            "simulated_s": run.simulated_s,
        }  # fmt: skip
        print(json.dumps(answer), flush=True)


class Trace:
    """A hash of each second of a run, and the steps of one second as text."""

    def __init__(self, second: int | None = None) -> None:
        self.hashes: list[str] = []
        self.steps: list[Step] = []
        self._second, self._hash = second, hashlib.sha256()

    def step(self, step: Step) -> None:
        """Add the results of a step to the hash of its second."""
        step = rewritten(step)
        second = step["at"] // 10**9
        # msgspec writes each float so that it can be read back to the last bit.
        self._hash.update(msgspec.json.encode(step))
        while len(self.hashes) <= second:
            self.hashes.append("")
        # The hash goes on from second to second, so equal ends mean equal runs.
        self.hashes[second] = self._hash.hexdigest()[:16]
        if second == self._second:
            self.steps.append(step)


def rewritten(step: Step, differences: tuple[tuple[str, str, str, str], ...] = DIFFERENCES) -> Step:
    """Return a step with the deliberate differences taken out."""
    changed = dict(step)
    for field, pattern, replacement, _ in differences:
        value = changed[field]
        text = value if isinstance(value, str) else json.dumps(value)
        changed[field] = _replaced(pattern, replacement, text)
    return changed


@lru_cache(4096)
def _replaced(pattern: str, replacement: str, text: str) -> str:
    return re.sub(pattern, replacement, text)


def comparable(plan: Plan, left_out: tuple[tuple[str, object, str], ...] = LEFT_OUT) -> Plan:
    """Return a plan without the events whose effects intentionally differ on the two sides."""
    events = plan["events"]
    for field, value, _ in left_out:
        events = [event for event in events if event.get(field) != value]
    return bad_moments.removed(board_inputs.removed(plan | {"events": events}))


class Side:
    """The process that plays plans on one checkout."""

    def __init__(self, tree: Path, adapter: Path | None = None) -> None:
        """Start the process on the checkout `tree`. `adapter` replaces its `product.py`."""
        environment = {key: value for key, value in os.environ.items() if key != "PYTHONPATH"}
        self._process = subprocess.Popen(
            [sys.executable, "-c", BOOT, str(tree.resolve()), str(OURS),
             str(adapter.resolve()) if adapter else ""],
            stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True, env=environment, cwd=OURS,
        )  # fmt: skip
        self.package = Path(self._read())
        if tree.resolve() not in self.package.parents:
            self.close()
            raise SystemExit(f"{tree} has no acsard: {self.package} was imported")

    def play(self, plan: Plan, second: int | None = None) -> dict[str, Any]:
        """Play a plan, and return its hashes and the steps of the given second."""
        assert self._process.stdin is not None
        self._process.stdin.write(json.dumps({"plan": plan, "second": second}) + "\n")
        self._process.stdin.flush()
        answer: dict[str, Any] = self._read()
        return answer

    def _read(self) -> Any:
        assert self._process.stdout is not None
        line = self._process.stdout.readline()
        if not line:
            raise SystemExit("a side of the pair ended; its error is above")
        return json.loads(line)

    def close(self) -> None:
        """End the process."""
        assert self._process.stdin is not None
        self._process.stdin.close()
        self._process.wait(10)


class Pair:
    """Two sides that play the same plans."""

    def __init__(self, ours: Path, other: Path, adapter: Path | None = None) -> None:
        self.sides = Side(ours), Side(other, adapter)

    def differs(self, plan: Plan) -> tuple[str, float]:
        """Play the plan on both sides. Return the first difference or "", and the simulated s."""
        with ThreadPoolExecutor(2) as pool:
            a, b = pool.map(lambda side: side.play(plan), self.sides)
        if a["hashes"] == b["hashes"] and a["error"] == b["error"]:
            return "", a["simulated_s"]
        both = zip(a["hashes"], b["hashes"], strict=False)
        second = next((n for n, (x, y) in enumerate(both) if x != y), None)
        if second is None:
            return f"ends differ: {a['error']!r} and {b['error']!r}", a["simulated_s"]
        steps = [side.play(plan, second)["steps"] for side in self.sides]
        return first_difference(*steps), a["simulated_s"]

    def close(self) -> None:
        """End both processes."""
        for side in self.sides:
            side.close()


def first_difference(ours: list[Step], theirs: list[Step]) -> str:
    """Return a text that describes the first field that differs in these steps."""
    for a, b in zip(ours, theirs, strict=False):
        for field in a:
            if a[field] != b[field]:
                at = f"robot time {a['at'] / 1e9:.6f} s"
                return f"{at}, {field}: here {a[field]!r}, there {b[field]!r}"
    return f"one has {len(ours)} steps in this second, the other {len(theirs)}"


def compare(
    tree: Path,
    seed: int,
    seconds: float,
    workers: int,
    adapter: Path | None = None,
    show: Callable[[str], None] = print,
) -> int:
    """Compare this checkout with another one for `seconds` of simulated time.

    Returns 1 if they differ, otherwise 0.
    """
    began, differing, runs, total = time.perf_counter(), 0, 0, 0.0
    pairs = [Pair(OURS, tree, adapter) for _ in range(max(1, workers // 2))]
    try:
        with ThreadPoolExecutor(len(pairs)) as pool:
            while total < seconds:
                plans = [comparable(make_plan(seed + runs + n)) for n in range(len(pairs))]
                results = pool.map(lambda pair, plan: pair.differs(plan), pairs, plans)
                for plan, (difference, simulated_s) in zip(plans, results, strict=True):
                    runs += 1
                    total += simulated_s
                    if difference:
                        differing += 1
                        show(f"seed {plan['seed']}: {difference}")
    finally:
        for pair in pairs:
            pair.close()
    show(
        f"{runs} pairs from seed {seed}, {total / 3600:.2f} h simulated on both sides in "
        f"{time.perf_counter() - began:.0f} s, {differing} differ; "
        f"{len(DIFFERENCES) + len(LEFT_OUT)} deliberate differences are listed"
    )
    return min(1, differing)
