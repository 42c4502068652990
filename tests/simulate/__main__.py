"""Play random plans against the whole daemon in virtual time.

The program prints a line for each plan in which the daemon breaks a promise of its documentation.
`tests/simulate/README.md` says how to use it.
"""

from __future__ import annotations

import argparse
import math
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from concurrent.futures import FIRST_COMPLETED, ProcessPoolExecutor, wait
from functools import partial
from pathlib import Path
from typing import Any

import msgspec

from tests.simulate import shrink
from tests.simulate.actors import Result, collect_seldom, digest, played
from tests.simulate.plan import Plan, make_plan

HERE = Path(__file__).parent

LARGEST = ("largest container", "largest text", "largest buffer", "largest excess mm")
"""Counts of which the table has the largest value of all runs, and not the sum."""

PlanOf = Callable[[int], Plan]
"""Makes the plan of a seed."""

MOST_SHRUNK = 3
"""Number of findings whose plans a run shrinks. To shrink one plan takes up to 400 runs of it."""


def commit() -> str:
    """Return the commit of this checkout, with a + if files have changed since."""
    result = subprocess.run(
        ["git", "describe", "--always", "--dirty=+"],
        capture_output=True, text=True, check=False, cwd=HERE,
    )  # fmt: skip
    return result.stdout.strip() or "unknown"


def results(
    seed: int, seconds: float, workers: int, within_s: float, plan_of: PlanOf
) -> Iterator[Result]:
    """Play the plans of consecutive seeds in parallel, and yield their results.

    It ends after `seconds` of simulated time in total, or after `within_s` of real time.
    """
    end = time.monotonic() + within_s
    with ProcessPoolExecutor(workers, initializer=collect_seldom) as pool:
        # A worker that is not forked, as in Python 3.14, does not import a package's `__main__`, so
        # the function must be in another module.
        running = {pool.submit(played, plan_of(seed + n)) for n in range(workers)}
        following, total = seed + workers, 0.0
        while running:
            done, running = wait(running, return_when=FIRST_COMPLETED)
            for future in done:
                result = future.result()
                total += result.simulated_s
                yield result
                if total < seconds and time.monotonic() < end:
                    running.add(pool.submit(played, plan_of(following)))
                    following += 1


def show(result: Result) -> None:
    """Print the broken promise of a run in one line."""
    print(f"{commit()} seed {result.seed}: {result.finding}", flush=True)


def table(counts: Counter[str]) -> str:
    """Return a table of how often each kind of event and check occurred, one line per group."""
    groups: dict[str, list[str]] = {}
    for name, count in sorted(counts.items()):
        group, _, rest = name.partition(" ")
        groups.setdefault(group, []).append(f"{rest or group} {count}")
    return "\n".join(f"  {group:<11} {', '.join(items)}" for group, items in groups.items())


def explore(
    seed: int, hours: float, workers: int, within_s: float, plans: Path | None, plan_of: PlanOf
) -> int:
    """Play random plans for this many simulated hours. Return the number of broken promises.

    If `plans` is a directory, the plans that broke a promise are written into it.
    """
    broken: list[Result] = []
    counts, simulated, cpu, findings, runs = Counter[str](), 0.0, 0.0, 0, 0
    began = time.perf_counter()
    for result in results(seed, hours * 3600, workers, within_s, plan_of):
        runs += 1
        simulated += result.simulated_s
        cpu += result.cpu_s
        largest = {name: max(counts[name], result.counts[name]) for name in LARGEST}
        counts.update(result.counts)
        for name, length in largest.items():
            counts[name] = length
        if result.finding:
            broken.append(result)
            findings += 1
            show(result)
    took = time.perf_counter() - began
    print(table(counts))
    print(
        f"{commit()}: {runs} runs from seed {seed}, {simulated / 3600:.2f} h simulated in "
        f"{took:.0f} s by {workers} workers, {simulated / max(cpu, 1e-9):.0f} times real time per "
        f"core, {findings} findings"
    )
    if plans is not None:
        keep_plans(broken, plans, plan_of)
    return findings


