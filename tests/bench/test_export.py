"""Print the time and the memory that the export of an hour's recording needs.

    pytest -s -m bench tests/bench/test_export.py

The recording is an hour of driving at 100 Hz in virtual time. The test runs `acsard recording
export` on it, and compares the memory with that of a minute's recording.
"""

from __future__ import annotations

import sys
from pathlib import Path
from typing import NamedTuple

import pytest
from msgspec.structs import replace

from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config
from acsard.core.config.toml_text import document
from acsard.core.guard import Guard
from acsard.core.robot import Robot
from acsard.core.values import Heard, Instant, Recording
from acsard.recording.file import FrameWriter, Head
from acsard.recording.recorded_steps import PlainStep
from tests.scenarios.world import START, World
from tests.system.harness import ROOT, finish

pytestmark = [pytest.mark.bench, pytest.mark.timeout(1800)]

BATCH = 200

HOUR_S, MINUTE_S = 3600.0, 60.0

PAGE_MB = 120.0
"""The page's server, with a calibration in progress."""


class Streamed:
    """A recorder that writes to its file all the time, because an hour does not fit into memory."""

    status = Recording("file")

    def __init__(self, path: Path, config: Config, start: Instant) -> None:
        text = "\n".join(document(effective(config))) + "\n"
        self.file = path.open("wb")
        self._frames = FrameWriter(self.file)
        times = start.mono_ns, start.wall_ns
        self._frames.begin(Head("0.2.0", config.robot.id, 0, *times, text))
        self._taken: list[PlainStep] = []
        self._number = 0

    def step(self, step: PlainStep, robot: Robot, guard: Guard) -> None:
        self._taken.append(step)
        if len(self._taken) == BATCH:
            self._frames.add_steps(self._number, self._taken)
            self._number += BATCH
            self._taken.clear()

    def begins(self, robot: Robot, guard: Guard) -> None: ...

    def died(self, now: Instant, heard: Heard) -> None: ...


def recorded(path: Path, seconds: float) -> Path:
    """Record a simulated drive of `seconds` in virtual time, and return the path of the file.

    The commanded speed changes every 15 s.
    """
    config = replace(Config(), record=replace(Config().record, directory=str(path.parent)))
    box = Streamed(path, config, START)
    world = World(config, recorder=box)
    world.drive(0.3, 0.2, 1.0)
    while world.now_ns - START.mono_ns < seconds * 1e9:
        for linear, angular in ((0.4, 0.3), (-0.2, 0.5), (0.0, -0.8), (0.5, 0.0)):
            world.hold(linear, angular, seconds=15.0)
    box.file.close()
    return path


class Cost(NamedTuple):
    seconds: float
    processor: float
    """Processor time, s. The rest of `seconds` went to other processes."""
    megabytes: float
    """Largest resident memory."""


MEASURED = """\
import sys, time
from pathlib import Path
from acsard.cli import main
assert main(sys.argv[1:]) == 0
status = Path("/proc/self/status").read_text()
print(time.process_time(), int(status.partition("VmHWM:")[2].split()[0]) / 1024)
"""
"""The kernel reports the process's largest memory since it became this program."""


def cost(*words: str) -> Cost:
    """Run `acsard` with these arguments. Return its run time, processor time and peak memory."""
    ended = finish([sys.executable, "-c", MEASURED, *words], ROOT, within=1500.0)
    assert ended.code == 0, ended
    processor, megabytes = map(float, ended.out.splitlines()[-1].split())
    return Cost(ended.seconds, processor, megabytes)


@pytest.fixture(scope="module")
def both(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, Path]:
    """Return recordings of a minute and of an hour."""
    where = tmp_path_factory.mktemp("hour")
    return recorded(where / "minute.rec.zst", MINUTE_S), recorded(where / "hour.rec.zst", HOUR_S)


@pytest.mark.parametrize("kind", ["mcap", "csv", "rosbag2"])
def test_an_hour_needs_hardly_more_memory_than_a_minute(
    kind: str, both: tuple[Path, Path], tmp_path: Path
) -> None:
    options = [] if kind == "mcap" else [f"--{kind}"]
    little, much = (
        cost(
            "recording", "export", str(path), str(tmp_path / path.name.partition(".")[0]), *options
        )
        for path in both
    )
    new = tmp_path / "hour"
    written = sum(p.stat().st_size for p in [new, *new.rglob("*")] if p.is_file()) / 1e6
    size = both[1].stat().st_size / 1e6
    print(
        f"\nan hour of {size:.1f} MB as {kind}: {much.seconds:.0f} s ({much.processor:.0f} s of a "
        f"processor), {written:.1f} MB written, {much.megabytes:.0f} MB resident at most (a "
        f"minute: {little.megabytes:.0f} MB)"
    )
    assert much.megabytes < little.megabytes + 2 * size + 50


def test_a_report_of_an_hour_has_room_beside_the_page_in_its_service(
    both: tuple[Path, Path], tmp_path: Path
) -> None:
    unit = (ROOT / "deploy/systemd/acsard-web.service").read_text()
    room = int(unit.partition("MemoryMax=")[2].partition("M")[0])
    little, much = (
        cost("recording", "report", str(path), str(tmp_path / path.name.partition(".")[0]))
        for path in both
    )
    print(
        f"\na report of an hour: {much.seconds:.0f} s ({much.processor:.0f} s of a processor), "
        f"{much.megabytes:.0f} MB resident at most (a minute: {little.megabytes:.0f} MB)"
    )
    assert PAGE_MB + much.megabytes < room
