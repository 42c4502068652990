"""Stops, faults and switching off: numbered causes, and a call releases only what it names."""

from __future__ import annotations

import re
from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from acsard.core.codes import Reason, reason
from acsard.core.motion.latches import (
    MAX_CAUSES,
    OTHERS,
    after_restart,
    describe,
    in_force,
    latched,
    released,
    stopped,
)
from acsard.core.motion.lifecycle import Lifecycle
from acsard.core.motion.modes import REFUSALS, Mode, RefusedError
from acsard.core.values import NS_PER_S, Cause, CauseKind, Instant, Latches
from tests.each import each

WALL_NS = 1_800_000_000 * NS_PER_S
PRESSED = reason("emergency_stop")
FLAT = reason("battery_empty", threshold="22 V", charged="24 V")


def dead(part: str) -> Reason:
    return reason("wheel_reversed", part, wheel=part, figures="(1)")


def ns(seconds: float) -> int:
    return round(seconds * NS_PER_S)


def at(seconds: float) -> Instant:
    return Instant(ns(seconds), WALL_NS + ns(seconds))


# the causes


def numbers(latches: Latches) -> list[int]:
    return [cause.number for cause in latches.causes]


def test_the_same_cause_renews_its_number_and_is_there_once() -> None:
    latches = latched(stopped(Latches(), "joe", WALL_NS), "stop", FLAT, WALL_NS)
    latches = stopped(stopped(latches, "ann", WALL_NS), "joe", WALL_NS + 1)
    for part in ("front_left", "rear_left", "front_left"):
        latches = latched(latches, "fault", dead(part), WALL_NS)
    for name in ("ann", "joe"):  # two who switch off are one cause
        latches = latched(latches, "inactive", reason("switched_off", by=name), WALL_NS, name)
    assert [(c.number, c.by, c.part) for c in latches.causes] == [
        (2, "", ""), (3, "ann", ""), (4, "joe", ""), (6, "", "rear_left"), (7, "", "front_left"),
        (9, "joe", ""),
    ]  # fmt: skip
    assert latches.causes[2].at_ns == WALL_NS + 1


def test_no_stop_is_forgotten_if_more_clients_stop_the_robot_than_it_lists() -> None:
    latches = latched(Latches(), "fault", dead("front_left"), WALL_NS)
    for number in range(100):
        before, latches = latches, stopped(latches, f"client{number}", WALL_NS)
        # A clear of all that was shown before a stop does not free the robot.
        assert len(released(latches, numbers(before)).causes) == 1
    assert len(latches.causes) == MAX_CAUSES == 32
    assert [latches.causes[place].by for place in (0, 1, -2)] == ["", "client0", "client29"]
    others = latches.causes[-1]
    assert (others.code, others.kind, others.number) == (OTHERS, "stop", latches.last)
    latches = latched(latches, "stop", FLAT, WALL_NS)
    assert [cause.code for cause in latches.causes[-2:]] == ["battery_empty", OTHERS]
    assert len(latches.causes) == MAX_CAUSES
    assert latches.causes[-1].number > others.number  # the stop of `client29` is in it now
    assert "client29" in latches.causes[-1].text


def test_a_stop_in_the_last_place_is_repeated_and_answered_like_another() -> None:
    timed = Timed()
    for number in range(40):
        timed.stop(f"client{number}")
        timed.run(0.02)
    (number,) = timed.life.stop_of("client39")
    timed.life.stop("client39", timed.life.stop_asked_ns, at(timed.now_s))
    assert timed.life.stop_of("client39") == (number,) == (timed.life.latches.last,)
    timed.life.stop("client50", timed.life.stop_asked_ns - 1, at(timed.now_s))
    assert timed.life.stop_of("client50") > (number,)


# the life of a robot


class Timed:
    """A lifecycle with a step each 10 ms, in which calls come at times in seconds."""

    def __init__(self, latches: Latches = Latches()) -> None:  # noqa: B008
        self.life = Lifecycle(latches)
        self.now_s = 0.0
        self.life.link(up=True)
        self.run(0.02)

    def run(self, seconds: float) -> None:
        for _ in range(round(seconds * 100)):
            self.now_s += 0.01
            if self.life.unshown:
                self.life.begin(ns(self.now_s))

    def stop(self, by: str = "joe") -> int:
        self.life.stop(by, ns(self.now_s), at(self.now_s))
        return self.life.latches.last

    def fault(self, part: str = "front_left") -> int:
        assert self.life.fault(dead(part), at(self.now_s))
        return self.life.latches.last

    def off(self, by: str = "joe") -> int:
        self.life.deactivate(by, at(self.now_s))
        return self.life.latches.last

    def press(self) -> int:
        self.life.press(PRESSED, at(self.now_s))
        self.life.hold(PRESSED, ns(self.now_s))
        return self.life.latches.last

    def clear(self, *named: int) -> tuple[int, ...]:
        asked_ns = ns(self.now_s)
        return self.life.clear(named or None, asked_ns)[1]

    def activate(self, *named: int) -> tuple[int, ...]:
        return self.life.activate(named or None, ns(self.now_s))

    @property
    def numbers(self) -> list[int]:
        return numbers(self.life.latches)

    @property
    def mode(self) -> Mode:
        return self.life.mode


def refusal(call: Callable[[], object]) -> str:
    with pytest.raises(RefusedError) as caught:
        call()
    return str(caught.value)


