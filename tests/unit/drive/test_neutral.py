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
from tests.unit.drive.commanders import GO, HIGH, HOUR_NS, LEFT, LOW, MS, RIGHT, Bench

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


def sender_in(state: State) -> Sender:
    """A sender in this state that last sent speeds at -50 ms and at 0."""
    sender = Sender(250 * MS, 1000 * MS, state)
    sender.notice(-50 * MS)
    sender.notice(0)
    return sender


def after(sign: Sign) -> Command:
    """What shows this of such a sender."""
    at_ns = {"moving": 1050 * MS, "zero": 250 * MS + 1, "pause": 1050 * MS + 1}[sign]
    return Command("high", REST if sign == "zero" else GO, at_ns)


@pytest.mark.parametrize(("state", "sign", "then"), MACHINE)
def test_what_a_sender_sends_leads_where_the_table_says(
    state: State, sign: Sign, then: State
) -> None:
    assert NEXT.get((state, sign), "free") == then
    sender = sender_in(state)
    sender.take(after(sign), 0)
    assert sender.state == then


def test_the_table_has_an_entry_for_every_state_and_sign() -> None:
    assert set(NEXT) == {*product(get_args(State)[:2], get_args(Sign))}
    assert {(state, sign) for state, sign, _ in MACHINE} == {*NEXT} | {
        ("free", sign) for sign in get_args(Sign)
    }


@pytest.mark.parametrize("sign", get_args(Sign))
def test_what_arrived_before_it_was_required_leads_nowhere(sign: Sign) -> None:
    sender, command = sender_in("heard"), after(sign)
    sender.take(command, command.arrived_ns + 1)
    assert sender.state == "heard"
    assert (sender.arrived_ns, sender.noticed_ns) == (command.arrived_ns, command.arrived_ns)
    again = sender_in("heard")
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
    arbiter = Arbiter(CommandsConfig(sources=(HIGH,)))
    assert arbiter.accept(Command("high", GO, 0)) == ""
    assert arbiter.choose(0).twist is None


def test_a_zero_is_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, GO)
    bench.wait(251).send(HIGH, REST)
    assert bench.choice().twist == REST
    bench.send(HIGH, GO)
    assert bench.choice().twist == GO


def test_a_zero_among_speeds_is_not_neutral_whoever_sent_it() -> None:
    bench = Bench(HIGH, armed=False)
    for _ in range(40):
        bench.send(HIGH, GO)
        bench.wait(25).send(HIGH, REST)
        assert bench.driver() == ""
        bench.wait(25)
    bench.wait(200).send(HIGH, REST)  # 250 ms after the last speed
    assert bench.driver() == ""
    bench.wait(1).send(HIGH, REST)
    assert bench.driver() == "high"


def test_a_zero_between_the_speeds_of_one_that_sends_seldom_is_not_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, GO)
    bench.wait(263)
    for _ in range(20):
        bench.send(HIGH, GO)
        bench.wait(260).send(HIGH, REST)
        assert bench.driver() == ""
        bench.wait(3)
    bench.wait(392 - 263).send(HIGH, REST)
    assert bench.driver() == ""
    bench.wait(266).send(HIGH, REST)  # half as long again as it usually takes
    assert bench.driver() == "high"


def test_a_zero_of_one_that_may_be_many_is_neutral_after_no_less_than_a_pause() -> None:
    bench = Bench(HIGH, armed=False)

    def send(twist: Twist, after_ms: float) -> None:
        bench.arbiter.accept(Command("high", twist, bench.wait(after_ms).now_ns, shared=True))

    send(REST, 0)
    assert bench.driver() == "high"  # there was no speed before it
    bench.arbiter.require_neutral(bench.now_ns)
    for _ in range(10):
        send(GO, 50)
    send(REST, 1050)
    assert bench.driver() == ""
    send(REST, 1)
    assert bench.driver() == "high"


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


