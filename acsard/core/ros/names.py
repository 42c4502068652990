"""Makes the Zenoh keys and liveliness tokens of ROS 2 topics and services.

The bridge's key is the name. That of rmw_zenoh_cpp also has the domain, the type and its hash, and
a wrong hash means no message. A token announces an endpoint: without it messages arrive, but `ros2
topic list` and `wait_for_service` do not find it. The formats are those of rmw_zenoh_cpp (Jazzy
0.2.4 and later) and zenoh-plugin-ros2dds 1.10.
"""

from __future__ import annotations

from typing import Literal

import xxhash
from msgspec import Struct

# fmt: off
# RIHS01, for Jazzy, Kilted and Lyrical: a part of the wire format. A test recomputes them.
TYPE_HASHES: dict[str, str] = {
    "geometry_msgs/msg/Twist":
        "RIHS01_9c45bf16fe0983d80e3cfe750d6835843d265a9a6c46bd2e609fcddde6fb8d2a",
    "geometry_msgs/msg/TwistStamped":
        "RIHS01_5f0fcd4f81d5d06ad9b4c4c63e3ea51b82d6ae4d0558f1d475229b1121db6f64",
    "nav_msgs/msg/Odometry":
        "RIHS01_3cc97dc7fb7502f8714462c526d369e35b603cfc34d946e3f2eda2766dfec6e0",
    "tf2_msgs/msg/TFMessage":
        "RIHS01_e369d0f05a23ae52508854b66f6aa0437f3449d652e8cbf22d5abe85d020f087",
    "sensor_msgs/msg/JointState":
        "RIHS01_a13ee3a330e346c9d87b5aa18d24e11690752bd33a0350f11c5882bc9179260e",
    "sensor_msgs/msg/BatteryState":
        "RIHS01_4bee5dfce981c98faa6828b868307a0a73f992ed0789f374ee96c8f840e69741",
    "sensor_msgs/msg/Imu":
        "RIHS01_7d9a00ff131080897a5ec7e26e315954b8eae3353c3f995c55faf71574000b5b",
    "nav2_msgs/msg/SpeedLimit":
        "RIHS01_83d8e4e842559f4d9a988b19d31b162216ec738536389f98438d1a166f91845a",
    "std_msgs/msg/Empty":
        "RIHS01_20b625256f32d5dbc0d04fee44f43c41e51c70d3502f84b4a08e7a9c26a96312",
    "rcl_interfaces/msg/Log":
        "RIHS01_e28ce254ca8abc06abf92773b74602cdbf116ed34fbaf294fb9f81da9f318eac",
    "diagnostic_msgs/msg/DiagnosticArray":
        "RIHS01_5a8a36efb05fb25070fa0fb3810290c0e6cd4862b54a8fb975a1ee8dc55a333e",
    "std_srvs/srv/Trigger":
        "RIHS01_eeff2cd6fa5ad9d27cdf4dec64818317839b62f212a91e6b5304b634b2062c5f",
    "rcl_interfaces/srv/DescribeParameters":
        "RIHS01_845b484d71eb0673dae682f2e3ba3c4851a65a3dcfb97bddd82c5b57e91e4cff",
    "rcl_interfaces/srv/GetParameters":
        "RIHS01_bf9803d5c74cf989a5de3e0c2e99444599a627c7ff75f97b8c05b01003675cbc",
    "rcl_interfaces/srv/GetParameterTypes":
        "RIHS01_da199c878688b3e530bdfe3ca8f74cb9fa0c303101e980a9e8f260e25e1c80ca",
    "rcl_interfaces/srv/ListParameters":
        "RIHS01_3e6062bfbb27bfb8730d4cef2558221f51a11646d78e7bb30a1e83afac3aad9d",
    "rcl_interfaces/srv/SetParameters":
        "RIHS01_56eed9a67e169f9cb6c1f987bc88f868c14a8fc9f743a263bc734c154015d7e0",
    "rcl_interfaces/srv/SetParametersAtomically":
        "RIHS01_0e192ef259c07fc3c07a13191d27002222e65e00ccec653ca05e856f79285fcd",
}
# fmt: on


NODE = "acsard"  # of the robot's ROS node, and prefix of its services


