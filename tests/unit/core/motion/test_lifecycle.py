"""Tests of latches and modes: one example of each rule, and a check of all reachable states."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from copy import copy
from functools import cache
from typing import NamedTuple

import pytest

from acsard.core.codes import Reason
from acsard.core.motion.emergency_stop import PRESSED_REASON, SILENT_REASON
from acsard.core.motion.lifecycle import LATCH_REQUIRED_S, MAX_FAULTS, Lifecycle
from acsard.core.motion.modes import Mode, RefusedError, mode_of
from acsard.core.values import NS_PER_S, Instant, Latch, Latches
from tests.each import each

WALL_NS = 1_800_000_000 * NS_PER_S


def at(seconds: float) -> Instant:
    ns = int(seconds * NS_PER_S)
    return Instant(ns, WALL_NS + ns)


def ns(seconds: float) -> int:
    return int(seconds * NS_PER_S)


def ready() -> Lifecycle:
    life = Lifecycle()
    life.link(up=True)
    return life


def stop(life: Lifecycle, seconds: float, by: str = "ann") -> str:
    return life.stop(by, ns(seconds), at(seconds))


def clear(life: Lifecycle, seconds: float, number: int | None = None) -> str:
    return life.clear(number, ns(seconds), at(seconds))


def activate(life: Lifecycle, seconds: float, number: int | None = None) -> bool:
    return life.activate(number, ns(seconds), at(seconds))


def deactivate(life: Lifecycle, seconds: float, by: str = "ann") -> str:
    return life.deactivate(by, at(seconds))


def press(life: Lifecycle, seconds: float, why: Reason = PRESSED_REASON) -> None:
    life.press(why, at(seconds))
    life.refuse_clear(why, ns(seconds))


def cause(text: str, advice: str = "") -> Reason:
    """Return a cause of which the text up to a bracket is the identity."""
    return Reason("driver_fault", text, advice, text.partition(" (")[0])


def number(life: Lifecycle) -> int:
    assert life.latches.in_force is not None
    return life.latches.in_force.number


def mode(life: Lifecycle) -> Mode:
    """Return the mode.

    A type checker would assume that the attribute cannot change between asserts.
    """
    return life.mode


def causes(life: Lifecycle) -> list[str]:
    """Return who or what caused the stop, the newest cause first."""
    assert life.latches.stop is not None
    return [cause.by or cause.code for cause in life.latches.stop.causes]


# the start


def test_the_robot_starts_waiting_for_its_link() -> None:
    assert (Lifecycle().mode, Lifecycle().latches) == (Mode.WAITING, Latches())


STOP = Latch(7, WALL_NS, "ann", "stopped by ann", "stopped", kept=True)
FAULT = Latch(8, WALL_NS, "", "a wheel is dead", "wheel_dead", kept=True)
OFF = Latch(9, WALL_NS, "joe", "switched off by joe", "switched_off", kept=True)


@each(
    ("latches", "begins", "code"),
    [
        (Latches(stop=STOP), Mode.STOPPED, "stopped"),
        (Latches(fault=FAULT), Mode.FAULT, "wheel_dead"),
        (Latches(inactive=OFF), Mode.INACTIVE, "switched_off"),
        (Latches(STOP, FAULT, OFF), Mode.FAULT, "wheel_dead"),
    ],
)
def test_the_robot_starts_as_its_latches_say(latches: Latches, begins: Mode, code: str) -> None:
    life = Lifecycle(latches=latches)
    life.link(up=True)
    life.command(fresh=True)
    assert (life.mode, life.why.code) == (begins, code)
    assert life.latches is latches


def test_after_restart_marks_every_latch_as_kept_and_changes_nothing_else() -> None:
    fresh = [Latch(x.number, x.at_ns, x.by, x.why, x.code) for x in (STOP, FAULT, OFF)]
    assert Latches(fresh[0], fresh[1], fresh[2]).after_restart() == Latches(STOP, FAULT, OFF)
    assert Latches().after_restart() == Latches()


def test_the_latch_in_force_is_the_fault_then_the_stop_then_the_switch() -> None:
    assert Latches(STOP, FAULT, OFF).in_force is FAULT
    assert Latches(STOP, None, OFF).in_force is STOP
    assert Latches(None, None, OFF).in_force is OFF
    assert Latches().in_force is None


# numbers


def test_a_number_is_the_wall_time_in_ms_and_grows_even_if_the_clock_does_not() -> None:
    life = ready()
    stop(life, 1.0)
    assert number(life) == (WALL_NS + NS_PER_S) // 1_000_000
    first = number(life)
    life.stop("ann", ns(2.0), Instant(ns(2.0), 0))
    assert number(life) == first + 1
    clear(life, 2.5, first + 1)
    life.stop("ann", ns(3.0), Instant(ns(3.0), 0))
    assert number(life) == first + 2
    early = ready()
    early.stop("ann", ns(1.0), Instant(ns(1.0), 0))
    assert number(early) == 1001  # 0 means that there is no stop
    lifecycle = Lifecycle(latches=Latches(stop=STOP, inactive=OFF))
    lifecycle.stop("ann", ns(1.0), Instant(ns(1.0), 0))
    assert number(lifecycle) == OFF.number + 1001


def test_a_number_is_not_used_again_after_a_restart_with_a_wall_clock_that_went_back() -> None:
    """The latch file contains only latches in force, and no numbers of released latches."""
    first = Lifecycle(latches=Latches(inactive=OFF))
    numbers = []
    for seconds in (1.0, 1.5):
        first.stop("ann", ns(seconds), Instant(ns(seconds), 0))
        numbers.append(number(first))
        first.clear(numbers[-1], ns(seconds + 0.1), Instant(ns(seconds + 0.1), 0))
    second = Lifecycle(latches=first.latches.after_restart())
    second.stop("joe", ns(3.0), Instant(ns(3.0), 0))
    assert number(second) > max(numbers)
    with pytest.raises(RefusedError):
        second.clear(numbers[0], ns(3.1), Instant(ns(3.1), 0))


def test_the_same_stop_arriving_twice_has_one_number() -> None:
    life = ready()
    life.stop("ann", ns(1.0), at(1.001))
    life.stop("joe", ns(1.1), at(1.101))
    latched = life.latches
    life.stop("ann", ns(1.0), at(1.102))
    life.stop("joe", ns(1.1), at(1.103))
    assert life.latches is latched
    assert causes(life) == ["joe", "ann"]


def test_a_stop_after_a_clear_counts_even_if_it_arrived_before_the_last_stop() -> None:
    life = ready()
    stop(life, 1.0)
    clear(life, 4.0, number(life))
    life.stop("joe", ns(0.5), at(4.1))
    assert mode(life) is Mode.STOPPED


# several causes of one stop


def test_a_cause_that_comes_many_times_is_named_once_under_the_newest_number() -> None:
    life = ready()
    numbers = []
    for seconds in range(1, 50):
        stop(life, seconds)
        press(life, seconds + 0.5)
        numbers.append(number(life))
    assert numbers == sorted(set(numbers))
    assert causes(life) == ["emergency_stop", "ann"]
    life.refuse_clear(None, ns(60.0))
    assert clear(life, 60.1, number(life))
    press(life, 61.0)
    assert causes(life) == ["emergency_stop"]


def test_the_causes_after_many_stops_are_the_first_clients_the_last_and_each_press() -> None:
    life = ready()
    press(life, 0.5)
    for client in range(1000):
        stop(life, 1.0 + client / 100, f"client {client}")
    press(life, 20.0, SILENT_REASON)
    stop(life, 30.0, "joe")
    assert causes(life) == [
        "joe", "emergency_stop_silent", "client 3", "client 2", "client 1", "client 0",
        "emergency_stop",
    ]  # fmt: skip


def test_a_stop_in_the_step_of_a_press_is_a_cause_although_it_arrived_before_the_press() -> None:
    life = ready()
    press(life, 1.0)
    pressed = number(life)
    life.stop("ann", ns(0.999), at(1.0))
    assert causes(life) == ["ann", "emergency_stop"]
    assert number(life) > pressed


def test_every_cause_survives_restarts() -> None:
    life = ready()
    stop(life, 1.0)
    press(life, 2.0)
    for _ in range(3):
        life = Lifecycle(latches=life.latches.after_restart())
        assert causes(life) == ["emergency_stop", "ann"]
        assert life.latches.stop is not None
        assert all(cause.kept for cause in life.latches.stop.causes)


# clear and activate


class LatchCase(NamedTuple):
    """How one client stops or deactivates a robot, and how a client releases it."""

    mode: Mode
    hold: Callable[[Lifecycle, float], object]
    verb: str


HELD = each(
    "held",
    [LatchCase(Mode.STOPPED, stop, "clear"), LatchCase(Mode.INACTIVE, deactivate, "activate")],
)


@HELD
@pytest.mark.parametrize(("asked_s", "now_s"), [(0.5, 9.0), (1.0, 9.0), (1.001, 1.0)])
@pytest.mark.parametrize("named", [True, False])
def test_a_release_that_came_before_the_latch_or_in_its_step_is_refused(
    held: LatchCase, asked_s: float, now_s: float, named: bool
) -> None:
    life = ready()
    held.hold(life, 1.0)
    with pytest.raises(RefusedError):
        getattr(life, held.verb)(number(life) if named else None, ns(asked_s), at(now_s))
    assert mode(life) is held.mode


@HELD
@pytest.mark.parametrize("since_s", [0.1, 1.999])
def test_a_release_without_a_number_is_refused_until_two_seconds_after_the_last_latch(
    held: LatchCase, since_s: float
) -> None:
    life = ready()
    stop(life, 0.1)
    clear(life, 0.2, number(life))
    held.hold(life, 1.0)
    release = {"clear": clear, "activate": activate}[held.verb]
    with pytest.raises(RefusedError):
        release(life, 1.0 + since_s)
    assert mode(life) is held.mode
    with pytest.raises(RefusedError):  # a step of the wall clock
        getattr(life, held.verb)(None, ns(1.5), Instant(ns(1.5), WALL_NS + ns(3600.0)))
    assert release(life, 1.0 + LATCH_REQUIRED_S)
    assert (mode(life), life.latches) == (Mode.READY, Latches())


def test_the_two_seconds_count_from_the_last_stop() -> None:
    life = ready()
    stop(life, 1.0)
    stop(life, 4.0, "joe")
    with pytest.raises(RefusedError):
        clear(life, 4.5)


@each("latches", [Latches(stop=STOP), Latches(fault=FAULT)])
@each("wall_s", [-3e8, 0.0, 1.5, 3e8])
def test_the_two_seconds_of_a_latch_from_the_start_count_from_the_first_step(
    wall_s: float, latches: Latches
) -> None:
    """A booting computer's clock may be wrong by years."""
    life = Lifecycle(latches=latches)
    for step_s in (10.0, 10.01, 11.5):
        life.begin(Instant(ns(step_s), WALL_NS + ns(wall_s)))
    for asked_s in (9.9, 11.5):
        with pytest.raises(RefusedError):
            life.clear(None, ns(asked_s), Instant(ns(11.5), WALL_NS + ns(wall_s)))
    assert copy(life).clear(number(life), ns(9.9), at(11.5))
    assert life.clear(None, ns(12.0), Instant(ns(12.0), WALL_NS + ns(wall_s)))


