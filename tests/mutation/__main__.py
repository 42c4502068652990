"""The mutation check of the safety core: does a test fail for every small fault in it?

    python -m tests.mutation [--sample 240] [--seed 1] [--only guard.py] [--jobs 2]

Draws a seeded sample of all mutants of the core, puts one at a time into a copy of the project
and runs the tests there: those of the mutated module first, then the other quick ones of the core,
then the scenarios and all other unit tests. Prints each mutant that no test noticed, and why
where `equivalent.py` lists it as one that none can. Exits 1 when less than 95 % of the others
were noticed.

Why not mutmut or cosmic-ray: both run with this code, but mutmut (3.8) leaves out all that is not
inside a function, which is the mode table and every constant; most of cosmic-ray's (8.7) mutants
are of the kind `a << b` for two floats, which die for nothing; and neither draws a sample.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import queue
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path

from tests.mutation.equivalent import EQUIVALENT
from tests.mutation.mutants import Mutant, mutants

ROOT = Path(__file__).parents[2]
CORE = (
    "acsard/drive",
    "acsard/guard.py",
    "acsard/mcu/check.py",
    "acsard/mcu/encoders.py",
    "acsard/mcu/codec.py",
    "acsard/mcu/negotiation.py",
    "acsard/mcu/promptest.py",
    "acsard/robot.py",
)
ENOUGH = 0.95
QUICK = [
    "tests/unit/drive",
    "tests/unit/mcu",
    "tests/unit/test_robot.py",
    "tests/unit/test_guard.py",
]
SLOW = ["tests/scenarios", "tests/unit", "-k", "not hour and not soak"]
SLOW += [f"--ignore={path}" for path in QUICK]
PYTEST = [sys.executable, "-B", "-m", "pytest", "-x", "-q", "-p", "no:cacheprovider"]
PYTEST += ["-p", "tests.mutation.profile", "--hypothesis-profile=mutation", "--hypothesis-seed=0"]


def sources() -> list[str]:
    """The modules of the core."""
    found: list[Path] = []
    for path in CORE:
        found += [ROOT / path] if path.endswith(".py") else sorted((ROOT / path).glob("*.py"))
    return [path.relative_to(ROOT).as_posix() for path in found]


def drawn(pool: list[Mutant], seed: int) -> list[Mutant]:
    """All mutants shuffled by the seed; an edit moves only those of the lines it changes."""
    met: Counter[str] = Counter()
    lots: list[tuple[bytes, Mutant]] = []
    for mutant in pool:
        met[mutant.key] += 1
        lot = f"{seed} {met[mutant.key]} {mutant.key}".encode()
        lots.append((hashlib.sha256(lot).digest(), mutant))
    return [mutant for _, mutant in sorted(lots)]


def mirror(path: str) -> str:
    """The test module of a module."""
    inside = Path(path).relative_to("acsard")
    return f"tests/unit/{inside.with_name('test_' + inside.name).as_posix()}"


class Copies:
    """As many copies of the project as run at once; a mutant is put into a free one."""

    def __init__(self, count: int, folder: Path) -> None:
        self.timeouts = 0
        self._free: queue.Queue[Path] = queue.Queue()
        self._limit = {"own": 600.0, "quick": 600.0, "slow": 600.0}
        for number in range(count):
            copy = folder / str(number)
            ignored = shutil.ignore_patterns(".*", "__pycache__")
            shutil.copytree(ROOT, copy, ignore=ignored)
            self._free.put(copy)

    def measure(self) -> None:
        """Run the tests without a fault: they must pass, and how long they take is the limit."""
        for stage in self._limit:
            began = time.monotonic()
            copy = self._free.get()
            if self._fails(copy, stage, sources()):
                sys.exit(f"the {stage} tests fail without any mutant")
            self._free.put(copy)
            self._limit[stage] = 5 * (time.monotonic() - began) + 20

    def verdict(self, mutant: Mutant) -> str:
        """Which tests noticed this mutant: "own", "quick", "slow" or "" for none."""
        copy = self._free.get()
        module = copy / mutant.path
        original = module.read_text(encoding="utf-8")
        module.write_text(mutant.text, encoding="utf-8")
        try:
            stages = list(self._limit)[: 2 if mutant.key in EQUIVALENT else 3]
            return next((s for s in stages if self._fails(copy, s, [mutant.path])), "")
        finally:
            module.write_text(original, encoding="utf-8")
            self._free.put(copy)

    def _fails(self, copy: Path, stage: str, paths: list[str]) -> bool:
        own = [test for path in paths if (copy / (test := mirror(path))).exists()]
        tests = {"own": own, "quick": QUICK, "slow": SLOW}[stage]
        if not tests:
            return False
        run = subprocess.Popen(
            [*PYTEST, *tests],
            cwd=copy,
            env=os.environ | {"PYTHONPATH": str(copy)},
            stdout=subprocess.DEVNULL,
            stderr=subprocess.DEVNULL,
            start_new_session=True,
        )
        try:
            code = run.wait(self._limit[stage])
        except subprocess.TimeoutExpired:
            os.killpg(run.pid, signal.SIGKILL)
            run.wait()
            self.timeouts += 1
            return True
        if code not in (0, 1, 2):  # all passed, a test failed, a module could not be imported
            raise RuntimeError(f"pytest ended with {code}")
        return code != 0


def main() -> int:
    """Draw the sample, try it, print what came of it."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutation", description=__doc__)
    parser.add_argument("--sample", type=int, default=240, help="how many mutants")
    parser.add_argument("--seed", type=int, default=1, help="which ones")
    parser.add_argument("--only", default="", help="only of modules whose path contains this")
    parser.add_argument("--jobs", type=int, default=2, help="how many at once")
    asked = parser.parse_args()
    os.nice(19)
    began = time.monotonic()
    pool = [mutant for path in sources() if asked.only in path for mutant in mutants(ROOT, path)]
    sample = drawn(pool, asked.seed)[: asked.sample]
    print(f"{len(sample)} of {len(pool)} mutants, seed {asked.seed}", flush=True)
    counts: Counter[str] = Counter()
    holes = 0
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(asked.jobs) as workers:
        copies = Copies(asked.jobs, Path(folder))
        copies.measure()
        verdicts = workers.map(copies.verdict, sample)
        for number, (mutant, verdict) in enumerate(zip(sample, verdicts, strict=True), 1):
            counts[verdict] += 1
            if not number % 20:
                print(f"    {number} tried", file=sys.stderr, flush=True)
            if verdict and mutant.key in EQUIVALENT:
                print(f"{number}: not equivalent, a test notices it: {mutant.key}", flush=True)
            if not verdict:
                why = EQUIVALENT.get(mutant.key, "")
                holes += not why
                print(f"{number}: line {mutant.line} of {mutant.key}", flush=True)
                print(f"    {why or 'NO TEST NOTICES IT'}", flush=True)
    killed = len(sample) - counts[""]
    score = killed / (killed + holes)
    minutes = (time.monotonic() - began) / 60
    print(
        f"killed {killed} of {len(sample)} = {killed / len(sample):.1%}, "
        f"{score:.1%} without the {counts[''] - holes} equivalent "
        f"({counts['own']} by the module's own tests, {counts['quick']} by others of the core, "
        f"{counts['slow']} by scenarios or other units; {copies.timeouts} by never ending), "
        f"{holes} not noticed; {minutes:.1f} min"
    )
    return 0 if score >= ENOUGH else 1


if __name__ == "__main__":
    sys.exit(main())
