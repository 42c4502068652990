"""The log: its formats, its queue, and the journal's protocol on a real socket."""

from __future__ import annotations

import io
import json
import os
import select
import socket
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.config.settings import LogConfig
from acsard.core.values import Event
from acsard.host.logs import (
    MAX_VALUE_LENGTH,
    JournalStream,
    Log,
    is_journal,
    output_in_threads,
    render,
)


class Journal:
    """A stand-in for systemd's journal at the other end of the socket."""

    def __init__(self, path: Path) -> None:
        self.path = str(path)
        self._socket = socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._socket.bind(self.path)
        self._socket.settimeout(5.0)

    def entry(self) -> dict[str, str]:
        """Return the fields of the next entry."""
        return fields(self._socket.recv(65536).decode())

    def close(self) -> None:
        self._socket.close()


def fields(text: str) -> dict[str, str]:
    """Parse a datagram to the journal. Each line must be NAME=value with a valid name."""
    variables: dict[str, str] = {}
    for line in text.removesuffix("\n").split("\n"):
        name, equals, value = line.partition("=")
        assert equals, f"{line!r} is no assignment"
        # The journal drops other names without a message.
        assert name.replace("_", "").isalnum(), name
        assert name.isascii(), name
        assert name == name.upper(), name
        assert name[0].isalpha(), name
        assert len(name) <= 64, name
        assert name not in variables, f"{name} twice"
        variables[name] = value
    return variables


@pytest.fixture
def journal(tmp_path: Path) -> Iterator[Journal]:
    journal = Journal(tmp_path / "journal")
    yield journal
    journal.close()


def rendered(**line: Any) -> dict[str, str]:
    return fields(render(None, "info", line))


# fields of a log line


def test_an_event_has_a_message_and_one_field_per_value() -> None:
    line = rendered(timestamp="now", level="warning", event="link_down", text="cable\npulled")
    assert line == {
        "MESSAGE": "link_down: cable pulled", "PRIORITY": "4", "SYSLOG_IDENTIFIER": "acsard",
        "ACSARD_EVENT": "link_down", "ACSARD_TEXT": "cable pulled",
    }  # fmt: skip
    line = rendered(level="info", event="started", robot="acsar", rate=100.0)
    assert line["MESSAGE"] == "started robot=acsar rate=100.0"
    assert (line["ACSARD_ROBOT"], line["ACSARD_RATE"]) == ("acsar", "100.0")
    levels = {"debug": "7", "info": "6", "warning": "4", "error": "3", "odd": "6"}
    for level, priority in levels.items():
        assert rendered(level=level, event="x")["PRIORITY"] == priority


@given(st.text())
def test_no_text_can_forge_a_field(text: str) -> None:
    line = rendered(level="info", event="heard", text=text)
    assert set(line) == {
        "MESSAGE",
        "PRIORITY",
        "SYSLOG_IDENTIFIER",
        "ACSARD_EVENT",
        "ACSARD_TEXT",
    }
    assert line["PRIORITY"] == "6"


# the stream


def test_each_write_sends_one_datagram(journal: Journal, tmp_path: Path) -> None:
    stream = JournalStream(journal.path)
    for text in ("MESSAGE=one\n", "MESSAGE=two\n", "MESSAGE=\udcff"):
        stream.write(text)
    assert [journal.entry()["MESSAGE"] for _ in range(3)] == ["one", "two", "?"]
    with pytest.raises(OSError, match="No such file"):
        JournalStream(str(tmp_path / "nothing"))


# which stream is the journal's


def test_a_stream_is_the_journal_if_the_environment_names_it(tmp_path: Path) -> None:
    with socket.socketpair()[0].makefile("w") as stream:
        status = os.fstat(stream.fileno())
        assert is_journal(stream, {"JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino}"})
        assert not is_journal(stream, {"JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino + 1}"})
        assert not is_journal(stream, {"JOURNAL_STREAM": ""})
        assert not is_journal(stream, {})
    with (tmp_path / "log").open("w") as closed:
        pass
    for other in (io.StringIO(), closed):
        assert not is_journal(other, {"JOURNAL_STREAM": "1:2"})