@pytest.mark.parametrize("every_ms", [20, 50, 200, 263, 400])
def test_a_second_s_silence_beyond_its_usual_interval_is_neutral(every_ms: int) -> None:
    bench = Bench(HIGH, armed=False)
    for _ in range(10):
        bench.wait(every_ms).send(HIGH)
    bench.wait(1000 + every_ms).send(HIGH)
    assert bench.driver() == ""
    bench.wait(every_ms).send(HIGH)
    bench.wait(1000 + every_ms + 1).send(HIGH)
    assert bench.driver() == "high"


def test_the_pause_is_as_long_as_configured() -> None:
    bench = Bench(HIGH, armed=False, pause=3.0)
    for after in (50, 50, 50, 50, 3050):
        assert bench.wait(after).send(HIGH) == ""
        assert bench.driver() == ""
    bench.wait(3051).send(HIGH)
    assert bench.driver() == "high"


@pytest.mark.parametrize("every_ms", [1000, 1500, 5000])
def test_one_that_sends_seldom_pauses_only_by_missing_two(every_ms: int) -> None:
    bench = Bench(HIGH, armed=False)
    for _ in range(10):
        bench.wait(every_ms).send(HIGH)
        assert bench.driver() == ""
    bench.wait(3 * every_ms).send(HIGH)
    assert bench.driver() == ""
    bench.wait(3 * every_ms + 1).send(HIGH)
    assert bench.driver() == "high"


def test_a_stall_among_its_intervals_does_not_make_them() -> None:
    bench = Bench(HIGH, armed=False)
    for after in (50, 50, 900, 50, 900, 50, 1051):
        assert bench.driver() == ""
        bench.wait(after).send(HIGH)
    assert bench.driver() == "high"


def test_who_sent_but_once_has_no_interval_to_pause_by() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH)
    bench.wait(5000).send(HIGH)
    assert bench.driver() == ""


@pytest.mark.parametrize(("number", "neutral"), [(3, True), (4, False), (23, False), (1, False)])
def test_a_silence_in_which_its_sequence_went_on_was_the_network_s(
    number: int, neutral: bool
) -> None:
    bench = Bench(HIGH, armed=False)
    for sequence, after in ((1, 50), (2, 50), (number, 4000)):
        command = Command("high", GO, bench.wait(after).now_ns, sequence=sequence)
        assert bench.arbiter.accept(command) == ""
    assert bench.driver() == ("high" if neutral else "")


def test_silence_from_the_start_is_not_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.wait(60_000).send(HIGH)
    assert bench.driver() == ""


def test_a_refused_zero_is_not_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.known(HIGH).arbiter.require_neutral(bench.now_ns + 1)
    bench.wait(300).send(HIGH, Twist(0.0, math.nan))
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
    assert choice.wait == Wait("neutral", "high", 1.0)


def test_without_neutral_first_the_first_command_drives() -> None:
    bench = Bench(HIGH, neutral_first=False, armed=False)
    bench.send(HIGH)
    assert bench.driver() == "high"
    bench.arbiter.require_neutral()
    assert bench.driver() == ""
    bench.send(HIGH)
    assert bench.driver() == "high"


def test_a_zero_that_did_not_count_yet_never_does_once_its_delay_proved_wrong() -> None:
    bench = Bench(HIGH, armed=False).known(HIGH)
    bench.arbiter.require_neutral(bench.now_ns + 1)
    bench.wait(50).stamped(HIGH)
    bench.wait(300_000)  # so long that its clock is new
    for age in range(3000, -1, -50):
        bench.wait(10).stamped(HIGH, age, twist=REST if age == 3000 else GO)
    for _ in range(20):
        bench.wait(50).stamped(HIGH)
    assert bench.choice().wait.what == "neutral"


# what is no silence


