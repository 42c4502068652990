"""The mutation check of the safety core: does a test fail for every small fault in it?

    python -m tests.mutation [--sample 240] [--seed 1] [--jobs 2]
    python -m tests.mutation --safety [--fast] [--jobs 2]
    python -m tests.mutation --only PATH [PATH ...] [--sample N] [--fast] [--jobs 2]

The first form draws a seeded sample of all mutants of the core. Tests must notice 95 % of them.
`--safety` tries every mutant of the modules in `SAFETY`, and tests must notice 98 %. So does
`--only`, for the modules whose path contains one of these.

Each mutant is put alone into a copy of the project, and the tests run there: first those of the
mutated module, then the scenarios that exercise it, then the other quick tests of the core, then
all other scenarios and unit tests. The output has each mutant that no test noticed, and the reason
where `equivalent.py` lists it as one that no test can notice. The exit status is 1 when tests
noticed too few. `--fast` leaves out the last step, which takes most of the time: it counts a mutant
that only the other scenarios and unit tests would notice as one that no test notices.

Why not mutmut or cosmic-ray: both run with this code. But mutmut (3.8) leaves out everything
outside a function, which is every table and constant. Most mutants of cosmic-ray (8.7) are
of the kind `a << b` for two floats, which any test notices. Neither draws a sample.
"""

from __future__ import annotations

import argparse
import hashlib
import os
import queue
import re
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
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
    "acsard/runtime/kept_latches.py",
)
SAFETY = (
    "acsard/guard.py",
    "acsard/drive/neutral.py",
    "acsard/drive/freshness.py",
    "acsard/drive/lifecycle.py",
    "acsard/drive/modes.py",
    "acsard/drive/sanity.py",
    "acsard/runtime/kept_latches.py",
)
ENOUGH, ENOUGH_OF_ALL = 0.95, 0.98
"""Share of the mutants that tests must notice: of a sample, and of every mutant of some modules."""

ARMING = ["tests/scenarios/test_arming.py", "tests/scenarios/test_other_tools.py"]
ARMING += ["tests/scenarios/test_congestion.py", "tests/scenarios/test_commands.py"]
LATCHES = ["tests/unit/test_robot.py", "tests/scenarios/test_latches.py"]
LATCHES += ["tests/scenarios/test_restart.py", "tests/unit/runtime/test_latch_file.py"]
NEAR = {
    "acsard/drive/arbiter.py": ARMING,
    "acsard/drive/freshness.py": ARMING,
    "acsard/drive/neutral.py": ARMING,
    "acsard/drive/lifecycle.py": LATCHES,
    "acsard/drive/modes.py": LATCHES,
    "acsard/runtime/kept_latches.py": LATCHES,
    "acsard/drive/sanity.py": ["tests/unit/test_robot.py", "tests/scenarios/test_sanity.py"],
}
"""More tests that exercise a module most. They run second, because they fail sooner than others."""

