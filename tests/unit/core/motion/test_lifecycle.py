"""The mode follows from facts and latches, and a call releases only what its sender knows."""

from __future__ import annotations

import random

import msgspec
import pytest

from acsard.core.codes import Reason, reason
from acsard.core.motion.latches import after_restart
from acsard.core.motion.lifecycle import SHOWN_S, Lifecycle
from acsard.core.motion.modes import Mode, RefusedError, mode_of
from acsard.core.values import NS_PER_S, Cause, CauseKind, Instant, Latches
from tests.each import each

WALL_NS = 1_800_000_000 * NS_PER_S


def ns(seconds: float) -> int:
    return round(seconds * NS_PER_S)


def at(seconds: float) -> Instant:
    return Instant(ns(seconds), WALL_NS + ns(seconds))


def why(part: str) -> Reason:
    return Reason("wheel_reversed", f"{part} is dead", part=part)


PRESSED = reason("emergency_stop")


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
        assert self.life.fault(why(part), at(self.now_s))
        return self.life.latches.last

    def off(self, by: str = "joe") -> int:
        self.life.deactivate(by, at(self.now_s))
        return self.life.latches.last

    def press(self) -> int:
        self.life.press(PRESSED, at(self.now_s))
        self.life.hold(PRESSED, ns(self.now_s))
        return self.life.latches.last

    def clear(self, *numbers: int, asked_s: float | None = None) -> tuple[int, ...]:
        asked_ns = ns(self.now_s if asked_s is None else asked_s)
        return self.life.clear(numbers or None, asked_ns)[1]

    def activate(self, *numbers: int) -> tuple[int, ...]:
        return self.life.activate(numbers or None, ns(self.now_s))

    @property
    def numbers(self) -> list[int]:
        return [cause.number for cause in self.life.latches.causes]

    @property
    def mode(self) -> Mode:
        return self.life.mode


@pytest.fixture
def timed() -> Timed:
    return Timed()


# the mode


def test_the_mode_follows_the_facts_in_order(timed: Timed) -> None:
    life = timed.life
    modes = [Lifecycle().mode, life.mode]
    for change in (
        lambda: life.command(fresh=True),
        lambda: life.link(up=False),
        timed.off,
        timed.stop,
        timed.fault,
        life.leave,
    ):
        change()
        modes.append(life.mode)
    assert modes == [
        "waiting", "ready", "driving", "waiting", "inactive", "stopped", "fault", "shutdown",
    ]  # fmt: skip


@each("kind", ["fault", "stop", "inactive"])
def test_a_robot_starts_as_its_latches_say_and_keeps_their_numbers(kind: CauseKind) -> None:
    cause = Cause(7, kind, "stopped", "stopped by joe", by="joe", at_ns=WALL_NS)
    life = Lifecycle(after_restart(Latches((cause,), 9)))
    assert life.mode == {"stop": "stopped"}.get(kind, kind)
    assert "was stopped by joe at 2027-01-15 08:00:00 UTC, before the restart" in life.why.text
    life.stop("ann", 0, at(1.0))
    assert life.latches.last == 10


def test_a_lifecycle_is_plain_data(timed: Timed) -> None:
    timed.fault()
    timed.press()
    timed.run(1.0)
    data = msgspec.msgpack.encode(timed.life)
    assert msgspec.msgpack.decode(data, type=Lifecycle) == timed.life


# stop


def test_the_same_stop_that_arrives_twice_has_one_number(timed: Timed) -> None:
    """The bus hands a call over as a stop first, and later as a query."""
    first = timed.stop()
    timed.life.stop("joe", ns(timed.now_s), at(timed.now_s + 0.1))
    assert timed.numbers == [first] == list(timed.life.stop_of("joe"))
    timed.run(0.1)
    assert timed.stop() > first
    assert len(timed.numbers) == 1


def test_a_stop_counts_after_a_clear_even_if_it_arrived_before(timed: Timed) -> None:
    timed.clear(timed.stop())
    timed.life.stop("joe", ns(timed.now_s) - 1, at(timed.now_s))
    assert timed.mode is Mode.STOPPED


