"""The black box of a running daemon: records each step without delaying the control loop.

Once a second a thread writes the queued steps to a file and syncs it. If the queue is full, steps
are lost and counted, and the recording goes on in a new file with the robot's state.
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
from acsard.core.values import NS_PER_S, Event, Inputs, Ns, Outputs, Recording, WallNs
from acsard.recording.recorded_steps import FinishedStep, StateBeforeStep, StepRecorder, Unfinished
from acsard.recording.state import MAX_ERROR_LENGTH, freeze
from acsard.recording.step_writer import Bug, StepWriter

MAX_QUEUED_STEPS = 4096  # 10 s at 400 steps a second

SLOW_SYNC_NS = 3 * NS_PER_S  # of a sync, after which the log reports that the disk hangs

SLOW_DISK = "the disk has accepted no data for 3 s"

SYNC_PAUSE_S = 0.98  # between two syncs: with one, about a second

# Text for the log and `state`.
ENDED = (
    "the recorder has ended because of an internal error, which is in the log: restart the daemon "
    "to record again"
)

# In `close()`: for the last steps and the end of the file, then for a marker.
CLOSE_S, MARK_S = 0.5, 0.1


class Recorder(StepRecorder):
    """The black box of a running daemon."""

    def __init__(
        self, config: Config, report: Callable[[Event], None], started_ns: WallNs = 0
    ) -> None:
        # `report` runs in the thread of the control loop. An export stamps messages that never
        # change with `started_ns`, the daemon's start.
        self._queue: deque[FinishedStep | StateBeforeStep] = deque()
        self._report = report
        self._events: deque[Event] = deque()  # of the thread; each `step` reports one
        self._number = 0  # of the next step
        self._lost = 0  # for a full queue
        self._full = False  # until half of the queue is free again
        self._sync_ns = 0  # running sync at the last `step`, or 0
        self._slow = False  # a slow disk was reported
        self._lost_before = 0  # `_lost` at that time
        self._failed_inputs: Inputs | None = None  # of the step in which the daemon failed
        # For a new file or a checkpoint. The thread sets it, and `step` after a full queue; `step`
        # clears it.
        self._wants_state = False
        self._writer = StepWriter(config, self._events.append, self._request_state, started_ns)
        self._over = threading.Event()
        self._thread = threading.Thread(target=self._work, name="record", daemon=True)
        self._thread.start()

    # These methods run in the control loop's thread.

    def begins(self, robot: Robot, guard: Guard) -> None:
        # Without this call, a replay begins with a new robot and guard.
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

    def _watch_disk(self, now_ns: Ns) -> None:
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
        # Recorded by `close`.
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
        """Write the last steps and the end of the file within `CLOSE_S`.

        If the disk is slower and the daemon has not failed, create a marker within `MARK_S`. Only
        an `Exception` (the first of a group) is a failure.
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
