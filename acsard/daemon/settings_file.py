"""The configuration file of a running daemon: compared with the settings in force, and changed.

The file and the settings differ after a `set` that was not written, and after a person has edited
the file. A thread reads the file again whenever it changes.

A `set` with `keep` passes this module twice. First the thread checks that the file can be changed;
otherwise nothing is set. Then the robot obeys, and the thread changes the file. The control loop
hands over requests and answers, and never waits for the disk.
"""

from __future__ import annotations

import errno
import stat
import threading
from collections import deque
from collections.abc import Callable
from pathlib import Path
from typing import Literal

from msgspec import Struct
from msgspec.structs import replace

from acsard.core.config.live import changed, differences
from acsard.core.config.lowered import TABLE, lowered
from acsard.core.config.parsing import ConfigError
from acsard.core.config.settings import Config, LimitsConfig
from acsard.core.formatting import listed, printable
from acsard.core.messages.encodings import Decoder
from acsard.core.messages.schema import Settings
from acsard.core.values import NS_PER_S, Answer, Event, Latches, Request
from acsard.host.config_file import Edit, keep, keepable
from acsard.host.errors import MendableError
from acsard.host.mailbox import Mailbox

LOOK_S = 2.0
"""Pause between two looks at the file."""

NAMED = 3
"""Largest number of differing settings that the text names, because `state` must stay short."""

MAX_TEXT = 200
"""Largest number of characters of the text."""

PATIENCE_NS = 5 * NS_PER_S // 2
"""Time from a `set` with `keep` to its answer, ns. A client waits for 3 s."""

JOBS = 32
"""Largest number of requests that have no answer yet. Further ones are refused at once."""

Signature = tuple[int, int, int]
"""Inode, size in bytes and time of change in ns of a file."""

_decoder = Decoder(Settings)


def keeps(encoding: str, payload: bytes) -> bool:
    """Return whether the payload of a `set`, already checked, asks to change the file too."""
    return _decoder.decode(encoding, payload).keep


class _Checked(Struct, frozen=True):
    """A request whose settings can be written."""

    request: Request
    edit: Edit


class _Pending(Struct):
    """A request that has no answer yet."""

    request: Request
    due_ns: int
    """Monotonic time at which it gets an answer in any case."""
    edit: Edit | None = None
    """The checked change of the file; None before the check."""
    answer: Answer | None = None
    """The robot's answer; None before the robot has obeyed."""