QUICK = [
    "tests/unit/drive",
    "tests/unit/mcu",
    "tests/unit/test_robot.py",
    "tests/unit/test_guard.py",
]
SLOW = ["tests/scenarios", "tests/unit", "-k", "not hour and not soak"]
SLOW += [f"--ignore={path}" for path in QUICK]
OUTPUT, FAILED = "mutation.txt", re.compile(r"^FAILED (.+?)(?: - .*)?$", re.M)
MOST_LEFT_OUT = 5
STAGES = ("own", "near", "quick", "slow")
PYTEST = [sys.executable, "-B", "-m", "pytest", "-n", "0", "-x", "-q", "-p", "no:cacheprovider"]
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

    def __init__(self, count: int, folder: Path, paths: list[str], stages: Sequence[str]) -> None:
        self.timeouts = 0
        self._paths = paths
        self._left_out: list[str] = []
        self._free: queue.Queue[Path] = queue.Queue()
        self._limit = dict.fromkeys(stages, 3600.0)
        for number in range(count):
            copy = folder / str(number)
            ignored = shutil.ignore_patterns(".*", "__pycache__")
            shutil.copytree(ROOT, copy, ignore=ignored)
            self._free.put(copy)

    def measure(self) -> None:
        """Run the tests without a fault, and take the time limits from that.

        A test that fails now would notice every mutant, so it is left out. More than
        `MOST_LEFT_OUT` such tests end the check.
        """
        for stage in self._limit:
            copy, began = self._free.get(), time.monotonic()
            while self._run(copy, stage, self._paths):
                failed = FAILED.findall((copy / OUTPUT).read_text(encoding="utf-8"))
                self._left_out += failed
                if not failed or len(self._left_out) > MOST_LEFT_OUT:
                    sys.exit(f"the {stage} tests fail without any mutant: {self._left_out}")
                print(f"left out, because it fails without any mutant: {failed}", flush=True)
                began = time.monotonic()
            self._free.put(copy)
            self._limit[stage] = 5 * (time.monotonic() - began) + 20

    def verdict(self, mutant: Mutant) -> str:
        """Return the stage whose tests noticed this mutant, or "" if none did."""
        copy = self._free.get()
        module = copy / mutant.path
        original = module.read_text(encoding="utf-8")
        module.write_text(mutant.text, encoding="utf-8")
        try:
            stages = [
                stage for stage in self._limit if stage != "slow" or mutant.key not in EQUIVALENT
            ]
            return next((s for s in stages if self._run(copy, s, [mutant.path])), "")
        finally:
            module.write_text(original, encoding="utf-8")
            self._free.put(copy)

    def _run(self, copy: Path, stage: str, paths: list[str]) -> bool:
        """Run the tests of a stage, and return whether one fails."""
        own = [test for path in paths if (copy / (test := mirror(path))).exists()]
        near = sorted({test for path in paths for test in NEAR.get(path, ())})
        tests = {"own": own, "near": near, "quick": QUICK, "slow": SLOW}[stage]
        if not tests:
            return False
        with (copy / OUTPUT).open("w") as output:
            run = subprocess.Popen(
                [*PYTEST, *tests, *(f"--deselect={test}" for test in self._left_out)],
                cwd=copy,
                env=os.environ | {"PYTHONPATH": str(copy)},
                stdout=output,
                stderr=subprocess.STDOUT,
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
    """Draw the mutants, try each, and print the result."""
    parser = argparse.ArgumentParser(prog="python -m tests.mutation", description=__doc__)
    parser.add_argument("--sample", type=int, help="how many mutants (240; all of named modules)")
    parser.add_argument("--seed", type=int, default=1, help="which ones")
    parser.add_argument(
        "--only", nargs="+", default=[], metavar="PATH", help="modules whose path contains one"
    )
    parser.add_argument("--safety", action="store_true", help="the modules that stop the robot")
    parser.add_argument("--fast", action="store_true", help="leave out the slow step")
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
    counts: Counter[str] = Counter()
    holes: list[str] = []
    with tempfile.TemporaryDirectory() as folder, ThreadPoolExecutor(asked.jobs) as workers:
        copies = Copies(asked.jobs, Path(folder), paths, STAGES[:-1] if asked.fast else STAGES)
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
                if not why:
                    holes.append(mutant.key)
                print(f"{number}: line {mutant.line} of {mutant.key}", flush=True)
                print(f"    {why or 'NO TEST NOTICES IT'}", flush=True)
    killed = len(sample) - counts[""]
    score = killed / max(1, killed + len(holes))
    minutes = (time.monotonic() - began) / 60
    by = ", ".join(f"{counts[stage]} {stage}" for stage in STAGES)
    print(
        f"killed {killed} of {len(sample)} = {killed / len(sample):.1%}, "
        f"{score:.1%} without the {counts[''] - len(holes)} equivalent "
        f"({by}; {copies.timeouts} by never ending), "
        f"{len(holes)} not noticed, {enough:.0%} is enough; {minutes:.1f} min"
    )
    return 0 if score >= enough else 1


if __name__ == "__main__":
    sys.exit(main())
