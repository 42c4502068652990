"""Tests of a log line: its fields, and that no value can break out of its field."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any, Literal

import pytest

from acsard.config.settings import LogConfig
from acsard.host.logs import MAX_VALUE, Log
from acsard.values import Event


def written(
    path: Path, *events: Event, form: Literal["json", "console", "logfmt"] = "json"
) -> list[str]:
    """Return the lines of a log in this format after these events."""
    with (path / "log").open("w+") as stream:
        log = Log(LogConfig(format=form), stream)
        for event in events:
            log.event(event)
        log.close()
        stream.seek(0)
        return stream.read().splitlines()


def entries(path: Path, *events: Event) -> list[dict[str, Any]]:
    return [json.loads(line) for line in written(path, *events)]


def test_an_event_says_who_and_how_often_only_where_there_is_something_to_say(
    tmp_path: Path,
) -> None:
    plain, full = entries(
        tmp_path,
        Event("link_up", "linked"),
        Event("stop", "stopped", "warning", by="joe (native)", count=3),
    )
    assert set(plain) == {"timestamp", "level", "event", "text"}
    assert (full["by"], full["count"], full["level"]) == ("joe (native)", 3, "warning")


@pytest.mark.parametrize("form", ["json", "console", "logfmt"])
def test_no_text_of_a_stranger_moves_the_cursor_or_makes_a_line(
    tmp_path: Path, form: Literal["json", "console", "logfmt"]
) -> None:
    evil = "cmd/\x1b[2J\n\r\x00\u202eapp"
    (line,) = written(tmp_path, Event("command_refused", evil, by=evil), form=form)
    told = line.replace("\x1b[0m", "").replace("\x1b[1m", "").replace("\x1b[2m", "")
    assert "cmd/\ufffd[2J  \ufffd\ufffdapp" in told.replace("\\ufffd", "\ufffd")
    assert "\x1b[2J" not in line
    assert "\u202e" not in line


def test_a_value_has_an_end(tmp_path: Path) -> None:
    (line,) = entries(tmp_path, Event("command_refused", "x" * 10_000))
    assert len(line["text"]) == MAX_VALUE


def test_an_event_below_the_level_is_not_written(tmp_path: Path) -> None:
    with (tmp_path / "log").open("w+") as stream:
        log = Log(LogConfig(format="json", level="warning"), stream)
        log.event(Event("link_up", "linked"))
        log.event(Event("link_down", "pulled", "warning"))
        log.close()
        stream.seek(0)
        assert [json.loads(line)["event"] for line in stream] == ["link_down"]


def test_from_another_level_on_it_tells_more_or_less(tmp_path: Path) -> None:
    with (tmp_path / "log").open("w+") as stream:
        log = Log(LogConfig(format="json", level="warning"), stream)
        for level in ("warning", "info", "error", "info"):
            log.use(LogConfig(format="json", level=level))
            log.event(Event("mode", level))
        log.close()
        stream.seek(0)
        told = [json.loads(line) for line in stream.read().splitlines()]
    assert [line["text"] for line in told] == ["info", "info"]
    assert all(set(line) == {"timestamp", "level", "event", "text"} for line in told)
