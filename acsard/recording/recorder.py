"""The black box of a running daemon: takes the inputs and outputs of each step, and never waits.

The control loop puts references into a bounded queue. A thread encodes them, adds a block to
the growing chunk each second and syncs it to the disk. If the disk is slow or stuck, the queue
fills, and further steps are lost and counted. The recording then goes on in a new file that begins
with the robot's state, so that it can be replayed.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress

from acsard.core.config.settings import Config
from acsard.core.guard import Guard
from acsard.core.robot import Robot
from acsard.core.values import Event, Inputs, Outputs, Recording
from acsard.recording.disk import Bug, OnDisk
from acsard.recording.recorded_steps import Start, Taken, Unfinished
from acsard.recording.state import freeze

MOST = 4096
"""Largest number of steps in the queue. At 100 Hz a disk may stall for 10 s without a loss."""

FLUSH_S = 0.98
"""Pause between two syncs. With the time that one takes, there is one each second."""

MOST_TEXT = 200
"""Largest number of characters of an exception's text."""

CLOSE_S, MARK_S = 0.5, 0.1
"""Times that `close` waits for the end of the file, and for a marker in its place."""


class Recorder:
    """The recorder. The control loop calls `step`; the thread does everything else."""

    def __init__(self, config: Config, tell: Callable[[Event], None], started_ns: int = 0) -> None:
        """Start the thread.

        Args:
            config: the configuration at the daemon's start.
            tell: takes the recorder's own events; it is called from within `step`.
            started_ns: wall-clock time of the daemon's start, ns since 1970. An export stamps the
                messages
                that never change with it.
        """
        self._queue: deque[Taken | Start] = deque()
        self._tell = tell
        self._said: deque[Event] = deque()
        self._number = 0
        """Number of steps so far."""
        self._missing = 0
        """Number of steps lost because the queue was full."""
        self._full = False
        self._died: Inputs | None = None
        """Inputs of the step that failed."""
        self._wants_state = False
        """Request for a new file: the thread sets it, and `step` clears it."""
        self._disk = OnDisk(config, self._say, self._ask, started_ns)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._work, name="record", daemon=True)
        self._thread.start()

    # The control loop's side

    def begins(self, robot: Robot, guard: Guard) -> None:
        """Let the first file begin with this robot, not with a new one of the configuration."""
        self._queue.append(Start(0, freeze(robot, guard.memory), robot.config))

    def step(
        self, inputs: Inputs, outputs: Outputs, left: bytes | None, robot: Robot, guard: Guard
    ) -> None:
        """Take a finished step; `left` is the line that was sent to the board, or None."""
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
        """Take the inputs of a step in which the daemon failed. The daemon ends because of it."""
        self._died = inputs

    @property
    def status(self) -> Recording:
        """Status of the recording, for `state` and `diagnostics`."""
        trouble = "the disk is too slow" if self._full else self._disk.trouble
        if not self._thread.is_alive():
            trouble = "the recorder has ended because of an error of its own, which is in the log"
        return Recording(self._disk.where, trouble, self._missing + self._disk.missing)

    def close(self, error: BaseException | None = None) -> None:
        """Write the last steps and the end of the file, if the disk is quick enough.

        `error` is the exception that ends the daemon. A `BaseException` that is not an `Exception`
        is an ordinary end.
        """
        while isinstance(error, BaseExceptionGroup):
            error = error.exceptions[0]
        if isinstance(error, Exception):
            self._disk.bug = self._bug(error)
        self._over.set()
        self._thread.join(CLOSE_S)
        if self._thread.is_alive() and self._disk.bug is None:
            # A disk that hangs must not delay the end of the daemon as well.
            marking = threading.Thread(target=self._disk.leave, args=["late"], daemon=True)
            marking.start()
            marking.join(MARK_S)

    def _bug(self, error: Exception) -> Bug:
        why = type(error).__name__
        # An exception whose text cannot be produced is reported by its type.
        with suppress(Exception):
            why = f"{why}: {error}"[:MOST_TEXT].encode(errors="replace").decode()
        if self._died is None:
            return Bug(why, None, b"")
        number, data = self._number, b""
        # The input that made the step fail may also be one that cannot be encoded.
        with suppress(Exception):
            data = Unfinished(number, self._died).encode()
        return Bug(f"in step {number}, {why}", self._died.now, data)

    # The thread's side

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
