"""Plants faults in copies of the product, and measures how long the simulator needs to find each.

    python -m tests.simulate.planted [--jobs 2] [--only NAME] [--missing] [--again]

Each fault is planted alone into a copy of this tree. A process plays seeds there until a promise
breaks or the time limit is reached: first the seeds that find other faults, because `.ci/run` plays
each seed of the table. A finding counts only if the same seed breaks no promise without the fault.
`PLANTED.md` stores the results; a run replaces the rows of the faults that it played. `--again`
plays only the recorded seed of each row, which takes seconds, and changes no file.
"""

from __future__ import annotations

import argparse
import json
import os
import re
import shutil
import subprocess
import sys
import tempfile
from collections import Counter
from collections.abc import Iterator
from concurrent.futures import ThreadPoolExecutor
from functools import cache
from pathlib import Path
from threading import Lock
from typing import NamedTuple

from tests.simulate import board_inputs
from tests.simulate.actors import REPLAYED, played
from tests.simulate.plan import Plan, make_plan
from tests.simulate.planted_faults import CASES, FAULTS, Fault
from tests.simulate.wiring import wheels

ROOT = Path(__file__).parents[2]
TABLE = Path(__file__).with_name("PLANTED.md")

FAULT_MINUTES, CASE_MINUTES = 10.0, 30.0
"""Core-minutes within which a fault and a case must be found."""

CHILD = """
import json, sys
from itertools import chain, count
from tests.simulate.actors import collect_seldom, played
from tests.simulate.plan import make_plan
from tests.simulate.planted import kinds
collect_seldom()
first, left, kind = json.loads(sys.argv[1]), float(sys.argv[2]), sys.argv[3]
for seed in chain(first, (seed for seed in count(1) if seed not in first)):
    plan = make_plan(seed)
    if not kind or kind in kinds(plan):
        result = played(plan)
        left -= result.cpu_s
        print(json.dumps([seed, result.promise, result.cpu_s, result.simulated_s]), flush=True)
    if left <= 0.0:
        break
"""


class Row(NamedTuple):
    """A row of the table in `PLANTED.md`. All fields are text."""

    name: str
    breaks: str
    promise: str
    """The promise that was broken, or why no seed breaks one."""
    seed: str
    """The seed that broke it, empty if none did."""
    core: str
    """Processor time until then, core-minutes."""
    simulated: str
    """Simulated time until then, minutes."""


def plant(fault: Fault, tree: Path) -> None:
    """Write a copy of the product with this fault, and of the simulator, into `tree`."""
    ignored = shutil.ignore_patterns("__pycache__", "page", "*.md")
    shutil.copytree(ROOT / "acsard", tree / "acsard", ignore=ignored)
    shutil.copytree(ROOT / "tests" / "simulate", tree / "tests" / "simulate", ignore=ignored)
    (tree / "tests" / "scenarios").mkdir()
    helpers = ("scenarios/world.py", "scenarios/imperfect_gyro.py", "noise.py", "stepped.py")
    for name in ("__init__.py", "scenarios/__init__.py", *helpers):
        shutil.copy(ROOT / "tests" / name, tree / "tests" / name)
    for module, text in edited(fault).items():
        (tree / "acsard" / module).write_text(text, encoding="utf-8")


def edited(fault: Fault) -> dict[str, str]:
    """Return the source of each module that the fault changes.

    Raises:
        ValueError: The text that an edit replaces does not occur exactly once in the product.
    """
    texts: dict[str, str] = {}
    for module, old, new in fault.edits:
        text = texts.get(module) or (ROOT / "acsard" / module).read_text(encoding="utf-8")
        if not old:
            texts[module] = text + new
            continue
        if text.count(old) != 1:
            raise ValueError(f"{fault.name}: {module} has {text.count(old)} times {old!r}")
        texts[module] = text.replace(old, new)
    return texts


