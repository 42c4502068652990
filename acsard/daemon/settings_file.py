"""Compares the configuration file with the settings in force, and writes settings to the file.

A `set` request with the field `keep` changes the settings and the file, in two stages. First a
thread checks that the file can be changed. If it cannot, no setting is changed. Then the robot uses
the settings, and the thread changes the file. The control loop never waits for the disk.
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

from acsard.core.config.live import changed, differences
from acsard.core.config.parsing import ConfigError
from acsard.core.config.settings import Config
from acsard.core.formatting import listed, printable
from acsard.core.messages.encodings import Decoder
from acsard.core.messages.schema import Settings
from acsard.core.values import NS_PER_S, Answer, Event, Request
from acsard.host.config_file import Edit, apply_edit, prepare_edit, read
from acsard.host.errors import MendableError
from acsard.host.mailbox import Mailbox

CHECK_PERIOD_S = 2.0
"""Time between two checks whether the configuration file has changed, s."""

MAX_NAMED = 3
"""Largest number of settings that `SettingsFile.differ` names. The text must stay short, because
the message `state` contains it."""

MAX_TEXT_LENGTH = 200
"""Largest length of `SettingsFile.differ`, characters. The rest is cut off."""

REPLY_TIMEOUT_NS = 5 * NS_PER_S // 2
"""Longest time from the arrival of a `set` request with `keep` to the daemon's reply, ns. It is
shorter than the 3 s for which a client waits for a reply."""

MAX_JOBS = 32
"""Largest number of `set` requests with `keep` that wait for their reply or for the change of the
file. Further requests are refused immediately."""

Signature = tuple[int, int, int]
"""Inode, size in bytes and modification time in ns of a file."""

_decoder = Decoder(Settings)


def keeps(encoding: str, payload: bytes) -> bool:
    """Return whether a valid `set` request has the field `keep`, which asks to change the file too.

    `encoding` is Zenoh's name of the encoding of `payload`.
    """
    return _decoder.decode(encoding, payload).keep


class _Checked(Struct, frozen=True):
    """A `set` request whose settings the thread can write to the file."""

    request: Request
    edit: Edit


class _Pending(Struct):
    """A `set` request with the field `keep` that is not finished yet.

    Either its client has no answer yet, or the thread may still change the file.
    """

    request: Request
    due_ns: int
    """Monotonic time after which the client is told that the request has failed, ns. This limit
    does not apply while the robot decides about the request."""
    edit: Edit | None = None
    """The prepared change of the file; None until the thread has checked the request."""
    answer: Answer | None = None
    """The robot's answer; None until the robot has used the settings."""
    overdue: bool = False
    """True if the client was told that the change of the file took too long. The thread may still
    change the file."""


