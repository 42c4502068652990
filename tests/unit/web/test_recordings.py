"""The page lists the recordings. Another process with limits draws one report at a time."""

from __future__ import annotations

import asyncio
import gzip
import os
import sys
from pathlib import Path
from typing import Any

import pytest

from acsard.core.values import NS_PER_S
from acsard.web import recordings as reports
from acsard.web.recordings import (
    CHILD_NICE,
    KEEP_REPORT_NS,
    MAX_REPORT_BYTES,
    BlackBox,
    Recording,
    Reports,
    ReportState,
    rows,
)
from tests.each import each


def test_a_robot_that_has_just_started_has_no_recordings(tmp_path: Path) -> None:
    """The recorder makes its directory about a second after the daemon's start."""
    assert rows(tmp_path / "record") == []


def test_a_file_that_the_daemon_renames_meanwhile_does_not_hide_the_others(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    names = ["000001-20261121T070027Z.mcap", "000002-20261121T070127Z.mcap.part"]
    for name in names:
        (tmp_path / name).write_bytes(b"")
    monkeypatch.setattr(reports, "listed", lambda place: [place / name for name in names])
    (tmp_path / names[1]).rename(tmp_path / "000002-20261121T070127Z.mcap")
    assert [row.name for row in rows(tmp_path)] == names[:1]


def test_a_file_in_place_of_the_directory_is_an_error(tmp_path: Path) -> None:
    (tmp_path / "record").write_text("")
    with pytest.raises(NotADirectoryError):
        rows(tmp_path / "record")


async def test_many_requests_at_once_read_the_disk_once(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A viewer with very many requests must not delay the stops of other clients."""
    looked: list[Path] = []

    def look(place: Path) -> list[Recording]:
        looked.append(place)
        return []

    monkeypatch.setattr(reports, "rows", look)
    robots: Any = None
    box = BlackBox(robots)
    monkeypatch.setattr(box, "_place", lambda: tmp_path)
    assert await asyncio.gather(*(box.rows() for _ in range(40))) == [[]] * 40
    assert looked == [tmp_path]
    monkeypatch.setattr(reports, "MIN_LIST_INTERVAL_NS", -1)
    await box.rows()
    assert len(looked) == 2


PATIENCE_S = 30.0

A, B = Path("/a.mcap"), Path("/b.mcap")

DRAWS = "import sys; print(40, file=sys.stderr); print('<html>', sys.argv[1])"

WAITS = "import sys, time; print(40, file=sys.stderr, flush=True); time.sleep(100)"


def drawn_by(program: str) -> Reports:
    """Return reports that this program draws instead of acsard."""
    return Reports((sys.executable, "-S", "-c", program))


async def become(renderer: Reports, path: Path, *states: str, stamp: int = 1) -> ReportState:
    """Wait until the report's progress has one of these states, and return the progress."""
    async with asyncio.timeout(PATIENCE_S):
        while (progress := renderer.request(path, (stamp, 0))).report not in states:
            await asyncio.sleep(0.01)
    return progress


async def test_a_request_starts_the_report_and_a_later_one_gets_it() -> None:
    renderer = drawn_by(DRAWS)
    assert renderer.request(A, (1, 0)).report == "drawing"
    assert renderer.drawn("a.mcap") is None
    progress = await become(renderer, A, "ready", "failed")
    assert progress == ReportState("ready", href="report/a.mcap")
    body = renderer.drawn("a.mcap")
    assert body is not None
    assert gzip.decompress(body) == b"<html> /a.mcap\n"
    assert renderer.drawn("b.mcap") is None


async def test_a_report_has_its_progress_and_a_second_report_waits() -> None:
    renderer = drawn_by(WAITS)
    renderer.request(A, (1, 0))
    async with asyncio.timeout(PATIENCE_S):
        while renderer.request(A, (1, 0)).percent != 40:
            await asyncio.sleep(0.01)
    assert renderer.request(B, (1, 0)).report == "busy"
    assert "a.mcap" in renderer.request(B, (1, 0)).text
    renderer.end()
    assert renderer.request(B, (1, 0)).report == "drawing"
    renderer.end()


async def test_a_report_is_made_again_only_if_its_recording_has_grown() -> None:
    renderer = drawn_by(DRAWS)
    await become(renderer, A, "ready")
    assert renderer.request(A, (1, 0)).report == "ready"
    assert renderer.request(A, (2, 0)).report == "drawing"
    # The recording grows while it is drawn, so the report has the stamp that was requested.
    await become(renderer, A, "ready", stamp=3)


@pytest.mark.slow
@each(
    ("program", "why"),
    [
        (
            "import sys; sys.exit('acsard: this command needs the library plotly')",
            "needs the library",
        ),
        ("raise MemoryError", "memory: draw the report on another machine"),
        ("{}['x']", "KeyError: 'x'"),
        ("import os; os.kill(os.getpid(), 9)", "most likely because memory ran out"),
        ("import os; os.kill(os.getpid(), 15)", "was ended by signal 15"),
        (
            f"import sys; sys.stdout.write('x' * {MAX_REPORT_BYTES + 1})",
            "draw a part of the recording",
        ),
    ],
)
async def test_a_failed_report_has_its_reason_and_the_next_request_starts_it_again(
    program: str, why: str
) -> None:
    renderer = drawn_by(program)
    progress = await become(renderer, A, "ready", "failed")
    assert progress.report == "failed"
    assert why in progress.text
    assert "acsard: " not in progress.text
    assert renderer.request(A, (1, 0)).report == "drawing"
    renderer.end()


@each(
    ("end", "expected"),
    [("'ä is missing'.encode()", "xä is missing"), ("b'\\xc3'", "x\N{REPLACEMENT CHARACTER}")],
)
async def test_a_character_across_two_reads_of_an_error_text_is_whole(
    end: str, expected: str
) -> None:
    """The server reads at most 4096 bytes at once, so a read may end inside a UTF-8 character."""
    program = f"import sys; sys.stderr.buffer.write(b'x' * 4095 + {end}); sys.exit(1)"
    progress = await become(drawn_by(program), A, "failed")
    assert progress.text.lstrip("x") == expected.lstrip("x")


async def test_a_missing_report_program_is_reported() -> None:
    progress = await become(Reports(("/nowhere/acsard",)), A, "ready", "failed")
    assert "No such file" in progress.text


async def test_a_report_that_takes_too_long_is_reported(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(reports, "DRAW_TIMEOUT_S", 0.05)
    progress = await become(drawn_by(WAITS), A, "ready", "failed")
    assert "acsard recording report" in progress.text


TELLS = """import os, resource, sys, time
limit, _ = resource.getrlimit(resource.RLIMIT_DATA)
while os.getpriority(os.PRIO_PROCESS, 0) == 0 or limit < 0:
    limit, _ = resource.getrlimit(resource.RLIMIT_DATA)
last = open("/proc/self/oom_score_adj").read().strip()
print(os.getpriority(os.PRIO_PROCESS, 0), limit, last, flush=True)
time.sleep(float(sys.argv[1].strip("/")))"""


async def test_a_report_process_has_low_priority_limited_memory_and_is_killed_first() -> None:
    renderer = drawn_by(TELLS)
    await become(renderer, Path("/0"), "ready")
    priority, memory, first = gzip.decompress(renderer.drawn("0") or b"").split()
    assert (int(priority), int(memory)) == (max(CHILD_NICE, os.nice(0)), reports.MAX_CHILD_MEMORY)
    assert first == b"1000"


async def test_a_report_without_further_requests_is_cancelled_and_its_process_ends(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    pid_file = tmp_path / "pid"
    program = f"import os; open({str(pid_file)!r}, 'w').write(str(os.getpid())); {WAITS}"
    renderer = drawn_by(program)
    renderer.request(A, (1, 0))
    async with asyncio.timeout(PATIENCE_S):
        while not (pid_file.exists() and pid_file.read_text()):
            await asyncio.sleep(0.01)
        renderer.tidy()
        assert renderer.request(A, (1, 0)).report == "drawing"
        monkeypatch.setattr(reports, "ABANDONED_NS", -NS_PER_S)
        renderer.tidy()
        while Path(f"/proc/{pid_file.read_text()}").exists():
            await asyncio.sleep(0.01)
    assert renderer.drawn("a.mcap") is None


async def test_an_opened_report_is_kept_for_another_quarter_of_an_hour(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    now_ns = 0
    monkeypatch.setattr("acsard.web.recordings.clock.mono_ns", lambda: now_ns)
    renderer = drawn_by(DRAWS)
    await become(renderer, A, "ready")
    for _ in range(3):
        now_ns += KEEP_REPORT_NS - NS_PER_S
        renderer.tidy()
        assert renderer.drawn("a.mcap")
    now_ns += KEEP_REPORT_NS + NS_PER_S
    renderer.tidy()
    assert renderer.drawn("a.mcap") is None
