"""Forwards messages from the bus to the Foxglove viewers.

The relay subscribes only to topics that a viewer shows, so all other topics cost no time here or in
the daemon. If messages arrive faster than the relay can forward them, the oldest are dropped.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping

import foxglove
import msgspec
import zenoh
from msgspec import Struct

from acsard.bus.subscription import Subscription, encoded, queue_on
from acsard.client import Client
from acsard.client.synchronous import decoder
from acsard.core.config.settings import Config, RosConfig
from acsard.core.incoming.commands import MAX_COMMAND_BYTES, Arrival, Receiver, Via
from acsard.core.messages.encodings import DecodeError
from acsard.core.messages.keys_and_roles import by_key, source_keys
from acsard.core.messages.schema import Events, LogEvent, Time, TwistStamped
from acsard.core.motion.kinematics import Kinematics
from acsard.core.ros.channels import CMD_VEL_IN, ENCODING, LOG_CHANNEL, SCHEMA_ENCODING, Channel
from acsard.core.ros.shapes import Log, command_message, log
from acsard.core.ros.transports import endpoints
from acsard.foxglove.robot_facts import Facts, key_of
from acsard.host import clock
from acsard.host.mailbox import Mailbox


class EventDeduplicator:
    """Converts the daemon's lists of events to log messages.

    Successive lists overlap, but each event becomes one log message only.
    """

    def __init__(self) -> None:
        self._total = self._stamp_ns = 0
        self._reported: list[LogEvent] = []

    def of(self, events: Events) -> list[Log]:
        """Return a log message for each event that was in no earlier list.

        After a restart of the daemon, all events are new. If the wall clock was also set back, some
        of them may be left out. A list that is older than an earlier list adds no messages.
        """
        known, previous, stamp_ns = self._total, self._reported, events.stamp.to_ns()
        before_ns = self._stamp_ns
        if events.total < known:
            if stamp_ns <= self._stamp_ns:
                return []  # an older answer that arrived after a published list
            known, previous = 0, []  # the daemon was restarted
        self._total, self._stamp_ns, self._reported = events.total, stamp_ns, events.events
        first = len(events.events) - min(events.total - known, len(events.events))
        # The number of new events is wrong if the daemon was restarted and has logged at least as
        # many events as before, so also use the times. Times alone are not enough, because the
        # clock may be set back. An event that lasts counts several times in the total but appears
        # once in the list.
        return [
            log(event, event.stamp)
            for place, event in enumerate(events.events)
            if (place >= first or event.stamp.to_ns() > before_ns) and event not in previous
        ]


class _Out:
    def __init__(self, row: Channel, key: str, channel: foxglove.Channel) -> None:
        self.row, self.key, self.channel = row, key, channel
        self.last: bytes | None = None

    def log(self, message: object) -> None:
        self.last = self.row.encode(message)
        self.channel.log(self.last)


class CommandForm(Struct, frozen=True):
    """The encoding and the transport of the commands on one key of the bus."""

    native: str
    """acsard's own key for these commands (not the ROS key), without the robot's id. A "*" in it
    stands for the name of a certificate."""
    encoding: str = ""
    """Zenoh encoding of all commands on the key; "" if each command names its own encoding."""
    via: Via = "native"


def command_forms(
    key_of: Callable[[str], str], ros: RosConfig, source: str
) -> dict[str, CommandForm]:
    """Return the `CommandForm` of each full key on which commands of a source may arrive, by key.

    The keys are those of acsard and those of ROS. `key_of` adds the robot's id to a key of acsard.
    """
    native = source_keys([source])
    forms = {key_of(key): CommandForm(key) for key in (*native, *source_keys([source], "*"))}
    for endpoint in endpoints(ros, "*"):
        if endpoint.native in native:
            forms[endpoint.key] = CommandForm(
                endpoint.native, endpoint.encoding, endpoint.transport
            )
    return forms


class Reader:
    """Converts commands in any encoding to messages of the topic `cmd_vel_in/<source>`."""

    def __init__(self, config: Config) -> None:
        self._receiver = Receiver(config.joints, Kinematics(config.drive))
        self._frame = config.odometry.base_frame

    def read(self, arrival: Arrival, wall_ns: int) -> TwistStamped:
        """Return the twist of a command, with the time of its arrival.

        `wall_ns` is the time at which the command arrived, ns since 1970. Raises `DecodeError` if
        the command is not valid.
        """
        twist = self._receiver.command(arrival).twist
        return command_message(twist, Time.from_ns(wall_ns), self._frame)


class Commanders:
    """Receives the commands that programs send to the robot. Each command source has one topic.

    Only one thread may use this class. Zenoh's threads call `wake`.
    """

    def __init__(self, robot: Client, wake: Callable[[], object]) -> None:
        self._robot, self._wake = robot, wake
        self._reader, self._commands_hidden = Reader(Config()), False
        self._forms: dict[str, dict[str, CommandForm]] = {}
        self._subscriptions: dict[str, _SourceSubscriptions] = {}

    def use(self, facts: Facts) -> None:
        """Use the command sources, keys and permissions in `facts` from now on.

        All subscriptions end, because the keys may have changed.
        """
        ros, self._commands_hidden = facts.config.ros, bool(facts.commands_hidden_reason)
        self._reader = Reader(facts.config)
        for source in facts.sources:
            topic = CMD_VEL_IN.topic(ros.namespace, source)
            self._forms[topic] = command_forms(self._robot.key, ros, source)
        self.follow(())  # the keys may have changed

    @property
    def topics(self) -> Collection[str]:
        """The names of the topics that show commands, one for each command source."""
        return self._forms.keys()

    def follow(self, topics: Collection[str]) -> None:
        """Subscribe to the commands of `topics` only.

        If this program is connected over TLS, do not subscribe at all, because it is not permitted
        to receive the commands of other clients.
        """
        wanted = set() if self._commands_hidden else self._forms.keys() & set(topics)
        for topic in self._subscriptions.keys() - wanted:
            self._subscriptions.pop(topic).undeclare()
        for topic in wanted - self._subscriptions.keys():
            self._subscriptions[topic] = _SourceSubscriptions(
                self._robot.session, self._forms[topic], self._wake
            )

    def take(self) -> Iterator[tuple[str, TwistStamped]]:
        """Yield a pair (topic, command) for each valid command since the last call."""
        for topic, subscription in self._subscriptions.items():
            for arrival, wall_ns in subscription.take():
                try:
                    yield topic, self._reader.read(arrival, wall_ns)
                except DecodeError:
                    pass  # the daemon refuses it too, and counts the reason


class _SourceSubscriptions:
    """The subscriptions to the commands of one source, and the queue of these commands."""

    def __init__(
        self, session: zenoh.Session, by_key: Mapping[str, CommandForm], wake: Callable[[], object]
    ) -> None:
        self._forms = by_key
        # This is one second of commands at 100 Hz. If more wait, the oldest are dropped.
        self._box = Mailbox[tuple[Arrival, int]](100, wake)
        handler = zenoh.handlers.Callback(self._take)
        self._declared = [session.declare_subscriber(key, handler) for key in by_key]

    def _take(self, sample: zenoh.Sample) -> None:
        now = clock.now()
        key = str(sample.key_expr)
        head, _, last = key.rpartition("/")
        form = self._forms.get(key) or self._forms.get(f"{head}/*")
        if form is None:
            return  # published on a wildcard key, which matches no source
        put = sample.kind == zenoh.SampleKind.PUT
        attached = sample.attachment
        arrival = Arrival(
            form.native.replace("*", last),
            put,
            # One byte over the limit is enough for the receiver to refuse the command.
            sample.payload.to_bytes()[: MAX_COMMAND_BYTES + 1],
            form.encoding or str(sample.encoding),
            now.mono_ns,
            None,
            "",
            form.via,
            b"" if attached is None else attached.to_bytes(),
        )
        self._box.put((arrival, now.wall_ns))

    def take(self) -> list[tuple[Arrival, int]]:
        """Return the new commands as pairs (command, arrival time in ns since 1970)."""
        return self._box.take()

    def undeclare(self) -> None:
        for subscriber in self._declared:
            try:
                subscriber.undeclare()
            except zenoh.ZError:
                pass  # the session is closed, and the subscription with it


class Relay:
    """Forwards all topics of a robot to the viewers. Only one thread may use this class."""

    def __init__(self, robot: Client, context: foxglove.Context, wake: Callable[[], None]) -> None:
        self._robot, self._context, self._wake = robot, context, wake
        self._outs: dict[str, _Out] = {}
        self._followed: dict[str, Subscription] = {}
        self._commanders = Commanders(robot, wake)
        self._deduplicator = EventDeduplicator()
        self.log_topic = ""
        self.unreadable = 0
        """Number of samples that could not be decoded."""

    def offer(self, facts: Facts) -> None:
        """Offer the robot's topics to the viewers. Topics that were offered before remain."""
        self._commanders.use(facts)
        for row, source in facts.rows():
            topic = row.topic(facts.config.ros.namespace, source)
            if row is LOG_CHANNEL:
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
        """The topics that show the commands of programs, one for each command source."""
        return self._commanders.topics

    def follow(self, topics: Collection[str], fresh: Collection[str]) -> None:
        """Subscribe to the keys of the topics that viewers show, and to no other keys.

        `fresh` are the topics with a new viewer. If such a topic is published rarely, its last
        message is sent again for the new viewer.
        """
        if self.log_topic in fresh:
            # A viewer that opens the log receives the last events too.
            self._deduplicator = EventDeduplicator()
        self._commanders.follow(topics)
        outputs = [
            out
            for topic, out in self._outs.items()
            if topic in topics and topic not in self._commanders.topics
        ]
        keys = {out.key for out in outputs}
        for key in self._followed.keys() - keys:
            self._followed.pop(key).undeclare()
        for topic in fresh:
            out = self._outs.get(topic)
            if out is None or out.key not in self._followed:
                continue
            if out.key == "events":
                self._robot.start_query("events", self._followed["events"].add)
            elif out.key in ("tf_static", "diagnostics", "state") and out.last:
                # These keys are published rarely, so a new viewer receives the last message.
                out.channel.log(out.last)
        for key in keys - self._followed.keys():
            self._followed[key] = self._subscribed(key)

    def _subscribed(self, key: str) -> Subscription:
        topic = by_key(key)
        assert topic is not None, key
        arrivals = queue_on(self._robot.session, self._robot.key(key), latched=topic.latched)
        arrivals.wakes(self._wake)
        if not topic.latched:
            self._robot.start_query(key, arrivals.put)  # the next message may be seconds away
        return Subscription(arrivals, self._robot.key(key))

    def forward(self) -> None:
        """Forward the messages and commands that have arrived since the last call."""
        for topic, command in self._commanders.take():
            self._outs[topic].log(command)
        for key, samples in self._followed.items():
            outs = [out for out in self._outs.values() if out.key == key]
            for message in self._messages(key, samples):
                if isinstance(message, Events):
                    for line in self._deduplicator.of(message):
                        self.log(line)
                    continue
                for out in outs:
                    out.log(message)

    def log(self, line: Log) -> None:
        """Publish a message on the topic `log`. Do nothing before this topic has been offered."""
        out = self._outs.get(self.log_topic)
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
            try:
                messages.append(reader.decode(*encoded(sample)))
            except DecodeError:
                self.unreadable += 1
        return messages