def test_after_a_stall_a_release_must_name_its_latch_for_two_seconds() -> None:
    life = ready()
    life.begin(at(1.0))
    stop(life, 1.0)
    life.begin(at(10.0), stalled=True)
    with pytest.raises(RefusedError):
        clear(life, 11.9)
    assert clear(life, 10.0 + LATCH_REQUIRED_S)


def test_an_activate_of_an_active_robot_changes_nothing_whatever_number_is_named() -> None:
    life = ready()
    before = life.latches
    assert not activate(life, 1.0)
    assert not activate(life, 1.0, 7)
    assert life.latches is before


# a fault and a stop


def test_each_cause_of_a_fault_is_latched_once_with_a_new_number() -> None:
    """Two faults have the same cause if their texts differ only in measured values."""
    life = ready()
    assert life.fault(cause("the left wheel is slow (3 %)"), at(1.0))
    first = life.latches.fault
    assert not life.fault(cause("the left wheel is slow (4 %)"), at(2.0))
    assert life.latches.fault == first
    assert life.fault(cause("the driver failed"), at(3.0))
    assert not life.fault(cause("the left wheel is slow (5 %)"), at(4.0))
    assert mode(life) is Mode.FAULT
    assert first is not None
    with pytest.raises(RefusedError):
        clear(life, 5.0, first.number)
    clear(life, 5.0, number(life))
    assert mode(life) is Mode.READY


