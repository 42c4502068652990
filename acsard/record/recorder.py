"""The black box of a running daemon: takes each step's inputs and outputs, never waits.

The loop puts references into a bounded queue. A thread makes bytes of them, a chunk a second, each
synced to the disk. A queue that is full, because the disk is slow or stuck, loses steps and counts
them; what follows begins a new file with the robot's state, so that it can be lived again.
"""

from __future__ import annotations

import platform
import threading
from collections import deque
from collections.abc import Callable, Iterator
from contextlib import suppress
from pathlib import Path
from typing import Literal, NamedTuple

from acsard import __version__
from acsard.config.parsing import effective
from acsard.config.settings import Config
from acsard.config.writing import document
from acsard.record.batch import encode
from acsard.record.directory import Ring, Run, leave
from acsard.record.file import About, Writing
from acsard.record.recovery import FULL
from acsard.record.room import AROUND_NS, Kind
from acsard.record.state import freeze
from acsard.record.steps import Taken, Unfinished
from acsard.record.story import told
from acsard.robot import Robot
from acsard.values import NS_PER_S, Event, Inputs, Instant, Outputs, Recording

MOST = 4096
"""Steps that wait for the thread: a disk may take 10 s, at 100 Hz, before any is lost."""

FLUSH_S = 0.98
"""Between two chunks; with what it takes to write one, there is one each second."""

RETRY_ROUNDS = 5
"""Between two tries of a disk that refused."""

BATCH = 256
"""Steps in a message at most: as many as a second has, unless commands pour in."""

LONGEST_NS = 3600 * NS_PER_S
"""What a file holds at most."""

HAPPENED = frozenset({"fault", "stop", "link_down", "link_stale", "port_lost"})
"""Events whose minutes are kept."""

MOST_TEXT = 200
"""Characters of what a fault of our own says."""

CLOSE_S, MARK_S = 0.5, 0.1
"""How long the end waits for the last chunk; and for a mark in its place."""


class _Start(NamedTuple):
    """What a file begins with: the robot after the step before number `number`."""

    number: int
    state: bytes
    config: Config
    """In force then: settings may have been changed since the daemon began."""


class _Bug(NamedTuple):
    """The fault of its own that the daemon ends by."""

    why: str
    at: Instant | None
    """Of the step that it ended, if it was in one."""
    unfinished: bytes
    """That step; empty where it cannot be written."""


class Recorder:
    """`step` is for the control loop; everything else happens in the thread."""

    def __init__(self, config: Config, tell: Callable[[Event], None], started_ns: int = 0) -> None:
        """`tell` takes the recorder's own events, from within `step`; the daemon's start by the
        wall clock is the stamp of what it says once and for all."""
        self._queue: deque[Taken | _Start] = deque()
        self._tell = tell
        self._said: deque[Event] = deque()
        self._number = 0
        """Steps so far."""
        self._missing = 0
        """Steps that found the queue full."""
        self._full = False
        self._died: Inputs | None = None
        """What came into the step that did not end."""
        self._wants_state = False
        """Set by the thread, cleared by `step`: begin a new file."""
        self._disk = _Disk(config, self._say, self._ask, started_ns)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._work, name="record", daemon=True)
        self._thread.start()

    # the control loop's side

    def step(
        self, inputs: Inputs, outputs: Outputs, left: bytes | None, robot: Robot, last: bytes
    ) -> None:
        """Take a step that is over; `left` is what went of it, `last` the line that went last."""
        queue = self._queue
        self._number += 1
        if self._said:
            self._tell(self._said.popleft())
        if self._full:
            self._missing += 1
            if len(queue) > MOST // 2:
                return
            self._full, self._wants_state = False, True
        elif len(queue) >= MOST:
            self._full = True
            self._missing += 1
            self._tell(Event("recording", "the disk is too slow; steps are lost", "warning"))
            return
        else:
            queue.append(Taken(inputs, outputs, left))
        if self._wants_state:
            self._wants_state = False
            queue.append(_Start(self._number, freeze(robot, last), robot.config))

    def died(self, inputs: Inputs) -> None:
        """A fault of our own ended the step that these came into; the daemon ends by it."""
        self._died = inputs

    @property
    def status(self) -> Recording:
        """How it goes, for `state` and `diagnostics`."""
        trouble = "the disk is too slow" if self._full else self._disk.trouble
        if not self._thread.is_alive():
            trouble = "the recorder has ended by a fault of its own; the log has it"
        return Recording(self._disk.where, trouble, self._missing + self._disk.missing)

    def close(self, error: BaseException | None = None) -> None:
        """Write the last chunk and the end of the file, if the disk lets us in time.

        `error` is what the daemon ends by; what is no `Exception` was asked for.
        """
        while isinstance(error, BaseExceptionGroup):
            error = error.exceptions[0]
        if isinstance(error, Exception):
            self._disk.bug = self._bug(error)
        self._over.set()
        self._thread.join(CLOSE_S)
        if self._thread.is_alive() and self._disk.bug is None:
            # A disk that hangs must not hold up the end of the daemon as well.
            marking = threading.Thread(target=self._disk.leave, args=["late"], daemon=True)
            marking.start()
            marking.join(MARK_S)

    def _bug(self, error: Exception) -> _Bug:
        why = type(error).__name__
        with suppress(Exception):  # one that cannot be told is one all the same
            why = f"{why}: {error}"[:MOST_TEXT].encode(errors="replace").decode()
        if self._died is None:
            return _Bug(why, None, b"")
        number, data = self._number, b""
        with suppress(Exception):  # what ended a step may be what no file takes
            data = Unfinished(number, self._died).encode()
        return _Bug(f"in step {number}, {why}", self._died.now, data)

    # the thread's side

    def _say(self, event: Event) -> None:
        self._said.append(event)

    def _ask(self) -> None:
        self._wants_state = True

    def _work(self) -> None:
        over = False
        while not over:
            over = self._over.wait(FLUSH_S)
            self._disk.round(self._taken(), over)

    def _taken(self) -> list[Taken | _Start]:
        queue = self._queue
        return [queue.popleft() for _ in range(len(queue))]


