"""Measures which faults of the product the tests notice.

    python -m tests.power mutants [--safety] [--only PATH [PATH ...]] [--tests PATH [PATH ...]]
                                  [--sample N] [--seed 1] [--minutes M] [--seconds 6] [--jobs 2]

A mutant has one changed, swapped or dropped piece of the syntax. A whole number above 20 changes by
a quarter, because `499` for `500` says nothing about a test. An index and a smaller number change
by 1. A fraction becomes a quarter larger or a fifth smaller.

All mutants are tried, or a sample, of the modules whose path contains a PATH of `--only`, and with
`--safety` of those in `SAFETY`. All tests that run in this process take part (`TESTS` in
`trials.py`), or those of `--tests`. Each mutant that no test noticed is printed, with the reason if
`equivalent.py` says that no test can notice it. `not noticed` means that no test failed in 6 s of
tests (`--seconds`), the fastest first; `not reached`, that none executes it. The exit status is 1
if the tests noticed less than 98 %.

A clone remembers which test noticed a mutant (`.pytest_cache/power/noticed.json`). That test runs
first the next time, and the program prints LOST for a mutant that was noticed once and is not now:
run it before and after you delete tests. It may be ended, and loses at most the mutants under way.

Run it as a user or in a container that can destroy nothing: a fault may be in code that deletes
files or ends processes. The faults that the random plans must find are in
`tests/simulate/PLANTED.md`.

The tools mutmut and cosmic-ray are not suitable. mutmut (3.8) leaves out all code outside
functions, which is every table and constant. Most mutants of cosmic-ray (8.7) are like `a << b` for
two floats, which every test notices. Neither tool draws a sample.
"""

from __future__ import annotations

import argparse
import hashlib
import json
import os
import shutil
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Collection, Iterable, Iterator
from io import TextIOWrapper
from pathlib import Path

from tests.power.equivalent import EQUIVALENT
from tests.power.mutants import mutants
from tests.power.trials import NOBODY, TESTS, UNDECIDED, UNREACHED, Trial, Trials

ROOT = Path(__file__).parents[2]
CACHE = ROOT / ".pytest_cache" / "power"
NOTICED = CACHE / "noticed.json"
SAFETY = (
    "acsard/core/guard.py",
    "acsard/core/motion/neutral.py",
    "acsard/core/motion/ages.py",
    "acsard/core/motion/lifecycle.py",
    "acsard/core/motion/modes.py",
    "acsard/core/motion/sanity.py",
    "acsard/core/motion/sides.py",
    "acsard/core/motion/wheels.py",
    "acsard/core/motion/latches.py",
)
ENOUGH = 0.98
"""Share of the mutants of `SAFETY` that tests must notice."""


def drawn(root: Path, only: Collection[str], seed: int) -> list[Trial]:
    """Return all mutants in a random order that depends on the seed.

    The order follows from each mutant's key. So an edit of the source moves only its own mutants.
    With `only`, the modules are those whose path contains one of these.
    """
    met: Counter[str] = Counter()
    lots: list[tuple[bytes, Trial]] = []
    paths = sorted(path.relative_to(root).as_posix() for path in root.glob("acsard/**/*.py"))
    for path in (path for path in paths if not only or any(part in path for part in only)):
        for _, _, statement, key, text in mutants(root, path):
            met[key] += 1
            lot = hashlib.sha256(f"{seed} {met[key]} {key}".encode()).digest()
            name = f"{key} #{met[key]}" if met[key] > 1 else key
            lots.append((lot, Trial(name, path, frozenset({statement} - {0}), text)))
    return [trial for _, trial in sorted(lots, key=lambda pair: pair[0])]


