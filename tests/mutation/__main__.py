"""The mutation check of the safety core: does a test fail for every small fault in it?

    python -m tests.mutation [--sample 240] [--seed 1] [--jobs 2]
    python -m tests.mutation --safety [--jobs 2]
    python -m tests.mutation --only PATH [PATH ...] [--sample N] [--jobs 2]

A mutant is the source with one small fault. The first form tries a random sample of all mutants of
the core. Tests must notice 95 % of them. `--safety` tries every mutant of the modules in `SAFETY`,
and tests must notice 98 %. `--only` does the same for the modules whose path contains a PATH.

Each mutant runs alone in its own process, until a test fails. Only tests of the core (`TESTS` in
`trials.py`) that execute the changed statement run. The tests of the same module come first, then
the others, the fastest first, for at most `MOST_SECONDS`. The output lists each mutant that no test
noticed, with the reason if `equivalent.py` says that no test can notice it. The exit status is 1 if
the tests noticed too few.

The tools mutmut and cosmic-ray are not suitable. mutmut (3.8) leaves out all code outside
functions, which is every table and constant. Most mutants of cosmic-ray (8.7) are like `a << b` for
two floats, which every test notices. Neither tool draws a sample.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import shutil
import sys
import tempfile
import time
from collections import Counter
from pathlib import Path

from tests.mutation.equivalent import EQUIVALENT
from tests.mutation.mutants import Mutant, mutants
from tests.mutation.trials import ENDLESS, NONE, OTHER, OWN, Trials

ROOT = Path(__file__).parents[2]
CORE = (
    "acsard/core/motion",
    "acsard/core/guard.py",
    "acsard/core/link/board_status.py",
    "acsard/core/link/checked_line.py",
    "acsard/core/link/encoders.py",
    "acsard/core/link/codec.py",
    "acsard/core/link/negotiation.py",
    "acsard/core/link/minimum_delay.py",
    "acsard/core/robot.py",
    "acsard/daemon/latch_rules.py",
)
SAFETY = (
    "acsard/core/guard.py",
    "acsard/core/motion/neutral.py",
    "acsard/core/motion/freshness.py",
    "acsard/core/motion/lifecycle.py",
    "acsard/core/motion/modes.py",
    "acsard/core/motion/sanity.py",
    "acsard/core/motion/wheel_witness.py",
    "acsard/daemon/latch_rules.py",
)
ENOUGH, ENOUGH_OF_ALL = 0.95, 0.98
"""Share of the mutants that tests must notice: of a sample, and of every mutant of some modules."""

MOST_LEFT_OUT = 5
"""Tests that may fail without a mutant. Such a test would notice every mutant."""


def sources() -> list[str]:
    """Return the paths of the modules of the core."""
    paths: list[Path] = []
    for path in CORE:
        paths += [ROOT / path] if path.endswith(".py") else sorted((ROOT / path).glob("*.py"))
    return [path.relative_to(ROOT).as_posix() for path in paths]


def drawn(pool: list[Mutant], seed: int) -> list[Mutant]:
    """Return all mutants in a random order that depends on the seed.

    The order follows from each mutant's key. So an edit of the source moves only its own mutants.
    """
    met: Counter[str] = Counter()
    lots: list[tuple[bytes, Mutant]] = []
    for mutant in pool:
        met[mutant.key] += 1
        lot = f"{seed} {met[mutant.key]} {mutant.key}".encode()
        lots.append((hashlib.sha256(lot).digest(), mutant))
    return [mutant for _, mutant in sorted(lots)]


def main() -> int:
    """Draw the mutants, try each, and print the result."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutation", description=__doc__)
    parser.add_argument("--sample", type=int, help="how many mutants (240; all of named modules)")
    parser.add_argument("--seed", type=int, default=1, help="which ones")
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="PATH", help="modules whose path contains one"
    )
    parser.add_argument("--safety", action="store_true", help="the modules that stop the robot")
    parser.add_argument("--jobs", type=int, default=2, help="how many at once")
    asked = parser.parse_args()
    os.nice(19)
    began = time.monotonic()
    only = [*asked.only, *(SAFETY if asked.safety else ())]
    paths = [path for path in sources() if not only or any(part in path for part in only)]
    pool = [mutant for path in paths for mutant in mutants(ROOT, path)]
    size = len(pool) if only else 240
    sample = drawn(pool, asked.seed)[: asked.sample or size]
    enough = ENOUGH_OF_ALL if only else ENOUGH
    print(f"{len(sample)} of {len(pool)} mutants, seed {asked.seed}", flush=True)
    counts: Counter[int] = Counter()
    holes: list[str] = []

    def work(trials: Trials) -> None:
        trials.measure(asked.jobs)
        if len(trials.failed) > MOST_LEFT_OUT:
            sys.exit(f"these tests fail without any mutant: {sorted(trials.failed)}")
        for test in sorted(trials.failed):
            print(f"left out, because it fails without any mutant: {test}", flush=True)
        print(f"measured in {(time.monotonic() - began) / 60:.1f} min", flush=True)
        for mutant, verdict in trials.verdicts(sample, asked.jobs):
            counts[verdict] += 1
            if not counts.total() % 20:
                print(f"    {counts.total()} tried", file=sys.stderr, flush=True)
            if verdict and mutant.key in EQUIVALENT:
                print(f"not equivalent, a test notices it: {mutant.key}", flush=True)
            if not verdict:
                why = EQUIVALENT.get(mutant.key, "")
                if not why:
                    holes.append(mutant.key)
                print(f"line {mutant.line} of {mutant.key}", flush=True)
                print(f"    {why or 'NO TEST NOTICES IT'}", flush=True)

    # The copy may not change while its tests run.
    with tempfile.TemporaryDirectory() as folder:
        ignored = shutil.ignore_patterns(".*", "__pycache__")
        shutil.copytree(ROOT, folder, ignore=ignored, dirs_exist_ok=True)
        Trials(Path(folder), paths, work).run()
    killed = len(sample) - counts[NONE]
    score = killed / max(1, killed + len(holes))
    minutes = (time.monotonic() - began) / 60
    print(
        f"killed {killed} of {len(sample)} = {killed / len(sample):.1%}, "
        f"{score:.1%} without the {counts[NONE] - len(holes)} equivalent "
        f"({counts[OWN]} by the module's own tests, {counts[OTHER]} by others, "
        f"{counts[ENDLESS]} by never ending), "
        f"{len(holes)} not noticed, {enough:.0%} is enough; {minutes:.1f} min"
    )
    return 0 if score >= enough else 1


if __name__ == "__main__":
    sys.exit(main())
