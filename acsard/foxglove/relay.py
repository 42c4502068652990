"""Forwards messages from the bus to the Foxglove viewers.

The relay subscribes only to topics that a viewer shows, so all other topics cost no time here or in
the daemon. If messages arrive faster than the relay can forward them, the oldest are dropped.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection
from contextlib import suppress

import foxglove
import msgspec
import zenoh

from acsard.bus.subscription import Subscription, encoded
from acsard.client.connection import Connection
from acsard.client.reads import decoder
from acsard.core.config.settings import Config
from acsard.core.messages.encodings import DecodeError
from acsard.core.messages.keys_and_roles import by_key
from acsard.core.messages.schema import Events, LogEvent
from acsard.core.ros.channels import (
    CMD_VEL_IN,
    ENCODING,
    LOG_CHANNEL,
    SCHEMA_ENCODING,
    Channel,
    published_channels,
)
from acsard.core.ros.shapes import Log, log
from acsard.core.ros.transports import unused_keys


class EventDeduplicator:
    """Converts the daemon's lists of events, which overlap, to one log message of each event."""

    def __init__(self) -> None:
        self._total = self._stamp_ns = 0
        self._reported: list[LogEvent] = []

    def of(self, events: Events) -> list[Log]:
        """Return a log message for each event that the list before did not have.

        A repetition of an event has a new time and is at the end of its list. After a restart of
        the daemon with a clock that was set back, some events may be left out.
        """
        stamp_ns = events.stamp.to_ns()
        if events.total < self._total and stamp_ns <= self._stamp_ns:
            return []  # an older answer that arrived after a published list
        previous, self._reported = self._reported, events.events
        self._total, self._stamp_ns = events.total, stamp_ns
        return [log(event, event.stamp) for event in events.events if event not in previous]


class _Out:
    def __init__(self, row: Channel, key: str, channel: foxglove.Channel) -> None:
        self.row, self.key, self.channel = row, key, channel
        self.last: bytes | None = None

    def log(self, message: object) -> None:
        self.last = self.row.encode(message)
        self.channel.log(self.last)


class Relay:
    """Forwards all topics of a robot to the viewers. Only one thread may use this class."""

    def __init__(
        self, robot: Connection, context: foxglove.Context, wake: Callable[[], None]
    ) -> None:
        self._robot, self._context, self._wake = robot, context, wake
        self._outs: dict[str, _Out] = {}
        self._followed: dict[str, Subscription] = {}
        self._deduplicator = EventDeduplicator()
        self._log_topic = ""

    def offer(self, config: Config) -> None:
        """Offer the robot's topics to the viewers. Topics that were offered before remain."""
        for row in published_channels(unused_keys(config)):
            if row is CMD_VEL_IN:
                continue  # only recordings contain the commands of other programs
            topic = row.topic(config.ros.namespace)
            if row is LOG_CHANNEL:
                self._log_topic = topic
            if topic not in self._outs:
                schema = foxglove.Schema(
                    name=row.schema_name, encoding=SCHEMA_ENCODING, data=row.schema.encode()
                )
                channel = foxglove.Channel(
                    topic, schema=schema, message_encoding=ENCODING, context=self._context
                )
                self._outs[topic] = _Out(row, row.native, channel)

    def follow(self, topics: Collection[str], fresh: Collection[str]) -> None:
        """Subscribe to the keys of the topics that viewers show.

        A topic in `fresh` has a new viewer, which gets the last message of a rare key again.
        """
        if self._log_topic in fresh:
            # A viewer that opens the log receives the last events too.
            self._deduplicator = EventDeduplicator()
        keys = {out.key for topic, out in self._outs.items() if topic in topics}
        for key in self._followed.keys() - keys:
            self._followed.pop(key).undeclare()
        for topic in fresh:
            out = self._outs.get(topic)
            if out is None or out.key not in self._followed:
                continue
            if out.key == "events":
                self._robot.start_query("events", self._followed["events"].put)
            elif out.key in ("tf_static", "diagnostics", "state") and out.last:
                # These keys are published rarely, so a new viewer receives the last message.
                out.channel.log(out.last)
        for key in keys - self._followed.keys():
            self._followed[key] = self._subscribed(key)

    def _subscribed(self, key: str) -> Subscription:
        topic = by_key(key)
        assert topic is not None, key
        samples = self._robot.subscribe(key)
        samples.wakes(self._wake)
        if not topic.latched:
            self._robot.start_query(key, samples.put)  # the next message may be seconds away
        return samples

    def forward(self) -> None:
        """Forward the messages that have arrived since the last call."""
        for key, samples in self._followed.items():
            outs = [out for out in self._outs.values() if out.key == key]
            for message in self._messages(key, samples):
                if isinstance(message, Events):
                    for line in self._deduplicator.of(message):
                        self._log(line)
                    continue
                for out in outs:
                    out.log(message)

    def _log(self, line: Log) -> None:
        out = self._outs.get(self._log_topic)
        if out is not None:
            out.log(line)

    def _messages(self, key: str, samples: Subscription) -> list[msgspec.Struct]:
        # A round forwards at most the newest 100 messages of a key, one second's worth at 100 Hz.
        backlog: deque[zenoh.Sample] = deque(maxlen=100)
        try:
            while (sample := samples.try_recv()) is not None:
                backlog.append(sample)
        except zenoh.ZError:
            pass  # the session is closed: the program is ending
        messages: list[msgspec.Struct] = []
        reader = decoder(key)
        for sample in backlog:
            with suppress(DecodeError):  # of a daemon of another version
                messages.append(reader.decode(*encoded(sample)))
        return messages
