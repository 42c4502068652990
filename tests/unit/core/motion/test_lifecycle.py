"""Tests of latches and modes: chosen sequences of events, and a check of all reachable states."""

from __future__ import annotations

import re
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
AT = "2027-01-15 08:00"


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


PRESSED, SILENT = PRESSED_REASON.text, SILENT_REASON.text


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


# the start


def test_the_robot_starts_waiting_for_its_link() -> None:
    assert Lifecycle().mode is Mode.WAITING


STOP = Latch(7, WALL_NS, "ann", "stopped by ann", "stopped", kept=True)
FAULT = Latch(8, WALL_NS, "", "a wheel is dead", "wheel_dead", kept=True)
OFF = Latch(9, WALL_NS, "joe", "switched off by joe", "switched_off", kept=True)


@each(
    ("latches", "begins", "why"),
    [
        (
            Latches(stop=STOP),
            Mode.STOPPED,
            f"was stopped by ann at {AT}:00 UTC, before the restart; call srv/clear",
        ),
        (
            Latches(fault=FAULT),
            Mode.FAULT,
            f"a wheel is dead, latched at {AT}:00 UTC, before the restart; call srv/clear",
        ),
        (
            Latches(inactive=OFF),
            Mode.INACTIVE,
            f"was switched off by joe at {AT}:00 UTC, before the restart; call srv/activate",
        ),
        (
            Latches(STOP, FAULT, OFF),
            Mode.FAULT,
            f"a wheel is dead, latched at {AT}:00 UTC, before the restart; also was stopped by ann "
            f"at {AT}:00 UTC, before the restart; call srv/clear twice, 2 s apart",
        ),
        (
            Latches(
                stop=Latch(
                    7,
                    WALL_NS,
                    "acsard",
                    "stopped at the start",
                    "stopped_at_start",
                    kept=True,
                )
            ),
            Mode.STOPPED,
            f"stopped at the start (latched at {AT}:00 UTC, before the restart); call srv/clear",
        ),
    ],
)
def test_the_robot_starts_as_its_latches_say(latches: Latches, begins: Mode, why: str) -> None:
    life = Lifecycle(latches=latches)
    life.link(up=True)
    life.command(fresh=True)
    assert (life.mode, life.why.text) == (begins, why)
    assert life.latches is latches


def test_after_restart_marks_every_latch_as_kept_and_changes_nothing_else() -> None:
    fresh = [Latch(x.number, x.at_ns, x.by, x.why, x.code) for x in (STOP, FAULT, OFF)]
    assert Latches(fresh[0], fresh[1], fresh[2]).after_restart() == Latches(STOP, FAULT, OFF)
    assert Latches().after_restart() == Latches()


# one stop


def test_a_stop_latches_until_a_later_clear() -> None:
    life = ready()
    assert stop(life, 1.0) == "stopped and latched; srv/clear releases it"
    assert mode(life) is Mode.STOPPED
    assert life.why.text == f"stopped by ann at {AT}:01 UTC; call srv/clear"
    done = clear(life, 1.5, number(life))
    assert done == "cleared; each sender must send a zero before it drives"
    assert (life.mode, life.latches) == (Mode.READY, Latches())


def test_a_number_is_the_wall_time_in_ms_and_grows_even_if_the_clock_does_not() -> None:
    life = ready()
    stop(life, 1.0)
    assert number(life) == (WALL_NS + NS_PER_S) // 1_000_000
    first = number(life)
    life.stop("ann", ns(2.0), Instant(ns(2.0), 0))
    assert number(life) == first + 1
    early = ready()
    early.stop("ann", ns(1.0), Instant(ns(1.0), 0))
    assert number(early) == 1001  # 0 means that there is no stop
    lifecycle = Lifecycle(latches=Latches(stop=STOP, inactive=OFF))
    lifecycle.stop("ann", ns(1.0), Instant(ns(1.0), 0))
    assert number(lifecycle) == OFF.number + 1001


def test_a_number_is_not_used_again_after_its_latch_is_released() -> None:
    life = ready()
    stop(life, 1.0)
    first = number(life)
    clear(life, 1.5, first)
    life.stop("ann", ns(2.0), Instant(ns(2.0), 0))
    assert number(life) == first + 1


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
    with pytest.raises(RefusedError, match=f"latch {numbers[0]} is not the latch"):
        second.clear(numbers[0], ns(3.1), Instant(ns(3.1), 0))


