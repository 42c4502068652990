"""The timeline of a recording, and the messages that its replayed robot publishes.

`words/transcripts/timeline.txt` shows what `acsard recording show` prints of a whole day, and
`scenarios/test_export.py` proves that the messages equal the original ones.
"""

from __future__ import annotations

from pathlib import Path

from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config
from acsard.core.config.toml_text import document
from acsard.core.ros.shapes import Log
from acsard.core.values import NS_PER_S
from acsard.recording.file import Failure, FrameWriter, Head, ReadRecord, Recording, Waits
from acsard.recording.published import Published, published
from acsard.recording.timeline import Timeline, TimelineEntry
from tests.scenarios.world import START
from tests.unit.drives import drive


def head(number: int = 0, started_ns: int = 0) -> Head:
    return Head("0.2.0", "acsar", number, 0, 0, started_ns=started_ns)


def entries_of(*records: ReadRecord) -> list[TimelineEntry]:
    timeline = Timeline()
    return [entry for record in records for entry in timeline.take(record)]


def texts(entries: list[TimelineEntry], name: str) -> list[str]:
    return [entry.sentence for entry in entries if entry.name == name]


def test_a_failure_of_the_daemon_is_reported() -> None:
    steps = drive().steps()
    last = entries_of(head(), *steps, Failure(len(steps), "ValueError: seven"))[-1]
    assert (last.name, last.level) == ("failure", "error")
    assert last.text == "the daemon failed: ValueError: seven"
    assert last.wall_ns == steps[-1].now.wall_ns
    now = steps[0].now
    (first,) = entries_of(head(), Failure(0, "ValueError: seven", now, steps[0].heard))
    assert first.wall_ns == now.wall_ns  # in the first step, too


def test_a_source_that_waits_has_an_entry_once_in_a_drive() -> None:
    steps = drive().steps()
    waits = Waits(steps[100].now, {"nav": ("source_priority", "app has priority")})
    other = Waits(steps[150].now, {"nav": ("source_first", "app came first")})
    entries = entries_of(head(), *steps[:100], waits, *steps[100:150], waits, other)
    assert texts(entries, "waits") == ["app has priority (by nav)", "app came first (by nav)"]
    again = entries_of(head(), *steps[:100], waits, *steps[100:], waits)
    assert texts(again, "waits") == ["app has priority (by nav)"] * 2


def test_each_run_has_its_start_and_one_that_was_cut_off_its_end() -> None:
    steps = drive().steps()
    first, second, third = (head(started_ns=run) for run in (1, 2, 3))
    entries = entries_of(first, *steps, second, third, *steps)
    runs = [
        (entry.name, entry.wall_ns) for entry in entries if entry.name in ("start", "cut", "clock")
    ]
    begin_ns, end_ns = steps[0].now.wall_ns, steps[-1].now.wall_ns
    assert runs == [("start", begin_ns), ("cut", end_ns), ("start", begin_ns)]


# the messages


def logs(messages: list[Published]) -> list[Log]:
    return [m.message for m in messages if isinstance(m.message, Log)]


def test_the_log_has_the_same_lines_as_the_timeline(tmp_path: Path) -> None:
    recording, timeline = Recording([drive().save(tmp_path / "a.rec.zst")]), Timeline()
    entries = [entry for record in recording.records() for entry in timeline.take(record)]
    lines = logs(list(published(recording)))
    assert [line.name for line in lines] == [entry.name for entry in entries]
    assert [line.msg for line in lines] == [entry.sentence for entry in entries]
    assert [line.stamp.to_ns() for line in lines] == [entry.wall_ns for entry in entries]
    assert "start" in [line.name for line in lines]


def test_what_sources_waited_for_before_a_part_is_not_in_its_log(tmp_path: Path) -> None:
    tape, path = drive(), tmp_path / "a.rec.zst"
    steps = tape.taken
    start, middle = steps[0].now, steps[len(steps) // 2].now
    with path.open("wb") as file:
        frames = FrameWriter(file)
        text = "\n".join(document(effective(Config()))) + "\n"
        frames.begin(Head("0.2.0", "acsar", 0, start.mono_ns, start.wall_ns, text))
        frames.add(Waits(start, {"nav": ("higher", "early")}))
        frames.add(Waits(middle, {"nav": ("equal", "late")}))
    part = published(Recording([path], START.wall_ns + 1))
    assert [line.msg for line in logs(list(part))] == ["late (by nav)"]


def test_a_part_has_the_messages_of_its_time_and_says_what_it_continues(tmp_path: Path) -> None:
    path, begin_ns = drive().save(tmp_path / "a.rec.zst"), START.wall_ns + NS_PER_S // 2
    part = list(published(Recording([path], begin_ns)))
    whole = list(published(Recording([path])))
    first, *rest = logs(part)
    assert (first.name, first.msg) == (
        "continues",
        "the robot is driving (commanded by app), link up (by app)",
    )
    assert min(m.wall_ns for m in part) >= begin_ns - 10_000_000
    steady = {"odom", "cmd_vel_out", "state", "joint_states"}
    inside = [m for m in whole if m.wall_ns >= begin_ns and m.channel.name in steady]
    assert [m for m in part if m.channel.name in steady] == inside
    assert rest == [line for line in logs(whole) if line.stamp.to_ns() >= begin_ns]