def test_the_number_of_causes_of_a_fault_is_limited() -> None:
    life = ready()
    latched = [
        life.fault(cause(chr(65 + number)), at(1.0 + number)) for number in range(MAX_FAULTS + 2)
    ]
    assert latched == [True] * MAX_FAULTS + [False] * 2


def test_a_fault_keeps_the_stop_and_each_is_cleared_separately() -> None:
    life = ready()
    stop(life, 1.0)
    assert life.fault(cause("a wheel is dead"), at(2.0))
    stop(life, 2.5)
    assert mode(life) is Mode.FAULT
    clear(life, 5.0)
    assert mode(life) is Mode.STOPPED
    with pytest.raises(RefusedError):
        clear(life, 6.9)  # the same clear request, delivered twice by the network
    clear(life, 5.0 + LATCH_REQUIRED_S)
    assert mode(life) is Mode.READY


def test_a_clear_without_a_number_needs_two_seconds_after_the_newest_of_fault_and_stop() -> None:
    life = ready()
    life.fault(cause("a wheel is dead"), at(3.0))
    with pytest.raises(RefusedError):
        clear(life, 4.5)
    life.fault(cause("the driver failed"), at(5.0))
    with pytest.raises(RefusedError):
        clear(life, 4.9 + LATCH_REQUIRED_S)
    stop(life, 8.0)
    with pytest.raises(RefusedError):
        clear(life, 9.0)
    clear(life, 8.0 + LATCH_REQUIRED_S)
    assert mode(life) is Mode.STOPPED


