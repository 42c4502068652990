"""The files that `recording export` and `report` write, and their progress."""

from __future__ import annotations

import re
from datetime import datetime
from functools import lru_cache
from pathlib import Path

import pytest

from acsard.cli import main
from acsard.recording.file import Recording
from acsard.recording.recorded_steps import US_PER_S
from tests.each import each
from tests.scenarios.taped import Tape
from tests.scenarios.world import START, World
from tests.system.typed import typed
from tests.unit.test_recording_report import traces

RECORDED = "000007-20270115T080000Z.rec.zst"


@pytest.fixture(scope="module")
def where(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory with one recording."""
    where = tmp_path_factory.mktemp("record")
    tape = Tape()
    World(recorder=tape).drive(0.5, seconds=1.5)
    tape.save(where / RECORDED)
    return where


@pytest.fixture(autouse=True)
def here(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    return tmp_path


def export(where: Path, *words: str) -> int:
    return main(["recording", "export", *words, "--directory", str(where)])


@pytest.mark.parametrize(
    ("words", "name"),
    [
        ((), "000007-20270115T080000Z.mcap"),
        (("--csv",), "000007-20270115T080000Z.csv"),
    ],
)
def test_the_newest_recording_is_exported_to_a_named_file_in_the_working_directory(
    words: tuple[str, ...], name: str, where: Path, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert export(where, *words) == 0
    output = capsys.readouterr()
    assert output.err == ""  # without a terminal there is no progress line
    assert output.out.endswith(f" in {name}\n")
    if words:
        (rows,) = re.findall(r"(\d+) rows", output.out)
        assert int(rows) == len((here / name).read_text().splitlines()) - 1
    assert [path.name for path in here.iterdir()] == [name]


def test_a_range_of_time_exports_only_that_part(where: Path, here: Path) -> None:
    begin = datetime.fromtimestamp(START.wall_ns / 1e9 + 0.5).isoformat()
    assert export(where, "7", "a.csv", "--csv") == 0
    assert export(where, "7", "b.csv", "--csv", "--from", begin, "--to", "+0.5s") == 0
    whole, part = ((here / name).read_text().splitlines() for name in ("a.csv", "b.csv"))
    assert whole[0] == part[0]
    assert set(part) < set(whole)
    assert 0.2 < len(part) / len(whole) < 0.5


def test_another_configuration_computes_the_odometry_again(where: Path, here: Path) -> None:
    (here / "other.toml").write_text("[drive]\nwheel_radius = 0.1\n")
    assert export(where, "7", "a.csv", "--csv") == 0
    assert export(where, "7", "b.csv", "--csv", "--config", "other.toml") == 0
    far, further = (
        float((here / name).read_text().splitlines()[-1].split(",")[8])
        for name in ("a.csv", "b.csv")
    )
    assert further == pytest.approx(2 * far, rel=0.02)


@each("words", ["y.pdf", "y.csv", "y.mcap --csv"])
def test_a_name_with_the_ending_of_another_kind_is_refused(
    words: str, where: Path, here: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert export(where, "7", *words.split()) == 2
    assert "with --csv with .csv" in capsys.readouterr().err
    assert not list(here.iterdir())


RECORDINGS = Path(__file__).parents[1] / "recordings"
QUIET = RECORDINGS / "quiet.rec.zst"


def report(*words: object) -> tuple[int, str, str]:
    result = typed("recording", "report", *map(str, words))
    return result.code, result.out, result.err


@lru_cache
def ends_at() -> tuple[float, float]:
    """Return the robot's last recorded position, m."""
    poses = [pose for step in Recording([QUIET]).steps() for pose in step.recorded.poses]
    return poses[-1][0] / US_PER_S, poses[-1][1] / US_PER_S


def test_the_numbers_of_the_file_are_those_of_the_recording(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    code, out, err = report(QUIET)
    assert (code, err) == (0, "")
    path = tmp_path / "quiet.html"
    assert out.startswith("quiet.html: ")
    assert path.stat().st_size < 2e6
    text = path.read_text(encoding="utf-8")
    (end,) = traces(text, "end")
    assert (end["x"][0], end["y"][0]) == pytest.approx(ends_at(), abs=1e-5)
    assert re.search(r"The robot drove 1\.87 m in 5\.1 s of 7\.9 s, at most 0\.5\d m/s\.", text)
    assert "(by unnamed (native))" in text


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a recording of this version, which is long enough to show progress."""
    tape = Tape()
    World(recorder=tape).drive(0.5, 0.3, seconds=8.0)
    return tape.save(tmp_path_factory.mktemp("recorded") / "drive.rec.zst")
