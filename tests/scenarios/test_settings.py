"""An operator changes settings while the robot drives: between two steps, safely, and logged."""

from __future__ import annotations

from itertools import pairwise

import msgspec
import pytest

from acsard.core.config.settings import Config, LimitsConfig
from acsard.core.incoming.queries import Query
from acsard.core.messages.schema import ServiceReply
from acsard.core.messages.signature import public_name
from acsard.core.values import NS_PER_S, Plain
from tests.scenarios.world import World
from tests.stepped import Outputs


@pytest.fixture
def world() -> World:
    world = World()
    world.run(0.2)
    return world


def sets(world: World, **settings: Plain) -> ServiceReply:
    """Call `set` with these settings. Two underscores in a name stand for a dot."""
    wishes = {key.replace("__", "."): value for key, value in settings.items()}
    return world.call("set", msgspec.json.encode({"settings": wishes}))


def config(world: World) -> Config:
    (reply,) = world.ask("config")
    return msgspec.json.decode(reply.payload, type=Config)


def applied(world: World) -> list[tuple[float, float]]:
    """Return a list to which each later step with a line adds its time (s) and speed (m/s)."""
    speeds: list[tuple[float, float]] = []

    def note(outputs: Outputs) -> None:
        if outputs.line is not None:
            speeds.append((outputs.now.mono_ns / NS_PER_S, outputs.applied.linear))

    world.watch = note
    return speeds


def slopes(lines: list[tuple[float, float]]) -> list[float]:
    """Return the acceleration in m/s2 between each pair of consecutive lines."""
    return [(v - before) / (t - at) for (at, before), (t, v) in pairwise(lines)]


def test_state_names_the_settings_that_were_changed_since_the_start(world: World) -> None:
    assert world.state.settings_differ == ""
    for speed, text in ((0.4, "limits.linear_speed = 0.4, not 1.0"), (1.0, "")):
        wish = {"settings": {"limits.linear_speed": speed}}
        assert world.call("set", msgspec.json.encode(wish)).success
        world.run(0.2)
        assert world.state.settings_differ == text


def test_a_lowered_limit_is_reached_by_the_deceleration_and_never_by_a_jump(world: World) -> None:
    world.drive(1.0, seconds=2.0)
    speeds = applied(world)
    assert sets(world, limits__linear_speed=0.4).success
    world.hold(1.0, seconds=1.5)
    assert world.state.mode == "driving"
    assert min(slopes(speeds)) == pytest.approx(-1.0)  # limits.linear_deceleration
    assert max(slopes(speeds)) <= 0.0
    assert speeds[-1][1] == pytest.approx(0.4)


def test_a_setting_is_in_config_and_in_the_log_with_its_client_and_old_value(
    world: World,
) -> None:
    payload = b'{"settings": {"limits.linear_speed": 0.8, "rates.telemetry": 5}}'
    name = msgspec.json.encode({"sender": "joe@laptop/s3cret"})
    key = "srv/set"
    world.bus.queries.append(Query(77, key, key, "", payload, "", world.now_ns, "native", name))
    world.run(0.03)
    (event,) = [event for event in world.events if event.name == "set"]
    assert event.text == "limits.linear_speed = 0.8 (was 1.0), rates.telemetry = 5.0 (was 0.0)"
    assert event.by == f"{public_name('joe@laptop/s3cret')} (native)"
    assert (config(world).limits.linear_speed, config(world).rates.telemetry) == (0.8, 5.0)


@pytest.mark.slow
def test_the_wheel_speed_limit_changes_only_at_rest_and_the_guard_uses_it() -> None:
    world = World(Config(limits=LimitsConfig(linear_speed=3.0, wheel_speed=10.0)))
    world.run(0.2)
    world.drive(3.0, seconds=1.0)
    assert not sets(world, limits__wheel_speed=40.0).success
    world.run(2.0)
    assert sets(world, limits__wheel_speed=40.0).success
    world.drive(3.0, seconds=2.0)
    assert world.state.mode == "driving"
    assert world.state.linear == pytest.approx(2.0, abs=0.1)
    world.run(3.0)
    assert sets(world, limits__wheel_speed=10.0).success
    world.drive(3.0, seconds=1.0)
    assert world.state.mode == "driving"
    assert world.state.linear == pytest.approx(0.5, abs=0.05)


def test_a_new_timeout_requires_neutral_first_and_is_then_in_force(world: World) -> None:
    world.drive(0.3, seconds=0.5)
    assert not sets(world, commands__sources__app__timeout=0.6).success
    world.run(1.0)
    assert sets(world, commands__sources__app__timeout=0.6).success
    world.hold(0.3, seconds=0.3)
    assert world.state.mode == "ready"
    world.run(2.0)  # a pause counts as neutral too
    world.drive(0.3, seconds=0.5)
    world.run(0.4)
    assert world.state.mode == "driving"
    world.run(0.3)
    assert world.state.mode == "ready"


def test_a_rate_is_in_force_from_the_next_message_on(world: World) -> None:
    assert sets(world, rates__odom=10.0).success
    world.bus.wanted_keys.add("odom")
    world.run(2.0)
    messages = world.bus.published["odom"]
    assert 19 <= len(messages) <= 21