def test_the_second_delivery_of_a_clear_does_not_release_a_fault_that_came_between() -> None:
    life = ready()
    life.fault(cause("a wheel is dead"), at(1.0))
    clear(life, 5.0)
    life.fault(cause("a wheel is dead"), at(5.05))
    with pytest.raises(RefusedError):
        clear(life, 5.16)
    clear(life, 5.2, number(life))
    assert mode(life) is Mode.READY


# inputs of the board


def test_a_clear_counts_only_after_the_end_of_the_cause() -> None:
    life = ready()
    press(life, 1.0)
    latch = number(life)
    with pytest.raises(RefusedError):
        clear(life, 9.0, latch)
    life.refuse_clear(None, ns(9.2))
    with pytest.raises(RefusedError):
        life.clear(latch, ns(9.2), at(9.3))
    life.caused_again(ns(9.5))
    with pytest.raises(RefusedError):
        life.clear(latch, ns(9.5), at(9.6))
    assert clear(life, 9.7, latch)
    assert mode(life) is Mode.READY


# words


def test_the_reason_names_each_cause_with_its_time_and_what_the_operator_can_do() -> None:
    life = Lifecycle(latches=Latches(stop=STOP))
    life.begin(at(0.5))
    press(life, 1.0)
    life.fault(cause("a wheel is dead"), at(2.0))
    life.refuse_clear(cause("a motor driver is hot", "let it cool"), ns(2.0))
    assert life.why.code == "driver_fault"
    assert life.why.text == (
        "a wheel is dead, latched at 2027-01-15 08:00:02 UTC; also a motor driver is hot; also "
        "emergency stop pressed at the robot (latched at 2027-01-15 08:00:01 UTC); also was "
        "stopped by ann at 2027-01-15 08:00:00 UTC, before the restart; let it cool, then call "
        "srv/clear twice, 2 s apart"
    )


