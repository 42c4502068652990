"""What the robot says of itself: its mode, its status, its counters and its events."""

from __future__ import annotations

import math
from collections import Counter
from itertools import product
from typing import get_args

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config, LimitsConfig
from acsard.core.motion.modes import REFUSALS, Mode, RefusedError, mode_of, require_allowed
from acsard.core.values import (
    REST,
    STILL,
    Cause,
    CauseKind,
    Command,
    Latches,
    Refusal,
    SpeedCap,
    Twist,
    Verb,
    WheelSpeeds,
)
from tests.each import each
from tests.unit.rig import GO, ROLLING, WALL_NS, Rig, names

# the mode

FACTS = ("shutting_down", "fault", "stopped", "inactive", "linked", "commanded")
DRAWN = """
    1.....  shutdown
    01....  fault
    001...  stopped
    0001..  inactive
    00000.  waiting
    000011  driving
    000010  ready
"""
"""The whole list of modes drawn by hand. A dot matches both values, in the order of `FACTS`."""


@each("values", product((False, True), repeat=6))
def test_the_mode_is_the_one_row_of_the_drawing_that_matches(values: tuple[bool, ...]) -> None:
    bits = "".join(str(int(value)) for value in values)
    rows = [line.split() for line in DRAWN.strip().splitlines()]
    found = [
        mode
        for pattern, mode in rows
        if all(cell in (".", bit) for cell, bit in zip(pattern, bits, strict=True))
    ]
    assert found == [mode_of(**dict(zip(FACTS, values, strict=True)))]


@each(("mode", "verb"), list(product(Mode, get_args(Verb))))
def test_a_mode_refuses_what_would_have_no_effect_and_says_why(mode: Mode, verb: Verb) -> None:
    down = mode is Mode.SHUTDOWN
    latching = mode in (Mode.FAULT, Mode.STOPPED) or down
    refuses = (verb in ("activate", "deactivate") and latching) or (down and verb == "clear")
    assert ((mode, verb) in REFUSALS) == refuses
    if not refuses:
        return require_allowed(mode, verb)
    with pytest.raises(RefusedError) as caught:
        require_allowed(mode, verb)
    assert ("`acsard call clear` first" in str(caught.value)) != down
    return None


# the status


def test_the_status_changes_with_mode_reason_link_and_source_and_not_otherwise() -> None:
    rig = Rig()
    assert rig.out.status_changed
    assert not rig.unplug().step().status_changed
    changes = [out.status_changed for out in rig.replug().each(6)]
    assert changes == [True, False, False, False, True, False]
    assert rig.step(REST).status_changed  # driven by app
    assert not rig.step(GO).status_changed
    assert rig.step(REST, source="teleop").status_changed
    assert not rig.step(REST, source="teleop").status_changed
    assert rig.step(ask="stop").status_changed


@each("angular", [0.0, 1.0])
def test_the_reason_says_that_a_robot_with_the_limits_0_cannot_move(angular: float) -> None:
    limits = LimitsConfig(linear_speed=0.0, angular_speed=angular)
    rig = Rig(Config(limits=limits)).linked()
    rig.step(REST)
    out = rig.step(GO)
    assert (out.mode, out.applied.linear) == ("driving", 0.0)
    assert out.code == ("commanded" if angular else "limits_zero")


def test_each_source_that_sends_and_does_not_drive_has_what_it_waits_for() -> None:
    rig = Rig().driving()
    rig.step(GO, source="teleop")
    waits = rig.robot.waits(rig.now_ns)
    assert {name: why.code for name, why in waits.items()} == {"teleop": "neutral", "app": "higher"}


@each(
    ("kind", "mode", "code"),
    [
        ("stop", "stopped", "stopped"),
        ("fault", "fault", "wheel_reversed"),
        ("inactive", "inactive", "switched_off"),
    ],
)
def test_a_robot_starts_in_the_mode_of_its_latches_with_one_event(
    kind: CauseKind, mode: str, code: str
) -> None:
    cause = Cause(7, kind, code, "why", by="joe", at_ns=WALL_NS, kept=True)  # type: ignore[arg-type]
    rig = Rig(latches=(latches := Latches((cause,), 7)))
    (event,) = rig.out.events
    assert (event.name, event.level, event.code) == ("mode", "warning", code)
    assert rig.out.latches is latches
    rig.linked().step(REST)
    assert {out.applied for out in rig.each(50, GO)} == {REST}
    assert (rig.mode, rig.out.code, rig.out.latches) == (mode, code, latches)
    assert rig.answer("activate" if mode == "inactive" else "clear").success
    assert rig.out.latches.causes == ()
    assert rig.drives()


# counters