class Run:
    """One call of this program."""

    def __init__(self, asked: argparse.Namespace) -> None:
        self.asked, self.began = asked, time.monotonic()
        self.before: dict[str, str] = json.loads(NOTICED.read_text()) if NOTICED.exists() else {}
        self.verdicts: dict[str, str] = {}

    def minutes(self) -> float:
        return (time.monotonic() - self.began) / 60

    def in_time(self, trials: Iterable[Trial]) -> Iterator[Trial]:
        for trial in trials:
            if self.minutes() > self.asked.minutes:
                return
            yield trial

    def mutants(self) -> int:
        """Draw mutants, try each, and print those that no test notices."""
        only = [*self.asked.only, *(SAFETY if self.asked.safety else ())]
        pool = drawn(ROOT, only, self.asked.seed)[: self.asked.sample]
        pool = [trial._replace(first=self.before.get(trial.name, "")) for trial in pool]

        def work(trials: Trials) -> None:
            # A test that noticed a mutant before can run without a measurement of all tests.
            self.tried(trials, [trial for trial in pool if trial.first])
            left = [t for t in pool if self.verdicts.get(t.name, UNDECIDED) == UNDECIDED]
            if left and self.minutes() < self.asked.minutes:
                trials.measure(self.asked.jobs, CACHE)
                for test in sorted(trials.failed):
                    print(f"left out, because it fails without any fault: {test}")
                print(f"all tests measured, {self.minutes():.1f} min")
                self.tried(trials, left)

        # The copy may not change while its tests run.
        with tempfile.TemporaryDirectory(ignore_cleanup_errors=True) as folder:
            ignored = shutil.ignore_patterns(".*", "__pycache__")
            shutil.copytree(ROOT, folder, ignore=ignored, dirs_exist_ok=True)
            Trials(Path(folder), self.asked.tests, self.asked.seconds, work).run()
        seen = self.verdicts
        holes = [n for n, v in seen.items() if v in (NOBODY, UNREACHED) and n not in EQUIVALENT]
        noticed = sum(verdict not in (NOBODY, UNREACHED, UNDECIDED) for verdict in seen.values())
        score = noticed / max(1, noticed + len(holes))
        print(
            f"{noticed} of {len(pool)} noticed, {len(holes)} not: "
            f"{score:.1%} without equivalent ones, {ENOUGH:.0%} is enough"
        )
        return int(score < ENOUGH)

    def tried(self, trials: Trials, some: list[Trial]) -> None:
        """Try these mutants, and print and store what comes out."""
        for trial, verdict in trials.verdicts(self.in_time(some), self.asked.jobs):
            name = trial.name
            self.verdicts[name] = verdict
            why = EQUIVALENT.get(name, "")
            if verdict in (NOBODY, UNREACHED):
                line = min(trial.lines, default="outside of functions")
                print(f"{name}, line {line}\n    {why or verdict.upper()}")
                if trial.first:
                    print(f"    LOST: {trial.first} noticed it")
            elif verdict != UNDECIDED:
                if why:
                    print(f"not equivalent, {verdict} notices it: {name}")
                self.before[name] = verdict
                CACHE.mkdir(parents=True, exist_ok=True)
                part = NOTICED.with_suffix(f".{os.getpid()}")
                part.write_text(json.dumps(self.before, indent=0))
                part.replace(NOTICED)
            print(f"{self.minutes():.1f} min, {len(self.verdicts)} tried", file=sys.stderr)


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.power", description=__doc__)
    parser.add_argument("command", choices=["mutants"])
    parser.add_argument("--safety", action="store_true", help="the modules that stop the robot")
    parser.add_argument("--only", nargs="+", default=[], metavar="PATH", help="parts of paths")
    parser.add_argument("--tests", nargs="+", default=TESTS, metavar="PATH", help="patterns")
    parser.add_argument("--sample", type=int, help="how many mutants")
    parser.add_argument("--seed", type=int, default=1, help="which mutants")
    parser.add_argument("--minutes", type=float, default=1e9, help="start nothing after this time")
    parser.add_argument("--seconds", type=float, default=6.0, help="of tests for each mutant")
    parser.add_argument("--jobs", type=int, default=2, help="how many processes")
    asked = parser.parse_args()
    for stream in (sys.stdout, sys.stderr):  # into a file too
        if isinstance(stream, TextIOWrapper):
            stream.reconfigure(line_buffering=True)
    return Run(asked).mutants()


if __name__ == "__main__":
    sys.exit(main())
