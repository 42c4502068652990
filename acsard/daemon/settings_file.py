"""Compares the configuration file with the settings in force, and changes the file.

A `set` request with the field `keep` changes the settings and the file. It has two stages. First a
thread checks that the file can be changed. If the file cannot be changed, nothing is set. Then the
robot uses the settings, and the thread changes the file. The control loop never waits for the disk.
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
"""Time between two checks whether the file has changed, s."""

NAMED = 3
"""Largest number of settings that `SettingsFile.differ` names, so that `state` stays short."""

MAX_TEXT = 200

PATIENCE_NS = 5 * NS_PER_S // 2
"""Longest time from a `set` request with `keep` to the daemon's reply, ns. A client waits for 3
s."""

JOBS = 32
"""Largest number of `set` requests with `keep` that wait for their reply. Further requests are
refused immediately."""

Signature = tuple[int, int, int]
"""Inode, size in bytes and modification time in ns of a file."""

_decoder = Decoder(Settings)


def keeps(encoding: str, payload: bytes) -> bool:
    """Return whether a valid `set` request also asks to change the configuration file."""
    return _decoder.decode(encoding, payload).keep


class _Checked(Struct, frozen=True):
    """A `set` request whose settings can be written to the file."""

    request: Request
    edit: Edit


class _Pending(Struct):
    """A `set` request with `keep` that has no reply yet."""

    request: Request
    due_ns: int
    """Monotonic time after which the request is answered with a failure, ns. This does not apply
    while the robot is deciding about the request."""
    edit: Edit | None = None
    """The change of the file, once the thread has checked it; None before."""
    answer: Answer | None = None
    """The robot's answer, once the robot has used the settings; None before."""


