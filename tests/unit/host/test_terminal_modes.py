"""Tests of colours, and of the terminal that reads single keys for keyboard driving."""

from __future__ import annotations

import io
import os
import pty
import select
import sys
import termios
from collections.abc import Iterator
from typing import TextIO

import pytest

from acsard.core.config.settings import LogConfig
from acsard.core.values import Event
from acsard.host.logs import Log
from acsard.host.terminal_modes import may_use_color, single_key_mode


@pytest.fixture(name="terminal")
def _terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[tuple[int, TextIO]]:
    """Yield both ends of a terminal that supports colours."""
    monkeypatch.delenv("NO_COLOR", raising=False)
    monkeypatch.setenv("TERM", "xterm-256color")
    ours, theirs = os.openpty()
    with os.fdopen(theirs, "w") as stream:
        yield ours, stream
    os.close(ours)


def test_a_terminal_has_colours_and_a_file_has_none(terminal: tuple[int, TextIO]) -> None:
    assert may_use_color(terminal[1])
    assert not may_use_color(io.StringIO())


@pytest.mark.parametrize(("name", "value"), [("NO_COLOR", "1"), ("TERM", "dumb")])
def test_the_environment_can_disable_colours(
    terminal: tuple[int, TextIO], monkeypatch: pytest.MonkeyPatch, name: str, value: str
) -> None:
    monkeypatch.setenv(name, value)
    assert not may_use_color(terminal[1])


def test_an_empty_no_color_variable_does_not_disable_colours(
    terminal: tuple[int, TextIO], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("NO_COLOR", "")
    assert may_use_color(terminal[1])


@pytest.mark.parametrize("wanted", [True, False])
def test_the_log_of_a_terminal_is_coloured_unless_no_color_is_set(
    terminal: tuple[int, TextIO], monkeypatch: pytest.MonkeyPatch, wanted: bool
) -> None:
    if not wanted:
        monkeypatch.setenv("NO_COLOR", "1")
    ours, stream = terminal
    logs = Log(LogConfig(), stream)
    logs.event(Event("stop", "stopped"))
    logs.close()
    assert (b"\x1b[" in os.read(ours, 4096)) is wanted


def test_the_console_s_log_in_a_file_has_no_colours(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("acsard.host.logs._fitting", lambda stream: "console")
    stream = io.StringIO()
    logs = Log(LogConfig(), stream)
    logs.event(Event("stop", "stopped"))
    logs.close()
    assert "stopped" in stream.getvalue()
    assert "\x1b" not in stream.getvalue()


CTRL_S = b"\x13"


def test_ctrl_s_is_read_as_a_key_and_the_terminal_modes_are_restored_afterwards(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    master, slave = pty.openpty()
    with os.fdopen(slave) as terminal, os.fdopen(master, "rb", 0) as far:
        monkeypatch.setattr(sys, "stdin", terminal)
        before = termios.tcgetattr(terminal)
        assert before[0] & termios.IXON
        with single_key_mode():
            os.write(far.fileno(), CTRL_S)
            assert os.read(terminal.fileno(), 9) == CTRL_S
            os.write(terminal.fileno(), b"written")
            assert select.select([far], [], [], 5.0)[0]
            assert far.read(9) == b"written"
        assert termios.tcgetattr(terminal) == before
