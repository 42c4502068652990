"""Tests of the prompt at a terminal, and of the prompt that asks no questions."""

from __future__ import annotations

import os
import pty
import re
import select
import termios
import threading
from collections import deque
from collections.abc import Callable, Iterator
from typing import TextIO

import pytest

from acsard.checkup.findings import Finding
from acsard.host.terminal_modes import single_key_mode
from acsard.terminal.output import plain
from acsard.terminal.prompt import NobodyError, NumberQuestion, Prompt, TerminalPrompt, row
from tests.system.harness import until

DISTANCE = NumberQuestion("How far?", "m", 0.5, 3.0)
OPTIONAL = NumberQuestion("How far, if you like?", "m", 0.5, 3.0, 0.0)

pytestmark = pytest.mark.timeout(30)


class Terminal:
    """The terminal that is standard input, with a person who types when it is read."""

    def __init__(self, master: int, terminal: TextIO) -> None:
        self._master, self._terminal = master, terminal
        self._texts, self._read = deque[str](), os.read

    def types(self, text: str) -> None:
        os.write(self._master, text.encode())
        until(lambda: select.select([self._terminal], [], [], 0)[0], 10.0, "it arrives")

    def answers(self, *texts: str) -> None:
        """Type one of these texts before each read from now on."""
        self._texts.extend(texts)

    def read(self, fd: int, size: int) -> bytes:
        if fd == self._terminal.fileno() and self._texts:
            self.types(self._texts.popleft())
        return self._read(fd, size)


@pytest.fixture
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[Terminal]:
    master, slave = pty.openpty()
    with open(slave) as stream:
        terminal = Terminal(master, stream)
        monkeypatch.setattr("sys.stdin", stream)
        monkeypatch.setattr(os, "read", terminal.read)
        yield terminal
    os.close(master)


def test_a_number_is_asked_for_until_it_is_valid_and_within_its_bounds(
    terminal: Terminal, capsys: pytest.CaptureFixture[str]
) -> None:
    terminal.answers("far\n", "0.1\n", "-2\n", "\n", "1,75\n")
    with single_key_mode():
        assert TerminalPrompt().number(DISTANCE) == 1.75
        terminal.answers("0.1\n", "\n")
        assert TerminalPrompt().number(OPTIONAL) == 0.0
    assert capsys.readouterr().err.count("from 0.5 to 3") == 5


@pytest.mark.parametrize("asked", [lambda p: p.number(DISTANCE), lambda p: p.start("Go.")])
def test_q_quits_at_every_question(
    terminal: Terminal, asked: Callable[[TerminalPrompt], object]
) -> None:
    terminal.answers("q\n")
    with single_key_mode(), pytest.raises(KeyboardInterrupt):
        asked(TerminalPrompt())


@pytest.mark.parametrize(
    "asked",
    [
        lambda p: p.ask("Which wheel?", ("fl", "rr")),
        lambda p: p.number(DISTANCE),
        lambda p: p.start("Go."),
        lambda p: p.keys(5.0),
    ],
)
@pytest.mark.parametrize("when", ["before the question", "at the question"])
def test_a_terminal_that_closes_ends_the_question_without_another_error(
    asked: Callable[[TerminalPrompt], object], when: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    master, slave = pty.openpty()
    hand = threading.Timer(0.0 if when == "before the question" else 0.3, os.close, [master])
    with open(slave) as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        hand.start()
        if when == "before the question":
            hand.join()
        with pytest.raises(KeyboardInterrupt):
            asked(TerminalPrompt())
    hand.join()


def test_a_line_that_was_typed_before_the_question_does_not_answer_it(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch
) -> None:
    flush = termios.tcflush

    def flushed(stream: TextIO, queue: int) -> None:
        flush(stream, queue)
        terminal.types("rr\n")

    terminal.types("fl\n")
    monkeypatch.setattr(termios, "tcflush", flushed)
    assert TerminalPrompt().ask("Which wheel did motor b turn?", ("fl", "rr")) == "rr"


@pytest.mark.parametrize(
    ("typed", "answers", "meant"),
    [
        ("Front right\n", ("fr", "fl", "none", "again"), "fr"),
        ("n\n", ("fr", "fl", "none", "again"), "none"),
        ("f\nfl\n", ("fr", "fl", "none", "again"), "fl"),  # "f" could be two of them
        ("f\n", ("forward", "back"), "forward"),
        ("\nb\n", ("forward", "back"), "back"),
        ("l\nlifted\n", ("lifted",), "lifted"),  # the only answer is a confirmation: in full
    ],
)
def test_an_answer_may_be_spoken_out_or_begun(
    terminal: Terminal, monkeypatch: pytest.MonkeyPatch,
    typed: str, answers: tuple[str, ...], meant: str,
) -> None:  # fmt: skip
    monkeypatch.setattr(termios, "tcflush", lambda *_: terminal.types(typed))
    assert TerminalPrompt().ask("Which?", answers) == meant


def test_nothing_but_enter_starts_a_leg(terminal: Terminal) -> None:
    terminal.answers("x ", "\n")
    with single_key_mode():
        person = TerminalPrompt()
        person.start("Go.")
        terminal.types(" ")
        assert person.keys(5.0) == " "


def test_without_a_prompt_an_optional_number_is_0_and_a_required_one_is_an_error() -> None:
    assert Prompt().number(OPTIONAL) == 0.0
    with pytest.raises(NobodyError, match=re.escape("run it without --yes")):
        Prompt().number(DISTANCE)


def test_a_row_has_the_verdict_the_meaning_and_the_remedy() -> None:
    finding = Finding("watchdog", "FAIL", "none", "it drives on " * 20, "give it one")
    head, *rest = plain(row(finding), width=100).splitlines()
    assert head == "FAIL    watchdog               none"
    assert all(line.startswith(" " * 8) for line in rest)
    assert rest[-1] == "        -> give it one"
