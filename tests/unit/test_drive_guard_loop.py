"""Robot and guard together: a healthy robot never trips the guard, whatever happens."""

from __future__ import annotations

import random

import pytest
from hypothesis import assume, given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.config.contradictions import contradictions
from acsard.core.config.settings import (
    Config,
    DriveConfig,
    FeedbackConfig,
    LimitsConfig,
    Source,
    WheelMap,
)
from acsard.core.guard import Guard
from acsard.core.link.codec import Codec
from acsard.core.robot import Robot
from acsard.core.values import (
    NS_PER_S,
    Command,
    Instant,
    Plain,
    Received,
    Request,
    Status,
    Trip,
    Twist,
    Verb,
    WheelSpeeds,
)
from tests.stepped import Inputs, Outputs, SteppedRobot

MS = 1_000_000
NOW_NS = 50 * NS_PER_S
SOURCES = (Source("app", 50), Source("slow", 10, timeout=1.0))
CODEC = Codec(WheelMap())
STOP = b"ap00.00,bp00.00,cp00.00,dp00.00\r\n"
COMMA_STOP = STOP[:-2] + b",\r\n"
DAMAGED, FAST, NO_LINK = "guard_line_damaged", "guard_too_fast", "guard_no_link"
GROWS, LATE = "guard_no_command", "guard_too_long"


def line(*wheels: float) -> bytes:
    """Return the line with these speeds for a, b, c, d. A single number is for all of them."""
    return CODEC.encode(WheelSpeeds(*(wheels * 4 if len(wheels) == 1 else wheels)))


class Loop:
    """Robot and guard, connected as in the control loop; `wire` collects the sent lines."""

    def __init__(self, config: Config, wheel_speed: float | None = None) -> None:
        self.robot, self.config = Robot(config), config
        self.stepped = SteppedRobot(self.robot)
        self.stop = self.robot.link_setup.codec.stop
        most = config.limits.wheel_speed if wheel_speed is None else wheel_speed
        checked = replace(config, limits=replace(config.limits, wheel_speed=most))
        self.guard = Guard(self.stop, checked)
        self.now_ns, self.opened, self.superseded = NOW_NS, 1, False
        self.trip: Trip = ""
        self.trips: list[str] = []
        self.events: list[str] = []
        self.wire: list[tuple[bytes, Outputs]] = []

    def step(
        self,
        *twists: Twist,
        ask: Verb | None = None,
        settings: dict[str, Plain] | None = None,
        ms: float = 10.0,
        tick: bool = True,
        heard: int = 1,
        port_open: bool = True,
        goes: bool = True,
    ) -> Outputs:
        self.now_ns += int(ms * MS)
        now = Instant(self.now_ns, self.now_ns)
        out = self.stepped.step(
            Inputs(
                now=now,
                tick=tick,
                port_open=port_open,
                opened=self.opened,
                received=(Received(now, self.stop * heard),),
                commands=tuple(Command("app", twist, self.now_ns) for twist in twists),
                requests=(Request(ask, settings=settings or {}),) if ask else (),
                guard_trip=self.trip,
                superseded=self.superseded,
            )
        )
        self.events += [event.name for event in out.events]
        if self.robot.config is not self.config:
            self.config = self.robot.config
            self.guard.use(self.config)
        if out.line is None:
            self.trip, self.superseded = "", False
            return out
        status = Status(out.mode, out.code, out.reason, out.link, out.source)
        data, self.trip = self.guard.check(out.line, self.now_ns, status, out.command_ns)
        self.trips += [self.trip] * bool(self.trip)
        self.superseded = not (goes and port_open)
        if not self.superseded:
            self.guard.record_written(data)
            self.wire.append((data, out))
        return out


def test_one_trip_causes_one_fault_that_names_its_reason() -> None:
    loop = Loop(Config(), wheel_speed=5.0)  # the robot itself assumes 40 rad/s
    loop.step(heard=3)
    loop.step(Twist())
    for _ in range(60):
        out = loop.step(Twist(1.0))
    assert (loop.trips, loop.events.count("fault"), out.code) == ([FAST], 1, FAST)
    assert loop.wire[-1][0] == STOP


@st.composite
def legal(draw: st.DrawFn) -> Config:
    """Return a random valid configuration. Its slowest ramps are often the longest allowed ones."""
    drive = DriveConfig(
        draw(st.floats(0.03, 0.2)),
        draw(st.floats(0.2, 0.8)),
        draw(st.floats(0.5, 2.0)),
        draw(st.floats(0.8, 1.2)),
        draw(st.floats(0.8, 1.2)),
    )
    wheel_speed = draw(st.floats(1.0, 90.0))
    sides = drive.left_wheel_radius_multiplier + drive.right_wheel_radius_multiplier
    rim = wheel_speed * drive.wheel_radius * sides / 2
    most = (rim, 2 * rim / (drive.wheel_separation * drive.wheel_separation_multiplier))
    numbers: dict[str, float] = {"wheel_speed": wheel_speed}
    for axis, reach, limit in zip(("linear", "angular"), most, (10.0, 50.0), strict=True):
        speed = draw(st.floats(0.0, limit))
        fastest = min(speed, reach)
        least = max(0.02, 1.001 * fastest / 5)
        softer = draw(st.one_of(st.just(least), st.floats(least, 100.0)))
        harder = max(softer, 1.001 * fastest / 2)
        numbers |= {
            f"{axis}_speed": speed,
            f"{axis}_acceleration": 100.0,
            f"{axis}_deceleration": softer,
            f"{axis}_stop_deceleration": draw(st.one_of(st.just(harder), st.floats(harder, 100.0))),
            f"{axis}_jerk": draw(st.sampled_from((0.0, 0.0, 500.0))),
        }
    feedback = FeedbackConfig(wheel_speed=99.99)
    return Config(drive=drive, limits=LimitsConfig(**numbers), feedback=feedback)


