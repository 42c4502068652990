"""From the bus to the viewers: a subscription for each topic that somebody looks at, no other.

What nobody shows costs nothing, here and at the daemon. Of what comes faster than it can be passed
on, the newest goes.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection

import foxglove
import msgspec
import zenoh

from acsard.bus.subscription import Subscription, encoded, queue_on
from acsard.client import Client
from acsard.foxglove.facts import Facts, key_of
from acsard.foxglove.heard import Commanders
from acsard.foxglove.news import News
from acsard.messages.encodings import DecodeError, Decoder
from acsard.messages.schema import MESSAGES, Events, RobotState
from acsard.messages.topics import by_key
from acsard.ros.channels import ENCODING, LOG, SCHEMA_ENCODING, Channel
from acsard.ros.shapes import Log

MOST = 100
"""Messages of a topic passed on at once: a second's."""

STATE, EVENTS = "state", "events"

KEPT = ("tf_static", "diagnostics", STATE)
"""What comes seldom: who begins to look gets the last one."""


class _Out:
    """A topic as the viewers have it."""

    def __init__(self, row: Channel, key: str, channel: foxglove.Channel) -> None:
        self.row, self.key, self.channel = row, key, channel
        self.last: bytes | None = None

    def log(self, message: object) -> None:
        """Pass one on."""
        self.last = self.row.encode(message)
        self.channel.log(self.last)


class Relay:
    """All topics of a robot; used by one thread, `wake` called by Zenoh's."""

    def __init__(self, robot: Client, context: foxglove.Context, wake: Callable[[], None]) -> None:
        self._robot, self._context, self._wake = robot, context, wake
        self._outs: dict[str, _Out] = {}
        self._followed: dict[str, Subscription] = {}
        self._commanders = Commanders(robot, wake)
        self._decoders: dict[str, Decoder[msgspec.Struct]] = {}
        self._news = News()
        self.log_topic = ""
        self.unreadable = 0
        """Samples that are no messages of ours."""

    def offer(self, facts: Facts) -> None:
        """Show what the robot has, beside what was shown before."""
        self._commanders.use(facts)
        for row, source in facts.rows():
            topic = row.topic(facts.config.ros.namespace, source)
            if row is LOG:
                self.log_topic = topic
            if topic not in self._outs:
                schema = foxglove.Schema(
                    name=row.schema_name, encoding=SCHEMA_ENCODING, data=row.schema.encode()
                )
                channel = foxglove.Channel(
                    topic, schema=schema, message_encoding=ENCODING, context=self._context
                )
                self._outs[topic] = _Out(row, key_of(row, source), channel)

    @property
    def commanders(self) -> Collection[str]:
        """The topics that show what each source commands."""
        return self._commanders.topics

    def follow(self, topics: Collection[str], fresh: Collection[str], *, state: bool) -> None:
        """Subscribe to what these need, and to `state` if it is asked for; `fresh` are new ones."""
        if self.log_topic in fresh:
            self._news = News()  # who opens the log sees the last events
        self._commanders.follow(topics)
        shown = [
            out
            for topic, out in self._outs.items()
            if topic in topics and topic not in self._commanders.topics
        ]
        keys = {out.key for out in shown} | ({STATE} if state else set())
        for key in self._followed.keys() - keys:
            self._followed.pop(key).undeclare()
        for topic in fresh:
            out = self._outs.get(topic)
            if out is None or out.key not in self._followed:
                continue
            if out.key == EVENTS:
                self._robot.ask(EVENTS, self._followed[EVENTS].add)
            elif out.key in KEPT and out.last:
                out.channel.log(out.last)
        for key in keys - self._followed.keys():
            self._followed[key] = self._subscribed(key)

    def _subscribed(self, key: str) -> Subscription:
        topic = by_key(key)
        assert topic is not None, key
        arrivals = queue_on(self._robot.session, self._robot.key(key), latched=topic.latched)
        arrivals.wakes(self._wake)
        if not topic.latched:
            self._robot.ask(key, arrivals.take)  # the next one may be seconds away
        return Subscription(arrivals, self._robot.key(key))

    def pass_on(self) -> RobotState | None:
        """Pass on what has come; the newest state among it."""
        newest: RobotState | None = None
        for topic, command in self._commanders.take():
            self._outs[topic].log(command)
        for key, samples in self._followed.items():
            outs = [out for out in self._outs.values() if out.key == key]
            for message in self._messages(key, samples):
                if isinstance(message, Events):
                    for line in self._news.of(message):
                        self.log(line)
                    continue
                for out in outs:
                    out.log(message)
                if isinstance(message, RobotState):
                    newest = message
        return newest

    def ask_state(self) -> None:
        """The next state may be long in coming: ask for one that comes as if published."""
        samples = self._followed.get(STATE)
        if samples is not None:
            self._robot.ask(STATE, samples.add)

    def log(self, line: Log) -> None:
        """A line on the topic `log`."""
        out = self._outs.get(self.log_topic)
        if out is not None:
            out.log(line)

    def _messages(self, key: str, samples: Subscription) -> list[msgspec.Struct]:
        held: deque[zenoh.Sample] = deque(maxlen=MOST)
        try:
            while (sample := samples.try_recv()) is not None:
                held.append(sample)
        except zenoh.ZError:
            pass  # the session has been closed: we are leaving
        found: list[msgspec.Struct] = []
        for sample in held:
            try:
                found.append(self._message(key, sample))
            except DecodeError:
                self.unreadable += 1
        return found

    def _message(self, key: str, sample: zenoh.Sample) -> msgspec.Struct:
        if key not in self._decoders:
            topic = by_key(key)
            assert topic is not None, key
            self._decoders[key] = Decoder(MESSAGES[topic.type])
        return self._decoders[key].decode(*encoded(sample))
