"""Clients send commands, wait or are refused, and `state` always gives the reason."""

from __future__ import annotations

import msgspec
import pytest

from acsard.core.config.settings import CommandsConfig, Config, Source
from acsard.core.incoming.commands import Arrival, Via
from acsard.core.incoming.queries import Query
from acsard.core.messages.encodings import encode
from acsard.core.messages.schema import Header, Time, Twist, TwistStamped, Vector3
from acsard.core.ros.attachments import Attachment
from acsard.core.values import NS_PER_S
from tests.each import each
from tests.scenarios.speakers import Speaker, Way
from tests.scenarios.world import World, naming


@pytest.fixture
def world() -> World:
    world = World()
    world.run(0.2)
    return world


def test_a_source_that_never_sent_a_zero_does_not_move_the_robot(world: World) -> None:
    world.hold(0.5, seconds=2.0)
    assert world.state.x == 0.0
    assert world.state.code == "neutral"


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


def test_a_person_who_holds_the_stick_through_a_clear_masks_the_planner(world: World) -> None:
    world.drive(0.3, seconds=0.5, source="teleop")
    world.call("stop")
    world.call("clear")
    world.send(0.0, source="nav")
    for _ in range(10):
        world.send(0.3, source="teleop")
        world.send(0.3, source="nav")
        world.run(0.05)
    assert world.state.source == "teleop"
    assert world.state.mode == "ready"
    assert world.state.code == "neutral"


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


