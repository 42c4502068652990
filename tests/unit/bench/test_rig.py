"""Tests of the messages that say why a process of a benchmark ended."""

from __future__ import annotations

from pathlib import Path

import pytest

from acsard.bench.rig import daemon_ended
from acsard.host.errors import Exit

JSON = '{"event": "ended"}\n'


@pytest.mark.parametrize(
    ("code", "log", "wanted", "text"),
    [
        (-9, JSON, Exit.FAILURE, "the daemon was ended by signal 9"),
        (0, JSON, Exit.FAILURE, "the daemon ended with exit code 0"),
        (3, "what\n", Exit.FAILURE, "the daemon ended with exit code 3: what"),
        (75, JSON, Exit.FAILURE, "the daemon ended with exit code 75"),
        (75, f"acsard: in use\n{JSON}\n", Exit.IN_USE, "in use"),
        (1, "Traceback ...\nKeyError: 1\n", Exit.FAILURE, "KeyError: 1"),
    ],
)
def test_an_ended_daemon_is_reported_with_its_own_message_if_it_has_one(
    tmp_path: Path, code: int, log: str, wanted: Exit, text: str
) -> None:
    file = tmp_path / "log"
    file.write_text(log)
    error = daemon_ended(code, file)
    assert (error.code, str(error)) == (wanted, text)
