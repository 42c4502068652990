"""No silence of a network lets a program drive on that never asked for rest.

A publisher on `cmd_vel` sends speeds and never stops. Something disarms it, and the network is
silent before, at or behind that, so that the daemon hears nothing of it for a while.
"""

from __future__ import annotations

import pytest

from tests.each import more
from tests.scenarios.networks import Event, Road, Silence, random_silence
from tests.scenarios.speakers import moved

BEFORE_S, BEHIND_S = 6.0, 16.0


def metres(silence: Silence) -> tuple[float, float]:
    """Return the ways that the robot drives before the event and behind it, m."""
    begin = BEFORE_S + silence.begin
    silences = [(begin, begin + silence.lasts)]
    if silence.again:
        silences.append((BEFORE_S + silence.again, BEFORE_S + silence.again + 1.1))
    road = Road(silence.way, silence.holds, silences)
    road.run(1.5, 0.0)
    latches = silence.event in ("clear", "activate")
    road.run(BEFORE_S - (2.5 if latches else 0.0), 0.3)
    before = road.world.mcu.vehicle.pose.x
    if latches:
        assert road.world.call("stop" if silence.event == "clear" else "deactivate").success
    road.run(BEFORE_S, 0.3)
    happen(road, silence.event)
    since_ns, x = road.world.now_ns, road.world.mcu.vehicle.pose.x
    road.run(BEFORE_S + silence.begin + silence.lasts + BEHIND_S, 0.3)
    drove = road.world.mcu.vehicle.pose.x - x
    return before, drove if moved(road.world, since_ns) else 0.0


def happen(road: Road, event: Event) -> None:
    """Let this event happen. A robot that it disarms in motion comes to rest."""
    world, mcu = road.world, road.world.mcu
    match event:
        case "clear" | "activate":
            assert world.call(event).success
            return
        case "restart":
            road.restart()
        case "reset":
            mcu.reset(world.now_ns, 50_000_000)
        case "unplug":
            world.port.unplug()
            road.run(road.now + 0.4, 0.3)
            mcu.advance(world.now_ns)
            world.port.plug(mcu)
    road.run(road.now + 0.6, 0.3)


@pytest.mark.slow
@pytest.mark.parametrize("first", [0, *(more(n) for n in range(15, 210, 15))])
def test_no_speed_drives_behind_a_silence_of_the_network(first: int) -> None:
    silences = [random_silence(seed) for seed in range(first, first + 15)]
    ways = [metres(silence) for silence in silences]
    assert [(silence, far) for silence, (_, far) in zip(silences, ways, strict=True) if far] == []
    # A silence that begins early leaves less time to drive before the event.
    assert sum(before > 0.1 for before, _ in ways) > 5
