"""A ROS program that never sends a zero drives behind a silence that is proved to be its own."""

from __future__ import annotations

import time
from pathlib import Path

import pytest

from tests.system.harness import Bus, Daemon
from tests.system.ros_clients import (
    HASHES,
    QUICK,
    TWIST,
    BridgeHalf,
    RmwClient,
    ZenohClient,
    session_at,
    twist,
)

pytestmark = pytest.mark.network

CONFIG = QUICK


def put_for(client: ZenohClient, seconds: float) -> None:
    """Command 0.3 m/s at 20 Hz, as a goal does that never sends a zero."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        client.put("cmd_vel", TWIST, twist(0.3))
        time.sleep(0.05)


@pytest.mark.slow
@pytest.mark.parametrize("way", ["bridge", "rmw"])
def test_silence_arms_nav_only_if_it_is_proved_to_be_the_sender_s(tmp_path: Path, way: str) -> None:
    with Daemon(tmp_path, config=QUICK) as daemon, Bus(daemon.endpoint) as bus:
        bus.linked()
        with session_at(daemon.endpoint) as session:
            if way == "rmw":
                goal = RmwClient(session)
                goal._sequence = 5000  # under way before the network was up
                put_for(goal, 3.0)
                assert bus.stands()["x"] == 0.0
                assert bus.state()["code"] in ("neutral", "no_command", "command")
                goal.put("cmd_vel", TWIST, twist(0.0))  # it ends
                time.sleep(11.0)
                put_for(goal, 1.0)  # another one
                assert bus.state()["x"] > 0.1
                return
            ros, (zid,) = BridgeHalf(session), (str(session.zid()),)
            time.sleep(12.0)
            put_for(ros, 2.0)  # without a token
            assert bus.stands()["x"] == 0.0
            qos = f":1:0:0,10:typehash=RIHS01_{HASHES[TWIST]};"
            key = f"@/{zid}/@ros2_lv/MP/cmd_vel/{TWIST.replace('/', '§')}/{qos}"
            token = session.liveliness().declare_token(key)
            time.sleep(5.0)
            put_for(ros, 2.0)  # sooner than a lost network would have ended the token
            assert bus.stands()["x"] == 0.0
            time.sleep(12.0)
            put_for(ros, 1.0)
            assert bus.state()["x"] > 0.1
            token.undeclare()
