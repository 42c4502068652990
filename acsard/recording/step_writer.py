"""Writes recorded steps to the current file, and reacts to errors of the disk.

The recorder's thread calls `write` about once a second. If the disk refuses, the steps of that call
are lost and counted, the next `RETRY_ROUNDS` calls write nothing, and then a new file begins with
the robot's state.
"""

from __future__ import annotations

import platform
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Literal, NamedTuple

from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config
from acsard.core.config.toml_text import document
from acsard.core.formatting import many
from acsard.core.values import NS_PER_S, Event, Instant, Ns, WallNs
from acsard.host.version import version
from acsard.host.wait_timer import WaitTimer
from acsard.recording.mcap_directory import RecordingDirectory, Run, disk_has_room, mark_cut
from acsard.recording.mcap_file import About, RecordingWriter
from acsard.recording.mcap_records import MAX_DATA_BYTES
from acsard.recording.mcap_timeline import entry_of
from acsard.recording.recorded_steps import FinishedStep, StateBeforeStep, split_at_states
from acsard.recording.recovery import DISK_FULL
from acsard.recording.retention import IncidentWindow
from acsard.recording.rows import encode
from acsard.recording.state import Checkpoint

RETRY_ROUNDS = 5  # about 1 s each, after an error of the disk

MAX_BATCH_STEPS = 256  # in a message: a second, if few commands arrive

# After damage to a chunk, a replay lacks at most 20 s. The control loop needs 0.6 ms for a
# checkpoint, after it has written its line. A checkpoint has 6 kB while the robot stands still, and
# 13 kB while it drives.
CHECKPOINT_NS = 18 * NS_PER_S + NS_PER_S // 2  # between checkpoints, from which a replay can begin

MAX_FILE_NS = 3600 * NS_PER_S  # covered by one file

# Events that retain their file, and those within a minute.
INCIDENTS = frozenset({
    "fault", "stop", "emergency_stop", "bumper_pressed", "battery_stop", "link_down", "link_stale",
    "port_lost",
})  # fmt: skip


class Bug(NamedTuple):
    """An internal error that ends the daemon."""

    why: str  # the number of a failed step, and the exception
    at: Instant | None  # of the failed step
    unfinished: bytes  # its inputs, encoded


