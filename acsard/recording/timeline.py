"""The timeline of a recording: what the robot recorded, in sentences.

It has each event, each new reason of the mode that no event reports, who waits while another
source drives, and the places where a run begins, steps are missing or the clock was set. `acsard
recording show`, the report and the topic `log` of an export have the same entries.
"""

from __future__ import annotations

from collections.abc import Iterator

from msgspec import Struct

from acsard.core.formatting import lasting, many
from acsard.core.values import NS_PER_S, Event, Instant, Level, Ns, WallNs
from acsard.recording.file import Failure, Head, ReadRecord, Waits
from acsard.recording.recorded_steps import RecordedStep

MIN_REASON_NS = NS_PER_S  # between two reasons: sources that alternate would fill the timeline

MIN_CLOCK_CHANGE_NS = 5 * NS_PER_S  # that is reported


class TimelineEntry(Struct, frozen=True, omit_defaults=True):
    """An event of the log, or another entry of a recording's timeline."""

    wall_ns: WallNs
    # Name of an event, or: start, continues (an earlier recording), gap (missing steps), clock (was
    # set), reason (a new one, of the same mode), waits (a source, while another one drives),
    # failure (of the daemon itself), cut (a run without its shutdown).
    name: str
    text: str
    level: Level = "info"
    by: str = ""  # client of the event, or source

    @property
    def sentence(self) -> str:
        """The text and the client, as in a line of the log."""
        return f"{self.text} (by {self.by})" if self.by else self.text


class Timeline:
    """Makes the entries of a recording from its records, in their order."""

    def __init__(self) -> None:
        self._head: Head | None = None
        self._last: RecordedStep | None = None  # of this run
        self._waits: dict[str, str] = {}  # codes by source, in this drive
        self._shown = ("", "", "")  # mode, code and source of the last reason
        self._reason_ns: Ns = -MIN_REASON_NS  # when it was reported

    def take(self, record: ReadRecord) -> Iterator[TimelineEntry]:
        match record:
            case Head():
                yield from self._begin(record)
            case RecordedStep():
                yield from self._step(record)
            case Waits():
                for source, (code, text) in record.reasons.items():
                    if self._waits.get(source) != code:
                        yield TimelineEntry(record.at.wall_ns, "waits", text, by=source)
                self._waits = {source: code for source, (code, _) in record.reasons.items()}
            case Failure(why=why, now=at):
                if at is None and self._last is not None:
                    at = self._last.now
                wall_ns = 0 if at is None else at.wall_ns
                yield TimelineEntry(wall_ns, "failure", f"the daemon failed: {why}", "error")

    def _begin(self, head: Head) -> Iterator[TimelineEntry]:
        before, self._head, last = self._head, head, self._last
        if before is None or last is None:
            return
        if before.started_ns == head.started_ns and head.number > last.number:
            return
        self._last = None
        if last.recorded.status.mode != "shutdown":
            text = "the recording of this run ends without the daemon's shutdown"
            yield TimelineEntry(last.now.wall_ns, "cut", text, "warning")

    def _step(self, step: RecordedStep) -> Iterator[TimelineEntry]:
        last, now = self._last, step.now
        status = step.recorded.status
        mode, reason, link, source = status.mode, status.reason, status.link, status.source
        if last is not None:
            yield from _between(last, step)
        elif step.number == 0:
            by = f" (acsard {self._head.version})" if self._head else ""
            yield TimelineEntry(now.wall_ns, "start", f"the daemon starts{by}")
        else:
            text = f"the robot is {mode} ({reason}), link {link}"
            yield TimelineEntry(now.wall_ns, "continues", text, by=source)
        self._last = step
        if mode != "driving":
            self._waits = {}
        for event in step.recorded.events:
            yield _entry_of(event, now)
        yield from self._reason(step)

    def _reason(self, step: RecordedStep) -> Iterator[TimelineEntry]:
        status = step.recorded.status
        mode, text, source, code = status.mode, status.reason, status.source, status.code
        now, shown = step.now, (mode, code, source if mode == "ready" else "")
        if shown == self._shown:
            return
        codes = [event.code for event in step.recorded.events]
        is_reported = mode != self._shown[0] or code in codes
        if not is_reported and mode != "driving":
            if now.mono_ns - self._reason_ns < MIN_REASON_NS:
                return
            yield TimelineEntry(now.wall_ns, "reason", f"{mode}: {text}", by=source)
        if not is_reported or mode == "waiting":
            # If a link is lost for less than a second, the event about the loss is sufficient.
            self._reason_ns = now.mono_ns
        self._shown = shown


def _entry_of(event: Event, now: Instant) -> TimelineEntry:
    return TimelineEntry(now.wall_ns, event.name, event.text, event.level, event.by)


def _between(last: RecordedStep, step: RecordedStep) -> Iterator[TimelineEntry]:
    before, now = last.now, step.now
    missing = step.number - last.number - 1
    passed_ns = now.mono_ns - before.mono_ns
    if missing > 0:
        steps = many(missing, "step is", "steps are")
        text = f"{steps} missing before this step ({passed_ns / NS_PER_S:.1f} s)"
        yield TimelineEntry(now.wall_ns, "gap", text, "warning")
    ahead_ns = now.wall_ns - before.wall_ns - passed_ns
    if abs(ahead_ns) >= MIN_CLOCK_CHANGE_NS:
        way = "forward" if ahead_ns > 0 else "back"
        # The monotonic clock does not advance while the computer is suspended.
        slept = ", or the computer was suspended" if ahead_ns > 0 else ""
        text = (
            f"the clock of the daemon's computer was set {way} by "
            f"{lasting(abs(ahead_ns) / NS_PER_S)}{slept}: the earlier entries show times of the "
            "clock before this change"
        )
        yield TimelineEntry(now.wall_ns, "clock", text, "warning")
