"""Tests of `acsard recording`: the list, parts of the timeline, and the recovered file."""

from __future__ import annotations

import json
import random
import re
import shutil
import time
from collections import Counter
from pathlib import Path

import pytest
from msgspec.structs import replace

from acsard.cli.recording import SERVICE_DIRECTORY
from acsard.core.config.settings import Config, RecordConfig
from acsard.core.values import NS_PER_S, Event
from acsard.host.errors import Exit
from acsard.recording.mcap_directory import RecordingDirectory
from acsard.recording.mcap_file import About, Recording, RecordingWriter
from acsard.recording.recorded_steps import FinishedStep, Unfinished
from acsard.recording.recovery import recover
from tests.scenarios.taped import Tape, chunks, recorded_world
from tests.scenarios.world import START, World
from tests.system.typed import typed

HARMED = 40
"""Number of damaged files; every verb processes each of them."""

NEW = {"show": "", "replay": "", "export": ".mcap", "report": ".html", "recover": ".new.mcap"}
"""Maps each verb that takes a file to the suffix of the file that it makes."""


@pytest.fixture(scope="module")
def where(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory with two recordings, of which the second is truncated."""
    where = tmp_path_factory.mktemp("record")
    for number, seconds in ((1, 2.0), (2, 4.0)):
        tape = Tape()
        world = World(recorder=tape)
        world.drive(0.5, seconds=seconds)
        world.call("stop")
        world.run(0.5)
        path = where / f"00000{number}-20270115T080000Z.mcap"
        tape.write(path, Config())
    path.rename(path.with_name(path.name + ".part"))
    path = path.with_name(path.name + ".part")
    # The end of the file takes 5600 bytes.
    path.write_bytes(path.read_bytes()[:-6400])
    return where


def log(where: Path, *words: str) -> tuple[int, str, str]:
    result = typed("recording", *words, "--directory", str(where))
    return result.code, result.out, result.err


@pytest.mark.parametrize("cut", ["crash", "bug", "disk"])
def test_the_list_marks_a_crash(cut: str, tmp_path: Path) -> None:
    """The list does not mark a recording that ended because the disk was full.

    In that case the daemon and the robot went on.
    """
    writing = RecordingWriter(
        tmp_path / "000001-20270115T080000Z.mcap", About("acsar", "1", "3", 1, 2)
    )
    writing.finish(cut, "why")
    (row,) = log(tmp_path)[1].splitlines()
    assert ("  ! [" in row) is (cut != "disk")


def test_the_list_can_be_restricted_to_a_range_of_time(tmp_path: Path) -> None:
    """The three recordings are a day apart, and the last one is not finished."""
    for number in (1, 2, 3):
        noon_ns = int(time.mktime((2027, 1, 14 + number, 12, 0, 0, 0, 0, -1))) * NS_PER_S
        name = f"00000{number}-20270115T080000Z.mcap{'.part' if number == 3 else ''}"
        path, about = tmp_path / name, About("acsar", "1", "3", 1, noon_ns)
        writing = RecordingWriter(path, about)
        writing.add("events", noon_ns, b"")
        if number == 3:
            writing.flush()
            writing.close()
        else:
            writing.finish()
    for words, numbers in (
        ("--from 2027-01-15", "123"),
        ("--to 2027-01-15", "1"),
        ("--from 2027-01-16 --to 2027-01-17", "23"),
        ("--from 2027-01-18", ""),
        ("--from 2027-01-15 --to 2027-01-15", "1"),
    ):
        code, out, _ = log(tmp_path, *words.split())
        assert code == 0
        assert [row[5] for row in out.splitlines() if row.startswith("00000")] == [*numbers]
        assert numbers or "no recordings from 2027-01-18 00:00:00 in" in out


@pytest.mark.slow
def test_the_configuration_names_the_directory_of_the_recordings(
    where: Path, tmp_path: Path
) -> None:
    file = tmp_path / "robot.toml"
    file.write_text(f'[record]\ndirectory = "{where}"\n')
    other = tmp_path / "other.toml"
    other.write_text("")
    assert "000001-20270115T080000Z.mcap" in typed("recording", "--config", str(file)).out
    for words in (
        ["--config", str(file), "show", "1"],
        ["show", "1", "--config", str(file)],
        ["--config", str(file), "replay", "1", "--config", str(other)],
    ):
        result = typed("recording", *words)
        assert (result.code, bool(result.out)) == (0, True)


@pytest.mark.slow
def test_the_list_distinguishes_a_start_from_a_continued_recording(tmp_path: Path) -> None:
    """The files are whole, truncated, recovered into a second file, and recovered in place."""
    tape, world = recorded_world(every=200)
    world.drive(0.5, seconds=4.0)
    for number, first in enumerate((0, 200)):
        whole = tmp_path / f"00000{number}-20270115T080000Z.mcap"
        tape.write(whole, Config(), first)
        data = whole.read_bytes()
        for place, name in enumerate((".mcap.part", "a.mcap", "b.mcap"), start=1):
            part = tmp_path / f"0000{place}{number}-20270115T080000Z{name}"
            part.write_bytes(data[: chunks(data)[-2][1]])
            if place > 1:
                cut = part.rename(tmp_path / "cut")
                assert recover(cut, part, "crash", room=place == 2) == ""
    rows = log(tmp_path)[1].splitlines()
    assert len(rows) == 8
    for row in rows:
        starts = row.partition("-")[0].endswith("0")
        assert (re.search("  (! )?start, 1 change of commander", row) is not None) is starts
        assert ("start" in row) is starts


def test_a_part_of_a_story_by_seconds_and_by_the_time_of_day(
    where: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def names(*words: str) -> set[str]:
        _, out, _ = log(where, "show", "1", "--json", *words)
        return {json.loads(line)["name"] for line in out.splitlines()}

    assert "start" in names("--to", "1")
    assert names("--from", "1.5", "--to", "2.5") == {"stop", "drive", "mode"}
    _, first = log(where, "show", "1")[1].partition("  ")[0].split(" ")
    hours, minutes, seconds = first.split(":")
    after = f"{hours}:{minutes}:{float(seconds) + 1.5:09.6f}"
    assert names("--from", after) == names("--from", "1.5")


def starts_at(world: World, hours: int, minutes: int, seconds: float, days: int = 0) -> None:
    """Set the simulated wall clock to this time of day."""
    day = time.localtime(START.wall_ns / 1e9)
    begin = (day.tm_year, day.tm_mon, day.tm_mday + days, hours, minutes, 0, 0, 0, -1)
    world.wall_offset_ns = int((time.mktime(begin) + seconds) * 1e9) - world.now_ns


def taped(where: Path, set_to: tuple[int, int, float, int] | None) -> Tape:
    """Record from two seconds before midnight to three seconds after it.

    A stop happens half a second after midnight. If `set_to` is given, the clock is set to that time
    at midnight.
    """
    tape, world = recorded_world()
    starts_at(world, 23, 59, 58.0)
    world.run(2.0)
    if set_to:
        starts_at(world, *set_to)
    world.run(0.5)
    world.call("stop")
    world.run(2.5)
    tape.write(where / "000001-20270115T235958Z.mcap", Config())
    return tape


@pytest.mark.variations(3)
@pytest.mark.parametrize(
    ("set_to", "hour"),
    [(None, "00:00"), ((14, 3, 0.0, 20), "14:03"), ((6, 0, 0.0, -3), "06:00")],
)
def test_a_time_of_day_is_found_over_midnight_and_where_the_clock_was_set(
    set_to: tuple[int, int, float, int] | None, hour: str, tmp_path: Path
) -> None:
    taped(tmp_path, set_to)

    def names(*words: str) -> set[str]:
        _, out, _ = log(tmp_path, "show", "1", "--json", *words)
        return {json.loads(line)["name"] for line in out.splitlines()}

    assert names("--to", "23:59:59") >= {"start"}
    assert "stop" not in names("--to", "23:59:59")
    assert "stop" in names("--from", f"{hour}:00")
    assert "start" not in names("--from", f"{hour}:00")
    assert "stop" in names("--to", f"{hour}:02")
    assert names("--from", f"{hour}:02.5", "--to", f"{hour}:02.7") == set()
    assert names("--from", "3.5") == set()
    assert "stop" in names("--from", "2", "--to", "3.4")


@pytest.mark.slow
def test_a_time_of_day_is_found_over_midnight_for_a_table_and_for_pictures(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.chdir(tmp_path)
    taped(tmp_path, None)
    rows = {}
    for name, words in (("all", ()), ("new", ("--from", "00:00")), ("old", ("--to", "00:00"))):
        assert log(tmp_path, "export", "1", f"{name}.csv", "--csv", *words)[0] == 0
        rows[name] = len((tmp_path / f"{name}.csv").read_text().splitlines()) - 1
    assert abs(rows["old"] + rows["new"] - rows["all"]) <= 1
    assert 1.2 < rows["new"] / rows["old"] < 1.8  # 3 s and 2 s, and one start
    assert log(tmp_path, "report", "1", "new.html", "--from", "00:00")[0] == 0
    assert re.search(r"<dt>Duration</dt><dd>(2\.9|3) s", (tmp_path / "new.html").read_text())


@pytest.mark.slow
@pytest.mark.parametrize("cut", [False, True])
def test_a_recording_that_a_kill_truncated_is_reported_as_such(
    cut: bool, where: Path, tmp_path: Path
) -> None:
    part = tmp_path / "000002-20270115T080000Z.mcap.part"
    (data,) = [path.read_bytes() for path in where.glob("000001*")]
    shutil.copy(next(where.glob("*.part")), part)
    if not cut:
        part.unlink()
        (tmp_path / part.stem).write_bytes(data)
    RecordingDirectory(RecordConfig(str(tmp_path))).close()
    reason = "the daemon or the computer stopped suddenly"
    _, out, _ = log(tmp_path)
    assert (reason in out) is cut
    _, out, err = log(tmp_path, "show")
    assert (out.splitlines()[-1].endswith(f"  ! cut: {reason}"), reason in err) == (cut, cut)
    _, out, _ = log(tmp_path, "show", "--json")
    last = json.loads(out.splitlines()[-1])
    assert (last["name"] == "cut", last["text"] == reason) == (cut, cut)
    if cut:
        new = tmp_path / "new.html"
        _, _, err = log(tmp_path, "report", "2", str(new))
        assert (reason in err, reason in new.read_text()) == (True, True)
    copy = tmp_path / "copy.mcap"
    assert log(tmp_path, "recover", str(next(tmp_path.glob("*2-*.mcap"))), str(copy))[0] == 0
    assert (reason in log(tmp_path, "show", str(copy))[1]) is cut


def test_recorded_texts_cannot_send_control_characters_to_the_terminal(tmp_path: Path) -> None:
    tape = Tape()
    World(recorder=tape).run(0.3)
    inputs, outputs, left = tape.taken[5]
    event = Event("stop", "\x1b[2J\u202egone", by="\x1b]0;title\x07")
    tape.taken[5] = FinishedStep(inputs, replace(outputs, events=(event,)), left)
    tape.write(tmp_path / "000001-20270115T080000Z.mcap", Config())
    for words in ((), ("show", "1"), ("show", "1", "--json")):
        code, out, _ = log(tmp_path, *words)
        assert (code, "stop" in out) == (0, True)
        assert all(line.isprintable() for line in out.splitlines())


def test_recover_writes_a_whole_file_or_none(
    where: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    new = tmp_path / "new.mcap"
    (cut,) = where.glob("*.part")
    states: list[bool] = []
    finish = RecordingWriter.finish

    def looked(writing: RecordingWriter, *how: str) -> None:
        states.append(new.exists())
        finish(writing, *how)

    monkeypatch.setattr(RecordingWriter, "finish", looked)
    assert log(where, "recover", str(cut), str(new))[0] == 0
    assert states == [False]
    assert [path for path in tmp_path.iterdir() if path.is_file()] == [new]


def test_recover_replaces_another_file_only_with_force(where: Path, tmp_path: Path) -> None:
    (cut,) = where.glob("*.part")
    (mine := tmp_path / "mine").write_text("mine")
    assert log(where, "recover", str(cut), str(mine))[0] == 1
    assert mine.read_text() == "mine"
    assert log(where, "recover", str(cut), str(mine), "--force")[0] == 0
    assert mine.read_text(errors="replace") != "mine"


def test_recover_replaces_no_copy_that_has_more_messages(where: Path, tmp_path: Path) -> None:
    new = tmp_path / "new.mcap"
    (cut,) = where.glob("*.part")
    (earlier := tmp_path / "earlier.mcap.part").write_bytes(cut.read_bytes()[:-2000])
    assert log(where, "recover", str(cut), str(new))[0] == 0
    longer = new.read_bytes()
    assert log(where, "recover", str(earlier), str(new), "--force")[0] == 1
    assert new.read_bytes() == longer


def harmed(data: bytes, dice: random.Random) -> bytes:
    """Return the data of a recording with one kind of damage.

    The data is truncated before or after the first chunk, or damaged in one or many places.
    """
    begin = chunks(data)[0][0]
    kind = dice.randrange(4)
    if kind < 2:
        return data[: dice.randrange(begin, len(data)) if kind else dice.randrange(begin)]
    bad = bytearray(data)
    for _ in range(1 if kind == 2 else dice.randint(2, 20)):
        bad[dice.randrange(begin if kind == 2 else 8, len(bad))] ^= dice.randrange(1, 256)
    return bytes(bad)


@pytest.mark.slow
def test_no_verb_raises_on_truncated_or_damaged_recordings(tmp_path: Path) -> None:
    """Recordings may begin with the daemon's start or a saved state, or end by an error."""
    tape, dice, ends = Tape(every=200), random.Random(6), Counter[int]()
    world = World(recorder=tape)
    world.drive(0.5, seconds=2.0)
    world.call("stop")
    world.run(0.5)
    sound = [tmp_path / "start", tmp_path / "state", tmp_path / "fault"]
    for first, path in zip((0, 200), sound, strict=False):
        tape.write(path, Config(), first)
    begun, last = Recording(sound[0]), tape.taken[-1].inputs
    ended = RecordingWriter(sound[2], begun.about)
    for topic, wall_ns, data in begun.messages():
        ended.add(topic, wall_ns, data)
    ended.add("unfinished", last.now.wall_ns, Unfinished(len(tape.taken), last).encode())
    ended.finish("bug", "a fault of our own")
    where = tmp_path / "record"
    where.mkdir()
    for number in range(HARMED):
        path = where / f"{number:06}-20270115T080000Z.mcap"
        path.write_bytes(harmed(sound[number % len(sound)].read_bytes(), dice))
        for verb, new in NEW.items():
            words = [verb, str(path), *([str(tmp_path / f"{number}{new}")] if new else [])]
            code, out, err = log(where, *words)
            assert code in (Exit.OK, Exit.FAILURE, Exit.INCOMPLETE), (words, out, err)
            assert (bool(out or err), bool(err) or code == Exit.OK) == (True, True), words
            assert "Traceback" not in err
            ends[code] += 1
    code, out, _ = log(where)
    assert (code, len(out.splitlines())) == (Exit.OK, HARMED)
    assert min(ends[Exit.OK], ends[Exit.FAILURE]) > HARMED / 2, ends
    code, out, err = log(where, "show", "all")
    assert (code, "  stop: " in out, "Traceback" in err) == (Exit.OK, True, False)


def test_the_default_directory_is_that_of_the_service() -> None:
    unit = Path(__file__).parents[3] / "deploy/systemd/acsard.service"
    settings = dict(row.partition("=")[::2] for row in unit.read_text().splitlines() if "=" in row)
    state = Path("/var/lib") / settings["StateDirectory"]
    assert settings["Environment"] == f"ACSARD_RECORD=%S/{settings['StateDirectory']}/record"
    assert state / "record" == SERVICE_DIRECTORY
