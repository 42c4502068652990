"""What commands print for people, as transcripts in `words/transcripts/`.

In a transcript, `$` begins a command, `|` a printed line, `!` a line of standard error and `#` a
comment. `exit` names an exit code other than 0. All commands of a transcript run in one temporary
directory, without a daemon. A command that fails changes no file. To write the transcripts anew
from their commands, run `pytest --approve tests/unit/test_cli_transcripts.py`, and then read
`git diff`.
"""

from __future__ import annotations

import os
import re
import shlex
import subprocess
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from acsard.core.config.settings import Config, McuConfig
from acsard.core.messages.signature import Signature
from acsard.core.values import NS_PER_S, Received
from acsard.host import config_file
from acsard.machine.authority import Authority
from tests.scenarios.taped import Tape, recorded_world
from tests.scenarios.world import World
from tests.system.typed import typed
from tests.unit.calibration_logs import usual

PLACE = Path(__file__).with_name("words") / "transcripts"

ADDRESS = "192.0.2.7"
"""The only address of this machine that a certificate names."""

VARYING = (
    (r"! usage: acsard [^\n]*\n(?:! {2,}[^\n]*\n)*", "! usage: ...\n"),
    (r"it expired on \S+;", "it expired on DATE;"),
    (r"Unable to load PEM file[^\n]*", "Unable to load PEM file"),
    (r" +[\d.]+ kB", "  12 kB"),
    (r"bytes \d+ to \d+", "bytes 123 to 456"),
)
"""Patterns of texts that differ between runs and versions of libraries, and their replacements."""