def test_a_stop_and_a_fault_during_the_shutdown_are_latched_for_the_next_start(
    timed: Timed,
) -> None:
    timed.life.leave()
    timed.stop()
    timed.fault()
    assert (timed.mode, len(timed.numbers)) == (Mode.SHUTDOWN, 2)
    with pytest.raises(RefusedError, match="shutting down"):
        timed.clear(*timed.numbers)


def test_each_wheel_with_a_fault_is_latched_once(timed: Timed) -> None:
    timed.fault("front_left")
    assert not timed.life.fault(why("front_left"), at(9.0))
    timed.fault("rear_left")
    assert len(timed.numbers) == 2


# clear


def test_a_clear_releases_exactly_what_it_names(timed: Timed) -> None:
    first, fault, press, off = timed.stop("ann"), timed.fault(), 0, 0
    press = timed.press()
    timed.life.hold(None, ns(timed.now_s))
    timed.run(0.01)
    assert timed.clear(first, 999) == (first,)
    assert timed.numbers == [fault, press]
    assert timed.clear(press) == (press,)
    assert timed.mode == "fault"
    assert timed.clear(fault) == (fault,)
    off = timed.off()
    assert timed.clear(off) == (), "nothing is to be cleared"
    assert timed.mode == "inactive"


def test_a_clear_that_names_nothing_in_force_is_refused_and_says_what_holds_the_robot(
    timed: Timed,
) -> None:
    number = timed.stop("ann")
    timed.run(5.0)
    with pytest.raises(RefusedError, match=rf"still stopped by ann.*\({number}\)"):
        timed.clear(number + 1)
    with pytest.raises(RefusedError, match="names no cause"):
        timed.life.clear((), ns(timed.now_s))
    assert timed.numbers == [number]


def test_a_plain_clear_releases_the_faults_and_the_next_one_the_stops(timed: Timed) -> None:
    stops = {timed.stop("ann"), timed.stop("joe")}
    faults = {timed.fault("front_left"), timed.fault("rear_left")}
    timed.run(SHOWN_S + 0.02)
    text, done = timed.life.clear(None, ns(timed.now_s))
    assert set(done) == faults
    assert text.startswith("cleared, but the robot is still stopped by joe and stopped by ann")
    assert set(timed.clear()) == stops
    assert timed.mode is Mode.READY


@each("kind", ["stop", "fault", "off"])
def test_a_plain_call_is_refused_until_the_newest_cause_was_shown_for_two_seconds(
    kind: str,
) -> None:
    timed = Timed()
    call = timed.activate if kind == "off" else timed.clear
    if kind == "fault":
        timed.stop("ann")
        timed.run(5.0)
    {"stop": timed.stop, "fault": timed.fault, "off": timed.off}[kind]()
    for _ in range(20):
        timed.run(0.1)
        with pytest.raises(RefusedError, match=r"has shown for only [01]\.\d s that it is"):
            call()
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


def test_the_two_seconds_of_a_cause_from_before_count_from_the_end_of_the_first_step() -> None:
    cause = Cause(7, "stop", "stopped", "stopped by joe", at_ns=WALL_NS, kept=True)
    life = Lifecycle(Latches((cause,), 7))
    life.begin(ns(1.0))
    assert life.shown == {}
    life.begin(ns(4.0))
    assert life.shown == {7: ns(4.0)}


def test_nothing_is_released_while_its_cause_lasts(timed: Timed) -> None:
    fault, press = timed.fault(), timed.press()
    timed.run(3.0)
    for numbers in ((), (fault,), (press,), (fault, press)):
        with pytest.raises(RefusedError, match="release it at the robot, then call srv/clear"):
            timed.clear(*numbers)
    asked_s = timed.now_s
    timed.life.hold(None, ns(timed.now_s))
    with pytest.raises(RefusedError, match="before the cause of the stop or fault had ended"):
        timed.clear(press, asked_s=asked_s)
    timed.run(0.01)
    assert timed.clear(fault, press)


# activate