class SettingsFile:
    """The configuration file of the daemon. Call `use` whenever the settings in force change."""

    def __init__(
        self, file: Path | None, parse: Callable[[bytes], Config], started: Config
    ) -> None:
        """Prepare the comparison, which begins when `start` is called.

        Args:
            file: the file that the daemon has read, or None for the built-in defaults.
            parse: function that returns the configuration of a daemon that starts with the given
                content of the file.
            started: the configuration with which the daemon has started.
        """
        self.differ = ""
        """The settings in force that differ from the file, in words, or the reason why the file
        cannot be used. It is "" if nothing differs."""
        self._file, self._parse = file, parse
        self._in_force = self._written = started
        self._signature: Signature | None = None
        self._box = Mailbox[Request | Literal["look"]](JOBS)
        """The requests whose settings the thread must check. The item "look" only wakes the
        thread."""
        self._changes = deque[tuple[Edit, Answer]]()
        """The changes to write to the file before the next check, each with the robot's answer."""
        self._results = Mailbox[_Checked | Answer](JOBS)
        self._pending: dict[int, _Pending] = {}
        self._started = self._limits = started.limits
        """`_started` has the limits at the start of the daemon. `_limits` has the same limits, but
        with the new value of each limit that the daemon has written to the file since then."""
        self._kept: tuple[Latches, LimitsConfig, LimitsConfig, Latches] | None = None
        """Cache of the method `latches`: the arguments of the last call, the `_limits` at that
        time, and the result."""

    # The control loop calls the methods below.

    def start(self) -> None:
        """Start the thread. If no thread can be started, the file is not compared or changed."""
        thread = threading.Thread(target=self._work, name="settings file", daemon=True)
        try:
            thread.start()
        except RuntimeError as error:
            self.differ = f"the daemon cannot compare its settings with its file ({error})"

    def use(self, config: Config) -> None:
        """Compare the file with `config` from now on, also after later changes of the file.

        `config` has the settings in force, except the limit that clients set by the Zenoh key
        `speed_limit`.
        """
        self._in_force = config
        self._look()

    def keep(self, request: Request, now_ns: int) -> None:
        """Queue a `set` request with `keep` for the thread. `results` returns the outcome."""
        full = len(self._pending) >= JOBS
        # A request beyond the limit is overdue from the start, so that `results` refuses it in this
        # step.
        self._pending[request.id] = _Pending(request, now_ns - 1 if full else now_ns + PATIENCE_NS)
        if not full:
            self._box.put(request)

    def _look(self) -> None:
        """Wake the thread, unless requests wait for it: the item "look" could displace a
        request."""
        if not self._box.waiting:
            self._box.put("look")

    def obeyed(self, answer: Answer) -> bool:
        """Process the robot's answer to any request. Return whether the answer must wait.

        An answer waits if its request is a `set` with `keep` whose settings the robot has used. The
        thread then writes the file, and `results` returns the answer. The caller sends all other
        answers to the clients.
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
        """Return the requests that the robot may obey now, and the answers for clients.

        Adds an event to `events` for each request whose settings were written to the file.
        """
        if not self._pending:
            return []
        found: list[Request | Answer] = []
        for one in self._results.take():
            number = one.id if isinstance(one, Answer) else one.request.id
            pending = self._pending.get(number)
            if pending is None:
                continue  # the request was overdue and has been answered
            if isinstance(one, _Checked):
                if now_ns > pending.due_ns:
                    continue  # the request is overdue: the code below answers it
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
        # Skip a request that the robot is deciding about. The robot may use its settings, so the
        # answer must not say that nothing is set.
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
        """The limits at the daemon's start, with the values written to the file since then."""
        return self._limits

    def latches(self, latches: Latches, now: LimitsConfig) -> Latches:
        """Return the robot's latches as they must be stored for the next start of the daemon.

        The next start reads the limits from the configuration file. So if the daemon has written
        limits to the file, `lowered` in the result has the limits that are lower in `now` than in
        the file. `now` has the limits in force, except the limit that clients set by the Zenoh key
        `speed_limit`.
        """
        file = self._limits
        if file is self._started:
            return latches
        kept = self._kept
        # Return the same object for the same arguments, because the latch file is written again for
        # each new object.
        if kept is None or not (kept[0] is latches and kept[1] is now and kept[2] is file):
            result = replace(latches, lowered=lowered(file, now))
            kept = self._kept = latches, now, file, result
        return kept[3]

    def close(self) -> None:
        """Tell the thread to end, without waiting for it."""
        self._box.close()

    # The thread runs the methods below.

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
        while self._changes:
            self._results.put(self._written_answer(*self._changes.popleft()))

    def _checked(self, request: Request) -> _Checked | Answer:
        try:
            # Refuse settings that the robot would refuse even at rest.
            changed(self._in_force, request.settings, at_rest=True)
        except ConfigError as error:
            return Answer(request.id, False, str(error))
        try:
            return _Checked(request, keepable(self._file, request.settings))
        except MendableError as error:
            return Answer(request.id, False, f"nothing is set: {error}")

    def _written_answer(self, edit: Edit, answer: Answer) -> Answer:
        told = answer.message
        try:
            keep(edit)
        except MendableError as error:
            return Answer(
                answer.id, False, f"{told}, but only until the daemon's next start, because {error}"
            )
        limits = {
            key.removeprefix(TABLE): float(value)  # type: ignore[arg-type]
            for key, value in edit.keys.items()
            if key.startswith(TABLE)
        }
        if limits:
            self._limits = replace(self._limits, **limits)
        return Answer(answer.id, True, f"{told}; written to {edit.file}")

    def _difference(self) -> str:
        try:
            self._read()
        except OSError as error:
            self._signature = None
            return f"the configuration file cannot be read: {error.strerror or error}"
        except ConfigError as error:
            self._signature = None
            return f"the daemon could not start again with its present file: {error.problems[0]}"
        found = differences(self._in_force, self._written)
        told = [one.words(key) for key, one in found.items()]
        return listed(told, NAMED)

    def _read(self) -> None:
        if self._file is None:
            return
        about = self._file.stat()
        if not stat.S_ISREG(about.st_mode):
            # Reading a pipe would never end.
            raise OSError(errno.EINVAL, "it is not a regular file")
        signature = about.st_ino, about.st_size, about.st_mtime_ns
        if signature != self._signature:
            self._written = self._parse(self._file.read_bytes())
            self._signature = signature


def _overdue(pending: _Pending) -> Answer:
    """Return the answer to a request that took too long, or that exceeded the limit `JOBS`."""
    why = (
        f"the disk did not answer within {PATIENCE_NS / NS_PER_S:g} s, or too many changes came at "
        "once"
    )
    answer = pending.answer
    text = f"nothing is set: {why}"
    if answer is not None:
        text = f"{answer.message}, but {why}: check whether the file has the new value"
    return Answer(pending.request.id, False, text)