HAPPENINGS = (
    "silence", "stall", "superseded", "command", "half", "stop", "clear", "lower", "harder"
)  # fmt: skip


def happen(loop: Loop, what: str, steps: int, ms: float, full: Twist) -> None:
    """Apply one event in the middle of a ramp."""
    limits = loop.config.limits
    match what:
        case "stall":
            loop.step(ms=ms * 10)
        case "superseded":
            for _ in range(steps):
                loop.step(ms=ms, goes=False)
        case "command" | "half":
            share = 1.0 if what == "command" else 0.5
            for _ in range(steps):
                loop.step(Twist(full.linear * share, full.angular * share), ms=ms)
        case "stop" | "clear":
            loop.step(ask=what, ms=ms)
        case "lower":
            slower = limits.linear_speed / 2, limits.angular_speed / 2
            names = "limits.linear_speed", "limits.angular_speed"
            loop.step(ask="set", settings=dict(zip(names, slower, strict=True)), ms=ms)
        case "harder":
            braking = limits.linear_stop_deceleration
            loop.step(ask="set", settings={"limits.linear_deceleration": braking}, ms=ms)
    for _ in range(steps):
        loop.step(ms=ms)


@given(
    config=legal(),
    ms=st.sampled_from((10.0, 24.0, 90.0)),
    signs=st.tuples(st.sampled_from((-1, 0, 1)), st.sampled_from((-1, 0, 1))),
    happenings=st.lists(st.tuples(st.sampled_from(HAPPENINGS), st.integers(0, 12)), max_size=6),
)
def test_no_permitted_ramp_is_cut_short_whatever_events_interrupt_it(
    config: Config, ms: float, signs: tuple[int, int], happenings: list[tuple[str, int]]
) -> None:
    assume(not contradictions(config))
    loop = Loop(config)
    full = Twist(signs[0] * 10.0, signs[1] * 50.0)
    loop.step(heard=3)
    loop.step(Twist())
    for _ in range(30):
        loop.step(full, ms=24.0)
    for what, steps in happenings:
        happen(loop, what, steps, ms, full)
    for _ in range(round(5500 / ms)):
        loop.step(ms=ms)
    assert loop.trips == []
    assert loop.wire[-1][0] == STOP


JERK = Config(limits=LimitsConfig(linear_jerk=5.0, angular_jerk=20.0, wheel_speed=20.0))
TWISTS = (Twist(), Twist(), Twist(0.5), Twist(-2.0, 2.0), Twist(0.0, -9.0))


def random_walk(dice: random.Random, config: Config) -> Loop:
    """Run three seconds with random behaviour of the port, the MCU, the wire and the operators."""
    loop, port_open, lines, goes, twist = Loop(config), True, 1, 1.0, Twist()
    verbs: tuple[Verb, ...] = ("stop", "clear", "clear", "activate", "deactivate")
    for _ in range(300):
        if dice.random() < (0.01 if port_open else 0.2):
            port_open = not port_open
            loop.opened += port_open
        if dice.random() < 0.01:
            loop.opened += port_open  # lost and found again between two steps
        if dice.random() < 0.05:
            lines = dice.choice((0, 1, 1, 1, 3))
        if dice.random() < 0.02:
            goes = dice.choice((1.0, 1.0, 0.7, 0.2))
        if dice.random() < 0.1:
            twist = dice.choice(TWISTS)
        loop.step(
            *[twist] * (dice.random() < 0.5),
            ask=dice.choice(verbs) if dice.random() < 0.01 else None,
            ms=dice.choice((10.0, 10.0, 10.0, 11.0, 3.0, 60.0)),
            tick=dice.random() < 0.85,
            heard=lines,
            port_open=port_open,
            goes=dice.random() < goes,
        )
    return loop


@pytest.mark.parametrize("config", [Config(), pytest.param(JERK, marks=pytest.mark.slow)])
def test_a_healthy_robot_never_trips_the_guard_and_speeds_up_only_by_fresh_commands(
    config: Config,
) -> None:
    moved = 0
    for seed in range(12):
        loop, before = random_walk(random.Random(seed), config), (0.0, 0.0, 0.0, 0.0)
        assert loop.trips == []
        moved += sum(data != STOP for data, _ in loop.wire)
        for data, result in loop.wire:
            if data == b"?\r\n":
                continue
            wheels = CODEC.decode(data.rstrip()).as_tuple()
            assert result.linked or not any(wheels)
            arrived_ns = result.command_ns
            fresh = arrived_ns is not None and result.now.mono_ns - arrived_ns <= 250 * MS
            if not (fresh and result.linked and result.mode == "driving"):
                for old, new in zip(before, wheels, strict=True):
                    assert abs(new) <= abs(old)
                    assert new * old >= 0.0
            before = wheels
    assert moved > 150
