"""The disk's side of the black box: the ring of files, the one being written, and how it goes.

One thread has it. A round takes what has come since the last: writes, syncs, begins and ends files,
keeps those around what happened. A disk that refuses costs what came in that round, is left alone
for some, and is tried again; what follows begins a new file with the robot's state.
"""

from __future__ import annotations

import platform
from collections.abc import Callable
from contextlib import suppress
from pathlib import Path
from typing import Literal, NamedTuple

from acsard import __version__
from acsard.config.parsing import effective
from acsard.config.settings import Config
from acsard.config.writing import document
from acsard.record.around import Around
from acsard.record.batch import encode
from acsard.record.directory import Ring, Run, leave
from acsard.record.file import About, Writing
from acsard.record.recovery import FULL
from acsard.record.steps import Start, Taken, runs
from acsard.record.story import told
from acsard.values import NS_PER_S, Event, Instant

RETRY_ROUNDS = 5
"""Between two tries of a disk that refused."""

BATCH = 256
"""Steps in a message at most: as many as a second has, unless commands pour in."""

LONGEST_NS = 3600 * NS_PER_S
"""What a file holds at most."""

HAPPENED = frozenset({"fault", "stop", "link_down", "link_stale", "port_lost"})
"""Events whose minutes are kept."""


class Bug(NamedTuple):
    """The fault of its own that the daemon ends by."""

    why: str
    at: Instant | None
    """Of the step that it ended, if it was in one."""
    unfinished: bytes
    """That step; empty where it cannot be written."""


class OnDisk:
    """The ring, the file, and how the disk takes it."""

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
        self._start: Start | None = Start(0, b"", config)
        """What the next file begins with; None when steps before it are missing."""
        self._around = Around[Path]()
        self._number = self._began_ns = 0
        self._last = Instant(0, 0)
        self._reason: str | None = None
        """The last one written to this file."""
        self._told = self._refused = False
        self._looked_back = False
        """At what the run before this one has left."""
        self._run = Run()
        self._cut_ns: int | None = None
        """When a crash has cut what was before this run, wall clock, once that is whole; looked at
        once."""
        self.bug: Bug | None = None
        """By which the daemon ends; looked at in the last round."""
        self._pause = 0
        self._handed = self._safe = 0
        """Steps of this round: given to the file, or counted as missing, and how many of them are
        synced, or counted. What a disk that refuses has not synced is gone."""

    def round(self, items: list[Taken | Start], over: bool) -> None:
        """Write what came, or count it as missing."""
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
        """Whatever becomes of the file that is being written, no crash has cut it. Called in a
        thread of its own where the daemon ends while this one still waits for the disk."""
        writing = self._writing
        if writing is not None:
            with suppress(OSError):  # then the next start takes it for a crash's
                leave(writing.path, self._around.kind, cut)

    def _take(self) -> Ring:
        """The directory, and what is told of it."""
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
        self._began_ns, self._reason = now.mono_ns, None
        if self._cut_ns is not None:
            since_ns, self._cut_ns = now.wall_ns - self._cut_ns, None
            self._around.earlier_happened(now.mono_ns - max(0, since_ns))
        self._around.begin(now.mono_ns)
        if start.state:
            self._writing.add("state", now.wall_ns, start.state)

    def _look_back(self, ring: Ring, now: Instant) -> None:
        """The minute before what happens, and after what happened, goes on over a restart."""
        for path, kind, ended_ns in ring.just_ended(now):
            self._around.earlier(path, kind, ended_ns)
        self._looked_back = True

    def _happened(self, ring: Ring, now: Instant) -> None:
        """This file stays, and what is less than a minute before it."""
        for path in self._around.happened(now.mono_ns):
            ring.keep(path)

    def _die(self, ring: Ring, bug: Bug) -> None:
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