def test_the_mode_follows_the_facts_in_order() -> None:
    timed = Timed()
    life, modes = timed.life, [Lifecycle().mode, timed.mode]
    for change in (
        lambda: life.command(fresh=True), lambda: life.link(up=False), timed.off, timed.stop,
        timed.fault, life.leave,
    ):  # fmt: skip
        change()
        modes.append(life.mode)
    assert modes == [
        "waiting", "ready", "driving", "waiting", "inactive", "stopped", "fault", "shutdown",
    ]  # fmt: skip
    assert msgspec.msgpack.decode(msgspec.msgpack.encode(life), type=Lifecycle) == life


@each("kind", ["fault", "stop", "inactive"])
def test_a_robot_starts_as_its_latches_say_and_keeps_their_numbers(kind: CauseKind) -> None:
    cause = Cause(7, kind, "stopped", "stopped by joe", by="joe", at_ns=WALL_NS)
    life = Lifecycle(after_restart(Latches((cause,), 9)))
    assert life.mode == {"stop": "stopped"}.get(kind, kind)
    assert "was stopped by joe at 2027-01-15 08:00:00 UTC, before the restart" in life.why.text
    life.begin(ns(1.0))  # the first step publishes it
    assert life.shown == {}
    life.begin(ns(4.0))
    assert life.shown == {7: ns(4.0)}
    life.stop("ann", 0, at(1.0))
    assert life.latches.last == 10


def test_a_stop_that_arrives_twice_has_one_number_and_counts_after_a_clear() -> None:
    """The bus hands a call over as a stop first, and later as a query."""
    timed = Timed()
    first = timed.stop()
    timed.life.stop("joe", ns(timed.now_s), at(timed.now_s + 0.1))
    assert timed.numbers == [first] == list(timed.life.stop_of("joe"))
    timed.run(0.1)
    assert timed.stop() > first
    assert len(timed.numbers) == 1
    timed.clear(*timed.numbers)
    timed.life.stop("joe", ns(timed.now_s) - 1, at(timed.now_s))
    assert timed.mode is Mode.STOPPED


def test_what_stops_the_robot_during_the_shutdown_is_latched_for_the_next_start() -> None:
    timed = Timed()
    timed.life.leave()
    timed.stop()
    timed.fault()
    assert not timed.life.fault(dead("front_left"), at(9.0))  # it is latched once
    assert (timed.mode, len(timed.numbers)) == (Mode.SHUTDOWN, 2)
    assert "shutting down" in refusal(lambda: timed.clear(*timed.numbers))


@each("kind", ["stop", "fault", "off"])
def test_a_plain_call_needs_two_seconds_since_the_newest_cause_was_shown(kind: str) -> None:
    timed = Timed()
    call = timed.activate if kind == "off" else timed.clear
    if kind == "fault":
        timed.stop("ann")
        timed.run(5.0)
    {"stop": timed.stop, "fault": timed.fault, "off": timed.off}[kind]()
    for _ in range(20):
        timed.run(0.1)
        assert re.search(r"has shown for only [01]\.\d s that it is", refusal(call))
    timed.run(0.02)
    assert call()


def test_the_two_seconds_count_from_the_end_of_the_step_that_latched() -> None:
    life = Lifecycle()
    life.begin(0)
    life.begin(ns(1.0))
    life.stop("joe", ns(1.0), at(1.0))
    life.begin(ns(4.0))  # the step took 3 s, and published the stop at its end
    for asked_s in (3.5, 4.0, 5.9):
        with pytest.raises(RefusedError):
            life.clear(None, ns(asked_s))
    assert life.clear(None, ns(6.0))[1] == (1,)


def test_only_activate_ends_inactive_and_only_without_a_latched_stop() -> None:
    timed = Timed()
    off = timed.off("ann")
    assert timed.off("joe") > off
    assert "still switched off by joe" in refusal(lambda: timed.activate(off))
    stop = timed.stop()
    assert "`acsard call clear` first" in refusal(lambda: timed.activate(*timed.numbers))
    refusal(timed.off)
    assert (
        "switched off: type `acsard call activate`" in timed.life.clear((stop,), ns(timed.now_s))[0]
    )
    assert timed.clear(*timed.numbers) == ()
    assert timed.activate(*timed.numbers)
    assert timed.mode is Mode.READY


def test_words(approved: Callable[[Path, str], None]) -> None:
    timed = Timed()
    lines = [timed.life.clear(None, 0)[0], timed.life.stop("ann", 0, at(0.0))]
    lines += [refusal(timed.clear), refusal(lambda: timed.life.clear((), 0))]
    lines += [timed.life.clear((1,), ns(5.0))[0], timed.life.deactivate("", at(1.0))]
    lines += [timed.life.why.text, refusal(timed.activate)]
    timed.stop("ann")
    timed.fault()
    timed.press()
    lines += [refusal(timed.clear), timed.life.why.text]
    timed.life.hold(reason("bumper", bumpers="bumper 2 pressed"), 0)
    lines.append(timed.life.why.text)
    causes = timed.life.latches.causes
    lines += [describe(replace(cause, kept=kept)) for cause in causes for kept in (False, True)]
    lines.append(in_force(causes))
    timed.life.leave()
    lines.append(timed.life.stop("joe", 0, at(2.0)))
    lines += [f"{verb} while {mode}: {text}" for (mode, verb), text in REFUSALS.items()]
    approved(Path(__file__).with_name("words") / "stop.txt", "\n".join(lines) + "\n")
