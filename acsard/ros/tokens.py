"""What ROS tools see of us: liveliness tokens, their QoS strings, and the GID made of a token.

Written as rmw_zenoh_cpp (Jazzy 0.2.4 and later) and zenoh-plugin-ros2dds 1.10 write theirs. A
token says that an endpoint exists; data flow without it, but `ros2 topic list` and
`wait_for_service` do not know.
"""

from __future__ import annotations

from typing import Literal

import xxhash
from msgspec import Struct

from acsard.ros.names import TYPE_HASHES, bridge_key, dds_type

Kind = Literal["MP", "MS", "SS"]
"""Publisher, subscription, service server."""

RMW_DEFAULT_DEPTH = 42


class Qos(Struct, frozen=True):
    """Keep last `depth`; `transient` keeps it for those who come late.

    A reader with `best_effort` takes from reliable writers too; a reliable one only from those.
    """

    depth: int = 10
    transient: bool = False
    best_effort: bool = False


class Node(Struct, frozen=True):
    """One ROS node in one Zenoh session."""

    domain: int
    zid: str
    namespace: str
    """Without slashes around it; "" is the root."""
    name: str

    @property
    def token(self) -> str:
        """The token of the node itself, which takes the first id of the session."""
        return f"{self._head}/0/NN/%/{_mangled('/' + self.namespace)}/{self.name}"

    def endpoint_token(self, number: int, kind: Kind, name: str, type_name: str, qos: Qos) -> str:
        """The token of endpoint `number` (from 1) with the fully qualified `name`."""
        return (
            f"{self._head}/{number}/{kind}/%/{_mangled('/' + self.namespace)}/{self.name}"
            f"/{_mangled(name)}/{dds_type(type_name)}/{TYPE_HASHES[type_name]}/{rmw_qos(qos)}"
        )

    @property
    def _head(self) -> str:
        return f"@ros2_lv/{self.domain}/{self.zid}/0"


def rmw_qos(qos: Qos) -> str:
    """QoS as rmw_zenoh_cpp writes it: what equals its default is left out."""
    depth = "" if qos.depth == RMW_DEFAULT_DEPTH else qos.depth
    reliability = "2" if qos.best_effort else ""
    return f"{reliability}:{'1' if qos.transient else ''}:,{depth}:,:,:,,"


def gid(token: str) -> bytes:
    """The 16 bytes that identify an endpoint: XXH3-128 of its token, low half first."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")


def bridge_presence(zid: str) -> str:
    """The token by which a ros2dds bridge makes itself known."""
    return f"@/{zid}/@ros2_lv"


def bridge_token(zid: str, kind: Kind, name: str, type_name: str, qos: Qos) -> str:
    """The token by which a ros2dds bridge announces a fully qualified name."""
    head = f"{bridge_presence(zid)}/{kind}/{_in_one_chunk(bridge_key(name))}"
    head += f"/{_in_one_chunk(type_name)}"
    if kind == "SS":
        return head
    how = f"{int(not qos.best_effort)}:{int(qos.transient)}:0,{qos.depth}"
    return f"{head}/:{how}:typehash={TYPE_HASHES[type_name]};"


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def _in_one_chunk(name: str) -> str:
    return name.replace("/", "§")
