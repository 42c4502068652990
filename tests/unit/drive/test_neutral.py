"""Neutral first: who has let go may drive, and what lets nobody drive."""

from __future__ import annotations

import math
from itertools import product
from typing import get_args

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.config.settings import CommandsConfig, Source
from acsard.drive.arbiter import Arbiter
from acsard.drive.neutral import NEXT, Sender, Sign, State
from acsard.values import REST, Command, Twist, Wait
from tests.unit.drive.commanders import GO, HIGH, HOUR_NS, LEFT, LOW, MS, RIGHT, SLOW, Bench

# the table

MACHINE: list[tuple[State, Sign, State]] = [
    ("unheard", "moving", "heard"),
    ("unheard", "zero", "free"),
    ("unheard", "pause", "heard"),
    ("heard", "moving", "heard"),
    ("heard", "zero", "free"),
    ("heard", "pause", "free"),
    ("free", "moving", "free"),
    ("free", "zero", "free"),
    ("free", "pause", "free"),
]


def after(sign: Sign) -> Command:
    """What shows this of a sender that was noticed at 0 and times out after 250 ms."""
    twist = REST if sign == "zero" else GO
    return Command("high", twist, 250 * MS + (sign == "pause"))


@pytest.mark.parametrize(("state", "sign", "then"), MACHINE)
def test_what_a_sender_sends_leads_where_the_table_says(
    state: State, sign: Sign, then: State
) -> None:
    assert NEXT[state, sign] == then
    sender = Sender(250 * MS, state)
    sender.take(after(sign), 0)
    assert sender.state == then


def test_the_table_has_an_entry_for_every_state_and_sign() -> None:
    assert set(NEXT) == {*product(get_args(State), get_args(Sign))}
    assert len(MACHINE) == len(NEXT)


@pytest.mark.parametrize("sign", get_args(Sign))
def test_what_arrived_before_it_was_required_leads_nowhere(sign: Sign) -> None:
    sender, command = Sender(250 * MS, "heard"), after(sign)
    sender.take(command, command.arrived_ns + 1)
    assert sender.state == "heard"
    assert (sender.arrived_ns, sender.noticed_ns) == (command.arrived_ns, command.arrived_ns)
    again = Sender(250 * MS, "heard")
    again.take(command, command.arrived_ns)
    assert again.state == NEXT["heard", sign]


# neutral first


def test_a_source_that_was_never_neutral_does_not_drive() -> None:
    bench = Bench(HIGH, armed=False)
    for _ in range(100):
        assert bench.send(HIGH) == ""
        assert bench.driver() == ""
        bench.wait(50)


def test_a_new_arbiter_asks_for_neutral_unasked() -> None:
    arbiter = Arbiter(CommandsConfig(True, (HIGH,)))
    assert arbiter.accept(Command("high", GO, 0)) == ""
    assert arbiter.choose(0).twist is None


def test_a_zero_is_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, GO)
    bench.send(HIGH, REST)
    assert bench.choice().twist == REST
    bench.send(HIGH, GO)
    assert bench.choice().twist == GO


def test_a_negative_zero_is_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, Twist(-0.0, -0.0))
    bench.send(HIGH, GO)
    assert bench.driver() == "high"


@pytest.mark.parametrize("twist", [Twist(0.0, 1e-9), Twist(1e-9, 0.0)])
def test_hardly_moving_is_not_neutral(twist: Twist) -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, twist)
    bench.send(HIGH, GO)
    assert bench.driver() == ""


@pytest.mark.parametrize("source", [HIGH, SLOW])
def test_a_source_that_was_heard_and_then_silent_for_its_own_timeout_is_neutral(
    source: Source,
) -> None:
    bench = Bench(source, armed=False)
    bench.send(source)
    bench.wait(source.timeout * 1000).send(source)
    assert bench.driver() == ""
    bench.wait(source.timeout * 1000 + 0.000001).send(source)
    assert bench.driver() == source.name


def test_silence_from_the_start_is_not_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.wait(60_000).send(HIGH)
    assert bench.driver() == ""


def test_a_refused_zero_is_not_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, Twist(0.0, math.nan))
    bench.stamped(HIGH)
    stamp_ns = bench.now_ns + bench.offset_ns - HOUR_NS
    zero = Command("high", REST, bench.now_ns, stamp_ns)
    assert bench.arbiter.accept(zero) == "stale"
    bench.send(HIGH)
    assert bench.driver() == ""


def test_a_refused_command_is_not_heard_so_its_silence_is_not_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, Twist(math.nan, 0.0))
    bench.wait(1000).send(HIGH)
    assert bench.driver() == ""


def test_a_source_that_was_neutral_stays_so_through_its_own_silence() -> None:
    bench = Bench(HIGH)
    bench.send(HIGH)
    bench.wait(60_000).send(HIGH)
    assert bench.driver() == "high"