def test_the_same_stop_arriving_twice_has_one_number() -> None:
    life = ready()
    life.stop("ann", ns(1.0), at(1.001))
    life.stop("joe", ns(1.1), at(1.101))
    latched = life.latches
    life.stop("ann", ns(1.0), at(1.102))
    life.stop("joe", ns(1.1), at(1.103))
    assert life.latches is latched
    assert latched.stop is not None
    assert latched.stop.by == "joe"


def test_a_stop_after_a_clear_counts_even_if_it_arrived_before_the_last_stop() -> None:
    life = ready()
    stop(life, 1.0)
    clear(life, 4.0, number(life))
    life.stop("joe", ns(0.5), at(4.1))
    assert mode(life) is Mode.STOPPED


# several causes of one stop


def test_a_press_keeps_the_name_of_the_client_that_stopped_the_robot() -> None:
    life = ready()
    stop(life, 1.0)
    latch = number(life)
    press(life, 2.0)
    life.refuse_clear(None, ns(3.0))
    both = f"{PRESSED} (latched at {AT}:02 UTC); also stopped by ann at {AT}:01 UTC"
    assert life.why.text == f"{both}; call srv/clear"
    with pytest.raises(RefusedError) as caught:
        clear(life, 9.0, latch)
    assert f"still stopped ({PRESSED}) and stopped by ann: look at" in str(caught.value)
    assert clear(life, 9.0, number(life)).startswith("cleared; ")
    assert mode(life) is Mode.READY
    press(life, 10.0)
    assert "ann" not in life.why.text


def test_each_client_that_stopped_the_robot_is_named_and_the_last_one_first() -> None:
    life = ready()
    for seconds, name in ((1.0, "ann"), (2.0, "joe"), (3.0, "ann")):
        stop(life, seconds, name)
    assert life.why.text == (
        f"stopped by ann at {AT}:03 UTC; also stopped by joe at {AT}:02 UTC; call srv/clear"
    )


def test_a_cause_that_comes_many_times_is_named_once_under_the_newest_number() -> None:
    life = ready()
    numbers = []
    for seconds in range(1, 50):
        stop(life, seconds)
        press(life, seconds + 0.5)
        numbers.append(number(life))
    assert numbers == sorted(set(numbers))
    life.refuse_clear(None, ns(60.0))
    assert life.why.text == (
        f"{PRESSED} (latched at {AT}:49 UTC); also stopped by ann at {AT}:49 UTC; call srv/clear"
    )


def test_the_reason_after_many_stops_names_the_first_clients_the_last_and_each_press() -> None:
    life = ready()
    press(life, 0.5)
    life.refuse_clear(None, ns(0.6))
    for client in range(1000):
        stop(life, 1.0 + client / 100, f"client {client}")
    press(life, 20.0, SILENT_REASON)
    life.refuse_clear(None, ns(21.0))
    stop(life, 30.0, "joe")
    why = life.why.text.replace(SILENT, "silent")
    assert re.findall(r"(client \d+|joe|silent|pressed) ", why) == [
        "joe", "silent", "client 3", "client 2", "client 1", "client 0", "pressed",
    ]  # fmt: skip


def test_a_stop_in_the_step_of_a_press_is_named_although_it_arrived_before_the_press() -> None:
    life = ready()
    press(life, 1.0)
    pressed = number(life)
    life.stop("ann", ns(0.999), at(1.0))
    assert life.why.text.startswith(f"stopped by ann at {AT}:01 UTC; also {PRESSED} (latched at ")
    latched = life.latches
    assert number(life) > pressed
    press(life, 1.1, SILENT_REASON)
    pressed = number(life)
    life.stop("ann", ns(0.999), at(1.2))  # the same request again, with its reply
    assert number(life) == pressed
    assert life.latches is not latched


def test_two_stops_are_named_in_whichever_order_a_step_takes_them() -> None:
    life = ready()
    life.stop("ann", ns(1.1), at(1.2))
    life.stop("joe", ns(1.0), at(1.2))
    latched = life.latches
    assert "stopped by ann" in life.why.text
    assert "stopped by joe" in life.why.text
    life.stop("ann", ns(1.1), at(1.3))
    life.stop("joe", ns(1.0), at(1.3))
    assert life.latches is latched


