"""ROS 2 nodes on DDS, built with Cyclone DDS for Python, and the bridge between DDS and Zenoh.

For the bridge a `DdsNode` looks like a ROS node, because it announces its endpoints on
`ros_discovery_info`, as rmw_cyclonedds_cpp does. Cyclone DDS encodes and decodes each message, with
types that are created from rosbags' definitions.

All traffic is on loopback, without multicast, in a domain that no other test process uses.
"""

from __future__ import annotations

import functools
import itertools
import re
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import numpy as np
from cyclonedds.domain import Domain, DomainParticipant
from cyclonedds.idl import IdlStruct, make_idl_struct, types
from cyclonedds.pub import DataWriter
from cyclonedds.qos import Policy, Qos
from cyclonedds.sub import DataReader
from cyclonedds.topic import Topic
from cyclonedds.util import duration
from rosbags.interfaces import Nodetype

from tests.system.harness import Program, until
from tests.system.ros_clients import (
    BRIDGE_FILE,
    EMPTY_REQUEST,
    HASHES,
    REQUESTS,
    ROUTE_S,
    TRIGGER,
    Called,
    Client,
    Sample,
    Samples,
    bare_environment,
    dds_name,
    encode,
    fields_of,
    make,
)

CYCLONE = """\
<CycloneDDS><Domain Id="any">
<General><AllowMulticast>false</AllowMulticast>
<Interfaces><NetworkInterface address="127.0.0.1"/></Interfaces></General>
<Discovery><ParticipantIndex>auto</ParticipantIndex>
<MaxAutoParticipantIndex>20</MaxAutoParticipantIndex>
<Peers><Peer address="127.0.0.1"/></Peers></Discovery>
</Domain></CycloneDDS>
"""
"""Cyclone DDS on loopback, without multicast."""

GRAPH = "rmw_dds_common/msg/ParticipantEntitiesInfo"

_RELIABLE = Policy.Reliability.Reliable(duration(seconds=1))
_VOLATILE = (_RELIABLE, Policy.Durability.Volatile, Policy.History.KeepLast(100))
_LATCHED = (_RELIABLE, Policy.Durability.TransientLocal, Policy.History.KeepLast(100))


class DdsDomain:
    """A DDS domain for the nodes of this process and for the bridges that it starts.

    `program` is the path of the bridge. `where` is the directory for its files.
    """

    def __init__(self, program: str, where: Path) -> None:
        self._program, self._where = program, where
        self.number, self._claim = _unused_domain()
        self._cyclone = where / f"cyclone{self.number}.xml"
        self._cyclone.write_text(CYCLONE)
        self._domain = Domain(self.number, CYCLONE)

    def __enter__(self) -> DdsDomain:
        return self

    def __exit__(self, *error: object) -> None:
        _delete(self._domain)
        self._claim.close()

    def node(self) -> DdsNode:
        """Return a node, which joins the domain when it is entered."""
        return DdsNode(self.number)

    def bridge(self, endpoint: str) -> Bridge:
        """Return a bridge that connects to the Zenoh address `endpoint`."""
        domain = str(self.number)
        words = [self._program, "-c", str(BRIDGE_FILE), "-e", endpoint, "-d", domain]
        own = {"CYCLONEDDS_URI": f"file://{self._cyclone}", "ROS_DISTRO": "jazzy"}
        env = bare_environment() | own | {"RUST_LOG": "zenoh_plugin_ros2dds=debug"}
        return Bridge(words, self._where, env)


def _unused_domain() -> tuple[int, socket.socket]:
    """Return the number of an unused DDS domain, and a socket that reserves it.

    Domain n has 250 UDP ports from 7400 + 250 n on, and its 20 participants use the first 52. The
    socket is bound to the last one, which is free. The ports of domains below 100 are below those
    that the kernel assigns by itself.
    """
    for number in range(20, 100):
        claim = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        try:
            claim.bind(("127.0.0.1", 7400 + 250 * number + 249))
        except OSError:
            claim.close()
            continue
        return number, claim
    raise AssertionError("no DDS domain is free")


NewDomain = Callable[[Path], DdsDomain]
"""Makes a domain, with a directory for its files."""


# types


@functools.cache
def idl(type_name: str) -> type[IdlStruct]:
    """Return the IDL type of a ROS message."""
    return _struct(dds_name(type_name), {}, type_name)