def holding() -> Bench:
    """One whose clock is known, who sends speeds at 20 Hz since neutral was required."""
    bench = Bench(HIGH, armed=False).known(HIGH)
    bench.arbiter.require_neutral(bench.now_ns + 1)
    for _ in range(6):
        bench.wait(50).stamped(HIGH)
    assert bench.driver() == ""
    return bench


def test_what_a_network_held_back_and_then_lets_in_arms_nobody() -> None:
    bench = Bench(HIGH, armed=False).known(HIGH)
    bench.wait(50).arbiter.require_neutral(bench.now_ns)
    assert bench.stamped(HIGH) == ""
    bench.wait(400)
    answers = [bench.stamped(HIGH, late_ms=late) for late in (350, 300, 250, 200, 100, 0)]
    assert answers == ["stale", "stale", "", "", "", ""]
    assert bench.driver() == ""


def test_what_pours_in_soon_after_a_clear_arms_nobody_however_late_each_came() -> None:
    bench = Bench(HIGH, armed=False).known(HIGH)
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
    bench = holding()
    bench.wait(1060).stamped(HIGH, late_ms=10)
    assert bench.driver() == ""
    bench.wait(1060).stamped(HIGH, late_ms=240)
    assert bench.driver() == ""


def test_a_pause_that_shows_in_the_stamps_too_is_neutral() -> None:
    bench = holding()
    bench.wait(1060).stamped(HIGH, late_ms=9.999)
    assert bench.driver() == "high"


def test_a_pause_before_a_command_without_a_stamp_is_neutral() -> None:
    bench = holding()
    bench.wait(1060).send(HIGH)
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
    bench.wait(1200).send(HIGH, GO, "a")
    assert bench.driver() == ""
    bench.wait(2101).send(HIGH, GO, "a")
    assert bench.driver() == "high"


@pytest.mark.parametrize("source", [Source("stranger", 1), HIGH])
def test_what_cannot_be_read_is_nothing_of_one_who_was_never_heard(source: Source) -> None:
    bench = Bench(HIGH, armed=False)
    bench.unreadable(source, "a")
    bench.wait(1000).send(HIGH, GO, "a")
    assert bench.driver() == ""
    assert bench.status(HIGH).waits_for == Wait("neutral", "high", 1.0)


def test_what_cannot_be_read_is_no_silence_of_its_own_sender_only() -> None:
    bench = Bench(HIGH, armed=False)
    for _ in range(2):
        bench.wait(50).send(HIGH, GO, "a")
    bench.wait(1000).unreadable(HIGH, "b")
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
        self.sign_ns = self.moved_ns = 0

    def sent(self, at_ns: int, stamp_ns: int, refused: bool, zero: bool) -> None:
        silent = at_ns - self.sign_ns > 1000 * MS
        self.sign_ns = at_ns
        still = at_ns - self.moved_ns > 250 * MS
        if refused or not zero:
            self.moved_ns = at_ns
        if refused:
            return
        if self.counted is not None and silent:
            held = stamp_ns and self.counted and stamp_ns - self.counted <= 1000 * MS
            self.paused |= not held
        self.zero |= zero and still
        self.counted = stamp_ns


@given(
    st.lists(
        st.tuples(
            st.sampled_from([0, 20, 100, 249, 251, 300, 600, 1500, 4000]),
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
    for sender in "ab":
        bench.known(HIGH, sender, sender)
    bench.arbiter.require_neutral(bench.now_ns + 1)
    bench.wait(1)
    told = {"a": Told(), "b": Told()}
    for one in told.values():
        one.sign_ns = bench.now_ns
    for wait_ms, sender, kind, late_ms in story:
        now_ns, refused, stamp_ns = bench.wait(wait_ms).now_ns, "", 0
        twist = TWISTS[sender]
        if kind == "neutral":
            bench.arbiter.require_neutral(now_ns)
            for name, one in told.items():
                told[name] = Told()
                told[name].sign_ns, told[name].moved_ns = one.sign_ns, one.moved_ns
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