def test_a_stop_latches_until_clear_and_then_requires_neutral(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    assert world.call("stop").success
    world.hold(0.5, seconds=1.0)
    assert (world.state.mode, world.state.code) == ("stopped", "stopped")
    assert world.state.linear == 0.0
    assert world.call("clear").success
    world.hold(0.5, seconds=1.0)
    assert world.state.mode == "ready"
    world.drive(0.5, seconds=0.5)
    assert world.state.mode == "driving"


def test_a_stop_brakes_harder_than_a_timeout(world: World) -> None:
    world.drive(0.9, seconds=2.0)
    world.put("stop", b"")
    world.run(0.4)
    assert world.lines()[-1] == b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"


def test_a_put_on_stop_stops_the_robot_with_any_payload(world: World) -> None:
    for payload in (b"", b"\x00", b"{}", b"please"):
        world.put("stop", payload)
        world.run(0.02)
        assert world.state.mode == "stopped"
        world.call("clear")


def test_a_delete_on_stop_is_not_a_stop(world: World) -> None:
    world.put("stop", b"", put=False)
    world.run(0.02)
    assert world.state.mode == "ready"


def test_a_deactivated_robot_ramps_down_and_ignores_commands(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    assert world.call("deactivate").success
    world.hold(0.5, seconds=1.0)
    assert world.state.mode == "inactive"
    assert world.state.linear == 0.0


def test_a_robot_stopped_while_inactive_is_inactive_after_clear(world: World) -> None:
    world.call("deactivate")
    world.call("stop")
    world.call("clear")
    assert world.state.mode == "inactive"


@pytest.mark.slow
@each(
    ("key", "payload", "put", "reason"),
    [
        ("cmd/app", b"{", True, "malformed"),
        ("cmd/app", b"hello", True, "unknown_encoding"),
        ("cmd/app", b"", True, "unknown_encoding"),
        ("cmd/app", b'{"linear":{"x":0.5}}', True, "wrong_shape"),
        ("cmd/app", b'{"linear":{"x":"fast"},"angular":{}}', True, "wrong_shape"),
        ("cmd/app", b'{"linear":{"speed":1},"angular":{}}', True, "wrong_shape"),
        ("cmd/app", b'{"linear":{},"angular":{}}' + b" " * 5000, True, "too_big"),
        ("cmd/app", b'{"linear":{"x":0.5},"angular":{}}', False, "not_a_put"),
        ("cmd/*", b'{"linear":{"x":0.5},"angular":{}}', True, "wildcard"),
        ("**", b'{"linear":{"x":0.5},"angular":{}}', True, "wildcard"),
        ("cmd/stranger", b'{"linear":{"x":0.5},"angular":{}}', True, "unknown_source"),
        ("wheel_cmd/app", b'{"name":["a"],"velocity":[1]}', True, "wrong_wheels"),
        (
            "cmd/app",
            msgspec.msgpack.encode({"linear": {"x": float("nan")}, "angular": {}}),
            True,
            "not_finite",
        ),
        (
            "cmd/app",
            msgspec.msgpack.encode({"linear": {"y": float("inf")}, "angular": {}}),
            True,
            "not_finite",
        ),
    ],
)
def test_a_bad_command_is_refused_as_a_whole_and_counted(
    key: str, payload: bytes, put: bool, reason: str
) -> None:
    world = World()
    world.run(0.2)
    world.drive(0.3, seconds=0.5)
    world.run(0.2)
    world.put(key, payload, put)
    world.run(0.06)
    assert world.state.counters[f"command_{reason}"] == 1
    assert world.state.refused
    assert world.state.mode == "ready"  # it extended nothing: the timeout has passed


def test_a_backlog_of_stamped_commands_is_not_obeyed(world: World) -> None:
    world.send(0.0, stamp_ns=world.now_ns)
    world.run(0.05)
    stamps = []
    for _ in range(20):
        stamps.append(world.now_ns)
        world.send(0.3, stamp_ns=world.now_ns)
        world.run(0.05)
    world.run(2.0)
    obeyed = world.state.counters["commands"]
    for stamp in stamps:  # messages that the network delayed for two seconds arrive at once
        world.send(0.3, stamp_ns=stamp)
    world.run(0.05)
    assert world.state.counters["commands"] == obeyed
    assert world.state.counters["command_stale"] == len(stamps)
    assert world.state.mode == "ready"


def test_a_sender_whose_clock_is_a_day_off_can_drive(world: World) -> None:
    day_ns = 86_400_000_000_000
    world.send(0.0, stamp_ns=world.now_ns + day_ns)
    world.run(0.05)
    for _ in range(10):
        world.send(0.3, stamp_ns=world.now_ns + day_ns)
        world.run(0.05)
    assert world.state.mode == "driving"


def test_state_reports_a_new_sender_and_counts_its_ignored_commands() -> None:
    world = World()
    world.run(0.2)
    client = Speaker(world, "signed", ahead=-3600.0)
    client.hold(0.0, 0.2)
    assert world.state.code == "unproven"
    assert "app is new" in {s.name: s.waits_for for s in world.state.sources}["app"]
    assert world.state.counters["commands_of_new_senders"] == 4
    # Every sender begins like this: nothing is refused, and no warning is logged.
    assert not [name for name in world.state.counters if name.startswith("command_")]
    assert world.state.refused == ""
    (warning,) = [event for event in world.events if event.name == "new_sender"][:1]
    assert warning.level == "debug"
    client.hold(0.4, 0.3)
    assert world.state.mode == "driving"


def test_stamps_that_zenoh_replaces_are_only_counted(world: World) -> None:
    client = Speaker(world, "signed", ahead=0.4)
    client.open()
    assert "stamps_replaced" not in world.state.counters
    ahead = Speaker(world, "signed", "b", ahead=3600.0)
    world.run(0.5)
    ahead.open()
    assert world.state.counters["stamps_replaced"] == 40


@pytest.mark.slow
def test_failed_hardware_holds_the_robot_and_the_reason_is_reported(world: World) -> None:
    """ros2_control sends zeros for ever after a hardware fault, while Nav2 sends speeds.

    The robot stays at rest, and after a few seconds the reason in `state` names ros2_control.
    """
    world.send(0.0, source="nav")
    world.send(0.0, source="ros2_control")
    world.run(0.3)
    world.drive(0.3, seconds=1.0, source="nav")
    for second in range(1, 13):
        for _ in range(20):
            world.send(0.0, source="ros2_control")
            world.send(0.3, source="nav")
            world.run(0.05)
        assert (world.state.code == "zeros") == (second >= 3)
    # a person may hold the robot by these zeros, so no other client drives past them
    assert world.state.linear == 0.0
    (code,) = [event.code for event in world.events if event.name == "commands_without_effect"]
    assert code == "zeros"
    world.run(0.3)
    world.drive(0.3, seconds=0.5, source="nav")
    assert world.state.code == "commanded"
    assert world.state.linear > 0.0


@pytest.mark.parametrize("way", ["rmw", "bridge"])
def test_the_first_try_of_a_ros_user_is_answered_in_words(world: World, way: Way) -> None:
    """`ros2 topic pub -r 10 /cmd_vel` sends only speeds, so the robot does not move.

    The reason in `state` and an event say that the sender must send a zero first.
    """
    Speaker(world, way).hold(0.5, 5.0, hz=10.0)
    assert world.state.x == 0.0
    assert world.state.code == "neutral"
    assert "`ros2 topic pub` with a speed never sends a zero" in world.state.reason
    (warning,) = [event for event in world.events if event.name == "commands_without_effect"]
    assert warning.text == f"app: {world.state.reason}"


def test_the_reason_for_a_native_sender_names_no_ros_tools(world: World) -> None:
    Speaker(world, "signed").hold(0.5, 5.0)
    assert world.state.code == "neutral"
    assert "ros2" not in world.state.reason


def test_the_wall_clock_may_step_without_changing_the_path() -> None:
    worlds = World(), World()
    for i, world in enumerate(worlds):
        world.run(0.2)
        world.drive(0.5, 0.5, seconds=1.0)
        world.wall_offset_ns += i * 86_400_000_000_000
        world.hold(0.5, 0.5, seconds=1.0)
    assert worlds[0].state.x == worlds[1].state.x
    assert worlds[0].lines() == worlds[1].lines()


def test_set_pose_and_reset_odometry_move_the_pose_and_not_the_robot(world: World) -> None:
    reply = world.call("set_pose", msgspec.json.encode({"x": 1.0, "y": -2.0, "yaw": 4.0}))
    assert reply.success
    state = world.state
    assert (state.x, state.y) == (1.0, -2.0)
    assert state.yaw == pytest.approx(4.0 - 2 * 3.141592653589793)
    assert world.call("reset_odometry").success
    assert (world.state.x, world.state.y, world.state.yaw) == (0.0, 0.0, 0.0)
    assert not world.call("set_pose", b'{"x": 1}').success


def test_a_query_on_the_wildcard_calls_no_service(world: World) -> None:
    for service in ("stop", "clear", "deactivate"):
        assert world.ask(f"srv/{service}", asked="**") == []
    assert world.state.mode == "ready"


def test_state_is_published_ten_times_a_second_and_immediately_on_change(world: World) -> None:
    world.bus.wanted_keys.add("state")
    world.run(0.5)
    published = world.bus.published["state"]
    before = len(published)
    world.run(5.0)
    assert len(published) - before == 50
    before = len(published)
    world.put("stop", b"")
    world.run(0.012)
    assert len(published) - before >= 1


def test_commands_that_a_newer_one_follows_before_the_step_are_counted(world: World) -> None:
    """The newest command of each source is not counted as superseded."""
    world.send_together([0.1, 0.2, 0.3])
    world.send_together([0.4], source="teleop")
    world.run(0.1)
    assert world.state.counters["commands_superseded"] == 2
    world.send(0.1)
    world.run(0.1)
    assert world.state.counters["commands_superseded"] == 2


def test_a_zero_from_before_the_clear_does_not_count_as_neutral(world: World) -> None:
    world.call("stop")
    world.send(0.0)
    world.now_ns += 300_000_000
    named = naming(world.numbers)
    world.bus.queries.append(Query(99, "srv/clear", "srv/clear", "", named, "", world.now_ns))
    world.send(0.5)
    world.hold(0.5, seconds=0.2)
    assert world.state.mode == "ready"
    assert world.state.code == "neutral"


def test_after_a_stall_a_waiting_command_without_a_stamp_does_not_drive(world: World) -> None:
    """Its sender may have ended during the stall. A sender that still runs drives again."""
    world.drive(0.5, seconds=1.0)
    world.stall(0.9)
    before = world.mcu.vehicle.pose.x
    world.send(0.5)
    world.run(0.5)
    assert world.mcu.vehicle.pose.x == pytest.approx(before, abs=0.01)
    assert world.state.mode == "ready"
    world.hold(0.5, seconds=0.5)
    assert world.state.mode == "driving"


def test_after_a_stall_a_waiting_zero_without_a_stamp_counts(world: World) -> None:
    world.drive(0.5, seconds=1.0)
    world.stall(0.2)
    world.send(0.0)
    assert world.state.mode == "driving"
    world.run(1.0)
    assert world.state.linear == 0.0
    assert world.state.counters.get("command_stale", 0) == 0


def test_a_plain_clear_right_after_a_stall_that_followed_the_stop_works(world: World) -> None:
    """The state with the stop was published before the stall."""
    world.call("stop")
    world.stall(2.5)
    (answer,) = world.ask("srv/clear")
    assert b'"success":true' in answer.payload
    assert world.state.mode == "ready"


def test_shutting_down_ramps_to_rest_and_obeys_no_client(world: World) -> None:
    world.drive(0.9, seconds=2.0)
    world.loop.shutting_down = True
    world.hold(0.9, seconds=0.35)
    assert world.loop.at_rest
    assert world.state.mode == "shutdown"
    assert not world.call("activate").success


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


@pytest.mark.variations(2)
@by_each_way
def test_a_zero_of_another_sender_on_the_same_key_does_not_start_the_robot(
    world: World, via: Via
) -> None:
    holding, other = Person(world, via, "a"), Person(world, via, "b")
    holding.drive(0.4)
    for verb in ("stop", "clear"):
        holding.send(0.4)
        assert world.call(verb).success
    # Wait for rest first: the other sender does not cause the end of the ramp.
    for _ in range(40):
        holding.send(0.4)
        world.run(0.05)
    x = world.state.x
    other.send(0.0)
    for _ in range(40):
        holding.send(0.4)
        world.run(0.05)
        assert world.state.linear == 0.0
    assert world.state.x == x
    assert waits_for(world).startswith("send a zero first: nav must send a zero")
    for _ in range(30):
        holding.send(0.0)
        world.run(0.05)
    holding.drive(0.4)


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


@pytest.mark.variations(3)
@by_each_way
@pytest.mark.parametrize("cleared_after", [0.05, 0.2, 0.4, 0.55])
def test_commands_that_the_network_delayed_around_a_clear_do_not_start_the_robot(
    world: World, via: Via, cleared_after: float
) -> None:
    person = Person(world, via, "a")
    person.drive(0.4)
    world.call("stop")
    world.run(0.5)
    # From here on the network delays all messages, at 20 Hz, for 0.6 s.
    world.run(cleared_after)
    assert world.call("clear").success
    person.send(0.4)  # one message gets through, so that the sender was seen
    world.run(0.6)
    for sent in range(12):
        person.send(0.4, late=0.6 - 0.05 * sent)
        world.run(0.002)
    for _ in range(20):
        person.send(0.4)
        world.run(0.05)
        assert world.state.linear == 0.0
    assert waits_for(world).startswith("send a zero first")
    assert world.state.counters["command_stale"] > 0


@pytest.mark.variations(3)
@by_each_way
def test_a_network_that_delivers_in_bursts_does_not_make_a_pause_that_arms(
    world: World, via: Via
) -> None:
    person = Person(world, via, "a")
    for _ in range(20):  # six at a time every 0.3 s: none is later than the timeout
        world.run(0.3)
        for late in (0.25, 0.2, 0.15, 0.1, 0.05, 0.0):
            person.send(0.4, late)
        world.run(0.01)
        assert world.state.linear == 0.0
    assert waits_for(world).startswith("send a zero first")


@pytest.mark.variations(3)
@by_each_way
@pytest.mark.parametrize("nonsense", ["NaN", "cut", "nothing", "a NaN in a stamped one"])
def test_an_unreadable_command_arms_no_sender(world: World, via: Via, nonsense: str) -> None:
    person = Person(world, via, "a")
    stamp = Time(*divmod(world.instant.wall_ns, NS_PER_S))
    bad, kind = {
        "NaN": (person.twist(float("nan")), "Twist"),
        "cut": (person.twist(0.5)[:-1], "Twist"),
        "nothing": (b"", "Twist"),
        "a NaN in a stamped one": (
            encode(TwistStamped(Header(stamp), Twist(Vector3(float("inf")), Vector3())), "cdr"),
            "TwistStamped",
        ),
    }[nonsense]
    person.send(0.5)
    for _ in range(6):
        world.run(0.05)
        person.put(bad, kind=kind)
    for _ in range(20):
        world.run(0.05)
        person.send(0.5)
    world.run(0.05)
    assert world.state.linear == 0.0
    assert waits_for(world).startswith("send a zero first")
    for _ in range(24):
        person.send(0.0)
        world.run(0.05)
    for _ in range(10):
        person.send(0.5)
        world.run(0.05)
    assert world.state.mode == "driving"


def test_wheel_speeds_that_cancel_out_do_not_arm_their_sender(world: World) -> None:
    joints = list(world.config.joints.as_tuple())

    def send(*speeds: float) -> None:
        world.put("wheel_cmd/app", msgspec.json.encode({"name": joints, "velocity": speeds}))
        world.run(0.05)

    send(8.0, 8.0, -8.0, -8.0)
    for _ in range(10):
        send(8.0, 8.0, 8.0, 8.0)
    assert world.state.mode == "ready"
    assert waits_for(world, "app").startswith("send a zero first")
    for _ in range(25):  # other clients may look like it, for a good second
        send(0.0, 0.0, 0.0, 0.0)
    for _ in range(10):
        send(8.0, 8.0, 8.0, 8.0)
    assert world.state.mode == "driving"