def recordings(where: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make two recordings, of which the second is cut and damaged, and one that is none."""
    monkeypatch.setattr("acsard.cli.recording.version", lambda: "0.2.0")  # of the tapes
    (where / "ring").mkdir()
    for number, seconds in ((1, 2.0), (2, 4.0)):
        tape = Tape(every=200)
        world = World(recorder=tape)
        world.drive(0.5, seconds=seconds)
        world.call("stop")
        world.run(0.5)
        tape.save(where / f"ring/00000{number}-20270115T080000Z.rec.zst")
    whole = where / "ring/000002-20270115T080000Z.rec.zst"
    data = bytearray(whole.read_bytes()[:-100])
    data[len(data) // 2] ^= 0xFF
    whole.write_bytes(data)
    (where / "ring/000003-20270115T080000Z.rec.zst").write_bytes(b"no recording")
    for path in (where / "ring").iterdir():
        os.utime(path, (1_800_000_010, 1_800_000_010))


def logs(where: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make a log, and the directory of a bag."""
    (where / "drive.csv").write_text(usual().csv(places=False))
    (where / "bag").mkdir()


def authorities(where: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Make an authority of another robot and an expired one, and give this machine fixed names."""
    Authority.make(where / "other", "other", 30, ["localhost"])
    Authority.make(where / "expired", "expired", -1, ["localhost"])
    monkeypatch.setattr("socket.gethostname", lambda: "robot")
    monkeypatch.setattr("acsard.machine.certificates.own_addresses", lambda: [ADDRESS])


def days(where: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Record a short day of a robot that meets many events, and its second half alone."""
    config = Config(mcu=McuConfig(port="/dev/ttyACM0"))
    tape, world = recorded_world(config, every=200)
    world.drive(0.5, 0.2, seconds=1.0)
    world.call("stop")
    world.run(1.0)
    world.call("clear")
    world.run(0.3)
    world.hold(0.5, seconds=2.5)  # without a zero
    world.drive(0.5, seconds=1.0, source="nav")
    world.send(0.0, source="teleop")
    for _ in range(40):
        world.send(0.5, source="teleop")
        payload, sender = b'{"linear": {"x": 0.3}, "angular": {}}', Signature("eve").pack()
        world.put("cmd/app", payload, attachment=sender)
        world.run(0.05)
    world.run(1.0)
    world.wall_offset_ns += 36_000 * NS_PER_S
    world.run(1.0)
    world.wall_offset_ns -= 7_200 * NS_PER_S
    world.drive(0.5, seconds=0.5)
    world.stall(0.6)
    world.run(1.0)
    with world.mcu.fault("mute"):
        world.run(0.05)
        world.stall(0.2)
        world.run(0.05)
    world.run(1.0)
    with world.mcu.fault("mute"):
        world.run(0.5)
        identity = b"!acsard-mcu 1 counts=3200 check=1 sample=1 lines=0 reset=brown-out\r\n"
        world.port.feed(Received(world.instant, identity))
        world.run(0.05)
    world.drive(0.5, seconds=0.5)
    world.loop.shutting_down = True
    world.run(0.1)
    tape.save(where / "day.rec.zst", config)
    tape.save(where / "evening.rec.zst", config, first=2000)


def ring(where: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Record two runs an hour apart, of which the first ends suddenly."""
    (where / "runs").mkdir()
    for number in range(2):
        tape, world = recorded_world()
        world.wall_offset_ns += number * 3600 * NS_PER_S
        world.drive(0.5, seconds=1.0)
        path = tape.save(where / f"runs/00000{number + 1}-20270115T080000Z.rec.zst")
        os.utime(path, ns=(world.instant.wall_ns, world.instant.wall_ns))


SLOW = ("mcu", "recording", "times")

PREPARED: dict[str, Callable[[Path, pytest.MonkeyPatch], None]] = {
    "recording": recordings,
    "calibrate": logs,
    "tls": authorities,
    "timeline": days,
    "times": ring,
}
"""Makes the files of a transcript, by its name."""


def marked(mark: str, printed: str) -> str:
    return "".join(f"{mark} {line}".rstrip() + "\n" for line in printed.splitlines())


def outcome(command: str) -> tuple[str, int]:
    """Run a command, and return its printed lines and its exit code."""
    program, *words = shlex.split(command)
    if program != "acsard":
        done = subprocess.run(command, shell=True, capture_output=True, text=True, timeout=10.0)
        return marked("|", done.stdout) + marked("!", done.stderr), done.returncode
    ended = typed(*words)
    printed = marked("|", ended.out) + marked("!", ended.err)
    for pattern, word in VARYING:
        printed = re.sub(pattern, word, printed)
    return printed, ended.code


def contents(where: Path) -> dict[Path, bytes]:
    return {path: path.read_bytes() if path.is_file() else b"" for path in where.rglob("*")}


def replayed(transcript: str, where: Path) -> Iterator[str]:
    """Run the commands of a transcript, and yield the lines that it should have."""
    for line in transcript.splitlines(keepends=True):
        if line.startswith("# ") or line == "\n":
            yield line
        elif line.startswith("$ "):
            before = contents(where)
            printed, code = outcome(line.removeprefix("$ "))
            assert code == 0 or contents(where) == before, f"{line} failed and changed a file"
            yield line + printed + (f"exit {code}\n" if code else "")


@pytest.fixture
def utc(monkeypatch: pytest.MonkeyPatch) -> Iterator[None]:
    """Print local times in UTC."""
    with monkeypatch.context() as patch:
        patch.setenv("TZ", "UTC")
        time.tzset()
        yield
    time.tzset()


@pytest.mark.usefixtures("utc")
@pytest.mark.parametrize(
    "name",
    [
        pytest.param(path.stem, marks=[pytest.mark.slow] if path.stem in SLOW else [])
        for path in sorted(PLACE.glob("*.txt"))
    ],
)
def test_each_command_prints_what_its_transcript_says(
    name: str,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    approved: Callable[[Path, str], None],
) -> None:
    for variable in ("ACSARD_CONFIG", "ACSARD_TLS", "ACSARD_RECORD"):
        monkeypatch.delenv(variable, raising=False)
    monkeypatch.setenv("COLUMNS", "80")
    monkeypatch.setenv("STATE_DIRECTORY", str(tmp_path / "state"))
    monkeypatch.setattr(config_file, "SEARCH_PATHS", (Path("acsard.toml"),))
    monkeypatch.chdir(tmp_path)
    if name in PREPARED:
        PREPARED[name](tmp_path, monkeypatch)
    path = PLACE / f"{name}.txt"
    transcript = path.read_text(encoding="utf-8")
    text = "".join(replayed(transcript, tmp_path)).replace(str(tmp_path), "HERE")
    approved(path, text)
