"""The prompt for `--json-lines`: another program, such as the robot's page, asks the person.

This module writes texts and questions to standard output as JSON objects, one per line. It reads
answers, key presses and signs of life from standard input. It interrupts the subcommand, as Ctrl-C
does, if the input ends. It does the same if the other program sends no line for
`MAX_INPUT_SILENCE_S` while something may move.

deploy/web/README.md describes the fields. The docstrings of the classes below become part of the
OpenAPI document (`web/openapi.py`).
"""

from __future__ import annotations

import os
import select
import signal
import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from itertools import count
from typing import Self, TypeVar

import msgspec
from msgspec import Struct

from acsard.checkup.findings import Finding
from acsard.host.config_file import change, require_changeable, writable
from acsard.host.errors import MendableError
from acsard.terminal.prompt import NumberQuestion

T = TypeVar("T")

# The other program sends a line every 0.1 s, even if the line is only `{}`. TCP resends a lost
# packet after 0.2 s, and again after another 0.4 s. So a line that is lost twice still arrives
# within this time. If this computer is too busy to keep the limit, a guided drive ends because it
# receives nothing from the daemon for 0.5 s (calibration/guided/leg_driver.py). When a person
# drives by hand, the timeout of the command source replaces this limit.
MAX_INPUT_SILENCE_S = 0.9
"""Longest time without a line from the other program while something may move, s.

After a longer time the subcommand is interrupted and sends zero speeds. So the robot begins to stop
within a second of the other program's last line.
"""

POLL_S = 0.05

MAX_LINE_BYTES = 65536
"""Maximum length of an input line, bytes. A longer line interrupts the subcommand."""


class Line(Struct, frozen=True):
    """An input line: an answer, a key press, or only a sign of life.

    If the line is an answer, `answer` is the number of the question, and `value` is the answer.
    Otherwise `answer` is 0. If the line is a key press, `key` is true. Unknown fields are ignored.
    """

    answer: int = 0
    value: str | float | None = None
    key: bool = False


# The lines of the output.


class Subject(Struct, frozen=True):
    """The first line: the robot or the board that is checked or calibrated."""

    subject: str
    simulated: bool


class JobMessage(Struct, frozen=True):
    """A message for the person. It stays on the screen."""

    message: str


class Doing(Struct, frozen=True):
    """The current activity. It replaces the previous activity on the screen."""

    doing: str


class Progress(Struct, frozen=True):
    """The completed share of the present drive or of the check, from 0 to 1."""

    progress: float


class Question(Struct, frozen=True, omit_defaults=True, kw_only=True):
    """A question for the person.

    The answer is one of the texts in `answers`. If `answers` is empty, the answer is a number from
    `least` to `most`, in the unit `unit`.
    """

    question: int
    """Number of the question. The line with the answer must contain this number."""
    words: str
    answers: Sequence[str] = ()
    unit: str = ""
    least: float | None = None
    most: float | None = None
    usual: float | None = None
    """Number that an empty answer stands for. Without it, an empty answer is rejected."""
    leg: bool = False
    """True if the robot drives after the answer. A key press stops this drive."""
    by_key: bool = False
    """True if a key press is the intended end of the drive that follows the answer."""
    wrong: str = ""
    """Explanation why the previous answer to this question was rejected, or an empty text."""


class FindingMessage(Struct, frozen=True):
    """One finding of a check. It is sent as soon as it is known."""

    finding: Finding


class Result(Struct, frozen=True):
    """The complete result as text, as a terminal shows it. After this line nothing moves."""

    result: str