@functools.cache
def idl_of_service(type_name: str, dds_type: str) -> type[IdlStruct]:
    """Return the IDL type of a service's request or reply, with the name `dds_type` on DDS.

    The type begins with the id of the request: the client's GUID and a sequence number, 8 bytes
    each.
    """
    return _struct(dds_type, {"guid": types.uint64, "number": types.int64}, type_name)


def _struct(name: str, header: dict[str, Any], type_name: str) -> type[IdlStruct]:
    fields = {name: _idl_field(*kind) for name, kind in fields_of(type_name)}
    made: type[IdlStruct] = make_idl_struct(name.rpartition("::")[2], name, header | fields)
    return made


_IDL_NAMES = {"bool": bool, "string": str, "byte": types.uint8, "char": types.uint8}
"""The basic types of ROS that have another name in the module `types`."""


def _idl_field(node: Nodetype, of: Any) -> Any:
    match node:
        case Nodetype.NAME:
            return idl(of)
        case Nodetype.ARRAY:
            return types.array[_idl_field(*of[0]), of[1]]
        case Nodetype.SEQUENCE:
            item = _idl_field(*of[0])
            return types.sequence[item, of[1]] if of[1] else types.sequence[item]
        case _:
            return _IDL_NAMES.get(of[0]) or getattr(types, of[0])


# nodes


class DdsNode(Client):
    """A ROS node on DDS. Leaving the context removes it from the domain.

    The first `put` of a topic waits until the bridge subscribes to it. The first `call` of a
    service waits until the bridge offers it.
    """

    PAUSE_S = 0.05

    def __init__(self, domain: int) -> None:
        super().__init__()
        self._participant = DomainParticipant(domain)
        self._graph = DataWriter(
            self._participant,
            Topic(self._participant, "ros_discovery_info", idl(GRAPH)),
            qos=Qos(_RELIABLE, Policy.Durability.TransientLocal, Policy.History.KeepLast(1)),
        )
        self._readers: list[DataReader[Any]] = []
        self._writers: list[DataWriter[Any]] = []
        self._publishers: dict[str, DataWriter[Any]] = {}
        self._clients: dict[str, _ServiceClient] = {}
        self._following: list[tuple[DataReader[Any], Samples]] = []
        self._numbers = itertools.count(1)
        self._ended = threading.Event()
        self._failed: list[BaseException] = []
        self._thread = threading.Thread(target=self._take_all, daemon=True)

    def __enter__(self) -> DdsNode:
        self._thread.start()
        return self

    def __exit__(self, *error: object) -> None:
        self._ended.set()
        self._thread.join()
        _delete(self._participant)
        assert not self._failed, self._failed

    def put(self, name: str, type_name: str, payload: bytes) -> None:
        if name not in self._publishers:
            publisher = self._writer(f"rt/{name}", idl(type_name), type_name)
            self._publishers[name] = publisher
            self._announce()
            until(publisher.get_matched_subscriptions, ROUTE_S, f"a route from {name}")
        publisher = self._publishers[name]
        publisher.write(publisher.data_type.deserialize(payload))

    @contextmanager
    def follow(self, name: str, type_name: str) -> Iterator[Samples]:
        with self._follow(name, type_name, _VOLATILE) as samples:
            yield samples

    @contextmanager
    def follow_late(self, name: str, type_name: str, depth: int = 100) -> Iterator[Samples]:
        latched = (*_LATCHED[:-1], Policy.History.KeepLast(depth))
        with self._follow(name, type_name, latched) as samples:
            yield samples

    @contextmanager
    def _follow(self, name: str, type_name: str, policies: Sequence[Any]) -> Iterator[Samples]:
        samples = Samples()
        reader = self._reader(f"rt/{name}", idl(type_name), policies)
        following = (reader, samples)
        self._following.append(following)
        self._announce()
        try:
            yield samples
        finally:
            self._following.remove(following)
            self._readers.remove(reader)
            _delete(reader)
            self._announce()

    def call(self, name: str, type_name: str = TRIGGER, payload: bytes = EMPTY_REQUEST) -> Called:
        if name not in self._clients:
            self._clients[name] = _ServiceClient(self, name, type_name)
        return self._clients[name].call(payload, next(self._numbers))

    def _take_all(self) -> None:
        """Pass received messages to the subscribers of `follow`, in a separate thread."""
        try:
            while not self._ended.wait(0.003):
                self._take()
        except BaseException as error:
            self._failed.append(error)
            raise

    def _take(self) -> None:
        for reader, samples in list(self._following):
            for payload in take_payloads(reader):
                samples.take(received(reader.topic.name, payload))

    def _reader(
        self, topic: str, kind: type[IdlStruct], policies: Sequence[Any] = _VOLATILE
    ) -> DataReader[Any]:
        made = Topic(self._participant, topic, kind)
        self._readers.append(DataReader(self._participant, made, qos=Qos(*policies)))
        return self._readers[-1]

    def _writer(self, topic: str, kind: type[IdlStruct], hashed: str = "") -> DataWriter[Any]:
        made = Topic(self._participant, topic, kind)
        policies = list(_VOLATILE)
        if hashed in HASHES:
            policies.append(Policy.Userdata(f"typehash=RIHS01_{HASHES[hashed]};".encode()))
        self._writers.append(DataWriter(self._participant, made, qos=Qos(*policies)))
        return self._writers[-1]

    def _announce(self) -> None:
        """Publish the list of the node's endpoints. The bridge ignores all others."""
        readers, writers = (
            [make("rmw_dds_common/msg/Gid", data=_gid(end)) for end in ends]
            for ends in (self._readers, self._writers)
        )
        node = make(
            "rmw_dds_common/msg/NodeEntitiesInfo",
            node_namespace="/",
            node_name="tester",
            reader_gid_seq=readers,
            writer_gid_seq=writers,
        )
        gid = make("rmw_dds_common/msg/Gid", data=_gid(self._participant))
        graph = make(GRAPH, gid=gid, node_entities_info_seq=[node])
        self._graph.write(idl(GRAPH).deserialize(encode(graph)))


