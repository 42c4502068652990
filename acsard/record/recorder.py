"""The black box of a running daemon: takes each step's inputs and outputs, never waits.

The loop puts references into a bounded queue. A thread makes bytes of them, a chunk a second, each
synced to the disk. A queue that is full, because the disk is slow or stuck, loses steps and counts
them; what follows begins a new file with the robot's state, so that it can be lived again.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress

from acsard.config.settings import Config
from acsard.guard import Guard
from acsard.record.disk import Bug, OnDisk
from acsard.record.state import freeze
from acsard.record.steps import Start, Taken, Unfinished
from acsard.robot import Robot
from acsard.values import Event, Inputs, Outputs, Recording

MOST = 4096
"""Steps that wait for the thread: a disk may take 10 s, at 100 Hz, before any is lost."""

FLUSH_S = 0.98
"""Between two chunks; with what it takes to write one, there is one each second."""

MOST_TEXT = 200
"""Characters of what a fault of our own says."""

CLOSE_S, MARK_S = 0.5, 0.1
"""How long the end waits for the last chunk; and for a mark in its place."""


class Recorder:
    """`step` is for the control loop; everything else happens in the thread."""

    def __init__(self, config: Config, tell: Callable[[Event], None], started_ns: int = 0) -> None:
        """`tell` takes the recorder's own events, from within `step`; the daemon's start by the
        wall clock is the stamp of what it says once and for all."""
        self._queue: deque[Taken | Start] = deque()
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
        self._disk = OnDisk(config, self._say, self._ask, started_ns)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._work, name="record", daemon=True)
        self._thread.start()

    # the control loop's side

    def begins(self, robot: Robot, guard: Guard) -> None:
        """Let the first file begin with this robot instead of one made of the configuration."""
        self._queue.append(Start(0, freeze(robot, guard.memory), robot.config))

    def step(
        self, inputs: Inputs, outputs: Outputs, left: bytes | None, robot: Robot, guard: Guard
    ) -> None:
        """Take a step that is over. `left` is the line of it that left, or None."""
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
            queue.append(Start(self._number, freeze(robot, guard.memory), robot.config))

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

    def _bug(self, error: Exception) -> Bug:
        why = type(error).__name__
        with suppress(Exception):  # one that cannot be told is one all the same
            why = f"{why}: {error}"[:MOST_TEXT].encode(errors="replace").decode()
        if self._died is None:
            return Bug(why, None, b"")
        number, data = self._number, b""
        with suppress(Exception):  # what ended a step may be what no file takes
            data = Unfinished(number, self._died).encode()
        return Bug(f"in step {number}, {why}", self._died.now, data)

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

    def _taken(self) -> list[Taken | Start]:
        queue = self._queue
        return [queue.popleft() for _ in range(len(queue))]