def test_every_cause_survives_restarts() -> None:
    life = ready()
    stop(life, 1.0)
    press(life, 2.0)
    for _ in range(3):
        life = Lifecycle(latches=life.latches.after_restart())
        assert life.why.text == (
            f"{PRESSED} (latched at {AT}:02 UTC, before the restart); also was stopped by "
            f"ann at {AT}:01 UTC, before the restart; call srv/clear"
        )
    press(life, 5.0, SILENT_REASON)
    life = Lifecycle(latches=life.latches.after_restart())
    press(life, 6.0)
    life.refuse_clear(None, ns(7.0))
    assert life.why.text == (
        f"{PRESSED} (latched at {AT}:06 UTC); also {SILENT} (latched at {AT}:05 UTC, "
        f"before the restart); also was stopped by ann at {AT}:01 UTC, before the restart; call "
        "srv/clear"
    )


# clear


class LatchCase(NamedTuple):
    """How one client stops or deactivates a robot, and how another client releases it."""

    said: str
    mode: Mode
    hold: Callable[[Lifecycle, float, str], object]
    verb: str
    before: str
    """Words for an earlier cause of the same latch."""


HELD = each(
    "held",
    [
        LatchCase("stopped", Mode.STOPPED, stop, "clear", " and stopped by ann"),
        LatchCase("switched off", Mode.INACTIVE, lambda life, s, by: life.deactivate(by, at(s)),
             "activate", ""),
    ],
)  # fmt: skip


@HELD
@pytest.mark.parametrize("asked_s", [0.5, 1.0])
@pytest.mark.parametrize("named", [True, False])
def test_a_release_that_arrived_before_the_latch_is_refused(
    held: LatchCase, asked_s: float, named: bool
) -> None:
    life = ready()
    held.hold(life, 1.0, "ann")
    with pytest.raises(RefusedError):
        getattr(life, held.verb)(number(life) if named else None, ns(asked_s), at(9.0))
    assert mode(life) is held.mode


@HELD
def test_a_release_of_the_same_step_as_the_latch_is_refused(held: LatchCase) -> None:
    life = ready()
    held.hold(life, 1.0, "ann")
    with pytest.raises(RefusedError, match="at the same time as this call or after it"):
        getattr(life, held.verb)(number(life), ns(1.001), at(1.0))


@HELD
@pytest.mark.parametrize(("since_s", "age"), [(0.1, "0.1"), (0.4, "0.4"), (1.999, "1.9")])
def test_a_release_without_a_number_is_refused_until_two_seconds_after_the_latch(
    held: LatchCase, since_s: float, age: str
) -> None:
    life = ready()
    held.hold(life, 1.0, "ann")
    release = {"clear": clear, "activate": activate}[held.verb]
    with pytest.raises(RefusedError) as caught:
        release(life, 1.0 + since_s)
    assert str(caught.value) == (
        f"the robot was {held.said} by ann {age} s ago: look at the robot, then call "
        f"srv/{held.verb} again when 2 s have passed since then, or name the number of the latch "
        "that you have seen"
    )
    assert mode(life) is held.mode
    assert release(life, 1.0 + LATCH_REQUIRED_S)
    assert (mode(life), life.latches) == (Mode.READY, Latches())


@HELD
@pytest.mark.parametrize("none", [False, True])
def test_a_release_that_names_another_latch_is_refused(held: LatchCase, none: bool) -> None:
    life = ready()
    held.hold(life, 1.0, "ann")
    latch = 0 if none else number(life)
    held.hold(life, 10.0, "joe")
    with pytest.raises(RefusedError) as caught:
        {"clear": clear, "activate": activate}[held.verb](life, 20.0, latch)
    assert str(caught.value) == (
        f"latch {latch} is not the latch that srv/{held.verb} would release now; the robot "
        f"is still {held.said} by joe{held.before}: look at the robot, then call srv/{held.verb} "
        "again with the present `latch` in `state`"
    )
    assert mode(life) is held.mode


def test_the_two_seconds_count_from_the_last_stop() -> None:
    life = ready()
    stop(life, 1.0)
    stop(life, 4.0, "joe")
    with pytest.raises(RefusedError, match=r"stopped by joe 0\.5 s ago"):
        clear(life, 4.5)


def test_a_step_of_the_wall_clock_does_not_end_the_two_seconds() -> None:
    life = ready()
    stop(life, 1.0)
    with pytest.raises(RefusedError, match=r"stopped by ann 0\.5 s ago"):
        life.clear(None, ns(1.5), Instant(ns(1.5), WALL_NS + ns(3600.0)))


