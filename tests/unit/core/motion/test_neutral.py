"""Tests of the neutral-first rule: a zero arms a sender, and where a source says so a pause."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.config.settings import CommandsConfig, Source
from acsard.core.motion.arbiter import Arbiter
from acsard.core.values import NS_PER_S, REST, Command, Twist, Wait
from tests.unit.core.motion.commanders import GO, HIGH, HOUR_NS, LEFT, LOW, MS, RIGHT, Bench

PAUSE = Source("high", 100, neutral_first="pause")

# shared identities


@pytest.mark.parametrize(("after_ms", "driver"), [(0, ""), (500, ""), (999, ""), (1000, "high")])
def test_a_shared_zero_arms_if_no_speed_follows_for_a_second(after_ms: float, driver: str) -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, REST, "a", shared=True)
    bench.wait(after_ms).send(HIGH, GO, "a", shared=True)
    assert bench.driver() == driver


def test_more_zeros_do_not_restart_the_pause() -> None:
    bench = Bench(HIGH, armed=False)
    for _ in range(11):
        bench.send(HIGH, REST, "a", shared=True)
        bench.wait(100)
    bench.send(HIGH, GO, "a", shared=True)
    assert bench.driver() == "high"


@pytest.mark.parametrize(("shared", "driver"), [(True, ""), (False, "high")])
def test_a_speed_of_another_shared_identity_ends_the_wait_of_a_shared_zero(
    shared: bool, driver: str
) -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, REST, "a", shared=True)
    bench.wait(500).send(HIGH, GO, "b", shared=shared)
    bench.wait(700).send(HIGH, GO, "a", shared=True)
    assert bench.driver() == driver


def test_an_unreadable_message_ends_the_wait_of_its_own_identity_only() -> None:
    bench = Bench(HIGH, armed=False)
    for name in "ab":
        bench.send(HIGH, REST, name, shared=True)
    bench.wait(500).unreadable(HIGH, "b")
    bench.wait(500)
    armed = {
        name: bench.arbiter.sources["high"].senders[name].is_armed(bench.now_ns) for name in "ab"
    }
    assert armed == {"a": True, "b": False}


def test_the_pause_behind_a_shared_zero_starts_again_after_a_stall() -> None:
    bench = Bench(HIGH, armed=False)
    bench.arbiter.begin(bench.now_ns, bench.commands)
    bench.send(HIGH, REST, "a", shared=True)
    bench.wait(900).arbiter.begin(bench.now_ns, bench.commands)
    sender = bench.arbiter.sources["high"].senders["a"]
    assert not sender.is_armed(bench.now_ns + 999 * MS)
    assert sender.is_armed(bench.now_ns + 1000 * MS)


def test_a_stall_brings_back_no_sender_that_was_silent_before() -> None:
    bench = Bench(HIGH, armed=False)
    bench.arbiter.begin(bench.now_ns, bench.commands)
    bench.send(HIGH, REST)
    bench.wait(100).arbiter.begin(bench.now_ns, bench.commands)
    bench.wait(200).arbiter.begin(bench.now_ns, bench.commands)
    assert bench.choice().wait.what == "stalled"
    for ms in (100, 100, 100, 200):
        bench.wait(ms).arbiter.begin(bench.now_ns, bench.commands)
    assert bench.choice().wait.what == "command"


# a zero of a clock that is not proven yet


@pytest.mark.parametrize(("late_ms", "driver"), [(0, "high"), (240, "high"), (260, "")])
def test_a_zero_during_the_proof_arms_unless_the_proof_shows_that_it_was_late(
    late_ms: float, driver: str
) -> None:
    bench = Bench(HIGH, armed=False)
    assert bench.stamped(HIGH, late_ms, twist=REST) == "unproven"
    for _ in range(8):
        bench.wait(50).stamped(HIGH)
    assert bench.stamped(HIGH) in ("", "not_newer")
    assert bench.driver() == driver


def test_a_shared_zero_during_the_proof_waits_for_a_second_without_a_speed_too() -> None:
    bench = Bench(HIGH, armed=False)
    bench.stamped(HIGH, twist=REST, shared=True)
    for _ in range(40):
        bench.wait(50).stamped(HIGH, shared=True)
    assert bench.driver() == ""
    bench.wait(50).stamped(HIGH, twist=REST, shared=True)
    bench.wait(1000).stamped(HIGH, shared=True)
    assert bench.driver() == "high"


def test_the_pause_behind_a_shared_zero_during_the_proof_starts_again_after_a_stall() -> None:
    bench = Bench(HIGH, armed=False)
    bench.arbiter.begin(bench.now_ns, bench.commands)
    bench.stamped(HIGH, twist=REST, shared=True)
    bench.wait(900).arbiter.begin(bench.now_ns, bench.commands)
    assert bench.stamped(HIGH, twist=REST, shared=True) == ""
    sender = bench.arbiter.sources["high"].senders[""]
    assert not sender.is_armed(bench.now_ns + 999 * MS)
    assert sender.is_armed(bench.now_ns + 1000 * MS)


def test_a_refused_zero_that_is_newer_ends_the_speed_and_arms_nothing() -> None:
    bench = Bench(HIGH)
    go = Command("high", GO, bench.now_ns, sequence=1)
    assert bench.accept(go) == ""
    bench.arbiter.caught_up_ns = bench.now_ns + 100 * MS
    for number, twist in ((1, GO), (0, GO), (2, REST)):
        stamp_ns = bench.now_ns + bench.offset_ns
        zero = Command("high", REST, bench.now_ns + 1, stamp_ns, sequence=number)
        assert bench.accept(zero) == "unproven"
        assert bench.choice().twist == twist
    bench.arbiter.require_neutral()
    bench.wait(500)
    assert bench.stamped(HIGH, 0.0) == ""
    assert bench.driver() == ""


@pytest.mark.parametrize("proven", [True, False])
@pytest.mark.parametrize(
    ("wait_ms", "number", "code"), [(2, 1, "not_newer"), (2, 3, ""), (260, 1, "")]
)
def test_a_speed_that_a_zero_of_another_clock_overtook_is_not_newer(
    wait_ms: float, number: int, code: str, proven: bool
) -> None:
    bench = Bench(HIGH).prove_clock(HIGH)
    if proven:
        bench.prove_clock(HIGH, "other clock")
    stamp_ns = bench.now_ns + bench.offset_ns + 1
    zero = Command("high", REST, bench.now_ns + 1, stamp_ns, "other clock", sequence=2)
    assert bench.accept(zero) == ("" if proven else "unproven")
    bench.wait(wait_ms)
    speed = Command("high", GO, bench.now_ns, bench.now_ns + bench.offset_ns, sequence=number)
    assert bench.accept(speed) == code


# a pause


@pytest.mark.parametrize(("pause_ms", "driver"), [(999, ""), (1000, "high")])
@pytest.mark.parametrize("shared", [False, True])
def test_where_a_source_says_so_a_pause_of_a_second_arms(
    pause_ms: float, driver: str, shared: bool
) -> None:
    bench = Bench(PAUSE, armed=False)
    bench.arbiter.watched_ns = bench.now_ns
    bench.send(PAUSE, GO, "a", shared)
    bench.wait(pause_ms).send(PAUSE, GO, "a", shared)
    assert bench.driver() == driver


def test_a_pause_of_one_program_of_a_shared_identity_arms_nothing() -> None:
    bench = Bench(PAUSE, armed=False)
    bench.arbiter.watched_ns = bench.now_ns
    for name in "ab" * 20:
        bench.wait(600).send(PAUSE, GO, name, shared=True)
        assert bench.driver() == ""


def test_the_pause_must_begin_after_the_event_and_while_the_daemon_watches() -> None:
    bench = Bench(PAUSE, armed=False)
    bench.wait(5000).arbiter.require_neutral(bench.now_ns)
    bench.wait(900).send(PAUSE)
    assert bench.driver() == ""
    assert bench.choice().wait == Wait("neutral", "high", 1.0, pause=True)
    bench.wait(600)
    bench.arbiter.watched_ns = bench.now_ns
    bench.wait(600).send(PAUSE)
    assert bench.driver() == ""
    bench.wait(1000).send(PAUSE)
    assert bench.driver() == "high"


def test_a_pause_before_the_proof_of_a_clock_arms_when_the_proof_ends() -> None:
    bench = Bench(PAUSE, armed=False)
    for _ in range(5):
        bench.stamped(PAUSE)
        assert bench.driver() == ""
        bench.wait(50)
    bench.stamped(PAUSE)
    assert bench.driver() == "high"


# silence


@pytest.mark.parametrize(("silent_ms", "driver"), [(10_000, "high"), (10_001, "")])
@pytest.mark.parametrize("shared", [False, True])
def test_a_sender_without_an_accepted_command_for_ten_seconds_is_disarmed(
    silent_ms: float, driver: str, shared: bool
) -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, REST, "a", shared)
    bench.wait(1000).send(HIGH, GO, "a", shared)
    bench.wait(silent_ms).send(HIGH, GO, "a", shared)
    assert bench.driver() == driver


# neutral first


def test_a_new_arbiter_requires_a_zero_first() -> None:
    arbiter, commands = Arbiter(), CommandsConfig(sources=(HIGH,))
    assert arbiter.accept(Command("high", GO, NS_PER_S), commands) is None
    assert arbiter.choose(NS_PER_S, commands).twist is None


def test_a_negative_zero_is_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, Twist(-0.0, -0.0))
    bench.send(HIGH, GO)
    assert bench.driver() == "high"


@pytest.mark.parametrize("twist", [Twist(0.0, 1e-9), Twist(1e-9, 0.0)])
def test_a_tiny_speed_is_not_neutral(twist: Twist) -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, twist)
    bench.send(HIGH, GO)
    assert bench.driver() == ""


def test_a_refused_zero_is_not_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    bench.prove_clock(HIGH).arbiter.require_neutral(bench.now_ns + 1)
    bench.wait(300).send(HIGH, Twist(0.0, math.nan))
    stamp_ns = bench.now_ns + bench.offset_ns - HOUR_NS
    zero = Command("high", REST, bench.now_ns, stamp_ns)
    assert bench.accept(zero) == "stale"
    bench.send(HIGH)
    assert bench.driver() == ""


def test_a_zero_on_one_source_does_not_arm_another_source() -> None:
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


def test_requiring_neutral_forgets_which_sender_came_first() -> None:
    bench = Bench(LEFT, RIGHT)
    bench.send(RIGHT)
    assert bench.driver() == "right"
    bench.arbiter.require_neutral()
    bench.wait(10).send(LEFT, REST)
    assert bench.driver() == "left"
    bench.wait(10).send(RIGHT, REST)
    assert bench.driver() == "left"


def test_an_unarmed_source_of_higher_priority_is_chosen_without_a_twist() -> None:
    bench = Bench(HIGH, LOW, armed=False)
    bench.send(LOW, REST)
    bench.send(LOW, GO)
    assert bench.driver() == "low"
    bench.send(HIGH, GO)
    choice = bench.choice()
    assert (choice.source, choice.twist, choice.arrived_ns) == ("high", None, None)
    assert choice.wait == Wait("neutral", "high", 1.0)


# events that are not a silence


def test_commands_that_a_network_held_back_do_not_arm() -> None:
    bench = Bench(HIGH, armed=False).prove_clock(HIGH)
    bench.wait(50).arbiter.require_neutral(bench.now_ns)
    assert bench.stamped(HIGH) == ""
    bench.wait(400)
    answers = [bench.stamped(HIGH, late_ms=late) for late in (350, 300, 250, 200, 100, 0)]
    assert answers == ["stale", "stale", "", "", "", ""]
    assert bench.driver() == ""


def test_late_commands_that_arrive_together_soon_after_a_clear_do_not_arm() -> None:
    bench = Bench(HIGH, armed=False).prove_clock(HIGH)
    bench.wait(600).arbiter.require_neutral(bench.now_ns)
    assert [bench.wait(5).stamped(HIGH, late_ms=late) for late in (500, 400, 100)] == [
        "stale",
        "stale",
        "",
    ]
    assert bench.driver() == ""
    assert bench.wait(200).stamped(HIGH) == ""
    assert bench.driver() == ""


@pytest.mark.parametrize("source", [Source("stranger", 1), HIGH])
def test_an_unreadable_message_of_an_unknown_sender_has_no_effect(source: Source) -> None:
    bench = Bench(HIGH, armed=False)
    bench.unreadable(source, "a")
    bench.wait(1000).send(HIGH, GO, "a")
    assert bench.driver() == ""
    assert bench.status(HIGH).waits_for == Wait("neutral", "high", 1.0)


def test_a_refused_command_does_not_take_the_robot_from_a_lower_source() -> None:
    bench = Bench(HIGH, LOW)
    bench.send(LOW)
    assert bench.send(HIGH, Twist(math.nan, 0.0), "a") == "not_finite"
    bench.unreadable(HIGH, "a")
    assert bench.driver() == "low"


def test_a_twist_that_is_zero_because_opposites_cancel_is_not_neutral() -> None:
    bench = Bench(HIGH, armed=False)
    cancelled = Command("high", REST, bench.now_ns, cancelled=True)
    assert bench.accept(cancelled) == ""
    assert bench.driver() == ""
    bench.send(HIGH, GO)
    assert bench.driver() == ""


def test_a_twist_that_cancels_out_is_followed_if_its_sender_is_armed() -> None:
    bench = Bench(HIGH)
    assert bench.accept(Command("high", REST, bench.now_ns, cancelled=True)) == ""
    assert bench.choice().twist == REST


# the rule as a model

SHARED = {"session": Twist(0.3, 0.0), "key": Twist(0.4, 0.0)}
TWISTS = {"a": Twist(0.1, 0.0), "b": Twist(0.2, 0.0)} | SHARED
"""One twist per sender; the followed twist shows which sender drives."""

KINDS = ("go", "zero", "cancelled", "nan", "unreadable", "stamped", "neutral")


@given(
    st.lists(
        st.tuples(
            st.sampled_from([0, 20, 100, 249, 251, 300, 600, 999, 1000, 4000]),
            st.sampled_from([*TWISTS]),
            st.sampled_from(KINDS),
            st.sampled_from([0, 60, 200, 249, 260, 400]),
        ),
        max_size=30,
    )
)
def test_no_twist_of_a_sender_that_no_zero_has_armed_is_followed(
    story: list[tuple[int, str, str, int]],
) -> None:
    bench = Bench(HIGH, armed=False)
    for name in TWISTS:
        bench.prove_clock(HIGH, name, name)
    bench.arbiter.require_neutral(bench.now_ns + 1)
    bench.wait(1)
    armed: set[str] = set()
    waiting: dict[str, int] = {}
    for wait_ms, name, kind, late_ms in story:
        now_ns, refused, shared = bench.wait(wait_ms).now_ns, "", name in SHARED
        armed.update(other for other, at_ns in waiting.items() if now_ns - at_ns >= 1000 * MS)
        if kind == "neutral":
            bench.arbiter.require_neutral(now_ns)
            armed, waiting = set(), {}
            assert bench.driver() == ""
            continue
        if kind == "unreadable":
            bench.unreadable(HIGH, name)
            refused = kind
        elif kind == "stamped":
            refused = bench.stamped(HIGH, late_ms, name, TWISTS[name], name, shared)
        else:
            twists = {"go": TWISTS[name], "nan": Twist(math.nan, 0.0)}
            refused = bench.accept(
                Command(
                    "high",
                    twists.get(kind, REST),
                    now_ns,
                    sender=name,
                    cancelled=kind == "cancelled",
                    shared=shared,
                )
            )
        zero = kind == "zero" and not refused
        if zero and not shared:
            armed.add(name)
        elif zero:
            waiting.setdefault(name, now_ns)
        elif kind == "unreadable":
            waiting.pop(name, None)
        elif shared:
            waiting = {}
        followed = bench.choice().twist
        if followed == REST:
            assert armed
        for other, twist in TWISTS.items():
            if followed == twist:
                assert other in armed