class _Disk:
    """What the thread has: the ring, the file, and how the disk takes it."""

    def __init__(
        self,
        config: Config,
        say: Callable[[Event], None],
        ask: Callable[[], None],
        started_ns: int,
    ) -> None:
        self._started_ns = started_ns
        self.where = config.record.directory
        self.trouble = ""
        self.missing = 0
        """Steps that came while the disk took nothing."""
        self._config, self._say, self._ask = config, say, ask
        self._ring: Ring | None = None
        self._writing: Writing | None = None
        self._start: _Start | None = _Start(0, b"", config)
        """What the next file begins with; None when steps before it are missing."""
        self._recent: list[tuple[Path, int]] = []
        """What ended less than a minute ago, and when; nothing has happened close to it yet."""
        self._number = self._began_ns = 0
        self._last = Instant(0, 0)
        self._happened_ns = -AROUND_NS
        self._reason: str | None = None
        """The last one written to this file."""
        self._kind: Kind = "plain"
        """What the file is that is being written."""
        self._told = self._refused = False
        self._looked_back = False
        """At what the run before this one has left."""
        self._run = Run()
        self._cut_ns: int | None = None
        """When a crash has cut what was before this run, wall clock, once that is whole; looked at
        once."""
        self.bug: _Bug | None = None
        """By which the daemon ends; looked at in the last round."""
        self._pause = 0
        self._handed = self._safe = 0
        """Steps of this round: given to the file, or counted as missing, and how many of them are
        synced, or counted. What a disk that refuses has not synced is gone."""

    def round(self, items: list[Taken | _Start], over: bool) -> None:
        """Write what came, or count it as missing."""
        self._handed = self._safe = 0
        try:
            if self._pause == 0 or over:
                ring = self._ring = self._ring or self._take()
                for start, steps in _runs(items):
                    self._write(ring, start, steps)
                self._flush(ring, over)
            else:
                self._pause -= 1
        except OSError as error:
            self._fail(error)
        missed = sum(isinstance(item, Taken) for item in items) - self._safe
        if missed:
            self.missing += missed
            self._start = None
        if self._start is None and self._writing is None and self._pause == 0:
            self._ask()

    def leave(self, cut: Literal["late", "disk"]) -> None:
        """Whatever becomes of the file that is being written, no crash has cut it. Called in a
        thread of its own where the daemon ends while this one still waits for the disk."""
        writing = self._writing
        if writing is not None:
            with suppress(OSError):  # then the next start takes it for a crash's
                leave(writing.path, self._kind, cut)

    def _take(self) -> Ring:
        """The directory, and what is told of it."""
        ring = Ring(self._config.record, self._run, self._refused)
        self._refused, self._cut_ns = False, ring.cut_ns or self._cut_ns
        for text in ring.said:
            self._say(Event("recording", text, "warning"))
        return ring

    def _write(self, ring: Ring, start: _Start | None, steps: list[Taken]) -> None:
        if start is not None:
            self._finish(ring)
            self._start, self._number = start, start.number
        if self._writing is None:
            if self._start is None or not steps:
                self.missing += len(steps)
                self._handed += len(steps)
                self._safe = self._handed
                return
            self._begin(ring, self._start, steps[0].inputs.now)
        assert self._writing is not None
        for at in range(0, len(steps), BATCH):
            batch = steps[at : at + BATCH]
            self._writing.add(
                "steps", batch[0].inputs.now.wall_ns, encode(self._number, batch, self._reason)
            )
            self._reason = batch[-1].outputs.reason
            self._number += len(batch)
            self._handed += len(batch)
            self._last = batch[-1].inputs.now
            for _, outputs, _ in batch:
                for event in outputs.events:
                    self._writing.event(told(event, outputs.now.wall_ns))
                    if event.name in HAPPENED:
                        self._happened(ring, outputs.now)

    def _begin(self, ring: Ring, start: _Start, now: Instant) -> None:
        ring.trim(now)
        if not self._looked_back:
            self._look_back(ring, now)
        about = About(
            robot=self._config.robot.id,
            version=__version__,
            python=platform.python_version(),
            mono_ns=now.mono_ns,
            wall_ns=now.wall_ns,
            started_ns=self._started_ns,
            config="\n".join(document(effective(start.config))) + "\n",
        )
        self._writing, self._start = ring.begin(about), None
        self._began_ns, self._reason = now.mono_ns, None
        if self._cut_ns is not None:
            since_ns, self._cut_ns = now.wall_ns - self._cut_ns, None
            self._happened_ns = max(self._happened_ns, now.mono_ns - max(0, since_ns))
        self._kind = "near" if now.mono_ns - self._happened_ns < AROUND_NS else "plain"
        if start.state:
            self._writing.add("state", now.wall_ns, start.state)

    def _look_back(self, ring: Ring, now: Instant) -> None:
        """The minute before what happens, and after what happened, goes on over a restart."""
        for path, kind, ended_ns in ring.just_ended(now):
            if kind == "plain":
                self._recent.append((path, ended_ns))
            elif kind == "kept":
                self._happened_ns = max(self._happened_ns, ended_ns)
        self._looked_back = True

    def _happened(self, ring: Ring, now: Instant) -> None:
        """This file stays, and what is less than a minute before it."""
        self._kind, self._happened_ns = "kept", now.mono_ns
        for path, ended_ns in self._recent:
            if now.mono_ns - ended_ns < AROUND_NS:
                ring.keep(path)
        self._recent.clear()

    def _die(self, ring: Ring, bug: _Bug) -> None:
        """What came into the last step, and that the file stays, as after a crash."""
        if bug.at is not None and self._writing is None and self._start is not None:
            self._begin(ring, self._start, bug.at)
        if self._writing is None:
            return
        self._last = bug.at or self._last
        if bug.unfinished:
            self._writing.add("unfinished", self._last.wall_ns, bug.unfinished)
        self._happened(ring, self._last)

    def _flush(self, ring: Ring, over: bool) -> None:
        if over:
            if self.bug is not None:
                self._die(ring, self.bug)
            self._finish(ring, *(("bug", self.bug.why) if self.bug else ()))
            ring.close()
        if self._writing is None:
            return
        self._writing.flush()
        self._safe, self._run.given = self._handed, 0
        ring.tend(self._last)
        if self.trouble or not self._told:
            self.trouble, self._told = "", True
            self._say(Event("recording", f"to {self.where}"))
        long = self._last.mono_ns - self._began_ns > LONGEST_NS
        if long or self._writing.size > ring.file_bytes:
            self._ask()

    def _finish(self, ring: Ring, cut: str = "", why: str = "") -> None:
        if self._writing is None:
            return
        path, last_ns = ring.end(self._writing, self._kind, cut, why), self._last.mono_ns
        self._writing, self._safe = None, self._handed
        recent = [(p, ns) for p, ns in self._recent if last_ns - ns < AROUND_NS]
        self._recent = recent if self._kind != "plain" else [*recent, (path, last_ns)]

    def _fail(self, error: OSError) -> None:
        text = f"{self.where}: {error.strerror or error}"
        if text != self.trouble:
            self.trouble = text
            self._say(Event("recording", f"{text}; driving goes on", "warning"))
        if self._writing is not None:
            self._run.cut[self._writing.path.name] = self._kind
            if self.bug is None:
                self.leave("disk")
        for open_one in (self._writing, self._ring):
            if open_one is not None:
                open_one.close()
        self._refused = error.errno in FULL
        self._writing = self._ring = None
        self._pause = RETRY_ROUNDS


def _runs(items: list[Taken | _Start]) -> Iterator[tuple[_Start | None, list[Taken]]]:
    """What follows without a break, and what it begins with if it begins anew."""
    start: _Start | None = None
    steps: list[Taken] = []
    for item in items:
        if isinstance(item, Taken):
            steps.append(item)
            continue
        yield start, steps
        start, steps = item, []
    yield start, steps