@each("wall_s", [-3e8, 0.0, 1.5, 3e8])
@each("saved", [True, False])
def test_the_two_seconds_of_a_stop_from_the_start_count_from_the_first_step(
    saved: bool, wall_s: float
) -> None:
    """A `clear` without a number releases a latch only after two seconds.

    For a latch from the file they begin with the first step, because a booting computer's clock may
    be wrong by years.
    """
    stop_at_start = Latch(7, WALL_NS, "ann", "stopped by ann", "stopped", kept=saved)
    life = Lifecycle(latches=Latches(stop=stop_at_start))
    for step_s in (10.0, 10.01, 11.5):
        life.begin(Instant(ns(step_s), WALL_NS + ns(wall_s)))
    for asked_s, age in ((9.9, "0.1"), (11.5, "1.5")):
        with pytest.raises(RefusedError) as caught:
            life.clear(None, ns(asked_s), Instant(ns(11.5), WALL_NS + ns(wall_s)))
        assert str(caught.value) == (
            f"the daemon started or resumed {age} s ago and the robot is still stopped by ann: "
            "look at the robot, then call srv/clear again when 2 s have passed since then, or name "
            "the number of the latch that you have seen"
        )
    assert life.clear(None, ns(12.0), Instant(ns(12.0), WALL_NS + ns(wall_s)))


def test_a_stop_in_the_first_step_is_not_older_than_the_start() -> None:
    life = ready()
    life.begin(at(10.0))
    stop(life, 10.0)
    with pytest.raises(RefusedError, match=r"stopped by ann 1\.0 s ago"):
        clear(life, 11.0)


def test_a_named_clear_releases_a_stop_from_the_start_immediately() -> None:
    life = Lifecycle(latches=Latches(stop=STOP))
    life.begin(at(10.0))
    assert life.clear(STOP.number, ns(9.9), at(10.0))


# a fault and a stop


def both() -> Lifecycle:
    life = ready()
    stop(life, 1.0)
    assert life.fault(cause("a wheel is dead"), at(2.0))
    return life


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
    assert life.why.text == (
        f"the driver failed, latched at {AT}:03 UTC; also the left wheel is slow (3 %), latched at "
        f"{AT}:01 UTC; call srv/clear"
    )
    assert first is not None
    with pytest.raises(RefusedError, match="the driver failed; also the left wheel is slow"):
        life.clear(first.number, 5 * NS_PER_S, at(5.0))
    assert life.latches.fault is not None
    life.clear(life.latches.fault.number, 5 * NS_PER_S, at(5.0))
    assert mode(life) is Mode.READY


def test_the_number_of_causes_of_a_fault_is_limited() -> None:
    life = ready()
    latched = [
        life.fault(cause(chr(65 + number)), at(1.0 + number)) for number in range(MAX_FAULTS + 2)
    ]
    assert latched == [True] * MAX_FAULTS + [False] * 2


def test_a_fault_keeps_the_stop_and_each_is_cleared_separately() -> None:
    life = both()
    assert mode(life) is Mode.FAULT
    assert life.why.text == (
        f"a wheel is dead, latched at {AT}:02 UTC; also stopped by ann at {AT}:01 UTC; "
        "call srv/clear twice, 2 s apart"
    )
    assert (
        clear(life, 5.0)
        == "fault cleared, but the robot is still stopped by ann: call srv/clear again in 2 s"
    )
    assert mode(life) is Mode.STOPPED
    with pytest.raises(RefusedError, match="a latch was cleared less than 2 s ago"):
        clear(life, 6.9)  # the same clear request, delivered twice by the network
    assert (
        clear(life, 5.0 + LATCH_REQUIRED_S)
        == "cleared; each sender must send a zero before it drives"
    )
    assert mode(life) is Mode.READY


def test_a_stop_keeps_the_fault() -> None:
    life = ready()
    life.fault(cause("a wheel is dead"), at(1.0))
    message = stop(life, 2.0)
    assert message == (
        "stopped and latched; call srv/clear twice, 2 s apart: the first call releases the fault, "
        "the second call releases the stop"
    )
    assert mode(life) is Mode.FAULT
    clear(life, 5.0)
    assert mode(life) is Mode.STOPPED


