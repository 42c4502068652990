"""Of several sources the highest drives; of several senders of one source, the first."""

from __future__ import annotations

import pytest

from acsard.core.config.settings import CommandsConfig, Config, Source
from acsard.core.incoming.commands import Arrival, Via
from acsard.core.messages.encodings import encode
from acsard.core.messages.schema import Twist, Vector3
from acsard.core.ros.attachments import Attachment
from acsard.core.values import NS_PER_S
from tests.scenarios.world import World


@pytest.fixture
def world() -> World:
    world = World()
    world.run(0.2)
    return world


def test_the_higher_priority_takes_the_robot_and_gives_it_back(world: World) -> None:
    world.send(0.0, source="nav")
    world.send(0.0, source="teleop")
    world.run(0.05)
    for _ in range(20):
        world.send(0.2, source="nav")
        world.send(-0.2, source="teleop")
        world.run(0.05)
    assert world.state.source == "teleop"
    assert world.odom.twist.twist.linear.x < 0
    waiting = {s.name: s.waits_for for s in world.state.sources}
    assert "teleop has priority" in waiting["nav"]
    world.hold(0.2, seconds=1.0, source="nav")
    assert world.state.source == "nav"
    assert world.odom.twist.twist.linear.x > 0


def test_at_equal_priority_the_first_keeps_the_robot() -> None:
    pair = (Source("left", 50), Source("right", 50))
    world = World(Config(commands=CommandsConfig(sources=pair)))
    world.run(0.2)
    world.drive(0.3, seconds=0.2, source="right")
    world.send(0.0, source="left")
    for _ in range(10):
        world.send(-0.3, source="left")
        world.send(0.3, source="right")
        world.run(0.05)
    assert world.state.source == "right"
    assert "came first" in {s.name: s.waits_for for s in world.state.sources}["left"]


# several people on one source, and networks that delay samples


class Person:
    """A person who commands the source `nav` by one of the three routes.

    Each instance is a separate sender.
    """

    def __init__(self, world: World, via: Via, name: str) -> None:
        self.world, self.via, self.name = world, via, name
        self._sent = 0

    def twist(self, linear: float) -> bytes:
        return encode(Twist(Vector3(linear), Vector3()), "cdr")

    def send(self, linear: float, late: float = 0.0) -> None:
        """Send a Twist that was stamped `late` seconds ago."""
        self.put(self.twist(linear), late)

    def put(self, payload: bytes, late: float = 0.0, kind: str = "Twist") -> None:
        instant, via = self.world.instant, self.via
        stamp_ns = instant.wall_ns - int(late * NS_PER_S)
        self._sent += 1
        rmw = via == "rmw"
        arrival = Arrival(
            "cmd/nav",
            True,
            payload,
            f"application/cdr;geometry_msgs/msg/{kind}" if rmw else "application/cdr",
            instant.mono_ns,
            None if rmw else stamp_ns,
            "" if rmw else f"session of {self.name}",
            via,
            Attachment(self._sent, stamp_ns, self.name.encode().ljust(16)).pack() if rmw else b"",
        )
        self.world.bus.arrivals.append(arrival)

    def drive(self, linear: float) -> None:
        """Send zeros for 1.2 s, then a speed at 20 Hz for 0.5 s. Check that the robot drives."""
        for _ in range(24):
            self.send(0.0)
            self.world.run(0.05)
        for _ in range(10):
            self.world.run(0.05)
            self.send(linear)
        assert self.world.state.mode == "driving"


VIAS: list[Via] = ["rmw", "bridge", "native"]

by_each_way = pytest.mark.parametrize("via", VIAS)


def waits_for(world: World, source: str = "nav") -> str:
    return {s.name: s.waits_for for s in world.state.sources}[source]


@by_each_way
def test_only_the_first_of_two_senders_on_a_key_is_obeyed_and_the_second_is_reported(
    world: World, via: Via
) -> None:
    first, second = Person(world, via, "a"), Person(world, via, "b")
    first.send(0.0)
    world.run(0.02)
    second.send(0.0)
    if via != "rmw":
        world.run(1.1)
    for _ in range(40):
        first.send(0.4)
        world.run(0.025)
        second.send(-0.4)
        world.run(0.025)
        assert world.odom.twist.twist.linear.x >= 0.0
    assert world.state.linear == pytest.approx(0.4, abs=0.03)
    assert (
        waits_for(world)
        == "1 other sender of this source must wait until the sender that drives falls silent"
    )
    for _ in range(40):
        second.send(-0.4)
        world.run(0.05)
    assert world.state.linear == pytest.approx(-0.4, abs=0.03)
    assert waits_for(world) == ""


def test_two_nodes_behind_one_bridge_that_stamps_nothing_are_one_sender(world: World) -> None:
    def send(linear: float) -> None:
        payload = encode(Twist(Vector3(linear), Vector3()), "cdr")
        world.bus.arrivals.append(
            Arrival("cmd/nav", True, payload, "application/cdr", world.now_ns, None, "", "bridge")
        )

    send(0.0)
    world.run(1.1)
    for _ in range(20):
        send(0.4)
        world.run(0.05)
    assert world.state.linear == pytest.approx(0.4, abs=0.03)
    assert waits_for(world) == ""
