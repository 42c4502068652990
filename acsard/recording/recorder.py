"""The black box of a running daemon: records each step without delaying the control loop.

The loop appends each step to a bounded queue, which a thread writes to a file once a second: a kill
of the daemon costs at most 1.5 s of the recording, a power cut 10 s. If the queue is full, or the
disk refuses, steps are lost and counted, and the recording goes on with the robot's state.
"""

from __future__ import annotations

import errno
import os
import threading
from collections import deque
from collections.abc import Callable, Mapping, Sequence
from contextlib import suppress
from typing import BinaryIO

from msgspec import Struct

from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config
from acsard.core.config.toml_text import document
from acsard.core.formatting import many
from acsard.core.guard import Guard
from acsard.core.robot import Robot
from acsard.core.values import NS_PER_S, Event, Heard, Instant, Ns, Recording, WallNs
from acsard.host.threads import Worker
from acsard.host.version import version
from acsard.host.wait_timer import WaitTimer
from acsard.recording.directory import RecordingDirectory
from acsard.recording.file import Failure, FrameWriter, Head, Waits, ahead_ns
from acsard.recording.recorded_steps import PlainStep, StepRecorder
from acsard.recording.state import MAX_ERROR_LENGTH, freeze

MAX_QUEUED_STEPS = 4096  # 10 s at 400 steps a second

WRITE_PAUSE_S = 0.98  # between two writes: with one, about a second

SYNC_NS = 10 * NS_PER_S  # between two syncs, at most

# Between two heads. Damage costs this much, a head 15 kB, and the state in it 0.3 ms of the control
# loop (with the clocks of 1,024 senders 3 ms), after it has written its line.
HEAD_NS = 20 * NS_PER_S

FILE_NS = 3600 * NS_PER_S  # of one file

CLOCK_JUMP_NS = NS_PER_S  # of the wall clock: a new file begins, by whose time it is found

RETRY_ROUNDS = 5  # about 1 s each, after an error of the disk

SLOW_DISK_NS = 3 * NS_PER_S  # of one write, after which the log reports that the disk hangs

SLOW_DISK = "the disk has accepted no data for 3 s"

ENDED = (
    "the recorder has ended because of an internal error, which is in the log: restart the daemon "
    "to record again"
)

CLOSE_S = 0.5  # for the last steps, when the daemon ends


WATCH_STEPS = 8  # between two looks at the disk's time


class Start(Struct, frozen=True):
    """The robot between two steps, for a `Head`."""

    number: int  # of the next step
    at: Instant
    config: Config  # in force
    state: bytes


