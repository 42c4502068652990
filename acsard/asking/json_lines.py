"""`--json-lines`: the person beside the robot is asked by a program, the robot's page say.

Out go JSON objects, one a line, on standard output: what is told and asked. In come answers, keys,
and signs that somebody is still there, on standard input. The end of the input ends it as Ctrl-C
does, and so does its silence while something may move: the program speaks as long as it hears the
person. deploy/web/README.md has the fields.
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
from typing import TYPE_CHECKING, Self, TypeVar

import msgspec
from msgspec import Struct

from acsard.asking.attendant import number_of
from acsard.calibration.guided.steps import Ask
from acsard.host.config_file import writable
from acsard.host.errors import MendableError
from acsard.host.files import change, require_changeable
from acsard.web.lines import Doing, Found, Progress, Question, Result, Subject, Told

if TYPE_CHECKING:
    from acsard.checkup.findings import Finding
    from acsard.checkup.report import Report

T = TypeVar("T")

HEARD_S = 0.9
"""Who is to stop what moves is heard so often at least: zeros go out a second after the last sign.

He says something every 0.1 s, if only `{}`. What a network loses TCP sends again after 0.2 s, and
once more after 0.4 s: what is lost twice still comes in time, and a STOP that is lost three times
would be as late. A computer too busy for this has ended the leg before, by 0.5 s without a word of
the daemon (calibration/guided/riding.py). Driving by hand every command is a sign, and the source's
timeout holds."""

LISTEN_S = 0.05

LEAVING_S = 1.0
"""Whoever does not read why it ends is waited for so long."""

LINE_BYTES = 65536
"""Of a line that comes; who sends a longer one has lost his mind, and is not listened to."""

CHECK_STEPS = 16
"""Findings of a check that comes to its end, about: its progress is told by them."""

KEY = " "


class Line(Struct, frozen=True):
    """What comes in; other fields are ignored."""

    answer: int = 0
    value: str | float | None = None
    key: bool = False


class JsonLines:
    """Standard input and output as a conversation; leaving ends it."""

    def __init__(self) -> None:
        self._input, self._left = sys.stdin.fileno(), False
        self._lines, self._numbers = msgspec.json.Decoder(Line), count(1)
        self._news = threading.Condition()
        self._open, self._answer = 0, Line()
        self._pressed = False
        self._moves = False
        """Something may move, which a person has begun and must be able to stop."""
        self._reader = threading.Thread(target=self._listen, name="standard input", daemon=True)

    def __enter__(self) -> Self:
        self._reader.start()
        return self

    def __exit__(self, *error: object) -> None:
        with self._news:
            self._left = True
        self._reader.join(LEAVING_S)

    # out

    def begin(self, subject: str, *, simulated: bool) -> None:
        """What it is about, first of all."""
        self._tell(Subject(subject, simulated))

    def told(self, text: str) -> None:
        """Tell what stays."""
        self._tell(Told(text))

    def progress(self, share: float) -> None:
        """So much is done."""
        self._tell(Progress(round(share, 3)))

    def shows(self, text: str) -> None:
        """What was found, as at a terminal; nothing moves any more."""
        self._moves = False
        self._tell(Result(text.strip("\n")))

    def choose(self, words: str, answers: Sequence[str], **more: bool) -> str:
        """One of the answers; whatever else is said is told to be none, and asked again."""

        def chosen(value: str | float | None) -> str:
            if value not in answers:
                raise ValueError(f"one of: {', '.join(answers)}")
            return str(value)

        return self._ask(chosen, words=words, answers=answers, **more)

    def offer(self, config: str | None, keys: Mapping[str, object], trouble: str = "") -> bool:
        """Write these keys into the configuration file, where that can be and the person wants it;
        `trouble` is why it must not. Whether it was done."""
        try:
            if trouble:
                raise MendableError(trouble)
            file = writable(config)
            require_changeable(file, keys)
        except MendableError as error:
            self.told(f"Nothing can be written from here: {error}")
            return False
        wanted = self.choose(f"Write these lines into {file}? Comments stay.", ("write", "leave"))
        self._moves = False
        if wanted == "write":
            change(file, keys)
            self.told(f"{file}: written")
        return wanted == "write"

    def _tell(self, message: Struct) -> None:
        print(msgspec.json.encode(message).decode(), flush=True)

    def _ask(self, read: Callable[[str | float | None], T], **about: object) -> T:
        """What `read` makes of the answer; it raises `ValueError` with what that has to be."""
        self._moves, wrong = False, ""
        while True:
            question = msgspec.convert(
                {"question": next(self._numbers), "wrong": wrong, **about}, Question
            )
            self._open = question.question
            # Without the lock: who does not read what he is told is listened to all the same.
            self._tell(question)
            with self._news:
                while self._open:
                    # Not for ever: a signal just before it begins to wait would not wake it.
                    self._news.wait(LISTEN_S)
            try:
                got = read(self._answer.value)
            except ValueError as error:
                wrong = str(error)
                continue
            self._moves = True
            return got

    # in

    def pressed(self, wait_s: float) -> bool:
        """A key was, since the last answer or look; waits that long for one."""
        with self._news:
            self._news.wait_for(lambda: self._pressed, wait_s)
            pressed, self._pressed = self._pressed, False
            return pressed

    def _listen(self) -> None:
        """Whatever ends it but the end of the conversation ends what is done."""
        try:
            self._end(self._heard_out())
        except BaseException as error:
            self._end(f"what comes in cannot be read: {error}")
            raise

    def _heard_out(self) -> str:
        """Take what comes in; why no more does, or "" when the conversation is over."""
        held, heard_s = b"", time.monotonic()
        while not self._left:
            if self._readable(LISTEN_S):
                read = os.read(self._input, 4096)
                *whole, held = (held + read).split(b"\n")
                if not read or len(held) > LINE_BYTES:
                    return "the program that asks is gone"
                for line in whole:
                    self._take(line)
                heard_s = time.monotonic()
            elif self._moves and time.monotonic() - heard_s > HEARD_S and not self._readable(0.0):
                return f"nothing was heard for {HEARD_S:g} s of who is to stop it"
        return ""

    def _readable(self, wait_s: float) -> bool:
        """Something has come, or does within so long."""
        return bool(select.select([self._input], [], [], wait_s)[0])

    def _take(self, line: bytes) -> None:
        try:
            said = self._lines.decode(line)
        except (msgspec.MsgspecError, ValueError, RecursionError):
            return  # the question stays open
        with self._news:
            if said.key:
                self._pressed = True
            elif said.answer and said.answer == self._open:
                # A key from before stops nothing, and one from now on does.
                self._open, self._answer, self._pressed = 0, said, False
            self._news.notify_all()

    def _end(self, why: str) -> None:
        main = threading.main_thread().ident
        assert main is not None
        with self._news:
            if self._left:
                return
            # First what stops the wheels: nobody may be there any more to be told.
            signal.pthread_kill(main, signal.SIGINT)
        with suppress(OSError):
            print(f"acsard: {why}", file=sys.stderr, flush=True)


class JsonAttendant(JsonLines):
    """Beside a robot that is calibrated: `attendant.Attendant`."""

    def say(self, text: str) -> None:
        """Tell."""
        self.told(text)

    def start(self, text: str, by_key: bool = False) -> None:
        """Return when the leg may begin."""
        self.choose(text, ("start",), leg=True, by_key=by_key)

    def number(self, ask: Ask) -> float:
        """What was read off."""

        def read(value: str | float | None) -> float:
            number = number_of("" if value is None else str(value), ask.usual)
            if not ask.least <= number <= ask.most:
                raise ValueError(f"a number of {ask.unit} from {ask.least:g} to {ask.most:g}")
            return number

        return self._ask(
            read, words=ask.words, unit=ask.unit, least=ask.least, most=ask.most, usual=ask.usual
        )

    def keys(self, wait_s: float) -> str:
        """The key that was pressed."""
        return KEY if self.pressed(wait_s) else ""


class JsonPerson(JsonLines):
    """At a board that is checked: `person.Screen`."""

    def __init__(self) -> None:
        super().__init__()
        self._found = 0

    def say(self, text: str) -> None:
        """Tell what happens now."""
        self._tell(Doing(text))

    def ask(self, question: str, answers: Sequence[str]) -> str:
        """One of the answers."""
        return self.choose(question, answers)

    def found(self, finding: Finding) -> None:
        """As it is made."""
        self._found += 1
        self._tell(Found(finding))
        self.progress(min(0.99, self._found / CHECK_STEPS))

    def result(self, found: Report, where: str) -> None:
        """All of it together."""
        from acsard.checkup.report import summary

        self.progress(1.0)
        self.shows(summary(found, where))
