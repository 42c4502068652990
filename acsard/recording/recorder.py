"""The black box of a running daemon: records each step without delaying the control loop.

The control loop puts each step into a bounded queue. Once a second a thread writes the queued steps
to a file, and syncs the file to the disk. If the queue is full, further steps are lost and counted.
The recording then goes on in a new file that begins with the robot's state, so that the new file
can be replayed.
"""

from __future__ import annotations

import threading
from collections import deque
from collections.abc import Callable
from contextlib import suppress

from acsard.core.config.settings import Config
from acsard.core.formatting import many
from acsard.core.guard import Guard
from acsard.core.robot import Robot
from acsard.core.values import NS_PER_S, Event, Inputs, Outputs, Recording
from acsard.recording.recorded_steps import FinishedStep, StateBeforeStep, StepRecorder, Unfinished
from acsard.recording.state import MAX_ERROR_LENGTH, freeze
from acsard.recording.step_writer import Bug, StepWriter

MAX_QUEUED_STEPS = 4096
"""Largest number of queued steps. At 400 steps a second, the queue is full after 10 s."""

SLOW_SYNC_NS = 3 * NS_PER_S
"""If a sync of the file to the disk takes longer than this time, ns, the log reports that the disk
hangs."""

SLOW_DISK = "the disk has accepted no data for 3 s"

SYNC_PAUSE_S = 0.98
"""Pause between two syncs of the file to the disk, s. The pause and one sync together take about a
second."""

ENDED = (
    "the recorder has ended because of an internal error, which is in the log: restart the daemon "
    "to record again"
)
"""Text for the log and for `state` after an internal error has ended the recorder's thread."""

CLOSE_S, MARK_S = 0.5, 0.1
"""Time limits in `Recorder.close()`, s. `CLOSE_S` applies to writing the last steps and the end of
the file. If the disk is too slow for that, `MARK_S` applies to writing a marker file."""


