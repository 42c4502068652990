"""`python -m tests.pythons PYTHON...`: check that Python versions replay each other's recordings.

First this Python records ten minutes with every fault of the simulator. It records them on the
plain link, and on the checked link with counts and a gyro. Each file exists twice: one begins at
the start, and one in the middle, with a stored state.

Then each PYTHON (a path) replays these files and `tests/recordings`, in a new venv with the
dependencies of the service. It also records ten minutes, which this Python replays. The program
prints a line per file. The exit code is 0 if all lines, modes and poses are identical to the last
bit.
"""

from __future__ import annotations

import argparse
import os
import re
import subprocess
import sys
import tempfile
from collections.abc import Sequence
from pathlib import Path

from msgspec.structs import replace

from acsard.core.config.settings import Config
from acsard.recording.file import SUFFIX
from tests.scenarios.taped import Tape, drive_through_faults
from tests.scenarios.world import World

ROOT = Path(__file__).resolve().parents[1]

SECONDS = 600.0

PLAIN = Config()
FULL = replace(
    PLAIN,
    mcu=replace(PLAIN.mcu, link_check="on", encoder_counts=3200),
    odometry=replace(PLAIN.odometry, gyro=True),
)

VERDICT = re.compile(
    r"([\d ]+) of \1 lines are the same, ([\d ]+) of \2 poses, ([\d ]+) of \3 modes, "
    r"\3 of \3 reasons, \3 of \3 links, \3 of \3 sources, ([\d ]+) of \4 events$"
)
"""The verdict when everything is the same to the last bit, not merely to the micrometre."""

EXCEPT_WORDS = re.compile(
    VERDICT.pattern.replace(r"\3 of \3 reasons", r"[\d ]+ of \3 reasons")
    .replace(r"of \4 events", r"of [\d ]+ events")
)  # fmt: skip
"""The verdict on `tests/recordings`, in which reasons and events have words of older versions."""


def record(where: Path, seconds: float) -> list[Path]:
    """Record the drives with this Python."""
    made = []
    for name, config in (("plain", PLAIN), ("full", FULL)):
        tape = Tape(every=50_000)
        world = World(config, recorder=tape)
        drive_through_faults(world, seconds)
        for first in (0, *list(tape.states)[:1]):
            path = where / f"{name}-{first}-{sys.version_info[0]}.{sys.version_info[1]}{SUFFIX}"
            tape.save(path, config, first)
            made.append(path)
    return made


def installed(python: str, where: Path) -> str:
    """Create a venv with acsard's dependencies for this Python. Return the path of its Python."""
    subprocess.run([python, "-m", "venv", where], check=True)
    pip = [str(where / "bin/pip"), "install", "--quiet", "--disable-pip-version-check"]
    subprocess.run([*pip, "-r", str(ROOT / "deploy/systemd/requirements.lock")], check=True)
    return str(where / "bin/python")


def run(python: str, *words: str) -> str:
    """Run this Python with the acsard of this repository, and return its output."""
    env = os.environ | {"PYTHONPATH": str(ROOT)}
    done = subprocess.run(
        [python, *words], cwd=ROOT, env=env, text=True, check=False,
        stdout=subprocess.PIPE, stderr=subprocess.STDOUT,
    )  # fmt: skip
    return done.stdout.strip()


def replays(python: str, paths: Sequence[Path], expected: re.Pattern[str] = VERDICT) -> bool:
    """Replay the files with this Python and print a line for each. Return whether all are right."""
    version, same = run(python, "-V"), True
    for path in paths:
        output = run(python, "-m", "acsard", "recording", "replay", str(path))
        print(f"{version:14} {path.name:20} {output}", flush=True)
        # the lines after the verdict list the items that were compared
        verdict, *_ = output.splitlines() or [""]
        same = same and expected.match(verdict) is not None
    return same


def main() -> int:
    parser = argparse.ArgumentParser(prog="python -m tests.pythons", description=__doc__)
    parser.add_argument("pythons", nargs="*", metavar="PYTHON")
    parser.add_argument("--seconds", type=float, default=SECONDS)
    parser.add_argument("--record", type=Path, help=argparse.SUPPRESS)
    asked = parser.parse_args()
    if asked.record:
        record(asked.record, asked.seconds)
        return 0
    short = sorted(ROOT.glob(f"tests/recordings/*{SUFFIX}"))
    with tempfile.TemporaryDirectory(prefix="pythons-") as name:
        where = Path(name)
        mine = record(where, asked.seconds)
        same = replays(sys.executable, mine)
        for number, python in enumerate(asked.pythons):
            other, theirs = installed(python, where / f"venv-{number}"), where / str(number)
            same = replays(other, short, EXCEPT_WORDS) and replays(other, mine) and same
            theirs.mkdir()
            output = run(
                other,
                "-m",
                "tests.pythons",
                "--record",
                str(theirs),
                "--seconds",
                str(asked.seconds),
            )
            print(output, end="")
            same = replays(sys.executable, sorted(theirs.glob(f"*{SUFFIX}"))) and same
    return 0 if same else 1


if __name__ == "__main__":
    sys.exit(main())
