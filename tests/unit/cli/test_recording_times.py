"""Tests of --from and --to without FILE, which search all recordings of the directory."""

from __future__ import annotations

import json
import os
import time
from pathlib import Path

import pytest

from acsard.core.config.settings import Config
from tests.scenarios.taped import Tape
from tests.scenarios.world import START, World
from tests.system.typed import typed

Ring = tuple[Path, list[str], list[float]]
"""A directory, the names of its recordings, and the time of a stop in each, s after the start."""

FILES = 30
STEPS = 200
"""Number of steps in each file, about a second."""


def local(seconds: float) -> str:
    """Return the local time this many seconds after the recording's start, as a person types it."""
    at = START.wall_ns / 1e9 + seconds
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(at)) + f"{at % 1:.3f}"[1:]


def rotated(tape: Tape, where: Path, count: int) -> list[str]:
    """Write the recorded steps as `count` files of `STEPS` steps each, and return their names."""
    names = [f"{number + 1:06}-20270115T080000Z.mcap" for number in range(count)]
    for number, name in enumerate(names):
        first = number * STEPS
        end = None if number == count - 1 else first + STEPS
        tape.write(where / name, Config(), first, end=end)
    return names


@pytest.fixture(scope="module")
def ring(tmp_path_factory: pytest.TempPathFactory) -> Ring:
    """Return a directory, the names of its 30 recordings, and the time of a stop in each.

    The times are in seconds after the start of the simulation.
    """
    where, tape = tmp_path_factory.mktemp("ring"), Tape(every=STEPS)
    world, stops = World(recorder=tape), []
    for number in range(FILES):
        while len(tape.taken) < number * STEPS + STEPS // 2:
            world.run(0.01)
        stops.append((world.now_ns - START.mono_ns) / 1e9)
        world.call("stop")
        world.run(0.1)
        world.call("clear")
    world.run(0.5)
    return where, rotated(tape, where, FILES), stops


def recording(where: Path, *words: str) -> tuple[int, str, str]:
    result = typed("recording", *words, "--directory", str(where))
    return result.code, result.out, result.err


@pytest.mark.slow
def test_a_time_is_found_in_every_file_of_the_ring(ring: Ring) -> None:
    where, names, stops = ring
    for number, stop in enumerate(stops):
        times = ("--from", local(stop - 0.05), "--to", local(stop + 0.05))
        code, out, err = recording(where, "show", "--json", *times)
        events = [json.loads(line) for line in out.splitlines()]
        assert code == 0
        assert [event["name"] for event in events].count("stop") == 1, (number, events)
        assert all(abs(e["seconds"] - START.wall_ns / 1e9 - stop) < 0.06 for e in events)
        assert f"1 of 30 recordings in {where}: {names[number]}" in err


@pytest.mark.slow
def test_a_time_of_day_is_looked_up_before_now_in_the_ring(
    ring: Ring, monkeypatch: pytest.MonkeyPatch
) -> None:
    where, names, stops = ring
    monkeypatch.setattr("time.time", lambda: START.wall_ns / 1e9 + 600.0)
    first, last = local(stops[7] - 0.05)[11:], local(stops[7] + 0.05)[11:]
    code, out, err = recording(where, "show", "--from", first, "--to", last)
    assert (code, out.count("  stop: "), names[7] in err) == (0, 1, True)
    monkeypatch.setattr("time.time", lambda: START.wall_ns / 1e9 + 86400 + 600.0)
    code, out, err = recording(where, "show", "--from", first, "--to", last)
    assert (code, out, "nothing was recorded" in err) == (1, "", True)
    times = ("--from", f"yesterday {first}", "--to", f"yesterday {last}")
    code, out, err = recording(where, "show", *times)
    assert (code, out.count("  stop: "), names[7] in err) == (0, 1, True)


@pytest.mark.slow
def test_an_export_goes_on_across_a_rotation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (where := tmp_path / "ring").mkdir()
    tape = Tape(every=STEPS)
    World(recorder=tape).drive(0.5, seconds=6.0)
    rotated(tape, where, 3)
    tape.write(tmp_path / "whole", Config())
    assert typed("recording", "export", "whole", "whole.csv", "--csv").code == 0
    code, _, err = recording(where, "export", "all", "ring.csv", "--csv")
    assert (code, f"3 of 3 recordings in {where}" in err) == (0, True)
    assert (tmp_path / "ring.csv").read_text() == (tmp_path / "whole.csv").read_text()
    times = ("--from", local(1.5), "--to", local(4.5))
    assert recording(where, "export", "--csv", *times)[0] == 0
    (part,) = tmp_path.glob("0*.csv")
    rows = part.read_text().splitlines()
    assert set(rows) < set((tmp_path / "whole.csv").read_text().splitlines())
    assert float(rows[-1].split(",")[0]) - float(rows[1].split(",")[0]) == pytest.approx(3, abs=0.1)


@pytest.mark.slow
def test_a_report_goes_on_across_a_rotation(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    (where := tmp_path / "ring").mkdir()
    tape = Tape(every=STEPS)
    World(recorder=tape).drive(0.5, seconds=3.0)
    names = rotated(tape, where, 3)
    assert recording(where, "report", "all", "ring.html")[0] == 0
    text = (tmp_path / "ring.html").read_text(encoding="utf-8")
    assert f" s, {len(tape.taken)} steps</dd>" in text
    assert f"<dt>File</dt><dd>{', '.join(names)}</dd>" in text
    assert "<td>was driving, 1." in text


@pytest.mark.slow
def test_a_search_reports_the_drive_and_the_cut_at_the_end_of_the_newest_recording(
    tmp_path: Path,
) -> None:
    tape = Tape(every=STEPS)
    World(recorder=tape).drive(0.5, seconds=3.0)
    *_, newest = rotated(tape, tmp_path, 3)
    part = (tmp_path / newest).rename(tmp_path / f"{newest}.part")
    part.write_bytes(part.read_bytes()[:-1000])
    written_s = time.time() - 60.0
    os.utime(part, (written_s, written_s))
    for times in (("--from", local(2.0)), ("--from", local(0.5), "--to", local(60.0))):
        code, out, err = recording(tmp_path, "show", *times)
        drive, cut = out.splitlines()[-2:]
        assert (code, "  drive: was driving, 1." in drive) == (0, True)
        assert cut.endswith(
            "  ! cut: the file has no end: it was cut off, or is still being recorded"
        )
        assert part.name in err
        os.utime(part)
        code, out, err = recording(tmp_path, "show", *times)
        assert (code, out.splitlines()[-1]) == (0, drive)
        assert err.endswith("[being recorded]")
        os.utime(part, (written_s, written_s))
    _, out, _ = recording(tmp_path, "show", "--to", local(2.0))
    assert "  drive: was driving, 0." in out.splitlines()[-1]