def keep_plans(broken: list[Result], where: Path, plan_of: PlanOf) -> None:
    """Write the plan of each finding into a directory, and replace the first ones by shrunk plans.

    Shrinking may take an hour, and a CI job may end before it is over.
    """
    found_by = commit()
    for result in broken:
        path = where / f"{result.seed}.json"
        print(shrink.write_corpus_file(plan_of(result.seed), result, found_by, path), flush=True)
    for result in broken[:MOST_SHRUNK]:
        small = shrink.shrunk(plan_of(result.seed), result)
        shrink.write_corpus_file(small, result, found_by, where / f"{result.seed}.json")


def replay(what: str, log: Callable[[dict[str, Any]], None] | None, plan_of: PlanOf) -> int:
    """Play the plan of a seed, or the plan in a JSON file."""
    plan = shrink.load(Path(what)) if what.endswith(".json") else plan_of(int(what))
    result = played(plan, log)
    if result.finding:
        show(result)
    print(f"{result.simulated_s:.1f} s simulated in {result.cpu_s:.1f} s")
    return int(bool(result.finding))


def print_step(step: dict[str, Any]) -> None:
    print(msgspec.json.encode(step).decode())


def reduce(seed: int, keep: str, plan_of: PlanOf) -> int:
    """Shrink the plan of a seed that breaks a promise. Print the result, or store it."""
    plan = plan_of(seed)
    result = played(plan)
    if not result.finding:
        print(f"seed {seed} breaks no promise")
        return 1
    show(result)
    small: Plan = shrink.shrunk(plan, result, print)
    show(played(small))
    if keep:
        print(shrink.write_corpus_file(small, result, commit(), HERE / "corpus" / f"{keep}.json"))
    else:
        print(shrink.written(small, result, commit()))
    return 0


def main() -> int:
    parser = argparse.ArgumentParser("tests.simulate", description=__doc__.partition("\n")[0])
    parser.add_argument("--seed", type=int, default=1, help="the first seed")
    parser.add_argument("--hours", type=float, default=0.1, help="simulated hours in all")
    parser.add_argument(
        "--within", type=float, default=math.inf, metavar="MINUTES", help="real time for new seeds"
    )
    parser.add_argument(
        "--workers", type=int, default=os.cpu_count() or 1, help="processes; one for each core"
    )
    parser.add_argument("--replay", metavar="SEED", help="play one seed, or a plan's file, again")
    parser.add_argument("--shrink", metavar="SEED", type=int, help="find the smallest plan")
    parser.add_argument("--keep", metavar="NAME", default="", help="with --shrink: into corpus/")
    parser.add_argument("--plans", metavar="DIR", type=Path, help="keep the plan of each finding")
    parser.add_argument("--steps", action="store_true", help="with --replay: print each step")
    parser.add_argument("--digests", metavar="SEEDS", type=int, help="print one of each plan")
    parser.add_argument("--wheels", type=int, choices=(2, 4), help="of each robot")
    options = parser.parse_args()
    plan_of = partial(make_plan, wheels=options.wheels)
    if options.replay:
        return replay(options.replay, print_step if options.steps else None, plan_of)
    if options.shrink is not None:
        return reduce(options.shrink, options.keep, plan_of)
    if options.digests:
        with ProcessPoolExecutor(options.workers, initializer=collect_seldom) as pool:
            plans = (plan_of(options.seed + n) for n in range(options.digests))
            for line in pool.map(digest, plans):
                print(line, flush=True)
        return 0
    within_s = options.within * 60
    workers, plans = options.workers, options.plans
    return min(1, explore(options.seed, options.hours, workers, within_s, plans, plan_of))


if __name__ == "__main__":
    sys.exit(main())