def hunt(fault: Fault, minutes: float) -> Row:
    """Plant the fault and play seeds until one finds it or the time limit is reached."""
    cpu_s, simulated_s = 0.0, 0.0
    with tempfile.TemporaryDirectory() as name:
        plant(fault, Path(name))
        for play in plays(Path(name), seeds(), 60 * minutes, fault.kind):
            cpu_s += play.cpu_s
            simulated_s += play.simulated_s
            if play.promise and not sound_finding(play.seed):
                return _row(fault, play.promise, str(play.seed), cpu_s, simulated_s)
    return _row(fault, "not found", "", cpu_s, simulated_s)


def _row(fault: Fault, promise: str, seed: str, cpu_s: float, simulated_s: float) -> Row:
    core, simulated = f"{cpu_s / 60:.2f}", f"{simulated_s / 60:.1f}"
    return Row(fault.name, fault.breaks, promise, seed, core, simulated)


def broken_again(fault: Fault, row: Row) -> str:
    """Return why the recorded seed of a row no longer finds its fault, "" if it still does."""
    seed = int(row.seed)
    with tempfile.TemporaryDirectory() as name:
        plant(fault, Path(name))
        # The process plays one seed at least, however short its time.
        (play,) = plays(Path(name), [seed], 0.001)
    if not play.promise:
        return "breaks no promise"
    return sound_finding(seed) and f"also breaks one without the fault: {sound_finding(seed)}"


@cache
def sound_finding(seed: int) -> str:
    """Return the promise that this seed breaks in the product without a fault, or ""."""
    return played(make_plan(seed)).finding


def kinds(plan: Plan) -> set[str]:
    """Return the kinds of a plan, by which `Fault.kind` chooses it."""
    names = board_inputs.kinds(plan) | {plan.get("moment", "")}
    names |= {"recorded"} if plan["seed"] % REPLAYED == 0 else set()
    names |= {"two wheels"} if len(wheels(plan["config"])) == 2 else set()
    for event in plan["events"]:
        names |= {*event, event["do"], *event.get("fault", ())[:1]}
        names |= {key.partition(".")[0] for key in event.get("settings", ())}
    return names


class Play(NamedTuple):
    """The result of playing one seed with a fault."""

    seed: int
    promise: str
    cpu_s: float
    simulated_s: float


def plays(tree: Path, first: list[int], seconds: float, kind: str = "") -> Iterator[Play]:
    """Yield the results of seeds, played on the code in `tree`: these first, then from 1 on.

    With a `kind`, only plans of this kind are played (`Fault.kind`). It ends when the time is over,
    or early if another program ends the process.
    """
    environment = os.environ | {"PYTHONPATH": str(tree), "PYTHONDONTWRITEBYTECODE": "1"}
    child = subprocess.Popen(
        [sys.executable, "-c", CHILD, json.dumps(first), str(seconds), kind],
        stdout=subprocess.PIPE, text=True, cwd=tree, env=environment,
    )  # fmt: skip
    assert child.stdout is not None
    try:
        for line in child.stdout:
            yield Play(*json.loads(line))
    finally:
        child.kill()
        code = child.wait()
    if code > 0:
        raise SystemExit(f"{tree}: the process that plays ended with {code}")


HEAD = """# Planted faults

`python -m tests.simulate.planted` writes this page. Each fault is planted alone into a copy of the
product, and the simulator plays seeds until a promise breaks: first the seeds of other rows, so
that few seeds find all faults, then from 1 on. A seed that also breaks a promise of the sound
product does not count; `.ci/run` plays all {seeds} seeds on the sound product. Core-minutes are the
processor time of the process that plays, on a machine that other work kept busy.

For some faults only plans of one kind are played, for example with an emergency stop
(`PLANS_OF_FAULT` in `planted_faults.py`). A fault must be found within
{fault:g} core-minutes, a case within {case:g}. A row keeps its last measurement; with the present
plans and judges, another seed may find its fault. `--again` plays the seed of each row again, and
lists the rows that no longer hold. "not found" says that no seed found the fault in the minutes
of that row. `--missing` measures those faults again, and all without a row.
"""