class Recorder(StepRecorder):
    """The black box of a running daemon."""

    def __init__(
        self, config: Config, report: Callable[[Event], None], started_ns: WallNs = 0
    ) -> None:
        # `report` runs in the thread of the control loop.
        self._report = report
        self._queue: deque[PlainStep | Start | Waits | Failure] = deque()
        self._number = 0  # of the next step
        self._head_ns = 0  # when the next head is due
        self._waits: Mapping[str, str] = {}  # codes of what sources wait for, in this drive
        self._waits_ns = 0  # when they are due; once a second
        self._lost = 0  # for a full queue
        self._full = False  # until half of the queue is free again
        self._slow = False  # a slow disk was reported
        self._waited_ns = self._lost_before = 0  # at the last step; `_lost` when the disk hung
        self._failed: tuple[Instant, Heard] | None = None  # in the step in which the daemon failed
        self._first = config, b""  # configuration and state before the first step
        self._writer = _Writer(config, started_ns)
        self._over = threading.Event()
        self._thread = Worker("record", self._work)
        self._thread.start()

    # The control loop calls these methods.

    def begins(self, robot: Robot, guard: Guard) -> None:
        # Without this call, a replay begins with a new robot and guard.
        self._first = robot.config, freeze(robot, guard.memory)

    def step(self, step: PlainStep, robot: Robot, guard: Guard) -> None:
        now, writer, queue = step[0], self._writer, self._queue
        if writer.events:
            self._report(writer.events.popleft())
        if self._number == 0:
            self._head_ns = now.mono_ns + HEAD_NS
            queue.append(Start(0, now, *self._first))
        self._number += 1
        if len(queue) >= MAX_QUEUED_STEPS or self._full:
            self._lose()
        else:
            queue.append(step)
        if (writer.wants_head or now.mono_ns >= self._head_ns) and not self._full:
            writer.wants_head, self._head_ns = False, now.mono_ns + HEAD_NS
            queue.append(Start(self._number, now, robot.config, freeze(robot, guard.memory)))
        if robot.status.mode != "driving":
            self._waits = {}
        elif now.mono_ns >= self._waits_ns:
            self._take_waits(now, robot)
        if self._number % WATCH_STEPS == 0:
            self._watch_disk(now.mono_ns)

    def _take_waits(self, now: Instant, robot: Robot) -> None:
        reasons = robot.waits(now.mono_ns)
        codes = {source: why.code for source, why in reasons.items()}
        if codes != self._waits and not self._full:
            self._queue.append(Waits.of(now, reasons))
            self._waits = codes
        self._waits_ns = now.mono_ns + NS_PER_S

    def _lose(self) -> None:
        self._lost += 1
        if not self._full:
            self._full = True
            cause = "the disk is too slow" if self._thread.is_alive() else "the recorder has ended"
            text = f"{cause}, so steps are missing in the recording"
            self._report(Event("recording", text, "warning"))
        elif len(self._queue) <= MAX_QUEUED_STEPS // 2:
            self._full, self._writer.wants_head = False, True

    def _watch_disk(self, now_ns: Ns) -> None:
        timer, waited_ns = self._writer.timer, self._waited_ns
        ended = timer.ended
        self._waited_ns = timer.wait_ns(now_ns)
        if self._slow:
            if timer.ended != ended and waited_ns <= SLOW_DISK_NS:
                self._slow = False
                missing = many(self._lost - self._lost_before, "step is", "steps are")
                text = f"the disk is fast enough again; {missing} missing in the recording"
                self._report(Event("recording", text))
        elif self._waited_ns > SLOW_DISK_NS:
            self._slow, self._lost_before = True, self._lost
            self._report(Event("recording", f"{SLOW_DISK}; driving goes on", "warning"))

    def died(self, now: Instant, heard: Heard) -> None:
        # Recorded by `close`.
        self._failed = now, heard

    @property
    def status(self) -> Recording:
        trouble = self._writer.trouble or (SLOW_DISK if self._slow else "")
        if self._full:
            trouble = "the disk is too slow, so steps of the recording are lost"
        if not self._thread.is_alive():
            trouble = ENDED
        return Recording(self._writer.where, trouble, self._lost + self._writer.lost)

    def close(self, error: BaseException | None = None) -> None:
        """Write the last steps within `CLOSE_S`, and the failure if `error` is an `Exception`."""
        while isinstance(error, BaseExceptionGroup):
            error = error.exceptions[0]
        if isinstance(error, Exception):
            why = type(error).__name__
            # Python may fail to produce the text of an exception. Then only its type is recorded.
            with suppress(Exception):
                why = f"{why}: {error}"[:MAX_ERROR_LENGTH].encode(errors="replace").decode()
            if self._number == 0 and self._failed is not None:
                self._queue.append(Start(0, self._failed[0], *self._first))
            self._queue.append(Failure(self._number, why, *(self._failed or ())))
        self._over.set()
        self._thread.join(CLOSE_S)
        while self._writer.events:
            self._report(self._writer.events.popleft())

    # The thread.

    def _work(self) -> None:
        over = False
        while not over:
            over = self._over.wait(WRITE_PAUSE_S)
            try:
                self._writer.write(self._take_queue(), over)
            except Exception:
                self._writer.events.append(Event("recording", ENDED, "error"))
                raise

    def _take_queue(self) -> list[PlainStep | Start | Waits | Failure]:
        queue = self._queue
        return [queue.popleft() for _ in range(len(queue))]