class JsonPrompt:
    """Prompt that exchanges JSON lines with another program over standard input and output.

    It is a context manager: it reads standard input until the end of the `with` block.
    """

    def __init__(self) -> None:
        self._input, self._left = sys.stdin.fileno(), False
        self._lines, self._numbers = msgspec.json.Decoder(Line), count(1)
        self._news = threading.Condition()
        self._open, self._answer = 0, Line()
        self._pressed = False
        self._found = 0
        self._moves = False
        """True while the robot may move because of this subcommand. In this time, the person must
        be able to stop the robot."""
        self._reader = threading.Thread(target=self._listen, name="standard input", daemon=True)

    def __enter__(self) -> Self:
        self._reader.start()
        return self

    def __exit__(self, *error: object) -> None:
        with self._news:
            self._left = True
        # Wait with a time limit. The thread hangs if it prints while the other program does not
        # read.
        self._reader.join(1.0)

    # Output

    def begin(self, subject: str, *, simulated: bool) -> None:
        self._send(Subject(subject, simulated))

    def show_text(self, text: str) -> None:
        self._send(JobMessage(text))

    def doing(self, text: str) -> None:
        self._send(Doing(text))

    def progress(self, share: float) -> None:
        self._send(Progress(round(share, 3)))

    def show_finding(self, finding: Finding) -> None:
        self._found += 1
        self._send(FindingMessage(finding))
        # A complete check has about 16 findings.
        self.progress(min(0.99, self._found / 16))

    def result(self, text: str) -> None:
        """Send the result `text`. Call this only when nothing moves any more.

        From now on, a silence of the other program does not interrupt the subcommand.
        """
        self._moves = False
        self.progress(1.0)
        self._send(Result(text.strip("\n")))

    def ask(self, question: str, answers: Sequence[str]) -> str:
        return self._choose(question, answers)

    def start(self, text: str, by_key: bool = False) -> None:
        self._choose(text, ("start",), leg=True, by_key=by_key)

    def number(self, ask: NumberQuestion) -> float:
        def read(value: str | float | None) -> float:
            return ask.number("" if value is None else str(value))

        return self._ask_until_valid(
            read, words=ask.words, unit=ask.unit, least=ask.least, most=ask.most, usual=ask.usual
        )

    def keys(self, wait_s: float) -> str:
        """Wait up to `wait_s` s for a key press. Return " " if a key was pressed, else "".

        A key press before this call counts too, but only if it came after the last answer. Each key
        press is returned only once.
        """
        with self._news:
            self._news.wait_for(lambda: self._pressed, wait_s)
            pressed, self._pressed = self._pressed, False
            return " " if pressed else ""

    def offer(self, config: str | None, keys: Mapping[str, object], trouble: str = "") -> bool:
        """Ask whether to write `keys` into the configuration file, and do so if the person agrees.

        If there is a reason not to write, or if the file cannot be changed, send a message with the
        reason, and do not ask.
        """
        try:
            if trouble:
                raise MendableError(trouble)
            file = writable(config)
            require_changeable(file, keys)
        except MendableError as error:
            self.show_text(f"acsard cannot write the configuration file: {error}")
            return False
        wanted = self.ask(
            f"Write these lines into {file}? The comments in the file stay.", ("write", "leave")
        )
        self._moves = False
        if wanted == "write":
            change(file, keys)
            self.show_text(f"{file}: written")
        return wanted == "write"

    def _choose(self, words: str, answers: Sequence[str], **more: bool) -> str:
        def chosen(value: str | float | None) -> str:
            if value not in answers:
                raise ValueError(f"answer with one of: {', '.join(answers)}")
            return str(value)

        return self._ask_until_valid(chosen, words=words, answers=answers, **more)

    def _send(self, message: Struct) -> None:
        print(msgspec.json.encode(message).decode(), flush=True)

    def _ask_until_valid(self, read: Callable[[str | float | None], T], **about: object) -> T:
        """Ask until `read` accepts the answer.

        To reject it, `read` raises `ValueError` with a description of valid answers.
        """
        self._moves, wrong = False, ""
        while True:
            question = msgspec.convert(
                {"question": next(self._numbers), "wrong": wrong, **about}, Question
            )
            self._open = question.question
            # Do not take the lock here: a program that does not read its output must still be able
            # to send.
            self._send(question)
            with self._news:
                while self._open:
                    # Wait with a time limit, because a signal that arrives just before the wait
                    # begins does not end it.
                    self._news.wait(POLL_S)
            try:
                answer = read(self._answer.value)
            except ValueError as error:
                wrong = str(error)
                continue
            self._moves = True
            return answer

    # Input

    def _listen(self) -> None:
        try:
            self._end(self._heard_out())
        except BaseException as error:
            self._end(f"standard input cannot be read: {error}")
            raise

    def _heard_out(self) -> str:
        """Read lines from standard input until the end of the `with` block, then return "".

        Return a reason to interrupt the subcommand if the input ends earlier, if a line is too
        long, or if no line arrives in time.
        """
        buffer, heard_s = b"", time.monotonic()
        while not self._left:
            if self._readable(POLL_S):
                read = os.read(self._input, 4096)
                *whole, buffer = (buffer + read).split(b"\n")
                if not read:
                    return "the program that shows the questions to the operator has ended"
                if len(buffer) > MAX_LINE_BYTES:
                    return f"a line on standard input has more than {MAX_LINE_BYTES} bytes"
                for line in whole:
                    self._take(line)
                heard_s = time.monotonic()
            elif (
                self._moves
                and time.monotonic() - heard_s > MAX_INPUT_SILENCE_S
                and not self._readable(0.0)
            ):
                return (
                    f"the operator's page or program sent no sign of life for "
                    f"{MAX_INPUT_SILENCE_S:g} s"
                )
        return ""

    def _readable(self, wait_s: float) -> bool:
        return bool(select.select([self._input], [], [], wait_s)[0])

    def _take(self, line: bytes) -> None:
        try:
            message = self._lines.decode(line)
        except (msgspec.MsgspecError, ValueError, RecursionError):
            # The line does not answer the question, which therefore stays open.
            return
        with self._news:
            if message.key:
                self._pressed = True
            elif message.answer and message.answer == self._open:
                # Forget a key that was pressed before the answer. A later key press stops the
                # drive.
                self._open, self._answer, self._pressed = 0, message, False
            self._news.notify_all()

    def _end(self, why: str) -> None:
        main = threading.main_thread().ident
        assert main is not None
        with self._news:
            if self._left:
                return
            # Interrupt the main thread first, because that stops the wheels. Printing the message
            # blocks if the other program does not read.
            signal.pthread_kill(main, signal.SIGINT)
        with suppress(OSError):
            print(f"acsard: {why}", file=sys.stderr, flush=True)