def test_the_newest_client_that_switched_the_robot_off_is_named() -> None:
    life = ready()
    deactivate(life, 1.0, "joe")
    deactivate(life, 2.0)
    assert life.latches.inactive is not None
    assert (life.why.code, life.latches.inactive.by) == ("switched_off", "ann")


def test_a_refusal_names_what_holds_the_robot() -> None:
    life = ready()
    stop(life, 1.0)
    press(life, 1.5)
    life.refuse_clear(None, ns(1.6))
    for latch, words in ((None, "the robot was stopped (em"), (3, "latch 3 is not the latch that")):
        with pytest.raises(RefusedError, match="stopped by ann" if latch else "0.4 s ago") as said:
            clear(life, 1.9, latch)
        assert str(said.value).startswith(words)


# shutdown


def test_a_stop_and_a_fault_during_the_shutdown_are_latched_for_the_next_start() -> None:
    life = ready()
    life.leave()
    stop(life, 1.0)
    assert life.fault(cause("a wheel is dead"), at(2.0))
    assert mode(life) is Mode.SHUTDOWN
    assert life.latches.stop is not None
    assert life.latches.fault is not None
    with pytest.raises(RefusedError):
        clear(life, 9.0, number(life))


# the model check


class State(NamedTuple):
    """All facts that decide the mode."""

    shutting_down: bool
    fault: bool
    stopped: bool
    inactive: bool
    linked: bool
    commanded: bool
    pressed: bool


Do = Callable[[Lifecycle, float], object]

FACTS: dict[str, Do] = {
    "link up": lambda life, _: life.link(up=True),
    "link lost": lambda life, _: life.link(up=False),
    "command": lambda life, _: life.command(fresh=True),
    "no command": lambda life, _: life.command(fresh=False),
    "fault": lambda life, now: life.fault(cause("a wheel is dead"), at(now)),
    "leave": lambda life, _: life.leave(),
    "press": lambda life, now: press(life, now),
    "release": lambda life, _: life.refuse_clear(None, ns(8.0)),
}

REQUESTS: dict[str, Do] = {
    "stop": stop,
    "the last stop again": lambda life, now: life.stop("ann", life._stop_asked_ns, at(now)),
    "clear by number": lambda life, now: clear(
        life, now, life.latches.next.number if life.latches.next else 0
    ),
    "clear without a number": clear,
    "clear by the number before": lambda life, now: clear(
        life, now, life.latches.next.number - 1 if life.latches.next else 0
    ),
    "clear by a later number": lambda life, now: clear(
        life, now, life.latches.next.number + 1 if life.latches.next else 9
    ),
    "clear from before": lambda life, now: life.clear(
        life.latches.next.number if life.latches.next else 0, 0, at(now)
    ),
    "activate by number": lambda life, now: activate(
        life, now, life.latches.inactive.number if life.latches.inactive else 0
    ),
    "activate without a number": activate,
    "activate by the number before": lambda life, now: activate(
        life, now, life.latches.inactive.number - 1 if life.latches.inactive else 9
    ),
    "activate from before": lambda life, now: life.activate(
        life.latches.inactive.number if life.latches.inactive else 9, 0, at(now)
    ),
    "deactivate": lambda life, now: life.deactivate("joe", at(now)),
}

