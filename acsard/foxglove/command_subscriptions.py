"""Subscribes to the commands of the shown sources, on every key and in every encoding.

Commands are decoded exactly as the daemon decodes them and as `acsard recording export` writes
them. A command that the daemon refuses is not shown; it appears in the daemon's counters.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator, Mapping

import zenoh
from msgspec import Struct

from acsard.client import Client
from acsard.core.config.settings import Config, RosConfig
from acsard.core.incoming.commands import MAX_COMMAND_BYTES, Arrival, Receiver, Via
from acsard.core.messages.encodings import DecodeError
from acsard.core.messages.schema import Time, TwistStamped
from acsard.core.messages.topics import source_keys
from acsard.core.motion.kinematics import Kinematics
from acsard.core.ros.channels import CMD_VEL_IN
from acsard.core.ros.shapes import asked
from acsard.core.ros.transports import endpoints
from acsard.foxglove.robot_facts import Facts
from acsard.host import clock
from acsard.host.mailbox import Mailbox

MOST = 100
"""Maximum number of waiting commands per source, about one second of the highest accepted rate; the
oldest are dropped."""


class Way(Struct, frozen=True):
    """How the daemon interprets samples on one key of the bus."""

    native: str
    """The native key below the robot's id that the key stands for; "*" is the name of a
    certificate."""
    encoding: str = ""
    """Encoding of samples that do not name one."""
    via: Via = "native"


def ways(key_of: Callable[[str], str], ros: RosConfig, source: str) -> dict[str, Way]:
    """Return each key on which this source accepts commands: twists, wheel speeds and the ROS keys.

    `key_of` returns the full key for a key below the robot's id.
    """
    native = source_keys([source])
    found = {key_of(key): Way(key) for key in (*native, *source_keys([source], "*"))}
    for one in endpoints(ros, "*"):
        if one.native in native:
            found[one.key] = Way(one.native, one.encoding, one.transport)
    return found


class Reader:
    """Converts commands to messages of `cmd_vel_in/<source>`, by the robot's configuration."""

    def __init__(self, config: Config) -> None:
        self._receiver = Receiver(config.joints, Kinematics(config.drive))
        self._frame = config.odometry.base_frame

    def read(self, arrival: Arrival, wall_ns: int) -> TwistStamped:
        """Return the twist of a command that arrived at `wall_ns` (wall clock).

        Raises `DecodeError`.
        """
        twist = self._receiver.command(arrival).twist
        return asked(twist, Time.from_ns(wall_ns), self._frame)


class Commanders:
    """The commands of all sources, by topic.

    One thread uses this class; Zenoh's threads call `wake`.
    """

    def __init__(self, robot: Client, wake: Callable[[], object]) -> None:
        self._robot, self._wake = robot, wake
        self._reader, self._deaf = Reader(Config()), False
        self._ways: dict[str, dict[str, Way]] = {}
        self._heard: dict[str, _Heard] = {}

    def use(self, facts: Facts) -> None:
        """Use the configuration and sources of this robot."""
        ros, self._deaf = facts.config.ros, bool(facts.deaf)
        self._reader = Reader(facts.config)
        for source in facts.sources:
            topic = CMD_VEL_IN.topic(ros.namespace, source)
            self._ways[topic] = ways(self._robot.key, ros, source)
        self.follow(())  # the keys may have changed

    @property
    def topics(self) -> Collection[str]:
        """The command topics, one for each source."""
        return self._ways.keys()

    def follow(self, topics: Collection[str]) -> None:
        """Subscribe to these topics only, and to none if this program cannot receive commands."""
        wanted = set() if self._deaf else self._ways.keys() & set(topics)
        for topic in self._heard.keys() - wanted:
            self._heard.pop(topic).undeclare()
        for topic in wanted - self._heard.keys():
            self._heard[topic] = _Heard(self._robot.session, self._ways[topic], self._wake)

    def take(self) -> Iterator[tuple[str, TwistStamped]]:
        """Yield each received command with its topic.

        A command that cannot be decoded is skipped.
        """
        for topic, heard in self._heard.items():
            for arrival, wall_ns in heard.take():
                try:
                    yield topic, self._reader.read(arrival, wall_ns)
                except DecodeError:
                    pass  # the daemon refuses it too, and counts the reason


class _Heard:
    """The subscriptions of one source.

    Zenoh's threads append each command with its arrival time.
    """

    def __init__(
        self, session: zenoh.Session, by_key: Mapping[str, Way], wake: Callable[[], object]
    ) -> None:
        self._ways = by_key
        self._box = Mailbox[tuple[Arrival, int]](MOST, wake)
        handler = zenoh.handlers.Callback(self._take)
        self._declared = [session.declare_subscriber(key, handler) for key in by_key]

    def _take(self, sample: zenoh.Sample) -> None:
        now = clock.now()
        key = str(sample.key_expr)
        head, _, last = key.rpartition("/")
        way = self._ways.get(key) or self._ways.get(f"{head}/*")
        if way is None:
            return  # published on a wildcard key, which matches no source
        put = sample.kind == zenoh.SampleKind.PUT
        attached = sample.attachment
        arrival = Arrival(
            way.native.replace("*", last),
            put,
            # One byte over the limit is enough for the receiver to refuse the command.
            sample.payload.to_bytes()[: MAX_COMMAND_BYTES + 1],
            way.encoding or str(sample.encoding),
            now.mono_ns,
            None,
            "",
            way.via,
            b"" if attached is None else attached.to_bytes(),
        )
        self._box.put((arrival, now.wall_ns))

    def take(self) -> list[tuple[Arrival, int]]:
        """Return the commands since the last call, with their wall-clock arrival times in ns."""
        return self._box.take()

    def undeclare(self) -> None:
        for one in self._declared:
            try:
                one.undeclare()
            except zenoh.ZError:
                pass  # the session is closed, and the subscription with it
