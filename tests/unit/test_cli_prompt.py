"""Tests of the prompt at a terminal, and of the prompt that asks no questions."""

from __future__ import annotations

import os
import pty
import re
import threading
import time
from collections.abc import Callable, Iterator

import pytest

from acsard.checkup.findings import Finding
from acsard.host.terminal_modes import single_key_mode
from acsard.terminal.output import plain
from acsard.terminal.prompt import NobodyError, NumberQuestion, Prompt, TerminalPrompt, row

DISTANCE = NumberQuestion("How far?", "m", 0.5, 3.0)
OPTIONAL = NumberQuestion("How far, if you like?", "m", 0.0, 3.0, 0.0)

Types = Callable[[str], None]

pytestmark = pytest.mark.timeout(30)


@pytest.fixture
def types(monkeypatch: pytest.MonkeyPatch) -> Iterator[Types]:
    """Return a function that types a text on the terminal that is standard input.

    It types after a delay because the prompt discards everything that was typed before the question
    appeared.
    """
    master, slave = pty.openpty()
    hands: list[threading.Timer] = []

    def types(text: str) -> None:
        hands.append(threading.Timer(0.1 * (len(hands) + 1), os.write, [master, text.encode()]))
        hands[-1].start()

    with open(slave) as terminal:
        monkeypatch.setattr("sys.stdin", terminal)
        yield types
    for hand in hands:
        hand.join()
    os.close(master)


def test_a_number_is_asked_for_until_it_is_valid_and_within_its_bounds(
    types: Types, capsys: pytest.CaptureFixture[str]
) -> None:
    with single_key_mode():
        person = TerminalPrompt()
        for line in ("far\n", "0.1\n", "-2\n", "\n", "1,75\n"):
            types(line)
        assert person.number(DISTANCE) == 1.75
    assert capsys.readouterr().err.count("from 0.5 to 3") == 4


@pytest.mark.parametrize("asked", [lambda p: p.number(DISTANCE), lambda p: p.start("Go.")])
def test_q_quits_at_every_question(types: Types, asked: Callable[[TerminalPrompt], object]) -> None:
    with single_key_mode():
        person = TerminalPrompt()
        types("q\n")
        with pytest.raises(KeyboardInterrupt):
            asked(person)


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


def test_a_line_that_was_typed_before_the_question_does_not_answer_it(types: Types) -> None:
    types("fl\n")
    time.sleep(0.4)
    types("rr\n")
    assert TerminalPrompt().ask("Which wheel did motor b turn?", ("fl", "rr")) == "rr"


def test_nothing_but_enter_starts_a_leg(types: Types) -> None:
    with single_key_mode():
        person = TerminalPrompt()
        types("x ")
        types("\n")
        types(" ")
        person.start("Go.")
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
