"""Measures which faults of the product the tests notice, and what they noticed once.

    python -m tests.power compare [--minutes M] [--jobs 2]
    python -m tests.power baseline [--anew] [--minutes M] [--jobs 2]
    python -m tests.power mutants [--safety] [--only PATH [PATH ...]] [--sample N] [--seed 1]

`baseline.json` has two scales: a fixed sample of mutants of the whole product, and each hunk of the
500 commits before its own commit that could still be undone. For each item it names the test that
noticed it. `not noticed` means that no test failed in 6 s of tests, the fastest first; `not
reached`, that none executes it. Items of modules that were deleted since are not in the file.

`compare` prints LOST for each item that a test noticed then and none notices now, and exits with 1
if there is one. A change that deletes tests says for each lost item which line of the product's
scope allows it, or adds a test. An item whose code was rewritten is gone, not lost. `baseline`
measures the items without a result, and `--anew` all items of this tree. `--scales` and `--only`
choose some. A run starts nothing after `--minutes`. It may be ended: it loses at most the items
under way, and the next run goes on where it ended.

A mutant has one changed, swapped or dropped piece of the syntax. A whole number above 20 changes by
a quarter, because `499` for `500` says nothing about a test. An index and a smaller number change
by 1. A fraction becomes a quarter larger or a fifth smaller. `mutants` tries all mutants, or a
sample, of the modules whose path contains a PATH, and with `--safety` of those in `SAFETY`. It
lists each mutant that no test noticed, with the reason if `equivalent.py` says that no test can
notice it. The exit status is 1 if the tests noticed less than 98 %.

All tests that run in this process take part (`TESTS` in `trials.py`). Run it as a user or in a
container that can destroy nothing: a fault may be in code that deletes files or ends processes. The
faults that the random plans must find are in `tests/simulate/PLANTED.md`.

The tools mutmut and cosmic-ray are not suitable. mutmut (3.8) leaves out all code outside
functions, which is every table and constant. Most mutants of cosmic-ray (8.7) are like `a << b` for
two floats, which every test notices. Neither tool draws a sample.
"""

from __future__ import annotations

import argparse
import os
import shutil
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable, Iterable, Iterator
from pathlib import Path

from tests.power.equivalent import EQUIVALENT
from tests.power.scales import (
    Results,
    drawn,
    is_measured,
    load,
    present,
    report,
    save,
    was_noticed,
)  # fmt: skip
from tests.power.trials import NOBODY, UNDECIDED, UNREACHED, Trial, Trials, digest

ROOT = Path(__file__).parents[2]
BASELINE = Path(__file__).with_name("baseline.json")
CACHE = ROOT / ".pytest_cache" / "power"
SCALES = ("mutants", "hunks")
SAFETY = (
    "acsard/core/guard.py",
    "acsard/core/motion/neutral.py",
    "acsard/core/motion/ages.py",
    "acsard/core/motion/lifecycle.py",
    "acsard/core/motion/modes.py",
    "acsard/core/motion/sanity.py",
    "acsard/core/motion/wheels.py",
    "acsard/core/motion/latches.py",
)
ENOUGH = 0.98
"""Share of the mutants of `SAFETY` that tests must notice."""