class SettingsFile:
    """The daemon's configuration file, and the thread that reads and changes it.

    The thread compares the file with the settings in force, and writes settings to the file if a
    client requests that. Call `use` whenever the settings in force change.
    """

    def __init__(
        self, file: Path | None, parse: Callable[[bytes], Config], started: Config
    ) -> None:
        """Prepare the comparison of the file with the settings. The method `start` begins it.

        Args:
            file: the configuration file that the daemon has read, or None if the daemon has read no
                file.
            parse: function that takes the content of a file, and returns the configuration with
                which the daemon would start with this content.
            started: the configuration with which the daemon has started.
        """
        self._differ = ""
        """Result of the thread's last comparison, as `differ` describes it."""
        self._file, self._parse = file, parse
        self._in_force = self._written = started
        self._signature: Signature | None = None
        self._compared = started, started, ""
        """The two configurations that the thread compared last, and their differences in words."""
        self._box = Mailbox[Request | Literal["compare"]](MAX_JOBS)
        """Queue of the thread: the requests that it must check. The item "compare" only wakes the
        thread, which then writes the changes and compares the file."""
        self._changes = deque[tuple[Edit, Answer]]()
        """The changes that the thread must write to the file before it checks another request. Each
        change is paired with the robot's answer to the client."""
        self._results = Mailbox[_Checked | Answer](MAX_JOBS)
        self.pending: dict[int, _Pending] = {}
        """The requests that `keep` has queued and that are not settled yet, by their ids. While
        there are such requests, each control step must call `results`."""
        self._thread: threading.Thread | None = None
        """The thread that compares and changes the file; None before it has started."""
        self._not_started = ""
        """The reason why the thread could not be started, or ""."""

    # The control loop calls the methods below.

    def start(self) -> None:
        """Start the thread. If no thread can be started, the file is neither compared nor changed.

        The property `differ` then gives the reason.
        """
        thread = threading.Thread(target=self._work, name="settings file", daemon=True)
        try:
            thread.start()
        except RuntimeError as error:
            self._not_started = str(error)
        else:
            self._thread = thread

    @property
    def differ(self) -> str:
        """Settings in force that differ from the file, in words, or "" if no setting differs.

        If the file cannot be compared, the text gives the reason.
        """
        trouble = self._trouble
        return f"{trouble}; restart acsard" if trouble else self._differ

    @property
    def _trouble(self) -> str:
        """Reason why no thread compares and changes the file, or "" if the thread runs."""
        if self._not_started:
            return (
                "the daemon could not start the thread that compares and changes the file "
                f"({self._not_started})"
            )
        # The thread ends by itself only because of a defect. Its traceback is in the daemon's log.
        if self._thread is None or self._thread.is_alive() or self._box.closed:
            return ""
        return "the thread that compares and changes the file has ended"

    def use(self, config: Config) -> None:
        """Compare the file with `config` now, and again whenever the file changes."""
        self._in_force = config
        self._wake_thread()

    def keep(self, request: Request, now_ns: int) -> Answer | None:
        """Queue a `set` request with the field `keep`, so that the thread checks it.

        If the check succeeds, a later call of `results` returns the request, and the robot must use
        the settings in it. Otherwise `results` returns an answer for the client. If the request
        cannot be queued, return the answer for the client now, else None. `now_ns` is the present
        monotonic time, ns.
        """
        if trouble := self._trouble:
            why = f"{trouble}; restart acsard, or send the request without `keep`"
        elif len(self.pending) >= MAX_JOBS:
            why = (
                f"more than {MAX_JOBS} changes of the file wait for the disk; try again in some "
                "seconds"
            )
        else:
            self.pending[request.id] = _Pending(request, now_ns + REPLY_TIMEOUT_NS)
            self._box.put(request)
            return None
        return Answer(request.id, False, f"no setting was changed: {why}")

    def _wake_thread(self) -> None:
        # If requests wait, the thread is awake. In a full queue, "compare" would displace a
        # request.
        if not self._box.waiting:
            self._box.put("compare")

    def defers_answer(self, answer: Answer) -> bool:
        """Process the robot's answer to a client's request; return whether the answer must wait.

        If the client sent a `set` request with the field `keep`, and the robot now uses the new
        settings, return True. The caller must not send the answer. The thread of this object first
        writes the settings to the configuration file, and then `results` returns the answer for the
        client.

        For any other answer, return False. The caller must send this answer now.
        """
        pending = self.pending.get(answer.id)
        if pending is None or pending.edit is None:
            return False
        if not answer.success:
            del self.pending[answer.id]
            return False
        pending.answer = answer
        self._changes.append((pending.edit, answer))
        self._wake_thread()
        return True

    def results(self, now_ns: int, events: list[Event]) -> list[Request | Answer]:
        """Return the requests whose settings the robot must use now, and the answers for clients.

        Append an event to `events` for each request whose settings were written to the file. If a
        request took too long, its client already has an answer. If the change of the file then
        fails, append an event too, because the client gets no further answer. `now_ns` is the
        present monotonic time, ns.
        """
        results: list[Request | Answer] = []
        for result in self._results.take():
            number = result.id if isinstance(result, Answer) else result.request.id
            pending = self.pending.get(number)
            if pending is None:
                continue  # the request was overdue and has been answered
            if isinstance(result, _Checked):
                if now_ns > pending.due_ns:
                    continue  # the request is overdue: the code below answers it
                pending.edit = result.edit
                results.append(result.request)
                continue
            if not pending.overdue:
                results.append(result)
            del self.pending[number]
            keys, by = ", ".join(pending.request.settings), pending.request.by
            # The log puts the kind in front of the text: `written: KEY to FILE`.
            if result.success:
                events.append(Event("set", f"{keys} to {self._file}", by=by, kind="written"))
            elif pending.overdue:
                text = f"{keys} to {self._file}: {result.message}"
                events.append(Event("set", text, "warning", by=by, kind="not written"))
        # Skip a request that the robot is deciding about. The robot may use its settings, so the
        # answer must not say that no setting was changed.
        overdue = [
            waits
            for waits in self.pending.values()
            if now_ns > waits.due_ns
            and (waits.edit is None or waits.answer is not None)
            and not waits.overdue
        ]
        for waits in overdue:
            waits.overdue = True
            if waits.answer is None:
                del self.pending[waits.request.id]
        return [*results, *(_overdue(pending, self._trouble) for pending in overdue)]

    def close(self) -> None:
        """Let the thread end. Do not wait for it."""
        self._box.close()

    # The thread runs the methods below.

    def _work(self) -> None:
        while not self._box.closed:
            self._box.wait(CHECK_PERIOD_S)
            for job in self._box.take():
                self._write()
                # A request that is overdue has its answer already.
                if isinstance(job, Request) and job.id in self.pending:
                    self._results.put(self._checked(job))
            self._write()
            self._differ = printable(self._difference())[:MAX_TEXT_LENGTH]

    def _write(self) -> None:
        while self._changes:
            self._results.put(self._written_answer(*self._changes.popleft()))

    def _checked(self, request: Request) -> _Checked | Answer:
        try:
            # Refuse settings here if the robot would refuse them even at rest.
            changed(self._in_force, request.settings, at_rest=True)
        except ConfigError as error:
            return Answer(request.id, False, str(error))
        try:
            return _Checked(request, prepare_edit(self._file, request.settings))
        except MendableError as error:
            return Answer(request.id, False, f"no setting was changed: {error}")

    def _written_answer(self, edit: Edit, answer: Answer) -> Answer:
        text = answer.message
        try:
            apply_edit(edit)
        except MendableError as error:
            return Answer(
                answer.id, False, f"{text}, but only until the daemon's next start, because {error}"
            )
        return Answer(answer.id, True, f"{text}; written to {edit.file}")

    def _difference(self) -> str:
        try:
            self._read()
        except OSError as error:
            self._signature = None
            return f"the configuration file cannot be read: {error.strerror or error}"
        except ConfigError as error:
            self._signature = None
            return (
                "the daemon could not start with the present content of its file: "
                f"{error.problems[0]}"
            )
        in_force, written = self._in_force, self._written
        # Comparing all settings takes 1 ms, and they are usually the same objects as last time.
        if self._compared[0] is not in_force or self._compared[1] is not written:
            changes = differences(in_force, written)
            texts = [change.describe(key) for key, change in changes.items()]
            self._compared = in_force, written, listed(texts, MAX_NAMED)
        return self._compared[2]

    def _read(self) -> None:
        if self._file is None:
            return
        about = self._file.stat()
        if not stat.S_ISREG(about.st_mode):
            # Reading a pipe would never end.
            raise OSError(errno.EINVAL, "it is not a regular file")
        signature = about.st_ino, about.st_size, about.st_mtime_ns
        if signature != self._signature:
            self._written = self._parse(read(self._file))
            self._signature = signature


def _overdue(pending: _Pending, trouble: str) -> Answer:
    """Return the answer to a request that took too long.

    `trouble` is the reason why no thread changes the file, or "" if the thread waits for the disk.
    """
    answer = pending.answer
    why = trouble or f"the disk did not answer within {REPLY_TIMEOUT_NS / NS_PER_S:g} s"
    mend = "restart acsard" if trouble else "check the disk (`dmesg`)"
    if answer is not None:
        text = f"{answer.message}, but {why}: check whether the file has the new value"
    else:
        text = f"no setting was changed: {why}; {mend}, then try again"
    return Answer(pending.request.id, False, text)