TRIGGERS = FACTS | REQUESTS
PAUSES = (0.5, LATCH_REQUIRED_S + 1.0)
"""Seconds before a trigger: one while a plain clear is still refused, and one after that."""


def state_of(life: Lifecycle) -> State:
    latches = life.latches
    return State(
        life._shutting_down,
        latches.fault is not None,
        latches.stop is not None,
        latches.inactive is not None,
        life._linked,
        life._commanded,
        bool(life._held),
    )


class Edge(NamedTuple):
    before: State
    trigger: str
    pause_s: float
    after: State
    refused: bool
    latches: tuple[Latches, Latches]
    mode: Mode


@cache
def explore() -> list[Edge]:
    """Return every edge of the state machine.

    These are all triggers, each early and late, in each reachable state.
    """
    edges: list[Edge] = []
    visited: set[tuple[State, tuple[bool, ...]]] = set()
    queue = deque([(Lifecycle(), 10.0)])
    while queue:
        life, now = queue.popleft()
        # A latch older than two seconds is a separate state, because a plain clear is accepted
        # there.
        times = life._stopped_ns, life._faulted_ns, life._cleared_ns, life._off_ns
        young = tuple([now - then_ns / NS_PER_S < LATCH_REQUIRED_S for then_ns in times])
        if (state_of(life), young) in visited:
            continue
        visited.add((state_of(life), young))
        for name, do in TRIGGERS.items():
            for pause_s in PAUSES:
                after, then, refused = copy(life), now + pause_s, False
                try:
                    do(after, then)
                except RefusedError:
                    refused = True
                latches = (life.latches, after.latches)
                edges.append(
                    Edge(state_of(life), name, pause_s, state_of(after), refused, latches,
                         after.mode)
                )  # fmt: skip
                queue.append((after, then))
    return edges


def test_every_combination_of_facts_and_latches_is_reached() -> None:
    states = {edge.before for edge in explore()}
    # A pressed emergency stop is always latched.
    assert len(states) == 2**5 * 3
    tried = {(edge.before, edge.trigger, edge.pause_s) for edge in explore()}
    assert len(tried) == 2**5 * 3 * len(TRIGGERS) * 2


def test_the_mode_always_follows_from_the_facts_and_the_latches() -> None:
    for edge in explore():
        *flags, inactive, linked, commanded, _ = edge.after
        shutting_down, fault, stopped = flags
        assert edge.mode is mode_of(
            shutting_down=shutting_down, fault=fault, stopped=stopped, inactive=inactive,
            linked=linked, commanded=commanded,
        )  # fmt: skip


def test_nothing_but_clear_releases_a_stop_or_a_fault() -> None:
    releases = {
        edge.trigger
        for edge in explore()
        if edge.before.stopped > edge.after.stopped or edge.before.fault > edge.after.fault
    }
    assert releases == {"clear by number", "clear without a number"}


def test_clear_releases_exactly_one_latch_and_the_fault_first() -> None:
    cleared = 0
    for edge in explore():
        if not edge.trigger.startswith("clear") or edge.refused:
            continue
        before, after = edge.before, edge.after
        assert before._replace(fault=False, stopped=False) == after._replace(
            fault=False, stopped=False
        )
        if before.fault or before.stopped:
            assert (after.fault, after.stopped) == (False, before.fault and before.stopped)
            cleared += 1
        else:
            assert before == after
    assert cleared > 100


def test_a_clear_by_the_current_number_succeeds_unless_shutting_down_or_pressed() -> None:
    for edge in explore():
        if edge.trigger == "clear by number":
            assert edge.refused == (edge.before.shutting_down or edge.before.pressed)


