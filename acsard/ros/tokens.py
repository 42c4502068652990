"""The liveliness tokens that ROS tools discover, their QoS strings, and the GID of a token.

The formats are those of rmw_zenoh_cpp (Jazzy 0.2.4 and later) and zenoh-plugin-ros2dds 1.10. A
token says that an endpoint exists. Data flows without it, but `ros2 topic list` and
`wait_for_service` do not find the endpoint.
"""

from __future__ import annotations

from typing import Literal

import xxhash
from msgspec import Struct

from acsard.ros.names import TYPE_HASHES, bridge_key, dds_type

Kind = Literal["MP", "MS", "SS"]
"""Publisher, subscription and service server."""

RMW_DEFAULT_DEPTH = 42


class Qos(Struct, frozen=True):
    """QoS profile: keep the last `depth` samples; `transient` also keeps them for late subscribers.

    A `best_effort` reader accepts reliable writers too. A reliable reader accepts only reliable
    ones.
    """

    depth: int = 10
    transient: bool = False
    best_effort: bool = False


class Node(Struct, frozen=True):
    """A ROS node in a Zenoh session."""

    domain: int
    zid: str
    namespace: str
    """Namespace without slashes at its ends; "" is the root."""
    name: str

    @property
    def token(self) -> str:
        """Token of the node itself, which has the first id of the session."""
        return f"{self._head}/0/NN/%/{_mangled('/' + self.namespace)}/{self.name}"

    def endpoint_token(self, number: int, kind: Kind, name: str, type_name: str, qos: Qos) -> str:
        """Return the token of endpoint `number` (from 1) with the fully qualified `name`."""
        return (
            f"{self._head}/{number}/{kind}/%/{_mangled('/' + self.namespace)}/{self.name}"
            f"/{_mangled(name)}/{dds_type(type_name)}/{TYPE_HASHES[type_name]}/{rmw_qos(qos)}"
        )

    @property
    def _head(self) -> str:
        return f"@ros2_lv/{self.domain}/{self.zid}/0"


def rmw_qos(qos: Qos) -> str:
    """Encode a QoS profile as rmw_zenoh_cpp does: values that equal the default are left out."""
    depth = "" if qos.depth == RMW_DEFAULT_DEPTH else qos.depth
    reliability = "2" if qos.best_effort else ""
    return f"{reliability}:{'1' if qos.transient else ''}:,{depth}:,:,:,,"


def gid(token: str) -> bytes:
    """Return the 16 bytes that identify an endpoint: XXH3-128 of its token, low half first."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")


def bridge_presence(zid: str) -> str:
    """Return the token by which a ros2dds bridge announces itself."""
    return f"@/{zid}/@ros2_lv"


def bridge_token(zid: str, kind: Kind, name: str, type_name: str, qos: Qos) -> str:
    """Return the token by which a ros2dds bridge announces a fully qualified name."""
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