def test_commands_are_counted_and_refusals_by_reason() -> None:
    rig = Rig().linked()
    rig.step(REST, GO)
    refusals = tuple(Refusal(why, "") for why in ("malformed", "malformed", "wildcard"))
    rig.step(Twist(math.nan, 0.0), refusals=refusals)
    rig.step(GO, source="stranger")
    found = {name: n for name, n in rig.counters.items() if name.startswith("command")}
    assert found == {
        "commands": 2, "commands_superseded": 1, "command_not_finite": 1,
        "command_unknown_source": 1, "command_malformed": 2, "command_wildcard": 1,
    }  # fmt: skip
    rig = Rig().linked()  # a sender whose clock is new is no refusal
    rig.step(REST, late_ms=0.0)
    assert rig.counters["commands_of_new_senders"] == 1
    assert not [name for name in rig.counters if name.startswith("command_")]
    rig.step(commands=(Command("app", REST, rig.now_ns, stamp_replaced=True),))
    assert rig.counters["stamps_replaced"] == 1


def test_lines_are_counted_and_refused_ones_by_reason() -> None:
    rig = Rig().linked()
    rig.reply = b"hello\r\n" + rig.codec.stop
    rig.step()
    rig.step(superseded=True)
    counters = rig.counters
    assert (counters["lines"], counters["line_malformed"]) == (7, 2)
    assert (counters["lines_sent"], counters["lines_superseded"]) == (5, 1)
    assert "line_too_long" not in counters
    for step in range(64):  # now and then one count of a hundred per turn
        rig.reply = rig.codec.encode(WheelSpeeds(*[6.28 * (step % 2)] * 4))
        rig.step()
    assert 0 < rig.counters["coarse_encoder_lines"] < 64
    assert "coarse_encoder_lines" not in counters


def test_a_lost_link_is_counted_and_whether_this_computer_was_late() -> None:
    for steps, ms in ((1, 400), (40, 10)):
        rig = Rig().linked()
        rig.reply = None
        assert rig.run(steps, ms=ms).link == "stale"
        assert rig.counters["link_lost"] == 1
        assert ("link_lost_host_stall" in rig.counters) == (ms == 400)


def test_what_the_wheels_do_is_reported_and_counted() -> None:
    for speeds, commanded, event, counter in (
        (WheelSpeeds(5.0, 5.0, 5.0, 5.0), False, "uncommanded_motion", "uncommanded_motion"),
        (replace(ROLLING, front_left=0.0), True, "wheel_fault", "wheel_faults"),
        (WheelSpeeds(-10.0, -10.0, -10.0, -10.0), True, "fault", "lines"),
        (WheelSpeeds(0.0, 0.0, 0.0, 0.0), True, "wheel_fault", "wheel_faults"),
    ):
        rig = Rig(watched=True)
        rig = rig.driving() if commanded else rig.linked()
        rig.reply = rig.codec.encode(speeds)
        outs = rig.each(400, *[GO] * commanded)
        assert event in [name for out in outs for name in names(out)]
        assert rig.counters[counter] >= 1


# events


def test_each_change_of_mode_by_request_is_an_event_even_in_quick_succession() -> None:
    rig = Rig().linked()
    for _ in range(2):
        assert names(rig.step(ask="stop")) == ["stop", "mode"]
        assert names(rig.step(ask="stop")) == ["stop"]  # a clear must name the new latch
        assert names(rig.step(ask="activate")) == []  # refused
        assert names(rig.step(ask="clear")) == ["clear", "mode"]
    rig = Rig().driving()
    rig.shutting_down = True
    (event,) = rig.step().events
    assert (event.name, event.code) == ("mode", "shutting_down")
    assert names(rig.step()) == []


def test_a_service_that_is_called_continuously_causes_one_event_per_second() -> None:
    rig = Rig().linked()
    events = [event for out in rig.each(250, ask="reset_odometry") for event in out.events]
    assert [event.count for event in events] == [1, 100, 100]


def test_a_speed_limit_applies_until_it_ends_and_each_change_is_an_event() -> None:
    rig = Rig().driving()

    def cap(speed: float | None) -> list[str]:
        out = rig.step(GO, speed_cap=SpeedCap(speed, "joe"))
        return [event.by for event in out.events if event.name == "speed_limit"]

    assert cap(0.3) == ["joe"]
    assert cap(0.3) == []
    path = rig.path(110, GO)  # an event that comes again within a second is held back
    assert min(path) == path[-1] == pytest.approx(0.3)
    assert "0.3 m/s" in rig.snapshot.state.speed_limit
    assert cap(None) == ["joe"]
    assert rig.run(60, GO).applied == GO
    assert rig.snapshot.state.speed_limit == ""


def test_more_than_one_implausible_line_in_a_hundred_is_an_event() -> None:
    rig, counts = Rig().linked(), Counter[str]()
    for i in range(1500):
        rig.reply = rig.codec.encode(WheelSpeeds(99.0, 0.0, 0.0, 0.0) if i % 50 == 0 else STILL)
        counts.update(names(rig.step()))
    assert counts["lines_implausible"] in (1, 2)
    assert rig.mode == "ready"


def test_lines_that_are_not_answered_are_reported() -> None:
    rig, counts = Rig().linked(), Counter[str]()
    for number in range(1100):
        rig.reply = None if number % 5 == 0 else rig.codec.stop
        counts.update(names(rig.step()))
    assert counts["lines_lost"] == 1