def test_nothing_releases_a_latch_while_the_emergency_stop_is_pressed() -> None:
    pressed = [edge for edge in explore() if edge.before.pressed]
    assert len(pressed) > 1000
    for edge in pressed:
        assert edge.after.stopped
        assert edge.after.fault >= edge.before.fault
        assert edge.trigger == "release" or edge.after.pressed


def test_a_released_emergency_stop_stays_a_latched_stop() -> None:
    for edge in explore():
        if edge.trigger == "release":
            assert edge.after == edge.before._replace(pressed=False)


def test_a_press_always_ends_in_a_latched_stop_with_a_new_number() -> None:
    for edge in explore():
        if edge.trigger == "press":
            assert edge.after == edge.before._replace(stopped=True, pressed=True)
            (before, after) = (latches.stop for latches in edge.latches)
            assert after is not None
            assert before is None or after.number > before.number


def test_a_clear_that_names_another_latch_or_came_before_it_releases_nothing() -> None:
    wrong = {"clear by the number before", "clear by a later number", "clear from before"}
    for edge in explore():
        if edge.trigger in wrong:
            assert edge.before == edge.after
            latched = edge.before.fault or edge.before.stopped or edge.before.shutting_down
            assert edge.refused == latched


def test_a_plain_clear_is_refused_until_two_seconds_after_a_stop() -> None:
    for edge in explore():
        if edge.trigger == "clear without a number" and edge.pause_s > LATCH_REQUIRED_S:
            assert edge.refused == (edge.before.shutting_down or edge.before.pressed)


def test_nothing_but_activate_ends_inactive() -> None:
    ends = {edge.trigger for edge in explore() if edge.before.inactive > edge.after.inactive}
    assert ends == {"activate by number", "activate without a number"}


def test_an_activate_that_names_another_latch_or_came_before_it_switches_nothing_on() -> None:
    for edge in explore():
        if edge.trigger in ("activate by the number before", "activate from before"):
            assert edge.before == edge.after


def test_a_plain_activate_is_refused_until_two_seconds_after_a_deactivate() -> None:
    soon = {
        edge.refused
        for edge in explore()
        if edge.trigger == "activate without a number" and edge.mode is Mode.INACTIVE
    }
    assert soon == {True}


def test_a_refused_request_changes_nothing() -> None:
    for edge in explore():
        if edge.refused:
            assert edge.latches[0] is edge.latches[1]
            assert edge.before == edge.after


def test_a_fact_and_a_stop_are_never_refused() -> None:
    refused = {edge.trigger for edge in explore() if edge.refused}
    assert not refused & {*FACTS, "stop", "the last stop again"}


def test_a_stop_always_ends_in_a_latched_stop() -> None:
    for edge in explore():
        if edge.trigger == "stop":
            assert edge.after.stopped
            (before, after) = (latches.stop for latches in edge.latches)
            assert after is not None
            assert before is None or after.number > before.number


def test_nothing_ends_a_shutdown() -> None:
    assert all(edge.after.shutting_down for edge in explore() if edge.before.shutting_down)


def test_latches_stay_the_same_object_until_one_changes() -> None:
    for edge in explore():
        before, after = edge.latches
        assert (before is after) == (before == after)


def test_switching_off_is_refused_exactly_while_a_latch_holds_or_the_daemon_leaves() -> None:
    for edge in explore():
        if edge.trigger == "deactivate":
            before = edge.before
            assert edge.refused == (before.shutting_down or before.fault or before.stopped)
            assert edge.refused or edge.after.inactive


def test_switching_on_by_number_is_refused_exactly_while_a_latch_holds_or_the_daemon_leaves() -> (
    None
):
    for edge in explore():
        late = edge.trigger == "activate without a number" and edge.pause_s > LATCH_REQUIRED_S
        if edge.trigger == "activate by number" or late:
            before = edge.before
            assert edge.refused == (before.shutting_down or before.fault or before.stopped)
            assert edge.refused or not edge.after.inactive
