"""Publishes what the robot reports, answers queries, and writes the events to the log.

The answer to a call waits until the disk has the latches.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable

from msgspec.structs import replace

from acsard.core.config.live import Difference, place
from acsard.core.config.settings import Config
from acsard.core.formatting import listed
from acsard.core.incoming.bus_interface import Bus
from acsard.core.incoming.queries import Queries, Query, refused
from acsard.core.messages.encodings import DecodeError
from acsard.core.messages.keys_and_roles import BEAT
from acsard.core.messages.report import Report
from acsard.core.messages.schema import Beat, Info, Message
from acsard.core.messages.snapshot import Snapshot
from acsard.core.robot import Robot
from acsard.core.summary import summary
from acsard.core.values import (
    NS_PER_US,
    Answer,
    Event,
    Instant,
    News,
    Ns,
    Recording,
    Refusal,
    Request,
    Twist,
)
from acsard.daemon.intake import Intake
from acsard.daemon.latch_file import MAX_ANSWER_DELAY_NS, Keeper
from acsard.daemon.latencies import Stopwatch
from acsard.host import clock
from acsard.recording.recorded_steps import StepRecorder

MAX_NAMED = 3  # settings in `settings_differ`

# Added to an answer while a slow disk lacks the newest latches.
NOT_STORED = (
    "the new state is not on the disk yet; if the daemon restarts before the disk has this state, "
    "it may lose a stop"
)


class Publication:
    def __init__(
        self,
        robot: Robot,
        bus: Bus,
        info: Info,
        start: Instant,
        log: Callable[[Event], None],
        keeper: Keeper,
        recorder: StepRecorder | None = None,
        events: list[Event] | None = None,
        certificate_ends: dict[str, int] | None = None,
        run: int = 0,
        boot_ns: Callable[[], Ns] = clock.boot_ns,
    ) -> None:
        # `events` collects those of other parts. `run` and `boot_ns` are those of the beats.
        self._config = config = robot.config
        self.report = Report(config, start, certificate_ends, info.version)
        self.intake = Intake(
            config, bus, [] if events is None else events, self.report.certificate_ends, run
        )
        self._run, self._boot_ns = run, boot_ns
        self.stopwatch = Stopwatch()
        # Returns the newest message of a key of another part, such as the simulator.
        self.beside: Callable[[str], Message | None] = lambda key: None
        # Gets each new configuration, after the events of its wake-up are in the log.
        self.adopted: Callable[[Config], None] = lambda config: None
        self._robot, self.bus, self._log, self._keeper = robot, bus, log, keeper
        self._recorder = recorder
        self._queries = Queries(config, info)
        # Settings that differ from the start, and their values then.
        self._differing: dict[str, Difference] = {}
        # Answers, with the time at which each was queued, until the disk has the latches.
        self._answers: deque[tuple[int, Answer]] = deque()
        self.now = start  # of the present wake-up
        bus.output.feedback_sent = self.stopwatch.figures["feedback_to_bus"].add

    def publish(self, news: News, applied: Twist | None) -> None:
        """Publish the messages that are due after this wake-up, and log its events.

        `applied` is the twist in a line that was due.
        """
        output, report, now, config = self.bus.output, self.report, self.now, self._robot.config
        is_new, wanted = config is not self._config, output.wanted_keys
        if is_new:
            self._use(config, news.answers)
        if applied is not None or news.events or news.status_changed:
            for key, message in report.others_due(now, news, applied, wanted, self._snapshot):
                output.publish(key, message)
        for answer in news.answers:
            self._answers.append((now.mono_ns, answer))
        if self._answers:
            self.answer()
        for event in news.events:
            self._log(event)
        if is_new:
            self.adopted(config)
        # These may be sent here, so they are last.
        if applied is not None and report.beat_due(now.mono_ns, wanted):
            output.publish_beat(self._beat())
        for estimate in news.estimates:
            if estimate.asked_ns is not None:
                self.stopwatch.round_trip(estimate.heard_ns - estimate.asked_ns)
            for topic in report.feedback_due(estimate, wanted):
                output.publish_feedback(topic, estimate)

    def answer(self, *, last: bool = False) -> None:
        """Send the answers whose latches are stored, or that wait for too long, or all (`last`)."""
        is_stored, before_ns = self._keeper.is_stored, self.now.mono_ns - MAX_ANSWER_DELAY_NS
        trouble = "" if is_stored else self._keeper.trouble or NOT_STORED
        while self._answers and (is_stored or last or self._answers[0][0] < before_ns):
            _, answer = self._answers.popleft()
            if trouble and answer.success:
                answer = replace(answer, message=f"{answer.message}; {trouble}")
            reply = self._queries.answered(answer, self.now.wall_ns)
            if reply is not None:
                self.bus.reply(reply)
                self.bus.retire(reply.ticket)

    def serve(self, query: Query, refusals: list[Refusal]) -> Request | None:
        """Answer a query, or return the request to the robot that it contains."""
        wall_ns, status = self.now.wall_ns, self._robot.status
        try:
            served = self._queries.serve(query, self.current, wall_ns, status)
        except DecodeError as error:
            refusals.append(Refusal(error.reason, f"{query.topic}: {error}"))
            reply = refused(query, str(error), wall_ns)
            served = [] if reply is None else [reply]
        if isinstance(served, Request):
            return served
        for reply in served:
            self.bus.reply(reply)
        self.bus.retire(query.ticket)
        return None

    def current(self, key: str) -> Message | None:
        """Return the present message of a key, or None."""
        if key == BEAT:
            return self._beat()
        return self.report.current(key, self._snapshot) or self.beside(key)

    def _beat(self) -> Beat:
        return Beat(self._run, self._boot_ns() // NS_PER_US)

    def counters(self) -> dict[str, int]:
        return self._snapshot().state.counters

    def _snapshot(self) -> Snapshot:
        now_ns = self.now.mono_ns
        shot, intake, latch_file = summary(self._robot, now_ns), self.intake, self._keeper.trouble
        recording = Recording() if self._recorder is None else self._recorder.status
        named = [one.describe(key) for key, one in self._differing.items()]
        state = replace(
            shot.state,
            counters=shot.state.counters | intake.counters,
            latencies=self.stopwatch.measured(now_ns),
            recording_error=recording.trouble,
            latch_file_error=latch_file or "",
            settings_differ=listed(named, MAX_NAMED),
        )
        return replace(
            shot,
            state=state,
            missed_last_minute=self.stopwatch.missed(now_ns),
            routers=intake.routers.status,
            recording=recording,
            latch_file=latch_file,
        )

    def _use(self, config: Config, answers: tuple[Answer, ...]) -> None:
        self._config = self._queries.config = self.report.config = config
        for answer in answers:
            for key, (old, new) in answer.changes.items():
                earlier = self._differing.pop(key, None)
                ours = old if earlier is None else earlier.ours
                if new != ours:
                    self._differing[key] = Difference(new, ours)
        self._differing = dict(sorted(self._differing.items(), key=lambda item: place(item[0])))