def test_the_neutral_of_one_source_is_not_that_of_another() -> None:
    bench = Bench(HIGH, LOW, armed=False)
    bench.send(LOW, REST)
    bench.send(HIGH)
    assert bench.driver() == ""


def test_requiring_neutral_forgets_every_command() -> None:
    bench = Bench(HIGH, LOW)
    bench.send(LOW)
    bench.arbiter.require_neutral()
    assert bench.driver() == ""
    assert bench.status(LOW).age_s is None


def test_requiring_neutral_forgets_what_was_neutral() -> None:
    bench = Bench(HIGH)
    bench.arbiter.require_neutral()
    bench.send(HIGH)
    assert bench.driver() == ""


def test_requiring_neutral_forgets_what_was_heard() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH)
    bench.arbiter.require_neutral()
    bench.wait(1000).send(HIGH)
    assert bench.driver() == ""


def test_requiring_neutral_forgets_who_came_first() -> None:
    bench = Bench(LEFT, RIGHT)
    bench.send(RIGHT)
    assert bench.driver() == "right"
    bench.arbiter.require_neutral()
    bench.wait(10).send(LEFT, REST)
    assert bench.driver() == "left"
    bench.wait(10).send(RIGHT, REST)
    assert bench.driver() == "left"


def test_a_waiting_source_holds_its_place_with_zero() -> None:
    bench = Bench(HIGH, LOW, armed=False)
    bench.send(LOW, REST)
    bench.send(LOW, GO)
    assert bench.driver() == "low"
    bench.send(HIGH, GO)
    choice = bench.choice()
    assert (choice.source, choice.twist, choice.arrived_ns) == ("high", None, None)
    assert choice.wait == Wait("neutral", "high", 0.25)


def test_without_neutral_first_the_first_command_drives() -> None:
    bench = Bench(HIGH, neutral_first=False, armed=False)
    bench.send(HIGH)
    assert bench.driver() == "high"
    bench.arbiter.require_neutral()
    assert bench.driver() == ""
    bench.send(HIGH)
    assert bench.driver() == "high"


# what is no silence


def test_what_a_network_held_back_and_then_lets_in_arms_nobody() -> None:
    bench = Bench(HIGH, armed=False)
    bench.stamped(HIGH)
    bench.wait(50).arbiter.require_neutral(bench.now_ns)
    assert bench.stamped(HIGH) == ""
    bench.wait(400)
    answers = [bench.stamped(HIGH, late_ms=late) for late in (350, 300, 250, 200, 100, 0)]
    assert answers == ["stale", "stale", "", "", "", ""]
    assert bench.driver() == ""


def test_what_pours_in_soon_after_a_clear_arms_nobody_however_late_each_came() -> None:
    bench = Bench(HIGH, armed=False)
    bench.stamped(HIGH)
    bench.wait(600).arbiter.require_neutral(bench.now_ns)
    assert [bench.wait(5).stamped(HIGH, late_ms=late) for late in (500, 400, 100)] == [
        "stale",
        "stale",
        "",
    ]
    assert bench.driver() == ""
    assert bench.wait(200).stamped(HIGH) == ""
    assert bench.driver() == ""


def test_a_gap_between_arrivals_that_is_none_between_stamps_is_no_pause() -> None:
    bench = Bench(HIGH, armed=False)
    bench.stamped(HIGH)
    bench.wait(260).stamped(HIGH, late_ms=210)
    assert bench.driver() == ""
    bench.wait(260).stamped(HIGH, late_ms=240)
    assert bench.driver() == ""


def test_stamps_that_are_just_the_timeout_apart_show_no_pause() -> None:
    bench = Bench(HIGH, armed=False)
    bench.stamped(HIGH)
    bench.wait(251).stamped(HIGH, late_ms=1)
    assert bench.driver() == ""
    bench.wait(251).stamped(HIGH)
    assert bench.driver() == "high"


def test_a_pause_that_shows_in_the_stamps_too_is_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.stamped(HIGH)
    bench.wait(251).stamped(HIGH, late_ms=1.001)
    assert bench.driver() == ""
    bench.wait(300).stamped(HIGH)
    assert bench.driver() == "high"


def test_a_pause_before_a_command_without_a_stamp_is_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.stamped(HIGH)
    bench.wait(251).send(HIGH)
    assert bench.driver() == "high"


@pytest.mark.parametrize("step_ms", [10, 50, 249])
def test_one_who_sends_nonsense_is_not_silent(step_ms: int) -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH)
    for _ in range(1 + 300 // step_ms):
        assert bench.wait(step_ms).send(HIGH, Twist(math.nan, 0.0)) == "not_finite"
    bench.wait(step_ms).send(HIGH)
    assert bench.driver() == ""


@pytest.mark.parametrize("step_ms", [10, 50, 249])
def test_one_who_sends_what_cannot_be_read_is_not_silent(step_ms: int) -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, GO, "a")
    for _ in range(1 + 300 // step_ms):
        bench.wait(step_ms).unreadable(HIGH, "a")
    bench.wait(step_ms).send(HIGH, GO, "a")
    assert bench.driver() == ""


def test_after_nonsense_a_whole_pause_is_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, GO, "a")
    bench.wait(200).unreadable(HIGH, "a")
    bench.wait(251).send(HIGH, GO, "a")
    assert bench.driver() == "high"