class SettingsFile:
    """The configuration file of the daemon. Call `use` whenever the settings in force change."""

    def __init__(
        self, file: Path | None, parse: Callable[[bytes], Config], started: Config
    ) -> None:
        """Compare nothing until `start`.

        Args:
            file: the file that the daemon has read, or None for the built-in defaults.
            parse: returns the configuration of a daemon that starts with this text.
            started: the configuration with which the daemon has started.
        """
        self.differ = ""
        """Settings in force that differ from the file, or why the file is unusable, in words; else
        empty."""
        self._file, self._parse = file, parse
        self._in_force = self._written = started
        """The settings in force, and those of the file."""
        self._signature: Signature | None = None
        """The signature of the file that `_written` was read from."""
        self._box = Mailbox[Request | Literal["look"]](JOBS)
        """The requests that the thread is to check."""
        self._changes = deque[tuple[Edit, Answer]]()
        """The changes that the thread is to write, each with the robot's answer and before the next
        check."""
        self._results = Mailbox[_Checked | Answer](JOBS)
        self._pending: dict[int, _Pending] = {}
        self._started = self._limits = started.limits
        """The limits with which the daemon has started, and those with the ones written since."""
        self._kept: tuple[Latches, LimitsConfig, LimitsConfig, Latches] | None = None
        """The arguments of the last call of `latches`, with `_limits`, and its result."""

    # the control loop's side

    def start(self) -> None:
        """Start the thread. If the process cannot start one, nothing is compared."""
        thread = threading.Thread(target=self._work, name="settings file", daemon=True)
        try:
            thread.start()
        except RuntimeError as error:
            self.differ = f"this process cannot compare them with the file ({error})"

    def use(self, config: Config) -> None:
        """Take the configuration in force from now on, without a speed limit."""
        self._in_force = config
        self._look()

    def keep(self, request: Request, now_ns: int) -> None:
        """Take a `set` with `keep`. `results` returns it once its settings can be written."""
        full = len(self._pending) >= JOBS
        # A request that is overdue from the start gets its answer in this step.
        self._pending[request.id] = _Pending(request, now_ns - 1 if full else now_ns + PATIENCE_NS)
        if not full:
            self._box.put(request)

    def _look(self) -> None:
        """Wake the thread. A request that waits does so too, and must not be displaced."""
        if not self._box.waiting:
            self._box.put("look")

    def obeyed(self, answer: Answer) -> bool:
        """Take the robot's answer to a request that `results` has returned.

        Return True if the thread now writes the settings: `results` will return the answer. Return
        False if there is nothing to write.
        """
        pending = self._pending.get(answer.id)
        if pending is None or pending.edit is None:
            return False
        if not answer.success:
            del self._pending[answer.id]
            return False
        pending.answer = answer
        self._changes.append((pending.edit, answer))
        self._look()
        return True

    def results(self, now_ns: int, events: list[Event]) -> list[Request | Answer]:
        """Return the requests that the robot may obey now, and the answers; add events."""
        if not self._pending:
            return []
        found: list[Request | Answer] = []
        for one in self._results.take():
            number = one.id if isinstance(one, Answer) else one.request.id
            pending = self._pending.get(number)
            if pending is None:
                continue  # it was overdue, and has its answer
            if isinstance(one, _Checked):
                if now_ns > pending.due_ns:
                    continue  # its answer below says that nothing is set
                pending.edit = one.edit
                found.append(one.request)
                continue
            found.append(one)
            del self._pending[number]
            if one.success:
                keys = ", ".join(pending.request.settings)
                # The log puts the kind in front of the text: `written: KEY to FILE`.
                text = f"{keys} to {self._file}"
                events.append(Event("set", text, by=pending.request.by, kind="written"))
        # A request that the robot has gets the robot's answer, so it may not be called "not set".
        overdue = [
            waits
            for waits in self._pending.values()
            if now_ns > waits.due_ns and (waits.edit is None or waits.answer is not None)
        ]
        for waits in overdue:
            del self._pending[waits.request.id]
        return [*found, *map(_overdue, overdue)]

    @property
    def limits(self) -> LimitsConfig:
        """The limits of the daemon's start, with those that it has written since."""
        return self._limits

    def latches(self, latches: Latches, now: LimitsConfig) -> Latches:
        """Return the latches of the robot for the next start, which begins with the file.

        The robot compares its limits with those of its start. If this daemon has written others
        since, a limit is lowered if it is below the one in the file.

        Args:
            latches: the latches of the robot.
            now: the limits in force, without a speed limit.
        """
        file = self._limits
        if file is self._started:
            return latches
        kept = self._kept
        # The latch file is written again only if it gets another object.
        if kept is None or not (kept[0] is latches and kept[1] is now and kept[2] is file):
            result = replace(latches, lowered=lowered(file, now))
            kept = self._kept = latches, now, file, result
        return kept[3]

    def close(self) -> None:
        """Let the thread end."""
        self._box.close()

    # the thread's side

    def _work(self) -> None:
        while not self._box.closed:
            self._box.wait(LOOK_S)
            for job in self._box.take():
                self._write()
                # A request that is overdue has its answer already.
                if isinstance(job, Request) and job.id in self._pending:
                    self._results.put(self._checked(job))
            self._write()
            self.differ = printable(self._difference())[:MAX_TEXT]

    def _write(self) -> None:
        """Write the changes that the robot has obeyed."""
        while self._changes:
            self._results.put(self._written_answer(*self._changes.popleft()))

    def _checked(self, request: Request) -> _Checked | Answer:
        """Return the request if its settings can be written, else the answer that refuses it."""
        try:
            # The robot would refuse these settings even while it stands.
            changed(self._in_force, request.settings, at_rest=True)
        except ConfigError as error:
            return Answer(request.id, False, str(error))
        try:
            return _Checked(request, keepable(self._file, request.settings))
        except MendableError as error:
            return Answer(request.id, False, f"nothing is set: {error}")

    def _written_answer(self, edit: Edit, answer: Answer) -> Answer:
        """Write a change, and return the answer to its request."""
        told = answer.message
        try:
            keep(edit)
        except MendableError as error:
            return Answer(answer.id, False, f"{told}; until the next start: {error}")
        limits = {
            key.removeprefix(TABLE): float(value)  # type: ignore[arg-type]
            for key, value in edit.keys.items()
            if key.startswith(TABLE)
        }
        if limits:
            self._limits = replace(self._limits, **limits)
        return Answer(answer.id, True, f"{told}; written to {edit.file}")

    def _difference(self) -> str:
        """Return the text of `differ`."""
        try:
            self._read()
        except OSError as error:
            self._signature = None
            return f"the file cannot be read: {error.strerror or error}"
        except ConfigError as error:
            self._signature = None
            return f"the file cannot be used at the next start: {error.problems[0]}"
        found = differences(self._in_force, self._written)
        told = [one.words(key) for key, one in found.items()]
        return listed(told, NAMED)

    def _read(self) -> None:
        """Read the file if it has changed. Raises `OSError` or `ConfigError`."""
        if self._file is None:
            return
        about = self._file.stat()
        if not stat.S_ISREG(about.st_mode):
            # Reading a pipe of this name would never end.
            raise OSError(errno.EINVAL, "it is not a regular file")
        signature = about.st_ino, about.st_size, about.st_mtime_ns
        if signature != self._signature:
            self._written = self._parse(self._file.read_bytes())
            self._signature = signature


def _overdue(pending: _Pending) -> Answer:
    """Return the answer to a request for which the disk takes too long, or to one too many."""
    why = (
        f"the disk did not answer within {PATIENCE_NS / NS_PER_S:g} s, or too many changes came at "
        "once"
    )
    answer = pending.answer
    text = f"nothing is set: {why}"
    if answer is not None:
        text = f"{answer.message}; {why}: look whether the file has it"
    return Answer(pending.request.id, False, text)
