"""Compare the firmware's machine code and the daemon's lines with those of an older commit.

    python -m tests.firmware.unchanged COMMIT

The first part builds the firmware of both checkouts with each set of definitions that tests use,
apart from those with inputs. The second part drives a robot in virtual time with each kind of board
that knows no inputs. It compares all bytes that the daemon sends and receives, and their times. The
exit code is 1 if anything differs.
"""

from __future__ import annotations

import hashlib
import os
import subprocess
import sys
import tempfile
from pathlib import Path

from tests.firmware.board import ROOT

BUILDS = (
    "", "-DTEST_HANG", "'-DCOUNTS_PER_TURN=2 * 4 * 12'", "-DPWM_HZ=250UL", "-DBAUD_RATE=9600UL",
    "-DBAUD_RATE=57600UL", "-DREQUIRE_CHECK=1",
)  # fmt: skip
"""Definitions of the firmware builds of the tests, but for those with inputs."""

DRIVE = """
import hashlib
from acsard.core.config.settings import Config, ControlConfig, McuConfig, SimConfig
from tests.scenarios.world import World

def board(faults="", rate=100.0, **mcu):
    sim = SimConfig(faults=tuple(faults.split()))
    return Config(mcu=McuConfig(**mcu), sim=sim, control=ControlConfig(rate=rate))

BOARDS = {
    "a strict board": board(),
    "the old sketch": board("free_running comma_latched", trailing_comma=True, reply_period=0.1),
    "unpadded replies": board("unpadded trailing_comma"),
    "replies with spaces": board("spaces"),
    "few replies": board("sparse_replies", reply_period=0.1),
    "a board that is never understood": board("noise"),
    "bit errors": board("bit_errors", link_check="auto"),
    "9600 baud": board(rate=16.0, baud_rate=9600),
    "no checked link": board("no_check", link_check="auto"),
    "plain lines only": board("plain_only", link_check="auto"),
    "a checked link without counts": board("no_sample", link_check="require", encoder_counts=3200),
    "a checked link": board(link_check="require"),
    "counts": board(link_check="auto", encoder_counts=3200),
}
for name, config in BOARDS.items():
    world, seen, count = World(config), hashlib.sha256(), 0
    took, fed = world.mcu.receive, world.port.feed
    def received(now_ns, data):
        seen.update(b"> %d " % now_ns + data)
        took(now_ns, data)
    def feed(piece):
        seen.update(b"< %d " % piece.at.mono_ns + piece.data)
        fed(piece)
    world.mcu.receive, world.port.feed = received, feed
    for _ in range(3):
        world.drive(0.8, 0.5, seconds=3.0)
        world.send(0.0)
        world.run(1.0)
        world.drive(-0.3, -1.5, seconds=2.0)
        world.call("stop")
        world.hold(0.5, seconds=0.5)
        world.call("clear")
        world.mcu.reset(world.now_ns)
        world.hold(0.5, seconds=4.0)
        world.stall(0.3)
        world.run(1.0)
    print(name, len(world.port.sent), "lines", seen.hexdigest())
"""
"""The second part, which runs on the code of either checkout."""


def machine_code(tree: Path, where: Path) -> list[str]:
    """Return a line for each build of the firmware: its definitions and the digest of its code."""
    lines = []
    for number, defines in enumerate(BUILDS):
        place = where / str(number)
        words = ["make", "-s", f"BUILD={place}", f"DEFINES={defines}", f"{place}/firmware.hex"]
        subprocess.run(words, cwd=tree / "deploy" / "firmware", check=True, timeout=100)
        digest = hashlib.sha256((place / "firmware.hex").read_bytes()).hexdigest()
        lines.append(f"firmware {defines or 'as delivered'} {digest}")
    return lines


def wire(tree: Path) -> list[str]:
    """Return the number of lines and a digest of the bytes for each board without inputs."""
    words = [sys.executable, "-c", DRIVE]
    env = os.environ | {"PYTHONPATH": str(tree)}
    done = subprocess.run(words, cwd=tree, env=env, check=True, text=True, stdout=subprocess.PIPE)
    return done.stdout.splitlines()


def main(commit: str) -> int:
    """Print what is the same and what differs. Return the exit code."""
    with tempfile.TemporaryDirectory() as directory:
        where = Path(directory)
        before = where / "before"
        before.mkdir()
        archive = subprocess.run(
            ["git", "archive", commit], cwd=ROOT, check=True, stdout=subprocess.PIPE
        )
        subprocess.run(["tar", "-x"], cwd=before, input=archive.stdout, check=True)
        old = machine_code(before, where / "old") + wire(before)
        new = machine_code(ROOT, where / "new") + wire(ROOT)
    for line, other in zip(old, new, strict=True):
        print("same     " if line == other else "DIFFERENT", other)
    return int(old != new)


if __name__ == "__main__":
    raise SystemExit(main(sys.argv[1]))
