"""The recorder's thread: writes steps to the current file and reacts to disk errors.

A single thread calls `round` about once a second. It writes and syncs the steps that have arrived,
begins and ends files, and retains the files around an incident. If the disk refuses, the steps of
that round are lost and counted. The recorder then pauses for `RETRY_ROUNDS` rounds and tries again
with a new file, which begins with the robot's state.
"""

from __future__ import annotations

import platform
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Literal, NamedTuple

from acsard import __version__
from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config
from acsard.core.config.writing import document
from acsard.core.values import NS_PER_S, Event, Instant
from acsard.recording.chunks import MOST_DATA
from acsard.recording.directory import Ring, Run, leave
from acsard.recording.file import About, Writing
from acsard.recording.recorded_steps import Start, Taken, runs
from acsard.recording.recovery import FULL
from acsard.recording.retention import Around
from acsard.recording.rows import encode
from acsard.recording.timeline import told

RETRY_ROUNDS = 5
"""Rounds to wait, about one second each, after the disk refused."""

BATCH = 256
"""Largest number of steps in one message. One second has fewer, unless many commands arrive."""

LONGEST_NS = 3600 * NS_PER_S
"""Longest time that one file may cover."""

HAPPENED = frozenset({"fault", "stop", "link_down", "link_stale", "port_lost"})
"""Events that count as incidents: the files within a minute of them are retained."""


class Bug(NamedTuple):
    """A failure of the daemon itself, which ends it."""

    why: str
    at: Instant | None
    """Instant of the step that failed; None if the daemon failed outside a step."""
    unfinished: bytes
    """Encoded inputs of that step; empty if they cannot be encoded."""


class OnDisk:
    """The directory, the file that is being written, and the state of the disk."""

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
        """Number of steps lost because the disk refused to write."""
        self._config, self._say, self._ask = config, say, ask
        self._ring: Ring | None = None
        self._writing: Writing | None = None
        self._start: Start | None = Start(0, b"", config)
        """Start of the next file; None if steps were lost, so that a new robot state is needed."""
        self._around = Around[Path]()
        self._number = self._began_ns = 0
        self._last = Instant(0, 0)
        self._told = self._refused = False
        self._looked_back = False
        """True once the files of the previous run have been examined."""
        self._run = Run()
        self._cut_ns: int | None = None
        """Wall-clock time at which a crash cut off the previous run's file, ns since 1970. It is
        set when that file is finished and used once.
        """
        self.bug: Bug | None = None
        """The failure that ends the daemon; read in the last round."""
        self._pause = 0
        self._handed = self._safe = 0
        """Steps of this round that were written to the file or counted as missing, and how many
        of them are synced or counted. Steps that are not synced when the disk refuses are lost.
        """

    def round(self, items: list[Taken | Start], over: bool) -> None:
        """Write the items that have arrived, or count them as missing.

        `over` marks the last round.
        """
        self._handed = self._safe = 0
        try:
            if self._pause == 0 or over:
                ring = self._ring = self._ring or self._take()
                for start, steps in runs(items):
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
        """Mark the file that is being written, so that it does not pass for one cut off by a crash.

        If the daemon ends while this object's thread still waits for the disk, another thread calls
        this.
        """
        writing = self._writing
        if writing is not None:
            # Without the marker, the next start treats the file as cut off by a crash.
            with suppress(OSError):
                leave(writing.path, self._around.kind, cut)

    def _take(self) -> Ring:
        """Open the directory, and report the files that could not be finished."""
        ring = Ring(self._config.record, self._run, self._refused)
        self._refused, self._cut_ns = False, ring.cut_ns or self._cut_ns
        for text in ring.said:
            self._say(Event("recording", text, "warning"))
        return ring

    def _write(self, ring: Ring, start: Start | None, steps: list[Taken]) -> None:
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
            self._add(ring, self._writing, steps[at : at + BATCH])

    def _add(self, ring: Ring, writing: Writing, batch: list[Taken]) -> None:
        """Write steps as one message, or as several if one would be too large to be read."""
        data = encode(self._number, batch)
        if len(data) > MOST_DATA and len(batch) > 1:
            half = len(batch) // 2
            self._add(ring, writing, batch[:half])
            self._add(ring, writing, batch[half:])
            return
        writing.add("steps", batch[0].inputs.now.wall_ns, data)
        self._number += len(batch)
        self._handed += len(batch)
        self._last = batch[-1].inputs.now
        for _, outputs, _ in batch:
            for event in outputs.events:
                writing.event(told(event, outputs.now.wall_ns))
                if event.name in HAPPENED:
                    self._happened(ring, outputs.now)

    def _begin(self, ring: Ring, start: Start, now: Instant) -> None:
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
        self._began_ns = now.mono_ns
        if self._cut_ns is not None:
            since_ns, self._cut_ns = now.wall_ns - self._cut_ns, None
            self._around.earlier_happened(now.mono_ns - max(0, since_ns))
        self._around.begin(now.mono_ns)
        if start.state:
            self._writing.add("state", now.wall_ns, start.state)

    def _look_back(self, ring: Ring, now: Instant) -> None:
        """Carry the minute before and after an incident over a restart of the daemon."""
        for path, kind, ended_ns in ring.just_ended(now):
            self._around.earlier(path, kind, ended_ns)
        self._looked_back = True

    def _happened(self, ring: Ring, now: Instant) -> None:
        """Retain the current file and those that ended less than a minute before."""
        for path in self._around.happened(now.mono_ns):
            ring.keep(path)

    def _die(self, ring: Ring, bug: Bug) -> None:
        """Write the inputs of the step that failed, and retain the file as after a crash."""
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
        path = ring.end(self._writing, self._around.kind, cut, why)
        self._writing, self._safe = None, self._handed
        self._around.end(path, self._last.mono_ns)

    def _fail(self, error: OSError) -> None:
        text = f"{self.where}: {error.strerror or error}"
        if text != self.trouble:
            self.trouble = text
            self._say(Event("recording", f"{text}; driving goes on", "warning"))
        if self._writing is not None:
            self._run.cut[self._writing.path.name] = self._around.kind
            if self.bug is None:
                self.leave("disk")
        for open_one in (self._writing, self._ring):
            if open_one is not None:
                open_one.close()
        self._refused = error.errno in FULL
        self._writing = self._ring = None
        self._pause = RETRY_ROUNDS