def test_a_clear_named_for_a_stop_is_refused_when_a_fault_has_come() -> None:
    life = ready()
    stop(life, 1.0)
    latch = number(life)
    life.fault(cause("a wheel is dead"), at(2.0))
    with pytest.raises(RefusedError, match=r"still in fault \(a wheel is dead\)"):
        clear(life, 9.0, latch)
    assert life.latches.stop is not None


def test_a_clear_without_a_number_releases_a_fault_only_when_the_client_may_have_seen_it() -> None:
    life = ready()
    life.fault(cause("a wheel is dead"), at(3.0))
    with pytest.raises(RefusedError, match=r"went into fault \(a wheel is dead\) 1\.5 s ago"):
        clear(life, 4.5)
    life.fault(cause("the driver failed"), at(5.0))
    with pytest.raises(RefusedError, match=r"went into fault \(the driver failed\) 1\.9 s ago"):
        clear(life, 4.9 + LATCH_REQUIRED_S)
    clear(life, 5.0 + LATCH_REQUIRED_S)
    assert mode(life) is Mode.READY


def test_the_second_delivery_of_a_clear_does_not_release_a_fault_that_came_between() -> None:
    life = ready()
    life.fault(cause("a wheel is dead"), at(1.0))
    clear(life, 5.0)
    life.fault(cause("a wheel is dead"), at(5.05))
    with pytest.raises(RefusedError, match=r"went into fault \(a wheel is dead\) 0\.1 s ago"):
        clear(life, 5.16)
    clear(life, 5.2, number(life))
    assert mode(life) is Mode.READY


def test_a_clear_without_a_number_is_refused_while_the_newest_of_fault_and_stop_is_young() -> None:
    life = both()
    with pytest.raises(RefusedError, match="went into fault"):
        clear(life, 3.0)
    stop(life, 5.0, "bob")
    with pytest.raises(RefusedError, match=r"was stopped by bob 1\.0 s ago"):
        clear(life, 6.0)
    assert "fault cleared" in clear(life, 5.0 + LATCH_REQUIRED_S)


def test_a_fault_from_before_a_restart_needs_a_number_in_the_first_two_seconds() -> None:
    before = ready()
    before.fault(cause("a wheel is dead"), at(1.0))
    life = Lifecycle(before.latches)
    life.begin(at(10.0))
    life.link(up=True)
    with pytest.raises(RefusedError, match="and the robot is still in fault"):
        clear(life, 11.0)
    clear(life, 10.0 + LATCH_REQUIRED_S)
    assert mode(life) is Mode.READY


# the emergency stop


def test_a_pressed_emergency_stop_is_latched_and_says_what_to_do() -> None:
    life = ready()
    press(life, 1.0)
    assert mode(life) is Mode.STOPPED
    latched = f"{PRESSED} (latched at {AT}:01 UTC)"
    assert life.why.text == f"{latched}; release it at the robot, then call srv/clear"
    with pytest.raises(RefusedError) as caught:
        clear(life, 9.0, number(life))
    assert str(caught.value) == f"{PRESSED}: release it at the robot, then call srv/clear again"
    life.refuse_clear(None, ns(9.2))
    with pytest.raises(RefusedError, match="before the cause of the stop or fault had ended"):
        life.clear(number(life), ns(9.2), at(9.3))
    assert (mode(life), life.why.text) == (Mode.STOPPED, f"{latched}; call srv/clear")
    assert clear(life, 9.5, number(life)).startswith("cleared; ")
    assert mode(life) is Mode.READY


def test_a_silent_input_names_the_board_and_its_cable() -> None:
    life = ready()
    press(life, 1.0, SILENT_REASON)
    assert life.why.text == (
        f"{SILENT} (latched at {AT}:01 UTC); check the board and its cable, then call srv/clear"
    )


def test_a_stop_and_a_fault_beside_a_pressed_emergency_stop_are_named_with_it() -> None:
    life = ready()
    press(life, 1.0)
    stop(life, 2.0, "joe")
    stopped = f"stopped by joe at {AT}:02 UTC; also {PRESSED} (latched at {AT}:01 UTC)"
    assert life.why.text == f"{stopped}; release it at the robot, then call srv/clear"
    life.fault(cause("a wheel is dead"), at(3.0))
    assert life.why.text == (
        f"a wheel is dead, latched at {AT}:03 UTC; also {stopped}; release it at the robot, then "
        "call srv/clear twice, 2 s apart"
    )
    life.refuse_clear(None, ns(8.0))
    assert clear(life, 9.0) == (
        "fault cleared, but the robot is still stopped by joe and "
        f"stopped ({PRESSED}): call srv/clear again in 2 s"
    )
    assert life.why.text == f"{stopped}; call srv/clear"


