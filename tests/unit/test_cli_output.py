"""Tables and sentences fit the width of a terminal.

In a pipe or a file they have no colours and are not shortened.
"""

from __future__ import annotations

import os
import sys

import pytest
from rich.text import Text

from acsard.terminal.output import plain, show, show_whole, table

COMMAND = "acsard set limits.linear_speed 0.8"

ROWS = table([("odom", "1", "a long sentence " * 6), ("tf", "100", "short")], ("KEY", "N"), {1})


def test_a_pipe_gets_whole_rows_without_colours(
    capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("COLUMNS", "30")
    monkeypatch.setenv("FORCE_COLOR", "1")
    show(ROWS)
    show_whole(Text(COMMAND, "red"))
    text = capsys.readouterr().out
    assert "\x1b" not in text
    assert len(text.splitlines()) == 4


def test_a_terminal_wraps_sentences_in_its_width_but_no_row_of_a_table_and_no_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setenv("COLUMNS", "30")
    monkeypatch.setenv("TERM", "xterm")
    monkeypatch.delenv("NO_COLOR", raising=False)
    ours, theirs = os.openpty()
    with os.fdopen(theirs, "w") as stream:
        monkeypatch.setattr(sys, "stdout", stream)
        show("one two " * 10, table([(Text("mark", "red"), "")]), most=100)
        show(ROWS)
        show_whole(Text(COMMAND, "red"))
        text = ""
        while text.count("\x1b[0m") < 2:
            text += os.read(ours, 4096).decode()
    os.close(ours)
    lines = text.splitlines()
    assert [line.strip() for line in lines[:4]] == [
        "one two one two one two one", "two one two one two one two", "one two one two one two",
        "\x1b[31mmark\x1b[0m",
    ]  # fmt: skip
    assert lines[4:7] == plain(ROWS).splitlines()
    assert lines[7] == f"\x1b[31m{COMMAND}\x1b[0m"