class Recorder(StepRecorder):
    """The black box of a running daemon.

    The control loop calls `step`, which never waits for the disk. A thread writes the steps to the
    disk.
    """

    def __init__(
        self, config: Config, report: Callable[[Event], None], started_ns: int = 0
    ) -> None:
        """Start the thread that writes to the disk.

        Args:
            config: the configuration at the daemon's start.
            report: receives events about the recorder itself. Only `step()` calls this function, so
                the function runs in the thread of the control loop.
            started_ns: wall-clock time of the daemon's start, ns since 1970. An export uses this
                time as the stamp of the messages that never change.
        """
        self._queue: deque[FinishedStep | StateBeforeStep] = deque()
        self._report = report
        self._events: deque[Event] = deque()
        """Events from the recorder's thread. Each call of `step` passes one event to `report`."""
        self._number = 0
        """Number of the next step. It counts the steps since the daemon's start."""
        self._lost = 0
        """Number of steps that were lost because the queue was full."""
        self._full = False
        """True after the queue was full, until half of the queue is free again."""
        self._sync_ns = 0
        """Duration of the running sync of the file, as of the last call of `step`, ns. It is 0 if
        no sync runs."""
        self._slow = False
        """True from the event that reports a slow disk to the event that reports a fast disk."""
        self._lost_before = 0
        """Value of `_lost` when `_slow` became true."""
        self._failed_inputs: Inputs | None = None
        """Inputs of the step in which the daemon failed, or None."""
        self._wants_state = False
        """True if the control loop must queue the robot's state for a new file or a checkpoint.

        The recorder's thread sets this flag, and also `step` after the queue was full. When `step`
        queues the state, it clears the flag.
        """
        self._writer = StepWriter(config, self._events.append, self._request_state, started_ns)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._work, name="record", daemon=True)
        self._thread.start()

    # These methods run in the control loop's thread.

    def begins(self, robot: Robot, guard: Guard) -> None:
        """Record the state of the robot and of its guard before the first step.

        This call may be omitted. A replay of the first file then begins with a new robot and a new
        guard.
        """
        self._queue.append(StateBeforeStep(0, freeze(robot, guard.memory), robot.config))

    def step(
        self, inputs: Inputs, outputs: Outputs, sent: bytes | None, robot: Robot, guard: Guard
    ) -> None:
        self._number += 1
        if self._events:
            self._report(self._events.popleft())
        self._enqueue(FinishedStep(inputs, outputs, sent), robot, guard)
        self._watch_disk(inputs.now.mono_ns)

    def _enqueue(self, step: FinishedStep, robot: Robot, guard: Guard) -> None:
        queue = self._queue
        if self._full:
            self._lost += 1
            if len(queue) > MAX_QUEUED_STEPS // 2:
                return
            self._full, self._wants_state = False, True
        elif len(queue) >= MAX_QUEUED_STEPS:
            self._hangs()
            self._full = True
            self._lost += 1
            cause = "the disk is too slow" if self._thread.is_alive() else "the recorder has ended"
            text = f"{cause}, so steps are missing in the recording"
            self._report(Event("recording", text, "warning"))
            return
        else:
            queue.append(step)
        if self._wants_state:
            self._wants_state = False
            queue.append(StateBeforeStep(self._number, freeze(robot, guard.memory), robot.config))

    def _watch_disk(self, now_ns: int) -> None:
        """Report when the disk begins to hang, and when it is fast enough again."""
        timer = self._writer.sync_timer
        ended, last_ns = timer.ended, self._sync_ns
        self._sync_ns = timer.wait_ns(now_ns)
        if self._slow and timer.ended != ended and last_ns <= SLOW_SYNC_NS:
            self._slow = False
            missing = many(self._lost - self._lost_before, "step is", "steps are")
            self._report(
                Event(
                    "recording",
                    f"the disk is fast enough again; {missing} missing in the recording",
                )
            )
        elif self._sync_ns > SLOW_SYNC_NS and not self._slow:
            self._hangs()
            self._report(Event("recording", f"{SLOW_DISK}; driving goes on", "warning"))

    def _hangs(self) -> None:
        if not self._slow:
            self._slow, self._lost_before = True, self._lost

    def died(self, inputs: Inputs) -> None:
        """Store the inputs of the step in which the daemon failed, so that `close` records them."""
        self._failed_inputs = inputs

    @property
    def status(self) -> Recording:
        trouble = self._writer.trouble or (SLOW_DISK if self._slow else "")
        if self._full:
            trouble = "the disk is too slow, so steps of the recording are lost"
        if not self._thread.is_alive():
            trouble = ENDED
        return Recording(self._writer.where, trouble, self._lost + self._writer.lost)

    def close(self, error: BaseException | None = None) -> None:
        """Write the last steps and the end of the file, and wait at most `CLOSE_S` for that.

        If the disk is slower, and the daemon has not failed, also try for at most `MARK_S` to
        create a marker file. The file tells the next start of the daemon that the disk was slow.

        Args:
            error: the exception that ends the daemon. An `Exception` is a failure of the daemon.
                None, or any other exception such as `KeyboardInterrupt`, is an ordinary end. In an
                exception group, the first exception counts.
        """
        while isinstance(error, BaseExceptionGroup):
            error = error.exceptions[0]
        if isinstance(error, Exception):
            self._writer.bug = self._bug(error)
        self._over.set()
        self._thread.join(CLOSE_S)
        while self._events:
            self._report(self._events.popleft())
        if self._thread.is_alive() and self._writer.bug is None:
            # A hanging disk may delay the marker too, but must not delay the end of the daemon.
            marking = threading.Thread(target=self._writer.mark_cut, args=["late"], daemon=True)
            marking.start()
            marking.join(MARK_S)

    def _bug(self, error: Exception) -> Bug:
        why = type(error).__name__
        # Python may fail to produce the text of an exception. Then only its type is recorded.
        with suppress(Exception):
            why = f"{why}: {error}"[:MAX_ERROR_LENGTH].encode(errors="replace").decode()
        if self._failed_inputs is None:
            return Bug(why, None, b"")
        number, data = self._number, b""
        # The input that made the step fail may also be impossible to encode.
        with suppress(Exception):
            data = Unfinished(number, self._failed_inputs).encode()
        return Bug(f"in step {number}, {why}", self._failed_inputs.now, data)

    # These methods run in the recorder's thread.

    def _request_state(self) -> None:
        self._wants_state = True

    def _work(self) -> None:
        over = False
        while not over:
            over = self._over.wait(SYNC_PAUSE_S)
            try:
                self._writer.write(self._take_queue(), over)
            except Exception:
                self._events.append(Event("recording", ENDED, "error"))
                raise

    def _take_queue(self) -> list[FinishedStep | StateBeforeStep]:
        queue = self._queue
        return [queue.popleft() for _ in range(len(queue))]
