"""The daemon names the causes of lateness that this machine can produce, the same everywhere."""

from __future__ import annotations

import json
import os
import re
import signal
import subprocess
import sys
from pathlib import Path
from typing import Any

import pytest

from acsard.daemon.late_causes import BECAUSE
from tests.system.harness import ROOT, Daemon, acsard, environment, running, until
from tests.system.late_plants import CGROUP, hog, spin

pytestmark = [
    pytest.mark.slow,
    pytest.mark.skipif(os.geteuid() != 0, reason="needs real-time priority, so root"),
]

TIMES = 8


@pytest.mark.nightly  # beside other tests, other causes are true as well
@pytest.mark.parametrize(
    ("cause", "words"),
    [
        ("processor", "other programs used the processor for"),
        ("disk", "the daemon waited for the disk"),
        ("memory", "of the daemon's memory had to be read from the disk"),
        pytest.param(
            "quota",
            "the daemon's processor quota was used up for",
            marks=pytest.mark.skipif(
                not (CGROUP.parent / "cpu.cfs_quota_us").exists(),
                reason="needs cgroups of version 1",
            ),
        ),
    ],
)
def test_a_planted_cause_is_named_eight_of_eight_times(
    cause: str, words: str, tmp_path: Path
) -> None:
    done = subprocess.run(
        [sys.executable, "-m", "tests.system.late_plants", cause, str(TIMES)],
        cwd=tmp_path,
        env=environment(PYTHONPATH=str(ROOT)),
        capture_output=True,
        text=True,
        timeout=60,
        check=False,
    )
    assert done.stderr == ""
    texts = [json.loads(line) for line in done.stdout.splitlines()]
    assert len(texts) == TIMES
    for reported in texts:
        (text,) = reported
        assert words in text, texts
        # Each further cause begins after the advice of the one before. Other tests may run beside
        # this one, so that other programs may really be a cause too.
        named = text.partition("because ")[2].split("), and ")
        others = [reason for reason in named if words not in reason]
        assert all(reason.startswith("other programs used the processor") for reason in others), (
            text
        )


def output_of(*words: str) -> str:
    """Return what a subcommand prints."""
    done = subprocess.run(acsard(*words), capture_output=True, text=True, timeout=60, check=False)
    return done.stdout


def causes_of(daemon: Daemon) -> list[dict[str, Any]]:
    return [event for event in daemon.events("missed_periods") if BECAUSE in event["text"]]


def test_log_recording_report_and_doctor_name_the_same_cause(tmp_path: Path) -> None:
    directory = tmp_path / "record"
    config = {"record": {"directory": str(directory)}}
    with running(tmp_path, config=config) as (daemon, _):
        os.sched_setaffinity(daemon.pid, {0})
        with hog() as busy:
            spin(busy, 5)
            (event, *_) = until(lambda: causes_of(daemon), 10.0, "the cause is in the log")
            doctor = output_of("doctor", "--config", str(daemon.config))
            busy.kill()
        daemon.signal(signal.SIGTERM)
        assert daemon.ended(5.0) == 0
        name = event["text"].rpartition("; the last: ")[2].partition("late: ")[2] or event["text"]
        clause = name.rpartition(BECAUSE)[2]
        assert clause.startswith("other programs used the processor for ")
        assert re.search(rf"the real-time program \S+ \(pid {busy.pid}\)", clause)
    (file,) = directory.rglob("*.mcap")
    sentences = output_of("recording", "show", str(file))
    page = tmp_path / "report.html"
    output_of("recording", "report", str(file), str(page))
    for text in (doctor, sentences, page.read_text()):
        assert clause in " ".join(text.split())