# the log as a whole


def test_an_event_arrives_in_the_journal_and_a_journal_that_disappears_raises_no_error(
    journal: Journal, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(JournalStream.__init__, "__defaults__", (journal.path,))
    monkeypatch.setattr("acsard.host.logs._fitting", lambda stream: "journal")
    log = Log(LogConfig())
    log.event(Event("link_up", "linked", "info"))
    entry = journal.entry()
    assert (entry["ACSARD_EVENT"], entry["MESSAGE"]) == ("link_up", "link_up: linked")
    journal.close()
    os.unlink(journal.path)
    for _ in range(10):
        log.event(Event("link_up", "linked", "info"))
    log.close()
    # Without a journal, the log is written as JSON.
    assert entries(tmp_path, Event("link_up", "linked"))[0]["event"] == "link_up"


def written(path: Path, *events: Event) -> list[str]:
    """Write these events to a log in a file, and return its lines."""
    with (path / "log").open("w+") as stream:
        log = Log(LogConfig(), stream)
        for event in events:
            log.event(event)
        log.close()
        stream.seek(0)
        return stream.read().splitlines()


def entries(path: Path, *events: Event) -> list[dict[str, Any]]:
    return [json.loads(line) for line in written(path, *events)]


def test_sender_and_count_of_an_event_are_logged_only_if_present(tmp_path: Path) -> None:
    stop = Event("stop", "x" * 10_000, "warning", by="joe (native)", count=3)
    plain, full = entries(tmp_path, Event("link_up", "linked"), stop)
    assert set(plain) == {"timestamp", "level", "event", "text"}
    assert (full["by"], full["count"], full["level"]) == ("joe (native)", 3, "warning")
    assert len(full["text"]) == MAX_VALUE_LENGTH


@pytest.mark.parametrize("form", ["json", "console"])
def test_control_characters_of_a_logged_text_are_replaced(
    tmp_path: Path, form: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("acsard.host.logs._fitting", lambda stream: form)
    evil = "cmd/\x1b[2J\n\r\x00\u202eapp"
    (line,) = written(tmp_path, Event("command_refused", evil, by=evil))
    text = line.replace("\x1b[0m", "").replace("\x1b[1m", "").replace("\x1b[2m", "")
    assert "cmd/\ufffd[2J  \ufffd\ufffdapp" in text.replace("\\ufffd", "\ufffd")
    assert "\x1b[2J" not in line
    assert "\u202e" not in line


def test_a_changed_log_level_applies_to_the_next_events(tmp_path: Path) -> None:
    with (tmp_path / "log").open("w+") as stream:
        log = Log(LogConfig(level="warning"), stream)
        for level in ("warning", "info", "error", "info"):
            log.use(LogConfig(level=level))
            log.event(Event("mode", level))
        log.close()
        stream.seek(0)
        records = [json.loads(line) for line in stream.read().splitlines()]
    assert [line["text"] for line in records] == ["info", "info"]
    assert all(set(line) == {"timestamp", "level", "event", "text"} for line in records)


def test_a_pipe_that_nobody_reads_blocks_no_output_stream(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    reader, writer = os.pipe()
    os.set_blocking(writer, False)
    filled = 0
    try:
        while True:
            filled += os.write(writer, bytes(4096))
    except BlockingIOError:
        os.set_blocking(writer, True)
    with open(writer, "w") as pipe, open(reader, "rb", buffering=0) as other_end:
        monkeypatch.setattr(sys, "stdout", pipe)
        monkeypatch.setattr(sys, "stderr", pipe)
        with output_in_threads():
            print("printed\n", end="", flush=True)
            sys.stderr.write("written\n")
            other_end.read(filled)
        assert (sys.stdout, sys.stderr) == (pipe, pipe)
        output = b""
        while not (b"printed\n" in output and b"written\n" in output):
            assert select.select([other_end], [], [], 10.0)[0], output
            output += other_end.read(4096)