def full_name(namespace: str, name: str) -> str:
    """Return the full name of a topic or service, with its leading slash."""
    return f"/{namespace}/{name}" if namespace else f"/{name}"


def bridge_key(name: str) -> str:
    """Return the bridge's Zenoh key of a full name."""
    return name.removeprefix("/")


def rmw_key(domain: int, name: str, type_name: str) -> str:
    """Return the Zenoh key of rmw_zenoh_cpp for a full name and a type `pkg/msg/Name`."""
    return f"{domain}/{name.removeprefix('/')}/{dds_type(type_name)}/{TYPE_HASHES[type_name]}"


def dds_type(type_name: str) -> str:
    """Return `pkg::msg::dds_::Name_` for `pkg/msg/Name`."""
    package, kind, name = type_name.split("/")
    return f"{package}::{kind}::dds_::{name}_"


Kind = Literal["MP", "MS", "SS"]  # publisher, subscription, service server

RMW_DEFAULT_DEPTH = 42


class Qos(Struct, frozen=True):
    depth: int = 10  # samples that are kept
    transient: bool = False  # transient local: later subscribers get the kept samples, too
    # Such a subscription accepts every publisher, a reliable one only reliable ones.
    best_effort: bool = False


class Node(Struct, frozen=True):
    """A ROS node in a Zenoh session."""

    domain: int
    zid: str  # of the session
    namespace: str  # without slashes at its ends; "" is the root
    name: str

    @property
    def token(self) -> str:
        """Liveliness token of the node itself, without its endpoints."""
        return f"{self._head}/0/NN/%/{_mangled('/' + self.namespace)}/{self.name}"

    def endpoint_token(self, number: int, kind: Kind, name: str, type_name: str, qos: Qos) -> str:
        """Return the liveliness token of an endpoint, numbered from 1 in its session."""
        return (
            f"{self._head}/{number}/{kind}/%/{_mangled('/' + self.namespace)}/{self.name}"
            f"/{_mangled(name)}/{dds_type(type_name)}/{TYPE_HASHES[type_name]}/{rmw_qos(qos)}"
        )

    @property
    def _head(self) -> str:
        return f"@ros2_lv/{self.domain}/{self.zid}/0"


def rmw_qos(qos: Qos) -> str:
    """Return a QoS profile as in tokens of rmw_zenoh_cpp, without its defaults."""
    depth = "" if qos.depth == RMW_DEFAULT_DEPTH else qos.depth
    reliability = "2" if qos.best_effort else ""
    return f"{reliability}:{'1' if qos.transient else ''}:,{depth}:,:,:,,"


def gid(token: str) -> bytes:
    """Return the GID of an endpoint: XXH3-128 of its token, 16 bytes, little endian."""
    return xxhash.xxh3_128_intdigest(token.encode()).to_bytes(16, "little")


def bridge_presence(zid: str) -> str:
    """Return the liveliness token of a ros2dds bridge."""
    return f"@/{zid}/@ros2_lv"


def bridge_token(zid: str, kind: Kind, name: str, type_name: str, qos: Qos) -> str:
    """Return the liveliness token of an endpoint of a ros2dds bridge."""
    head = f"{bridge_presence(zid)}/{kind}/{_in_one_chunk(bridge_key(name))}"
    head += f"/{_in_one_chunk(type_name)}"
    if kind == "SS":
        return head
    how = f"{int(not qos.best_effort)}:{int(qos.transient)}:0,{qos.depth}"
    return f"{head}/:{how}:typehash={TYPE_HASHES[type_name]};"


def bridged_publishers(name: str) -> str:
    """Return the key expression of the tokens of all bridges with a publisher of a full name."""
    return f"{bridge_presence('*')}/MP/{_in_one_chunk(bridge_key(name))}/**"


def rmw_publishers(domain: int, name: str) -> str:
    """Return the key expression of the tokens of all publishers of a full name."""
    return f"@ros2_lv/{domain}/*/*/*/MP/*/*/*/{_mangled(name)}/**"


def _mangled(name: str) -> str:
    return name.replace("/", "%")


def _in_one_chunk(name: str) -> str:
    return name.replace("/", "§")
