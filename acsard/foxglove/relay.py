"""Forwards messages from the bus to the viewers, with a subscription only for topics that are
shown.

A topic that nobody looks at costs nothing, neither here nor in the daemon. If messages arrive
faster than they can be forwarded, the oldest are dropped.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection

import foxglove
import msgspec
import zenoh

from acsard.client import Client
from acsard.client.synchronous import decoder
from acsard.core.messages.encodings import DecodeError
from acsard.core.messages.schema import Events, LogEvent
from acsard.core.messages.topics import by_key
from acsard.core.ros.channels import ENCODING, LOG, SCHEMA_ENCODING, Channel
from acsard.core.ros.shapes import Log, log
from acsard.daemon.bus.subscription import Subscription, encoded, queue_on
from acsard.foxglove.command_subscriptions import Commanders
from acsard.foxglove.robot_facts import Facts, key_of

MOST = 100
"""Maximum number of messages of a topic per round; a second's worth at 100 Hz."""

EVENTS = "events"

KEPT = ("tf_static", "diagnostics", "state")
"""Keys that are published seldom; a viewer that starts to look receives the last message."""


class News:
    """The daemon's events as log lines, each of them once."""

    def __init__(self) -> None:
        self._total = self._stamp_ns = 0
        self._told: list[LogEvent] = []

    def of(self, events: Events) -> list[Log]:
        """Return the new events as log lines.

        After a restart of the daemon, return all events that it still knows.
        """
        known, told, stamp_ns = self._total, self._told, events.stamp.to_ns()
        if events.total < known:
            if stamp_ns <= self._stamp_ns:
                return []  # an older answer that arrived after a published list
            known, told = 0, []  # the daemon was restarted
        self._total, self._stamp_ns, self._told = events.total, stamp_ns, events.events
        new = min(events.total - known, len(events.events))
        last = events.events[len(events.events) - new :]
        # An event that lasts counts several times in the total but appears once in the list.
        return [log(one, one.stamp) for one in last if one not in told]


class _Out:
    """A topic as the viewers see it."""

    def __init__(self, row: Channel, key: str, channel: foxglove.Channel) -> None:
        self.row, self.key, self.channel = row, key, channel
        self.last: bytes | None = None

    def log(self, message: object) -> None:
        self.last = self.row.encode(message)
        self.channel.log(self.last)


class Relay:
    """All topics of a robot. One thread uses this class; Zenoh's threads call `wake`."""

    def __init__(self, robot: Client, context: foxglove.Context, wake: Callable[[], None]) -> None:
        self._robot, self._context, self._wake = robot, context, wake
        self._outs: dict[str, _Out] = {}
        self._followed: dict[str, Subscription] = {}
        self._commanders = Commanders(robot, wake)
        self._news = News()
        self.log_topic = ""
        self.unreadable = 0
        """Number of samples that could not be decoded."""

    def offer(self, facts: Facts) -> None:
        """Offer the robot's topics, in addition to those offered before."""
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
        """The topics that show the commands of each source."""
        return self._commanders.topics

    def follow(self, topics: Collection[str], fresh: Collection[str]) -> None:
        """Subscribe to the keys of these topics only.

        `fresh` are topics that a viewer has just begun to look at.
        """
        if self.log_topic in fresh:
            self._news = News()  # a viewer that opens the log sees the last events
        self._commanders.follow(topics)
        shown = [
            out
            for topic, out in self._outs.items()
            if topic in topics and topic not in self._commanders.topics
        ]
        keys = {out.key for out in shown}
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
            self._robot.ask(key, arrivals.put)  # the next message may be seconds away
        return Subscription(arrivals, self._robot.key(key))

    def pass_on(self) -> None:
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

    def log(self, line: Log) -> None:
        out = self._outs.get(self.log_topic)
        if out is not None:
            out.log(line)

    def _messages(self, key: str, samples: Subscription) -> list[msgspec.Struct]:
        held: deque[zenoh.Sample] = deque(maxlen=MOST)
        try:
            while (sample := samples.try_recv()) is not None:
                held.append(sample)
        except zenoh.ZError:
            pass  # the session is closed: the program is ending
        found: list[msgspec.Struct] = []
        reader = decoder(key)
        for sample in held:
            try:
                found.append(reader.decode(*encoded(sample)))
            except DecodeError:
                self.unreadable += 1
        return found