class StepWriter:
    def __init__(
        self,
        config: Config,
        report: Callable[[Event], None],
        request_state: Callable[[], None],
        started_ns: WallNs,
    ) -> None:
        # `request_state` asks the control loop for a `StateBeforeStep`. The first `write` opens a
        # file.
        self._started_ns = started_ns
        self.where = config.record.directory
        self.trouble = ""  # the present error of the disk, in words
        self.lost = 0  # steps, for errors of the disk
        self.sync_timer = WaitTimer()  # of the file, for the control loop
        self._lost_before = 0  # `lost` when the present error began
        self._safe_ns: Ns | None = None  # last step that is synced
        self._config, self._report, self._request_state = config, report, request_state
        self._directory: RecordingDirectory | None = None
        self._writing: RecordingWriter | None = None
        # State for the next file; None: a file is open, or it must be requested.
        self._start: StateBeforeStep | None = StateBeforeStep(0, b"", config)
        self._incidents = IncidentWindow[Path]()
        self._number = self._began_ns = self._state_ns = 0
        self._last = Instant(0, 0)
        self._reported = False  # that the daemon records
        self._refused = False  # although it reported free space
        self._looked_back = False  # the previous run's files are in `_incidents`
        self._run = Run()
        # Wall-clock time of a crash of the previous run, until a file begins.
        self._cut_ns: Ns | None = None
        self.bug: Bug | None = None  # recorded by the last `write`
        self._pause = 0  # calls that still write nothing
        # Steps of this `write` that were written or lost, and that are synced or in `lost`. The
        # others are lost if the disk refuses.
        self._handed = self._safe = 0

    def write(self, items: list[FinishedStep | StateBeforeStep], over: bool) -> None:
        """Write the items of the recorder's queue and sync; the last call finishes the file."""
        self._handed = self._safe = 0
        try:
            if self._pause == 0 or over:
                self._directory = self._directory or self._open_directory()
                for start, steps in split_at_states(items):
                    self._write_group(start, steps)
                self._flush(over)
            else:
                self._pause -= 1
        except OSError as error:
            self._fail(error)
        for event in self._run.events:
            self._report(event)
        self._run.events.clear()
        lost = sum(isinstance(item, FinishedStep) for item in items) - self._safe
        if lost:
            self.lost += lost
            self._start = None
        if self._start is None and self._writing is None and self._pause == 0:
            self._request_state()

    def mark_cut(self, cut: Literal["late", "disk"]) -> None:
        """Create a marker of why the file is not finished ("late": too slow; "disk": full).

        Otherwise the next start would assume a crash. Another thread may call this during `write`.
        """
        writing = self._writing
        if writing is not None:
            with suppress(OSError):
                mark_cut(writing.path, self._incidents.kind, cut)

    def _open_directory(self) -> RecordingDirectory:
        directory = RecordingDirectory(self._config.record, self._run, self._refused)
        self._refused, self._cut_ns = False, directory.cut_ns or self._cut_ns
        for text in directory.messages:
            self._report(Event("recording", text, "warning"))
        return directory

    @property
    def _opened(self) -> RecordingDirectory:
        assert self._directory is not None
        return self._directory

    def _write_group(self, start: StateBeforeStep | None, steps: list[FinishedStep]) -> None:
        # The state begins a new file, or is a checkpoint.
        if start is not None and self._writing is not None and self._goes_on(start):
            self._add_checkpoint(self._writing, start, self._last)
        elif start is not None:
            self._finish()
            self._start, self._number = start, start.number
        if self._writing is None:
            if self._start is None or not steps:
                self.lost += len(steps)
                self._handed += len(steps)
                self._safe = self._handed
                return
            self._begin(self._start, steps[0].inputs.now)
        assert self._writing is not None
        for at in range(0, len(steps), MAX_BATCH_STEPS):
            self._add(self._writing, steps[at : at + MAX_BATCH_STEPS])

    def _goes_on(self, start: StateBeforeStep) -> bool:
        return start.number == self._number and not self._is_long_enough()

    def _is_long_enough(self) -> bool:
        too_long = self._last.mono_ns - self._began_ns > MAX_FILE_NS
        return too_long or (
            self._writing is not None and self._writing.size > self._opened.file_bytes
        )

    def _add_checkpoint(
        self, writing: RecordingWriter, start: StateBeforeStep, now: Instant
    ) -> None:
        if start.state:
            writing.add("state", now.wall_ns, Checkpoint(start.number, start.state).encode())
        self._state_ns = now.mono_ns

    def _add(self, writing: RecordingWriter, batch: list[FinishedStep]) -> None:
        data = encode(self._number, batch)
        # The reader refuses a larger message.
        if len(data) > MAX_DATA_BYTES and len(batch) > 1:
            half = len(batch) // 2
            self._add(writing, batch[:half])
            self._add(writing, batch[half:])
            return
        writing.add("steps", batch[0].inputs.now.wall_ns, data)
        self._number += len(batch)
        self._handed += len(batch)
        self._last = batch[-1].inputs.now
        for _, outputs, _ in batch:
            for event in outputs.events:
                writing.event(entry_of(event, outputs.now.wall_ns))
                if event.name in INCIDENTS:
                    self._retain(outputs.now)

    def _begin(self, start: StateBeforeStep, now: Instant) -> None:
        self._opened.trim(now)
        if not self._looked_back:
            self._look_back(now)
        about = About(
            robot=self._config.robot.id,
            version=version(),
            python=platform.python_version(),
            mono_ns=now.mono_ns,
            wall_ns=now.wall_ns,
            started_ns=self._started_ns,
            config="\n".join(document(effective(start.config))) + "\n",
        )
        self._writing, self._start = self._opened.begin(about), None
        self._began_ns = now.mono_ns
        if self._cut_ns is not None:
            since_ns, self._cut_ns = now.wall_ns - self._cut_ns, None
            self._incidents.earlier_happened(now.mono_ns - max(0, since_ns))
        self._incidents.begin(now.mono_ns)
        self._add_checkpoint(self._writing, start, now)

    def _look_back(self, now: Instant) -> None:
        # An incident at the beginning of this run protects them, and one in them this run's first
        # file.
        for path, kind, ended_ns in self._opened.just_ended(now):
            self._incidents.earlier(path, kind, ended_ns)
        self._looked_back = True

    def _retain(self, now: Instant) -> None:
        for path in self._incidents.happened(now.mono_ns):
            self._opened.retain(path)

    def _write_bug(self, bug: Bug) -> None:
        if bug.at is not None and self._writing is None and self._start is not None:
            self._begin(self._start, bug.at)
        if self._writing is None:
            return
        self._last = bug.at or self._last
        if bug.unfinished:
            self._writing.add("unfinished", self._last.wall_ns, bug.unfinished)
        self._retain(self._last)

    def _flush(self, over: bool) -> None:
        if over:
            if self.bug is not None:
                self._write_bug(self.bug)
            self._finish(*(("bug", self.bug.why) if self.bug else ()))
            self._opened.close()
        if self._writing is None:
            return
        self.sync_timer.begin()
        try:
            self._writing.flush()
        finally:
            self.sync_timer.end()
        self._safe, self._run.freed = self._handed, 0
        self._opened.maintain(self._last)
        if self.trouble or not self._reported:
            missing = many(self.lost - self._lost_before, "step is", "steps are")
            if self.lost > self._lost_before and self._safe_ns is not None:
                # The cut-off file may contain some of these steps although no sync confirmed them.
                at_most = f", at most {(self._began_ns - self._safe_ns) / NS_PER_S:.1f} s"
            else:
                at_most = ""
            # The disk also refused the event that gave the reason, so repeat the reason here.
            since = (
                f" again; {missing} missing{at_most} (the error was: {self.trouble})"
                if self.trouble
                else ""
            )
            self.trouble, self._reported = "", True
            self._report(Event("recording", f"the daemon records to {self.where}{since}"))
        self._safe_ns = self._last.mono_ns
        if self._is_long_enough() or self._last.mono_ns - self._state_ns > CHECKPOINT_NS:
            self._request_state()

    def _finish(self, cut: str = "", why: str = "") -> None:
        if self._writing is None:
            return
        path = self._opened.end(self._writing, self._incidents.kind, cut, why)
        self._writing, self._safe = None, self._handed
        self._incidents.end(path, self._last.mono_ns)

    def _fail(self, error: OSError) -> None:
        text = f"{self.where}: {error.strerror or error}"
        if not self.trouble:
            self._lost_before = self.lost
        if text != self.trouble:
            self.trouble = text
            self._report(Event("recording", f"{text}; driving goes on", "warning"))
        if self._writing is not None:
            self._run.cut[self._writing.path.name] = self._incidents.kind
            if self.bug is None:
                self.mark_cut("disk")
        for resource in (self._writing, self._directory):
            if resource is not None:
                resource.close()
        # If the disk reports that it is full, this report alone decides which recordings are
        # deleted. Otherwise the daemon would delete one more when the disk has room again.
        try:
            self._refused = error.errno in DISK_FULL and disk_has_room(Path(self.where))
        except OSError:
            self._refused = False
        self._writing = self._directory = None
        self._pause = RETRY_ROUNDS