class Run:
    """One call of this program."""

    def __init__(self, asked: argparse.Namespace) -> None:
        self.asked, self.began = asked, time.monotonic()

    def minutes(self) -> float:
        return (time.monotonic() - self.began) / 60

    def in_time(self, items: Iterable[Trial]) -> Iterator[Trial]:
        for item in items:
            if self.minutes() > self.asked.minutes:
                return
            yield item

    def tried(
        self, items: list[Trial], results: Results, keep: Callable[[Trial, str], None]
    ) -> None:
        """Try the items that have no result yet. Call `keep` after each."""

        def work(trials: Trials) -> None:
            # The test that noticed an item before can run without a measurement of all tests.
            for final in (False, True) if any(item.first for item in items) else (True,):
                open_ones = (None, UNDECIDED) if final else (None,)
                todo = [i for i in items if results[i.scale].get(i.name) in open_ones]
                if final and todo and self.minutes() < self.asked.minutes:
                    trials.measure(self.asked.jobs, CACHE)
                    for test in sorted(trials.failed):
                        print(f"left out, because it fails without any fault: {test}")
                    print(f"all tests measured, {self.minutes():.1f} min", flush=True)
                left = len(todo)
                for item, verdict in trials.verdicts(self.in_time(todo), self.asked.jobs):
                    left -= 1
                    results[item.scale][item.name] = verdict
                    keep(item, verdict)
                    print(f"{self.minutes():.1f} min, {left} left", file=sys.stderr, flush=True)

        left = [i for i in items if results[i.scale].get(i.name) in (None, UNDECIDED)]
        if not left or self.minutes() > self.asked.minutes:
            return
        # The copy may not change while its tests run.
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            ignored = shutil.ignore_patterns(".*", "__pycache__")
            shutil.copytree(ROOT, folder, ignore=ignored, dirs_exist_ok=True)
            Trials(Path(folder), work).run()

    def mutants(self) -> int:
        """Draw mutants of some modules, try each, and print those that no test notices."""
        only = [*self.asked.only, *(SAFETY if self.asked.safety else ())]
        pool = drawn(ROOT, only, self.asked.seed)[: self.asked.sample]
        results: Results = {"mutants": {}}

        def keep(item: Trial, verdict: str) -> None:
            why = EQUIVALENT.get(item.name, "")
            if why and was_noticed(verdict):
                print(f"not equivalent, {verdict} notices it: {item.name}", flush=True)
            elif verdict in (NOBODY, UNREACHED):
                line = min(item.lines, default="outside of functions")
                print(f"{item.name}, line {line}\n    {why or verdict.upper()}", flush=True)

        self.tried(pool, results, keep)
        verdicts = results["mutants"]
        holes = [n for n, v in verdicts.items() if v in (NOBODY, UNREACHED) and n not in EQUIVALENT]
        noticed = sum(map(was_noticed, verdicts.values()))
        score = noticed / max(1, noticed + len(holes))
        print(
            f"{noticed} of {len(pool)} noticed, {len(holes)} not: "
            f"{score:.1%} without equivalent ones, {ENOUGH:.0%} is enough"
        )
        return int(score < ENOUGH)

    def baseline(self) -> int:
        """Measure the items of the baseline that have no result yet."""
        commit = subprocess.run(
            ["git", "-C", ROOT, "rev-parse", "HEAD"], capture_output=True, text=True
        ).stdout.strip()
        before, results = ("", {}) if self.asked.anew else load(BASELINE)
        if before not in ("", commit):
            sys.exit(f"{BASELINE.name} is of {before}: check that out, or give --anew")
        items = present(ROOT, self.asked.scales, results, self.asked.only)
        for item in items:
            results.setdefault(item.scale, {}).setdefault(item.name, None)
        save(BASELINE, commit, results)
        self.tried(items, results, lambda item, verdict: save(BASELINE, commit, results))
        for scale, verdicts in sorted(results.items()):
            measured = [verdict for verdict in verdicts.values() if is_measured(verdict)]
            noticed = sum(map(was_noticed, measured))
            print(f"{scale}: {len(verdicts)}, measured {len(measured)}, noticed {noticed}")
        return 0

    def compare(self) -> int:
        """Print what the tests noticed once and do not notice any more."""
        commit, known = load(BASELINE)
        known = {scale: known[scale] for scale in self.asked.scales if scale in known}
        items = present(ROOT, known, known, self.asked.only)
        file = CACHE / f"compared-{digest(ROOT)}.json"
        _, now = load(file)
        now = {scale: dict(now.get(scale, {})) for scale in known}
        before = [(item, known[item.scale].get(item.name)) for item in items]
        todo = [item._replace(first=test) for item, test in before if test and was_noticed(test)]
        self.tried(todo, now, lambda item, verdict: save(file, commit, now))
        print(f"compared with {commit}")
        return int(report(known, now, items))


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.power", description=__doc__)
    parser.add_argument("command", choices=("compare", "baseline", "mutants"))
    parser.add_argument("--jobs", type=int, default=2, help="how many processes")
    parser.add_argument("--minutes", type=float, default=1e9, help="start nothing after this time")
    parser.add_argument("--scales", nargs="+", default=SCALES, choices=SCALES)
    parser.add_argument("--anew", action="store_true", help="a new baseline of this tree")
    parser.add_argument("--only", nargs="+", default=[], metavar="PATH", help="parts of paths")
    parser.add_argument("--safety", action="store_true", help="the modules that stop the robot")
    parser.add_argument("--sample", type=int, help="how many mutants")
    parser.add_argument("--seed", type=int, default=1, help="which mutants")
    asked = parser.parse_args()
    os.nice(19)
    command: Callable[[Run], int] = getattr(Run, asked.command)
    return command(Run(asked))


if __name__ == "__main__":
    sys.exit(main())
