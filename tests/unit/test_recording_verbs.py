"""`acsard recording`: the list, and the parts of the recordings that each verb takes."""

from __future__ import annotations

import io
import json
import os
import sys
import time
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest
from msgspec.structs import replace

from acsard.cli import parser
from acsard.core.values import Event
from acsard.host.errors import Exit
from acsard.host.version import version
from acsard.recording.file import Head, first_head
from tests.scenarios.taped import Tape
from tests.scenarios.world import START, World
from tests.system.typed import typed

STEPS = 200
"""Number of steps in each file, about a second."""


def name(number: int) -> str:
    return f"{number:06}-20270115T080000Z.rec.zst"


@pytest.fixture(scope="module")
def where(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a directory with one run in five files; the client `unnamed` stops it in each."""
    where, tape = tmp_path_factory.mktemp("record"), Tape(every=STEPS)
    world = World(recorder=tape)
    for number in range(5):
        while len(tape.taken) < number * STEPS + STEPS // 2:
            world.run(0.01)
        world.call("stop")
        world.run(0.1)
        world.call("clear")
    world.run(0.5)
    for number in range(5):
        end = None if number == 4 else (number + 1) * STEPS
        path = tape.save(where / name(number + 1), first=number * STEPS, end=end)
        last = tape.taken[(end or len(tape.taken)) - 1].now
        os.utime(path, ns=(last.wall_ns, last.wall_ns))
    return where


def log(where: Path, *words: str) -> tuple[int, str, str]:
    result = typed("recording", *words, "--directory", str(where))
    return result.code, result.out, result.err


def local(seconds: float) -> str:
    """Return the local time this many seconds after the start, as a person types it."""
    at = START.wall_ns / 1e9 + seconds
    return time.strftime("%Y-%m-%d %H:%M:%S", time.localtime(at)) + f"{at % 1:.3f}"[1:]


def entries(out: str) -> list[tuple[float, str]]:
    """Return the seconds after the start and the name of each line of `show --json`."""
    rows = [json.loads(line) for line in out.splitlines()]
    return [((row["wall_ns"] - START.wall_ns) / 1e9, row["name"]) for row in rows]


def test_the_list_has_a_row_for_each_recording_of_the_range(where: Path) -> None:
    code, out, err = log(where)
    assert (code, err) == (0, "")
    assert [row.split()[0] for row in out.splitlines()] == [name(n) for n in range(1, 6)]
    assert local(0.0)[:19] in out.splitlines()[0]
    _, out, _ = log(where, "--from", local(2.2), "--to", local(2.3))
    assert [row.split()[0] for row in out.splitlines()] in ([name(2)], [name(3)], [name(4)])
    code, out, _ = log(where, "--from", "2000-01-01", "--to", "2000-01-02")
    assert code == 0
    assert out == f"no recordings in {where} in that time: leave out --from and --to to list all"


def test_the_newest_recording_or_all_of_a_range_are_shown(where: Path) -> None:
    code, out, err = log(where, "show", "--json")
    assert code == 0
    assert err.endswith("this is the newest of 5 recordings; `acsard recording` lists all")
    assert len([one for _, one in entries(out) if one == "stop"]) == 1
    code, out, err = log(where, "show", "--json", "--from", local(1.0))
    assert (code, err) == (0, "")
    found = entries(out)
    assert found[0][1] == "continues"
    assert min(at for at, _ in found) >= 1.0
    assert len([one for _, one in found if one == "stop"]) == 4
    assert "gap" not in {one for _, one in found}
    _, whole, _ = log(where, "show", "--json", "--from", "2000-01-01")
    assert [entry for entry in entries(whole) if entry[0] >= found[1][0]] == found[1:]


def test_a_file_that_is_no_recording_does_not_hide_the_others(where: Path, tmp_path: Path) -> None:
    for path in where.iterdir():
        (tmp_path / path.name).write_bytes(path.read_bytes())
    (tmp_path / name(2)).write_bytes(b"no recording")
    code, out, err = log(tmp_path, "show", "--from", "2000-01-01")
    assert code == 0
    assert out.count("  stop: ") == 4
    assert out.count("! gap: ") == 1
    assert name(2) in err
    code, _, err = log(tmp_path, "replay", "--from", "2000-01-01")
    assert code == Exit.INCOMPLETE
    assert "not compared: " in err
    assert name(2) in err


@pytest.mark.parametrize("verb", ["show", "replay", "report", "export"])
def test_a_recording_of_which_nothing_can_be_read_is_not_called_empty(
    where: Path, tmp_path: Path, verb: str
) -> None:
    broken = tmp_path / name(1)
    data = bytearray((where / name(1)).read_bytes())
    data[200:210] = bytes(10)
    broken.write_bytes(data)
    words = [verb, str(broken), *([str(tmp_path / "new.mcap")] if verb == "export" else [])]
    result = typed("recording", *words)
    assert result.code == Exit.FAILURE
    assert "nothing of it can be read: 000001" in result.err
    assert "empty" not in result.err


def test_recorded_texts_cannot_send_control_characters_to_the_terminal(tmp_path: Path) -> None:
    tape = Tape()
    World(recorder=tape).run(0.3)
    step = tape.taken[5]
    event = Event("stop", "\x1b[2J\u202egone", by="\x1b]0;title\x07")
    tape.taken[5] = step._replace(news=replace(step.news, events=(event,)))
    tape.save(tmp_path / name(1))
    for words in (("show", "1"), ("show", "1", "--json")):
        code, out, _ = log(tmp_path, *words)
        assert (code, "stop" in out) == (0, True)
        assert all(line.isprintable() for line in out.splitlines())


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to become a user without permission")
def test_a_directory_that_this_user_may_not_read_ends_with_77(tmp_path: Path) -> None:
    os.seteuid(65534)
    try:
        code, _, err = log(tmp_path)
    finally:
        os.seteuid(0)
    assert (code, "Permission denied" in err) == (Exit.NO_PERMISSION, True)
    (tmp_path / "file").touch()
    code, _, err = log(tmp_path / "file")
    assert (code, "Not a directory" in err) == (Exit.FAILURE, True)


def test_the_file_of_another_program_is_refused_as_what_it_is(where: Path, tmp_path: Path) -> None:
    other = tmp_path / "drive.csv"
    code, _, err = log(where, "show", str(other))
    assert (code, "type the recording's number before it" in err) == (Exit.USAGE, True)
    other.write_text("t,left,right")
    code, _, err = log(where, "show", str(other))
    assert (code, "drive.csv is not a recording of acsard" in err) == (Exit.FAILURE, True)


def test_a_replay_names_another_version_that_recorded(where: Path, tmp_path: Path) -> None:
    path = tmp_path / name(1)
    code, out, _ = log(where, "replay", "1")
    assert (code, "recorded this, and acsard" in out) == (0, version() != "0.2.0")
    for own in (version(), "0.1.9"):
        tape = Tape()
        World(recorder=tape).run(1.0)
        with pytest.MonkeyPatch.context() as patched:
            patched.setattr("tests.scenarios.taped.Head", partial(versioned, own))
            tape.save(path)
        code, out, _ = log(tmp_path, "replay", "1")
        told = f"acsard {own} recorded this, and acsard {version()} replayed it"
        assert (code, told in out) == (0, own != version())


@pytest.mark.parametrize("verb", ["show", "replay", "report", "export"])
def test_a_time_or_a_directory_that_cannot_be_used_is_refused(
    where: Path, tmp_path: Path, verb: str
) -> None:
    new = [str(tmp_path / "new.mcap")] if verb == "export" else []
    code, _, err = log(where, verb, "1", *new, "--from", "yesterdy")
    assert (code, "yesterdy" in err) == (Exit.USAGE, True)
    code, _, err = log(tmp_path / "none", verb, "1", *new)
    assert (code, "the directory does not exist" in err) == (1, True)


def test_the_list_names_the_recordings_that_cannot_be_read(where: Path, tmp_path: Path) -> None:
    (tmp_path / name(1)).write_bytes((where / name(1)).read_bytes())
    (tmp_path / name(2)).write_bytes(b"no recording")
    for number in (3, 4):
        (tmp_path / name(number)).touch()

    def opened(path: Path) -> Head | None:
        if path.name == name(3):
            raise OSError(5, "Input/output error")
        if path.name == name(4):
            raise FileNotFoundError  # the daemon has deleted it
        return first_head(path)

    with pytest.MonkeyPatch.context() as patched:
        patched.setattr("acsard.cli.recording.first_head", opened)
        code, out, _ = log(tmp_path)
        now = time.time()
        for at_s, is_recorded in ((now, True), (now - 3600.0, False)):
            os.utime(tmp_path / name(1), (at_s, at_s))
            first, *_ = log(tmp_path)[1].splitlines()
            assert ("[being recorded]" in first) == is_recorded
    rows = out.splitlines()
    assert code == 0
    assert [row.split()[0] for row in rows] == [name(1), name(2), name(3)]
    assert rows[1].endswith("the beginning cannot be read")
    assert rows[2].endswith("cannot be read: Input/output error")


def test_a_replay_with_another_configuration_says_what_the_robot_would_have_done(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, approved: Callable[[Path, str], None]
) -> None:
    """The second configuration is so different that the replayed robot has a fault."""
    monkeypatch.setattr("acsard.cli.recording.version", lambda: "0.2.0")  # of the tape
    tape, other, text = Tape(), tmp_path / "other.toml", ""
    world = World(recorder=tape)
    world.drive(0.5, seconds=1.0)
    world.run(0.5)
    tape.save(tmp_path / name(1))
    for settings in (
        "[rates]\nodom = 5.0\n",
        "[limits]\nlinear_speed = 0.3\n",
        "[drive]\nwheel_radius = 0.12\n[limits]\nwheel_speed = 2.0\n",
    ):
        other.write_text(settings)
        code, out, err = log(tmp_path, "replay", "1", "--config", str(other))
        assert (code, err) == (0, "")
        text += f"--- {' '.join(settings.split())}\n{out}\n"
    approved(Path(__file__).with_name("words") / "replay.txt", text)


def versioned(own: str, _: str, *fields: object) -> Head:
    return Head(own, *fields)  # type: ignore[arg-type]


def test_a_recording_that_does_not_exist_is_named(where: Path, tmp_path: Path) -> None:
    advice = "`acsard recording` lists the recordings"
    code, _, err = log(where, "show", "7")
    assert (code, err) == (1, f"acsard: no recording 7 in {where}; {advice}")
    code, _, err = log(tmp_path, "show")
    assert (code, err) == (1, f"acsard: no recording in {tmp_path}; {advice}")


@pytest.mark.parametrize("verb", ["report", "export"])
def test_a_file_that_cannot_be_written_ends_with_the_reason(
    where: Path, tmp_path: Path, verb: str
) -> None:
    new = tmp_path / "none" / ("new.html" if verb == "report" else "new.mcap")
    code, out, err = log(where, verb, "1", str(new))
    assert (code, out) == (Exit.FAILURE, "")
    assert f"cannot write {new}: No such file or directory" in err


class Terminal(io.StringIO):
    def isatty(self) -> bool:
        return True


def test_a_long_reading_shows_on_a_terminal_how_far_it_is(
    where: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("acsard.cli.recording.PROGRESS_RECORDS", 100)
    errors = Terminal()
    with monkeypatch.context() as patched:
        patched.setattr(sys, "stderr", errors)
        args = parser(["recording"]).parse_args(["recording", "replay", str(where / name(1))])
        assert args.main(args) == 0
    *times, end = errors.getvalue().split("\r")[1:]
    assert end == "\x1b[K"
    assert 1 <= len(times) <= STEPS // 100 + 2
    assert times[0] == local(0.0)[:19]