def test_only_activate_ends_inactive_and_only_without_a_latched_stop(timed: Timed) -> None:
    off = timed.off("ann")
    assert timed.off("joe") > off
    with pytest.raises(RefusedError, match="still switched off by joe"):
        timed.activate(off)
    stop = timed.stop()
    with pytest.raises(RefusedError, match="call srv/clear first"):
        timed.activate(*timed.numbers)
    with pytest.raises(RefusedError):
        timed.off()
    text, _ = timed.life.clear((stop,), ns(timed.now_s))
    assert "still switched off: call srv/activate" in text
    assert timed.activate(*timed.numbers)
    assert timed.activate(5) == (), "it is on"
    assert timed.mode is Mode.READY


# the reason


def test_the_reason_names_each_cause_and_what_a_person_can_do(timed: Timed) -> None:
    timed.stop("ann")
    timed.fault("front_left")
    timed.press()
    text = timed.life.why.text
    assert timed.life.why.code == "wheel_reversed"
    assert text.startswith("front_left is dead (latched at 2027-01-15 08:00:00 UTC); also ")
    assert "; also emergency stop pressed at the robot (latched at" in text
    assert "; also stopped by ann at 2027" in text
    assert text.endswith("; release it at the robot, then call srv/clear")
    timed.life.hold(reason("bumper", bumpers="bumper 2 pressed"), 0)
    assert "; also bumper 2 pressed; release it at the robot, then" in timed.life.why.text


# all histories


@each("seed", range(300))
def test_in_any_history_a_call_releases_what_it_names_and_numbers_are_new(seed: int) -> None:
    """Callers act on states that they read up to 3 s ago; the daemon restarts now and then."""
    dice, timed = random.Random(seed), Timed(Latches(last=seed))
    given: set[int] = set()
    latched_s: dict[int, float] = {}
    for _ in range(60):
        timed.run(dice.choice((0.01, 0.3, 1.0, 2.5)))
        life, before = timed.life, timed.life.latches
        act = dice.choice(("stop", "stop", "fault", "press", "off", "clear", "activate", "restart"))
        named = dice.choice(
            (None, tuple(timed.numbers), tuple(dice.sample(sorted(given), min(3, len(given)))))
        )
        try:
            match act:
                case "stop":
                    timed.stop(dice.choice(("ann", "joe", "")))
                case "fault":
                    life.fault(why(dice.choice(("front_left", "rear_left"))), at(timed.now_s))
                case "press":
                    timed.press()
                    timed.life.hold(None, ns(timed.now_s) - 1)
                case "off":
                    timed.off(dice.choice(("ann", "joe")))
                case "restart":
                    timed = Timed(after_restart(before))
                    latched_s = dict.fromkeys(timed.numbers, timed.now_s - 0.02)
                case "clear" | "activate":
                    call = life.clear if act == "clear" else life.activate
                    call(named, ns(timed.now_s))
        except RefusedError:
            assert life.latches is before
        after = timed.life.latches
        left, kinds = {c.number for c in after.causes}, {c.kind for c in after.causes}
        fresh = left - {c.number for c in before.causes}
        assert not fresh & given
        given |= fresh
        latched_s |= dict.fromkeys(fresh, timed.now_s)
        gone = [c for c in before.causes if c.number not in left]
        if act in ("clear", "activate"):
            ours = {"fault", "stop"} if act == "clear" else {"inactive"}
            assert {c.kind for c in gone} <= ours
            if named is not None:
                expected = {c.number for c in before.causes if c.number in named and c.kind in ours}
                blocked = act == "activate" and kinds & {"fault", "stop"}
                assert blocked or {c.number for c in gone} == expected
            assert named is not None or all(
                timed.now_s - latched_s[c.number] >= SHOWN_S for c in gone
            )
        else:
            # A cause that came again has replaced itself.
            assert len(gone) <= len(fresh)
        assert timed.mode is mode_of(
            shutting_down=False,
            fault="fault" in kinds,
            stopped="stop" in kinds,
            inactive="inactive" in kinds,
            linked=True,
            commanded=False,
        )