@pytest.mark.parametrize("source", [Source("stranger", 1), HIGH])
def test_what_cannot_be_read_is_nothing_of_one_who_was_never_heard(source: Source) -> None:
    bench = Bench(HIGH, armed=False)
    bench.unreadable(source, "a")
    bench.wait(1000).send(HIGH, GO, "a")
    assert bench.driver() == ""
    assert bench.status(HIGH).waits_for == Wait("neutral", "high", 0.25)


def test_what_cannot_be_read_is_no_silence_of_its_own_sender_only() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, GO, "a")
    bench.wait(200).unreadable(HIGH, "b")
    bench.wait(51).send(HIGH, GO, "a")
    assert bench.driver() == "high"


def test_a_refused_command_is_no_sign_of_one_who_may_drive() -> None:
    bench = Bench(HIGH, LOW)
    bench.send(LOW)
    assert bench.send(HIGH, Twist(math.nan, 0.0), "a") == "not_finite"
    bench.unreadable(HIGH, "a")
    assert bench.driver() == "low"


def test_a_twist_that_is_zero_because_opposites_cancel_is_not_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    cancelled = Command("high", REST, bench.now_ns, cancelled=True)
    assert bench.arbiter.accept(cancelled) == ""
    assert bench.driver() == ""
    bench.send(HIGH, GO)
    assert bench.driver() == ""


def test_a_twist_that_cancels_out_is_followed_of_one_who_may_drive() -> None:
    bench = Bench(HIGH)
    assert bench.arbiter.accept(Command("high", REST, bench.now_ns, cancelled=True)) == ""
    assert bench.choice().twist == REST


# the law of it

TWISTS = {"a": Twist(0.1, 0.0), "b": Twist(0.2, 0.0)}
"""What tells in these whose twist is followed."""

KINDS = ("go", "zero", "cancelled", "nan", "unreadable", "stamped", "neutral")


class Told:
    """What a sender has done since neutral was last required, as the law says it."""

    def __init__(self) -> None:
        self.zero = self.paused = False
        self.counted: int | None = None
        """The stamp of the last command that counted, or 0 when it had none."""
        self.sign_ns = 0

    def sent(self, at_ns: int, stamp_ns: int, refused: bool, zero: bool) -> None:
        silent = at_ns - self.sign_ns > 250 * MS
        self.sign_ns = at_ns
        if refused:
            return
        if self.counted is not None and silent:
            held = stamp_ns and self.counted and stamp_ns - self.counted <= 250 * MS
            self.paused |= not held
        self.zero |= zero
        self.counted = stamp_ns


@given(
    st.lists(
        st.tuples(
            st.sampled_from([0, 20, 100, 249, 251, 300, 600]),
            st.sampled_from("ab"),
            st.sampled_from(KINDS),
            st.sampled_from([0, 60, 200, 249, 260, 400]),
        ),
        max_size=30,
    )
)
def test_no_twist_is_followed_of_a_sender_that_was_neither_neutral_nor_silent(
    story: list[tuple[int, str, str, int]],
) -> None:
    bench = Bench(HIGH, armed=False)
    told = {"a": Told(), "b": Told()}
    for wait_ms, sender, kind, late_ms in story:
        now_ns, refused, stamp_ns = bench.wait(wait_ms).now_ns, "", 0
        twist = TWISTS[sender]
        if kind == "neutral":
            bench.arbiter.require_neutral(now_ns)
            for name, one in told.items():
                told[name] = Told()
                told[name].sign_ns = one.sign_ns
            assert bench.driver() == ""
            continue
        if kind == "unreadable":
            bench.unreadable(HIGH, sender)
            refused = kind
        elif kind == "stamped":
            stamp_ns = now_ns + bench.offset_ns - late_ms * MS
            refused = bench.stamped(HIGH, late_ms, clock=sender, twist=twist, sender=sender)
        elif kind == "cancelled":
            bench.arbiter.accept(Command("high", REST, now_ns, sender=sender, cancelled=True))
        else:
            given_twist = {"go": twist, "zero": REST, "nan": Twist(math.nan, 0.0)}[kind]
            refused = bench.send(HIGH, given_twist, sender)
        told[sender].sent(now_ns, stamp_ns, bool(refused), kind == "zero")
        followed = bench.choice().twist
        if followed == REST:
            assert told["a"].zero or told["a"].paused or told["b"].zero or told["b"].paused
        for name, mark in TWISTS.items():
            if followed == mark:
                assert told[name].zero or told[name].paused, name
