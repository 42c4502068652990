"""No silence of a real network lets a program drive on that never asked for rest.

The file of this name in `scenarios/` has 210 silences in virtual time. Here the bytes between a
publisher and the daemon pass a TCP relay that holds them, or that ends the connections.
"""

from __future__ import annotations

import json
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import pytest
import zenoh

from tests.system.harness import Bus, Daemon, until
from tests.system.relay import Relay
from tests.system.ros_clients import (
    HASHES,
    QUICK,
    TWIST,
    BridgeHalf,
    RmwClient,
    dds_name,
    gid_of,
    session_at,
    twist,
)

pytestmark = [pytest.mark.network, pytest.mark.slow]

LASTS = 6.0
"""Time behind a silence in which the robot must not move, s."""


class Publisher:
    """A program with a publisher of `cmd_vel`, or of `cmd/nav`, and its token."""

    def __init__(self, session: zenoh.Session, way: str) -> None:
        self.linear = 0.0
        self._put: Callable[[], Any]
        zid = str(session.zid())
        kind = TWIST.replace("/", "§")
        match way:
            case "rmw":
                ros = RmwClient(session)
                token = (
                    f"@ros2_lv/0/{zid}/0/10/MP/%/%/nav2/%cmd_vel/{dds_name(TWIST)}"
                    f"/RIHS01_{HASHES[TWIST]}/::,10:,:,:,,"
                )
                ros.gid = gid_of(token)
                self._put = lambda: ros.put("cmd_vel", TWIST, twist(self.linear))
            case "bridge":
                bridge = BridgeHalf(session)
                token = (
                    f"@/{zid}/@ros2_lv/MP/cmd_vel/{kind}/:1:0:0,10:typehash=RIHS01_{HASHES[TWIST]};"
                )
                self._put = lambda: bridge.put("cmd_vel", TWIST, twist(self.linear))
            case _:
                token = ""
                self._put = lambda: session.put("acsard/acsar/cmd/nav", self._json())
        self._token = session.liveliness().declare_token(token) if token else None

    def _json(self) -> str:
        return json.dumps({"linear": {"x": self.linear}, "angular": {}})

    @contextmanager
    def sending(self) -> Iterator[None]:
        """Send at 20 Hz, also while the network is away."""
        ends = threading.Event()

        def send() -> None:
            while not ends.wait(0.05):
                self._put()

        thread = threading.Thread(target=send, daemon=True)
        thread.start()
        try:
            yield
        finally:
            ends.set()
            thread.join()


def nightly(*values: Any) -> Any:
    return pytest.param(*values, marks=pytest.mark.nightly)


@pytest.mark.parametrize(
    ("way", "relay_does", "silent_s", "event"),
    [
        ("rmw", "holds", 1.2, "clear"),
        ("bridge", "cuts", 1.2, "restart"),
        ("plain", "holds", 6.0, "activate"),
        nightly("rmw", "cuts", 1.2, "clear"),
        nightly("rmw", "holds", 6.0, "activate"),
        nightly("rmw", "cuts", 11.5, "clear"),
        nightly("rmw", "cuts", 7.5, "restart"),
        nightly("rmw", "holds", 11.5, "restart"),
        nightly("bridge", "holds", 1.2, "clear"),
        nightly("bridge", "cuts", 11.5, "clear"),
        nightly("bridge", "holds", 11.5, "clear"),
        nightly("bridge", "holds", 7.5, "restart"),
        nightly("plain", "cuts", 1.2, "clear"),
        nightly("plain", "cuts", 11.5, "restart"),
    ],
)  # fmt: skip
def test_no_speed_drives_behind_a_silence(
    tmp_path: Path, way: str, relay_does: str, silent_s: float, event: str
) -> None:
    first = Daemon(tmp_path, config=QUICK)
    with ExitStack() as stack:
        stack.enter_context(first)
        relay = stack.enter_context(Relay(first.endpoint))
        publisher = Publisher(stack.enter_context(session_at(relay.endpoint)), way)
        stack.enter_context(publisher.sending())
        with Bus(first.endpoint) as bus:
            bus.linked()
            time.sleep(1.5)
            publisher.linear = 0.3
            until(lambda: bus.state()["x"] > 0.1, 10.0, f"it drives\n{first}")
            if event != "restart":
                bus.get("srv/stop" if event == "clear" else "srv/deactivate")
                bus.stands()
                time.sleep(2.2)
            relay.open.clear()
            if relay_does == "cuts":
                relay.cut()
            begun = time.monotonic()
            time.sleep(0.3)
            if event != "restart":
                bus.get(f"srv/{event}")
        if event == "restart":
            first.__exit__()
            stack.enter_context(Daemon(tmp_path, config=QUICK, endpoint=first.endpoint))
        with Bus(first.endpoint) as bus:
            bus.linked()
            x, counted = bus.state()["x"], bus.count("commands")
            time.sleep(max(0.0, begun + silent_s - time.monotonic()))
            relay.open.set()
            until(lambda: bus.count("commands") > counted, 10.0, "the commands are back")
            time.sleep(LASTS)
            state = bus.state()
            assert (state["mode"], state["x"]) == ("ready", x), state["reason"]
