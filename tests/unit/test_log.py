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
from tests.each import each


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
    line = rendered(timestamp="now", level="warning", event="link_down", text="cable pulled")
    assert line == {
        "MESSAGE": "link_down: cable pulled",
        "PRIORITY": "4",
        "SYSLOG_IDENTIFIER": "acsard",
        "ACSARD_EVENT": "link_down",
        "ACSARD_TEXT": "cable pulled",
    }


def test_a_line_without_a_text_shows_its_fields_in_the_message() -> None:
    line = rendered(level="info", event="started", robot="acsar", rate=100.0)
    assert line["MESSAGE"] == "started robot=acsar rate=100.0"
    assert line["ACSARD_ROBOT"] == "acsar"
    assert line["ACSARD_RATE"] == "100.0"


@each(
    ("level", "priority"),
    [("debug", "7"), ("info", "6"), ("warning", "4"), ("error", "3"), ("odd", "6")],
)
def test_a_level_becomes_the_syslog_priority(level: str, priority: str) -> None:
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


def test_a_line_end_in_a_value_becomes_a_space() -> None:
    line = rendered(level="info", event="heard", text="ap10.00\nPRIORITY=0")
    assert line["ACSARD_TEXT"] == "ap10.00 PRIORITY=0"


# the stream


def test_each_write_sends_one_datagram(journal: Journal) -> None:
    stream = JournalStream(journal.path)
    stream.write("MESSAGE=one\n")
    stream.write("MESSAGE=two\n")
    assert [journal.entry(), journal.entry()] == [{"MESSAGE": "one"}, {"MESSAGE": "two"}]


def test_text_that_is_not_utf_8_is_replaced(journal: Journal) -> None:
    JournalStream(journal.path).write("MESSAGE=\udcff")
    assert journal.entry() == {"MESSAGE": "?"}


def test_a_missing_journal_socket_raises_an_os_error(tmp_path: Path) -> None:
    with pytest.raises(OSError, match="No such file"):
        JournalStream(str(tmp_path / "nothing"))


# which stream is the journal's


def test_a_stream_is_the_journal_if_the_environment_names_it() -> None:
    with socket.socketpair()[0].makefile("w") as stream:
        status = os.fstat(stream.fileno())
        assert is_journal(stream, {"JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino}"})
        assert not is_journal(stream, {"JOURNAL_STREAM": f"{status.st_dev}:{status.st_ino + 1}"})
        assert not is_journal(stream, {"JOURNAL_STREAM": ""})
        assert not is_journal(stream, {})


def test_a_stream_in_memory_or_closed_is_not_the_journal(tmp_path: Path) -> None:
    with (tmp_path / "log").open("w") as closed:
        pass
    for stream in (io.StringIO(), closed):
        assert not is_journal(stream, {"JOURNAL_STREAM": "1:2"})


# the log as a whole


def test_an_event_of_the_log_arrives_with_its_fields(
    journal: Journal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(JournalStream.__init__, "__defaults__", (journal.path,))
    monkeypatch.setattr("acsard.host.logs._fitting", lambda stream: "journal")
    log = Log(LogConfig())
    log.event(Event("link_up", "linked", "info"))
    entry = journal.entry()
    log.close()
    assert entry["ACSARD_EVENT"] == "link_up"
    assert entry["MESSAGE"] == "link_up: linked"


def test_without_a_journal_the_log_is_written_as_json(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(JournalStream.__init__, "__defaults__", (str(tmp_path / "nothing"),))
    with (tmp_path / "log").open("w+") as stream:
        monkeypatch.setattr("acsard.host.logs._fitting", lambda stream: "journal")
        log = Log(LogConfig(), stream)
        log.event(Event("link_up", "linked", "info"))
        log.close()
        stream.seek(0)
        assert '"event": "link_up"' in stream.read()


def test_a_journal_that_disappears_raises_no_error(
    journal: Journal, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(JournalStream.__init__, "__defaults__", (journal.path,))
    monkeypatch.setattr("acsard.host.logs._fitting", lambda stream: "journal")
    log = Log(LogConfig())
    journal.close()
    os.unlink(journal.path)
    for _ in range(10):
        log.event(Event("link_up", "linked", "info"))
    log.close()


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


def test_sender_and_count_of_an_event_are_logged_only_if_present(
    tmp_path: Path,
) -> None:
    plain, full = entries(
        tmp_path,
        Event("link_up", "linked"),
        Event("stop", "stopped", "warning", by="joe (native)", count=3),
    )
    assert set(plain) == {"timestamp", "level", "event", "text"}
    assert (full["by"], full["count"], full["level"]) == ("joe (native)", 3, "warning")


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


def test_a_long_value_is_truncated(tmp_path: Path) -> None:
    (line,) = entries(tmp_path, Event("command_refused", "x" * 10_000))
    assert len(line["text"]) == MAX_VALUE_LENGTH


def test_an_event_below_the_level_is_not_written(tmp_path: Path) -> None:
    with (tmp_path / "log").open("w+") as stream:
        log = Log(LogConfig(level="warning"), stream)
        log.event(Event("link_up", "linked"))
        log.event(Event("link_down", "pulled", "warning"))
        log.close()
        stream.seek(0)
        assert [json.loads(line)["event"] for line in stream] == ["link_down"]


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


def test_a_pipe_that_nobody_reads_blocks_neither_output_stream(
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