def test_a_fault_that_the_board_still_reports_is_not_cleared() -> None:
    life = ready()
    life.fault(cause("a motor driver is hot"), at(1.0))
    life.refuse_clear(cause("a motor driver is hot", "let it cool"), ns(1.0))
    fault = f"a motor driver is hot, latched at {AT}:01 UTC"
    assert life.why.text == f"{fault}; let it cool, then call srv/clear"
    with pytest.raises(RefusedError) as caught:
        clear(life, 9.0, number(life))
    assert str(caught.value) == "a motor driver is hot: let it cool, then call srv/clear again"
    stop(life, 10.0, "joe")
    assert life.why.text == (
        f"{fault}; also stopped by joe at {AT}:10 UTC; let it cool, then call srv/clear twice, "
        "2 s apart"
    )


def test_a_fault_beside_one_that_the_board_reports_names_both() -> None:
    life = ready()
    life.fault(cause("a wheel is dead"), at(1.0))
    life.refuse_clear(cause("a motor driver is hot", "let it cool"), ns(1.0))
    assert life.why.text == (
        f"a wheel is dead, latched at {AT}:01 UTC; also a motor driver is hot; let it cool, then "
        "call srv/clear"
    )


def test_a_press_after_a_release_is_a_new_latch() -> None:
    life = ready()
    press(life, 1.0)
    latch = number(life)
    life.refuse_clear(None, ns(8.0))
    press(life, 5.0)
    life.refuse_clear(None, ns(8.0))
    with pytest.raises(RefusedError) as caught:
        clear(life, 9.0, latch)
    assert str(caught.value) == (
        f"latch {latch} is not the latch that srv/clear would release now; the robot is "
        f"still stopped ({PRESSED}): look at the robot, then call srv/clear again with the "
        "present `latch` in `state`"
    )


def test_a_plain_clear_is_refused_right_after_a_press() -> None:
    life = ready()
    press(life, 1.0)
    life.refuse_clear(None, ns(1.2))
    with pytest.raises(RefusedError) as caught:
        clear(life, 1.5)
    assert str(caught.value).startswith(f"the robot was stopped ({PRESSED}) 0.5 s ago: look at")
    assert clear(life, 3.0)


# switched off


def off(seconds: float = 1.0, by: str = "joe") -> Lifecycle:
    life = ready()
    life.deactivate(by, at(seconds))
    return life


def test_each_deactivate_has_a_new_number_and_the_last_is_the_one_that_is_reported() -> None:
    life = off()
    first = number(life)
    life.deactivate("ann", at(2.0))
    assert number(life) > first
    assert life.why.text == f"switched off by ann at {AT}:02 UTC; call srv/activate"


def test_an_activate_of_an_active_robot_changes_nothing_whatever_number_is_named() -> None:
    life = ready()
    before = life.latches
    assert not activate(life, 1.0)
    assert not activate(life, 1.0, 7)
    assert life.latches is before


@each("latched", ["stop", "fault"])
def test_a_clear_of_a_robot_that_is_switched_off_says_so_and_names_activate(latched: str) -> None:
    life = off()
    if latched == "stop":
        stop(life, 2.0)
    else:
        life.fault(cause("a wheel is dead"), at(2.0))
    assert clear(life, 5.0) == (
        "cleared, but the robot is still switched off: call srv/activate to switch it on, then "
        "each sender must send a zero before it drives"
    )
    assert mode(life) is Mode.INACTIVE


def test_the_latch_in_force_is_the_fault_then_the_stop_then_the_switch() -> None:
    assert Latches(STOP, FAULT, OFF).in_force is FAULT
    assert Latches(STOP, None, OFF).in_force is STOP
    assert Latches(None, None, OFF).in_force is OFF
    assert Latches().in_force is None


# shutdown


def test_a_stop_and_a_fault_during_the_shutdown_are_latched_for_the_next_start() -> None:
    life = ready()
    life.leave()
    assert stop(life, 1.0) == "stopped and latched; the daemon is shutting down"
    assert life.fault(cause("a wheel is dead"), at(2.0))
    assert mode(life) is Mode.SHUTDOWN
    assert life.latches.stop is not None
    assert life.latches.fault is not None
    with pytest.raises(RefusedError, match="shutting down"):
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