class _Writer:
    # The part of the recorder that runs in its thread.

    def __init__(self, config: Config, started_ns: WallNs) -> None:
        self.events: deque[Event] = deque()  # for the control loop to report
        self.wants_head = False  # the control loop clears it
        self.where = config.record.directory
        self.trouble = ""  # the present error of the disk, in words
        self.lost = 0  # steps, for errors of the disk
        self.timer = WaitTimer()  # of a write
        self._robot, self._started_ns = config.robot.id, started_ns
        self._directory = RecordingDirectory(config.record)
        self._file: BinaryIO | None = None
        self._frames: FrameWriter | None = None  # into `_file`
        self._ends = False  # the file, at the next head
        self._number = 0  # of the next step
        self._began_ns = self._synced_ns = 0  # of the file
        self._last: Instant | None = None  # step in the file
        self._has_steps = False  # the file, as far as the disk has accepted them
        self._added = self._written = 0  # steps of this call: not flushed yet, and flushed
        self._pause = 0  # calls that still write nothing
        self._records = False  # it was reported
        self._lost_before = 0  # when the disk began to refuse
        self._text = config, _text(config)  # of the last head

    def write(self, items: Sequence[PlainStep | Start | Waits | Failure], over: bool) -> None:
        """Write the items of the recorder's queue. The last call ends the file."""
        steps = sum(isinstance(item, tuple) for item in items)
        self._added = self._written = 0
        if self._pause and not over:
            self._pause -= 1
        else:
            self.timer.begin()
            try:
                self._write(items)
                self._flush()
                self._sync()
                if over:
                    self._end()
            except OSError as error:
                self._refuse(error)
            finally:
                self.timer.end()
        self.lost += steps - self._written
        if self._written and not self._pause:
            self._report_success()
        elif steps and self._frames is None and not self._pause:
            self.wants_head = True

    def _write(self, items: Sequence[PlainStep | Start | Waits | Failure]) -> None:
        steps: list[PlainStep] = []
        for item in items:
            if isinstance(item, tuple):
                steps.append(item)
                continue
            self._add(steps)
            steps = []
            if isinstance(item, Start):
                self._begin(item)
            elif isinstance(item, Waits) and self._frames is not None:
                self._frames.add(item)
            elif isinstance(item, Failure) and self._frames is not None:
                _add_failure(self._frames, item)
        self._add(steps)

    def _add(self, steps: list[PlainStep]) -> None:
        # Only steps that follow a head.
        if not steps or self._frames is None:
            return
        self._frames.add_steps(self._number, steps)
        self._number += len(steps)
        last, now = self._last, steps[-1][0]
        if last is not None and abs(ahead_ns(now) - ahead_ns(last)) > CLOCK_JUMP_NS:
            self._ends = self.wants_head = True
        self._last = now
        self._added += len(steps)

    def _begin(self, start: Start) -> None:
        if self._ends:
            self._end()
        if self._frames is None:
            self._make_room()
            self._file = self._directory.begin(start.at.wall_ns)
            self._frames, self._last, self._has_steps = FrameWriter(self._file), None, False
            self._began_ns = self._synced_ns = start.at.mono_ns
        if start.config is not self._text[0]:
            self._text = start.config, _text(start.config)
        robot, (mono_ns, wall_ns) = self._robot, (start.at.mono_ns, start.at.wall_ns)
        begin = version(), robot, start.number, mono_ns, wall_ns
        self._frames.begin(Head(*begin, self._text[1], start.state, self._started_ns))
        self._number = start.number

    def _make_room(self) -> None:
        if text := self._directory.make_room():
            self.events.append(Event("recording", text, "warning"))

    def _flush(self) -> None:
        if self._file is None or self._last is None:
            return
        self._file.flush()
        # The disk also accepts data for a deleted file, but this data is lost.
        if not os.fstat(self._file.fileno()).st_nlink:
            raise FileNotFoundError(errno.ENOENT, "the file that is being recorded was removed")
        self._has_steps = True
        self._written, self._added = self._written + self._added, 0

    def _sync(self) -> None:
        if self._file is None or self._last is None:
            return
        now_ns = self._last.mono_ns
        if now_ns - self._synced_ns > SYNC_NS:
            os.fsync(self._file.fileno())
            self._synced_ns = now_ns
            self._make_room()
            is_large = self._file.tell() > self._directory.file_bytes
            if is_large or now_ns - self._began_ns > FILE_NS:
                self._ends = self.wants_head = True

    def _report_success(self) -> None:
        if self._records and not self.trouble:
            return
        since = ""
        if self.trouble:
            missing = many(self.lost - self._lost_before, "step is", "steps are")
            # The disk also refused the event that gave the reason, so repeat the reason here.
            since = f" again; {missing} missing (the error was: {self.trouble})"
        self._records, self.trouble = True, ""
        self.events.append(Event("recording", f"the daemon records to {self.where}{since}"))

    def _end(self) -> None:
        if self._file is not None and self._frames is not None:
            self._frames.end()
            self._flush()
            os.fsync(self._file.fileno())
            self._file.close()
        self._file, self._frames, self._ends = None, None, False

    def _refuse(self, error: OSError) -> None:
        text = f"{self.where}: {error.strerror or error}"
        if not self.trouble:
            self._lost_before = self.lost
        if text != self.trouble:
            self.trouble = text
            self.events.append(Event("recording", f"{text}; driving goes on", "warning"))
        if self._file is not None:
            with suppress(OSError):
                self._file.close()
            if not self._has_steps:
                with suppress(OSError):
                    os.unlink(self._file.name)
        self._file, self._frames, self._ends = None, None, False
        self._pause = RETRY_ROUNDS


def _add_failure(frames: FrameWriter, failure: Failure) -> None:
    try:
        frames.add(failure)
    except (TypeError, ValueError, OverflowError):
        # The input that made the step fail may also be impossible to encode.
        frames.add(Failure(failure.number, failure.why))


def _text(config: Config) -> str:
    return "\n".join(document(effective(config))) + "\n"
