"""The commanders that somebody looks at: what each sends, on each key that it may send on."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Collection, Iterator, Mapping

import zenoh

from acsard.client import Client
from acsard.config.settings import Config
from acsard.foxglove.commanders import Reader, Way, ways
from acsard.foxglove.facts import Facts
from acsard.host import clock
from acsard.incoming.commands import MAX_COMMAND_BYTES, Arrival
from acsard.messages.encodings import DecodeError
from acsard.messages.schema import TwistStamped
from acsard.ros.channels import CMD_VEL_IN

MOST = 100
"""Held at most, the newest: a second's of one who sends all he may get through."""


class Commanders:
    """All of them, each by its topic; used by one thread, `wake` called by Zenoh's."""

    def __init__(self, robot: Client, wake: Callable[[], object]) -> None:
        self._robot, self._wake = robot, wake
        self._reader, self._deaf = Reader(Config()), False
        self._ways: dict[str, dict[str, Way]] = {}
        self._heard: dict[str, _Heard] = {}

    def use(self, facts: Facts) -> None:
        """Hear them as this robot does."""
        ros, self._deaf = facts.config.ros, bool(facts.deaf)
        self._reader = Reader(facts.config)
        for source in facts.sources:
            topic = CMD_VEL_IN.topic(ros.namespace, source)
            self._ways[topic] = ways(self._robot.key, ros, source)
        self.follow(())  # it may be on other keys than before

    @property
    def topics(self) -> Collection[str]:
        """There is one for each source."""
        return self._ways.keys()

    def follow(self, topics: Collection[str]) -> None:
        """Subscribe to these, and to no other."""
        wanted = set() if self._deaf else self._ways.keys() & set(topics)
        for topic in self._heard.keys() - wanted:
            self._heard.pop(topic).undeclare()
        for topic in wanted - self._heard.keys():
            self._heard[topic] = _Heard(self._robot.session, self._ways[topic], self._wake)

    def take(self) -> Iterator[tuple[str, TwistStamped]]:
        """What has come since, by topic."""
        for topic, heard in self._heard.items():
            for arrival, wall_ns in heard.take():
                try:
                    yield topic, self._reader.read(arrival, wall_ns)
                except DecodeError:
                    pass  # the daemon refuses it too, and counts why


class _Heard:
    """Filled by Zenoh's threads, each command with the time it came."""

    def __init__(
        self, session: zenoh.Session, by_key: Mapping[str, Way], wake: Callable[[], object]
    ) -> None:
        self._ways, self._wake = by_key, wake
        self._held: deque[tuple[Arrival, int]] = deque(maxlen=MOST)
        handler = zenoh.handlers.Callback(self._take)
        self._declared = [session.declare_subscriber(key, handler) for key in by_key]

    def _take(self, sample: zenoh.Sample) -> None:
        now = clock.now()
        key = str(sample.key_expr)
        head, _, last = key.rpartition("/")
        way = self._ways.get(key) or self._ways.get(f"{head}/*")
        if way is None:
            return  # a stranger put it on a wildcard
        put = sample.kind == zenoh.SampleKind.PUT
        attached = sample.attachment
        arrival = Arrival(
            way.native.replace("*", last),
            put,
            sample.payload.to_bytes()[: MAX_COMMAND_BYTES + 1],  # by one too many it is refused
            way.encoding or str(sample.encoding),
            now.mono_ns,
            None,
            "",
            way.via,
            b"" if attached is None else attached.to_bytes(),
        )
        self._held.append((arrival, now.wall_ns))
        self._wake()

    def take(self) -> list[tuple[Arrival, int]]:
        """What has come since, with the wall-clock time, ns."""
        return [self._held.popleft() for _ in range(len(self._held))]

    def undeclare(self) -> None:
        """No more of them."""
        for one in self._declared:
            try:
                one.undeclare()
            except zenoh.ZError:
                pass  # with its session closed it is no more already