COLUMNS = """
| name | what it breaks | the promise that found it | seed | core-min | simulated min |
|---|---|---|---|---|---|
"""


def read() -> dict[str, Row]:
    """Return the rows of the table as it is."""
    if not TABLE.exists():
        return {}
    lines = re.findall(r"^\| (.+) \|$", TABLE.read_text(encoding="utf-8"), re.MULTILINE)
    rows = [line.split(" | ") for line in lines]
    return {row[0]: Row(*row) for row in rows if len(row) == len(Row._fields)}


def seeds() -> list[int]:
    """Return the seeds of the table, those that find the most faults first."""
    found = Counter(row.seed for row in read().values() if row.seed.isdigit())
    return [int(seed) for seed, _ in found.most_common()]


def text_of(rows: dict[str, Row]) -> str:
    """Return the text of `PLANTED.md` with these rows, in the order of the faults' definitions."""
    minutes = {"fault": FAULT_MINUTES, "case": CASE_MINUTES}
    text = HEAD.format(
        seeds=len({row.seed for row in rows.values() if row.seed.isdigit()}), **minutes
    )
    for title, faults in (("Faults", FAULTS), ("Cases that were once true", CASES)):
        known = [rows[fault.name] for fault in faults if fault.name in rows]
        text += f"\n## {title}\n{COLUMNS}"
        text += "".join("| " + " | ".join(row) + " |\n" for row in known)
    return text


def again(faults: list[Fault], jobs: int) -> int:
    """Play the recorded seed of each of these faults. Return how many no longer find their fault.

    Faults without a recorded seed are left out.
    """
    rows = read()
    recorded = [(fault, rows[fault.name]) for fault in faults if rows.get(fault.name)]
    recorded = [(fault, row) for fault, row in recorded if row.seed]
    lost = 0
    with ThreadPoolExecutor(jobs) as pool:
        reasons = pool.map(lambda pair: broken_again(*pair), recorded)
        for (fault, row), reason in zip(recorded, reasons, strict=True):
            if reason:
                lost += 1
                print(f"{fault.name}: seed {row.seed} {reason}", flush=True)
    print(f"{len(recorded) - lost} of {len(recorded)} rows hold")
    return lost


def main() -> int:
    parser = argparse.ArgumentParser("tests.simulate.planted")
    parser.add_argument("--jobs", type=int, default=2)
    parser.add_argument("--only", metavar="NAME", help="faults whose name begins so")
    parser.add_argument("--minutes", type=float, help="core-minutes for each, instead of its own")
    parser.add_argument("--missing", action="store_true", help="those that the table has not found")
    parser.add_argument("--again", action="store_true", help="play the seed of each row only")
    options = parser.parse_args()
    chosen = [f for f in (*FAULTS, *CASES) if f.name.startswith(options.only or "")]
    if options.missing:
        names = {name for name, row in read().items() if row.seed}
        chosen = [fault for fault in chosen if fault.name not in names]
    if options.again:
        return min(1, again(chosen, options.jobs))
    lock, lost = Lock(), 0

    def one(fault: Fault) -> None:
        nonlocal lost
        limit = options.minutes or (CASE_MINUTES if fault in CASES else FAULT_MINUTES)
        row = hunt(fault, limit)
        with lock:
            lost += not row.seed
            TABLE.write_text(text_of(read() | {row.name: row}), encoding="utf-8")
            print(f"{row.name}: {row.promise}, seed {row.seed}, {row.core} core-min", flush=True)

    with ThreadPoolExecutor(options.jobs) as pool:
        list(pool.map(one, chosen))
    TABLE.write_text(text_of(read()), encoding="utf-8")
    print(f"{len(chosen) - lost} of {len(chosen)} found")
    return min(1, lost)


if __name__ == "__main__":
    sys.exit(main())