class _ServiceClient:
    """A node's client of a service: a writer of requests and a reader of all replies."""

    def __init__(self, node: DdsNode, service: str, type_name: str) -> None:
        self.service = service
        request, reply = REQUESTS[type_name]
        kind = dds_name(type_name)
        asked = idl_of_service(request, f"{kind}Request_")
        answered = idl_of_service(reply, f"{kind}Response_")
        self._requests = node._writer(f"rq/{service}Request", asked)
        self._replies = node._reader(f"rr/{service}Reply", answered)
        self._guid = self._requests.guid.bytes[-8:]
        node._announce()

    def call(self, payload: bytes, number: int) -> Called:
        """Send a request, and return the replies that have arrived when the first one arrives.

        It first waits for the service, as ROS programs do.
        """
        until(self._requests.get_matched_subscriptions, ROUTE_S, f"a route to {self.service}")
        until(self._replies.get_matched_publications, ROUTE_S, f"a route from {self.service}")
        header = self._guid + struct.pack("<q", number)
        begun = time.monotonic()
        request = payload[:4] + header + payload[4:]
        self._requests.write(self._requests.data_type.deserialize(request))
        replies: list[Sample] = []

        def answered() -> bool:
            for answer in take_payloads(self._replies):
                if answer[4:20] == header:
                    replies.append(received(self.service, answer[:4] + answer[20:]))
            return bool(replies)

        try:
            until(answered, 5.0, f"an answer of {self.service}")
        except AssertionError:
            pass  # the caller sees that no reply came
        return Called(replies, 0, time.monotonic() - begun)


def take_payloads(reader: DataReader[Any]) -> list[bytes]:
    """Return the messages that have arrived at a reader, encoded in CDR."""
    samples = reader.take(100)
    return [sample.serialize() for sample in samples if isinstance(sample, IdlStruct)]


def received(name: str, payload: bytes) -> Sample:
    return Sample(time.monotonic(), name, payload, b"", "")


def _delete(entity: Any) -> None:
    """Delete an entity and its contents now, instead of when the last reference goes."""
    entity.__del__()


def _gid(entity: Any) -> Any:
    return np.frombuffer(entity.guid.bytes, dtype=np.uint8)


# the bridge


class Bridge(Program):
    """A bridge between a DDS domain and Zenoh."""

    @property
    def log(self) -> list[str]:
        """The bridge's log so far, without colours."""
        return [re.sub(r"\x1b\[[0-9;]*m", "", line) for line in [*self.out, *self.err]]

    def logs(self, *texts: str, within: float = 10.0) -> str:
        """Wait for a log line that contains all these texts, and return it."""
        look: Callable[[], str | None] = lambda: next(  # noqa: E731
            (line for line in self.log if all(text in line for text in texts)), None
        )
        return until(look, within, f"{texts} in the bridge's log")
