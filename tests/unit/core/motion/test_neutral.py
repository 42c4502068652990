"""Tests of the neutral-first rule: only a zero arms a sender."""

from __future__ import annotations

import math

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.config.settings import CommandsConfig, Source
from acsard.core.motion.arbiter import Arbiter
from acsard.core.motion.freshness import Verdict
from acsard.core.motion.neutral import Sender
from acsard.core.values import NS_PER_S, REST, Command, Twist, Wait
from tests.each import each
from tests.unit.core.motion.commanders import GO, HIGH, HOUR_NS, LEFT, LOW, MS, RIGHT, Bench

# one sender


def sender() -> Sender:
    return Sender(250 * MS, neutral_first=True)


def command_at(twist: Twist, at_ms: float, shared: bool = False) -> Command:
    return Command("high", twist, int(at_ms * MS), shared=shared)


def test_a_zero_of_an_unshared_sender_arms_immediately_even_right_after_a_speed() -> None:
    peer = sender()
    peer.take(command_at(GO, 0), 0)
    assert not peer.armed(0)
    peer.take(command_at(REST, 0), 0)
    assert peer.armed(0)
    peer.take(command_at(GO, 1), 0)
    assert peer.armed(MS)


@pytest.mark.parametrize("after_ms", [1, 250, 999.999])
def test_a_shared_zero_that_a_speed_follows_too_soon_does_not_arm(after_ms: float) -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, REST, "a", shared=True)
    bench.wait(after_ms).send(HIGH, GO, "a", shared=True)
    assert bench.driver() == ""
    bench.wait(5000).send(HIGH, GO, "a", shared=True)
    assert bench.driver() == ""


def test_a_shared_zero_arms_if_no_speed_follows_during_the_pause() -> None:
    peer = sender()
    peer.take(command_at(REST, 0, shared=True), 0)
    assert not peer.armed(1000 * MS - 1)
    assert peer.armed(1000 * MS)
    peer.take(command_at(GO, 1001, shared=True), 0)
    assert peer.armed(1001 * MS)


def test_more_zeros_do_not_restart_the_pause() -> None:
    peer = sender()
    for at_ms in range(0, 1000, 100):
        peer.take(command_at(REST, at_ms, shared=True), 0)
    peer.take(command_at(GO, 1000, shared=True), 0)
    assert peer.armed(1000 * MS)


@pytest.mark.parametrize("shared", [False, True])
def test_a_zero_that_arrived_before_zeros_were_required_does_not_arm(shared: bool) -> None:
    peer = sender()
    peer.take(command_at(REST, 0, shared), since_ns=1)
    assert not peer.armed(HOUR_NS)
    assert (peer.arrived_ns, peer.noticed_ns) == (0, 0)
    peer.take(command_at(REST, 0, shared), since_ns=0)
    assert peer.armed(1000 * MS)


@pytest.mark.parametrize("pause_ms", [1, 2000, 3_600_000])
def test_a_pause_without_a_zero_does_not_arm_however_long(pause_ms: int) -> None:
    for shared in (False, True):
        peer = sender()
        for number in range(10):
            peer.take(command_at(GO, number * pause_ms, shared), 0)
            assert not peer.armed(number * pause_ms * MS)


@pytest.mark.parametrize("other", ["speed", "cancelled", "not finite", "stale"])
@pytest.mark.parametrize("name", ["a", "b"])
def test_a_possible_speed_of_a_shared_identity_ends_the_wait_of_each_shared_zero(
    name: str, other: str
) -> None:
    """One program's samples may have a router's stamps at one time and no stamps at another.

    The daemon therefore cannot know whether the other shared identity is another program.
    """
    bench = Bench(HIGH, armed=False)
    for _ in range(60):
        bench.wait(50).stamped(HIGH, 0.0, "b", GO, "b", shared=True)
    for wait_ms, arms in ((999, False), (1000, True)):
        bench.wait(20).send(HIGH, REST, "a", shared=True)
        bench.wait(wait_ms)
        if other == "stale":
            assert bench.stamped(HIGH, 5000.0, "b", GO, "b", shared=True) == "stale"
        else:
            twist = {"speed": GO, "not finite": Twist(math.nan, 0.0)}.get(other, REST)
            cancelled = other == "cancelled"
            bench.send(HIGH, twist, name, shared=True, cancelled=cancelled)
        bench.wait(1100).send(HIGH, GO, "a", shared=True)
        assert (bench.driver() == "high") == arms


def test_a_speed_of_an_unshared_identity_does_not_end_the_wait_of_a_shared_zero() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, REST, "a", shared=True)
    bench.send(HIGH, GO, "b")
    bench.unreadable(HIGH, "b")
    bench.wait(1000).send(HIGH, GO, "a", shared=True)
    assert bench.driver() == "high"


def test_a_speed_on_another_source_does_not_end_the_wait_of_a_shared_zero() -> None:
    bench = Bench(HIGH, LOW, armed=False)
    bench.send(HIGH, REST, "a", shared=True)
    bench.send(LOW, GO, "a", shared=True)
    bench.wait(1000).send(HIGH, GO, "a", shared=True)
    assert bench.driver() == "high"


@pytest.mark.parametrize(
    ("name", "ends"), [("a", True), ("b", False), ("never seen", False), ("", False)]
)
def test_an_unreadable_or_lost_message_ends_the_wait_of_its_own_identity_only(
    name: str, ends: bool
) -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, REST, "a", shared=True)
    bench.send(HIGH, REST, "b", shared=True)
    for _ in range(20):
        bench.wait(50).unreadable(HIGH, name)
    bench.wait(1).send(HIGH, GO, "a", shared=True)
    assert (bench.driver() == "") is ends


def test_a_lost_message_that_arrived_when_the_pause_was_over_ends_no_wait() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, REST, "a", shared=True)
    bench.wait(1001).unreadable(HIGH, "a")
    bench.send(HIGH, GO, "a", shared=True)
    assert bench.driver() == "high"


@pytest.mark.parametrize("shared", [False, True])
def test_an_unproven_zero_arms_unless_its_clock_proves_wrong(shared: bool) -> None:
    for wrong in (False, True):
        peer = sender()
        peer.take(command_at(REST, 0, shared), 0, "unproven")
        if wrong:
            peer.unlearn()
        if not shared:
            peer.take(command_at(GO, 500, shared), 0, "unproven")
        peer.take(command_at(GO, 1100, shared), 0)
        assert peer.armed(1100 * MS) is not wrong
        peer.unlearn()
        assert peer.armed(1100 * MS) is not wrong, "a proven zero is never forgotten"


def test_a_proven_shared_zero_arms_after_the_pause_even_if_later_zeros_prove_wrong() -> None:
    peer = sender()
    peer.take(command_at(REST, 0, shared=True), 0)
    peer.take(command_at(REST, 900, shared=True), 0, "unproven")
    peer.take(command_at(REST, 1100, shared=True), 0, "unproven")
    peer.unlearn()
    assert peer.armed(1100 * MS)


def test_a_shared_zero_that_armed_is_not_forgotten_when_a_later_speed_proves_wrong() -> None:
    for refused in (False, True):
        peer = sender()
        peer.take(command_at(REST, 0, shared=True), 0)
        if refused:
            peer.refuse(command_at(GO, 1100, shared=True), "stale")
        else:
            peer.take(command_at(GO, 1100, shared=True), 0, "unproven")
        peer.unlearn()
        assert peer.armed(1100 * MS)


@pytest.mark.parametrize("shared", [False, True])
def test_a_speed_before_an_unproven_zero_is_not_followed_once_the_zero_arms(shared: bool) -> None:
    peer = Sender(5000 * MS, neutral_first=True)
    peer.take(command_at(GO, 0, shared), 0)
    peer.take(command_at(REST, 10, shared), 0, "unproven")
    assert peer.armed(1010 * MS if shared else 10 * MS)
    assert peer.twist == REST


@pytest.mark.parametrize("shared", [False, True])
def test_an_unproven_zero_leaves_an_unarmed_sender_live_so_its_source_keeps_priority(
    shared: bool,
) -> None:
    peer = sender()
    peer.take(command_at(GO, 0, shared), 0)
    peer.take(command_at(REST, 10, shared), 0, "unproven")
    assert peer.is_live(20 * MS)
    assert peer.armed(20 * MS) is not shared


@each("proven", [True, False])
@each(("before_ms", "rest_ms"), [(400, 600), (950, 100)])
def test_a_stall_does_not_count_as_pause_and_leaves_time_for_commands_that_waited(
    before_ms: int, rest_ms: int, proven: bool
) -> None:
    peer = sender()
    peer.take(command_at(REST, 0, shared=True), 0, "fresh" if proven else "unproven")
    peer.resume(before_ms * MS, 5000 * MS)
    end_ns = (5000 + rest_ms) * MS
    assert not peer.armed(end_ns - 1)
    assert peer.armed(end_ns)
    peer.unlearn()
    assert peer.armed(end_ns) is proven


def test_a_pause_that_was_over_before_a_stall_stays_over() -> None:
    peer = sender()
    peer.take(command_at(REST, 0, shared=True), 0)
    peer.resume(1000 * MS, 1700 * MS)
    assert peer.armed(1700 * MS)


@each(("silent_ms", "stays"), [(250, True), (251, False)])
def test_a_sender_that_was_not_silent_before_a_stall_keeps_its_place_after_the_stall(
    silent_ms: int, stays: bool
) -> None:
    peer = sender()
    peer.take(command_at(GO, 0), 0)
    peer.resume(silent_ms * MS, 1000 * MS)
    assert peer.present(1250 * MS) is stays
    assert not peer.is_live(1000 * MS)
    assert not peer.present(1251 * MS)


def test_a_sender_whose_clock_was_set_keeps_its_place_but_must_send_a_zero() -> None:
    peer = sender()
    peer.take(command_at(REST, 0), 0)
    peer.disarm(100 * MS)
    peer.take(command_at(GO, 100), 0)
    assert not peer.armed(100 * MS)
    assert peer.came_ns == 0
    for at_ms in range(200, 5000, 100):
        peer.take(command_at(GO, at_ms), 0)
        assert peer.holds(at_ms * MS) is (at_ms <= 4100)
    assert not peer.holds(9000 * MS)


def test_commands_in_doubt_count_as_zeros_or_speeds_too() -> None:
    peer = sender()
    marks = []
    for at_ms, twist, late in ((0, GO, 0), (100, GO, 1), (200, REST, 1), (300, REST, 0),
                               (400, GO, 1), (500, GO, 0)):  # fmt: skip
        if late:
            peer.refuse(command_at(twist, at_ms), "stale")
        else:
            peer.take(command_at(twist, at_ms), 0)
        marks.append((peer.speeds_ns, peer.zeros_ns))
    assert marks == [
        (0, None), (0, None), (None, 200 * MS), (None, 200 * MS), (400 * MS, None),
        (400 * MS, None),
    ]  # fmt: skip


def test_a_shared_zero_that_arrived_in_a_stall_begins_its_pause_at_the_end_of_the_stall() -> None:
    peer = sender()
    peer.take(command_at(REST, 0, shared=True), 0, watched_ns=800 * MS)
    peer.take(command_at(REST, 5, shared=True), 0)
    assert not peer.armed(1700 * MS)
    assert peer.armed(1800 * MS)


def test_a_sender_whose_stamps_are_in_doubt_keeps_its_place_for_four_seconds() -> None:
    peer = sender()
    peer.take(command_at(GO, 0), 0)
    for at_ms in range(200, 5000, 200):
        peer.refuse(command_at(GO, at_ms), "stale")
        assert peer.present(at_ms * MS) is (at_ms <= 4000)
        assert peer.is_live(at_ms * MS) is (at_ms <= 250)


def test_a_sender_that_was_silent_gets_no_place_by_a_command_in_doubt() -> None:
    peer = sender()
    peer.take(command_at(GO, 0), 0)
    peer.refuse(command_at(GO, 200), "stale")
    assert peer.present(450 * MS)
    peer.refuse(command_at(GO, 451), "stale")
    assert not peer.present(451 * MS)


@each("way", ["unproven", "stale"])
@each(("stamp", "twist"), [(25, REST), (15, GO), (None, GO)])
def test_a_zero_whose_stamp_is_in_doubt_ends_an_earlier_speed_but_refreshes_no_timeout(
    way: Verdict, stamp: int | None, twist: Twist
) -> None:
    peer = sender()
    peer.take(command_at(REST, 0), 0)
    peer.take(replace(command_at(GO, 10), stamp_ns=15), 0)
    zero = replace(command_at(REST, 20), stamp_ns=stamp)
    if way == "stale":
        peer.refuse(zero, way)
    else:
        peer.take(zero, 0, way)
    assert peer.twist == twist
    assert peer.arrived_ns == 10 * MS
    assert peer.armed(20 * MS)


@each(
    ("ahead_ms", "clock", "twist"),
    [(1, "a", REST), (250, "a", REST), (251, "a", GO), (0, "a", GO), (1, "b", GO)],
)
def test_a_speed_that_a_zero_in_doubt_overtook_is_not_followed_again(
    ahead_ms: int, clock: str, twist: Twist
) -> None:
    """A stamp that is ahead by more than the timeout of 250 ms is doubtful."""
    peer, stamp_ns = sender(), 5000 * MS
    peer.take(replace(command_at(GO, 10), stamp_ns=stamp_ns - MS, clock="a"), 0)
    peer.refuse(
        replace(command_at(REST, 20), stamp_ns=stamp_ns + ahead_ms * MS, clock="a"), "stale"
    )
    peer.take(replace(command_at(GO, 30), stamp_ns=stamp_ns, clock=clock), 0)
    assert peer.twist == twist
    peer.take(replace(command_at(GO, 40), stamp_ns=stamp_ns + 251 * MS, clock="a"), 0)
    assert peer.twist == GO


@each(("number", "twist"), [(8, REST), (7, GO), (None, GO)])
def test_a_zero_in_doubt_whose_number_is_higher_ends_an_earlier_speed(
    number: int | None, twist: Twist
) -> None:
    peer = sender()
    peer.take(replace(command_at(GO, 10), stamp_ns=15, sequence=7), 0)
    peer.refuse(replace(command_at(REST, 20), stamp_ns=5, sequence=number), "stale")
    assert peer.twist == twist


def test_a_shared_zero_that_armed_unproven_is_forgotten_when_its_clock_proves_wrong() -> None:
    peer = sender()
    peer.take(command_at(REST, 0, shared=True), 0, "unproven")
    assert peer.armed(1100 * MS)
    peer.unlearn()
    assert not peer.armed(HOUR_NS)


def test_a_sender_keeps_the_twist_the_name_and_the_kind_of_its_last_command() -> None:
    peer = sender()
    for ros, shared in ((True, False), (False, True)):
        command = Command("high", GO, 5 * MS, sender="joe", ros=ros, shared=shared)
        peer.take(command, 0)
        assert (peer.twist, peer.name, peer.ros, peer.shared) == (GO, "joe", ros, shared)
        assert (peer.arrived_ns, peer.noticed_ns) == (5 * MS, 5 * MS)


def test_the_first_zero_after_a_speed_is_remembered_while_the_sender_is_not_silent() -> None:
    peer, zeros = sender(), []
    for at_ms, twist in ((0, GO), (100, REST), (200, REST), (300, GO), (400, REST), (900, REST)):
        peer.take(command_at(twist, at_ms), 0)
        zeros.append(peer.zeros_ns)
    assert zeros == [None, 100 * MS, 100 * MS, None, 400 * MS, 900 * MS]


def test_requiring_a_zero_again_forgets_the_zeros_that_wait() -> None:
    peer = sender()
    peer.take(command_at(REST, 0, shared=True), 0)
    peer.require_neutral()
    assert not peer.armed(HOUR_NS)
    peer.take(command_at(REST, 0), 0)
    peer.require_neutral()
    peer.unlearn()
    assert not peer.armed(HOUR_NS)


def test_without_neutral_first_every_sender_is_armed() -> None:
    peer = Sender(250 * MS, neutral_first=False)
    assert peer.armed(0)
    peer.require_neutral()
    assert peer.armed(0)


def test_a_command_counts_until_its_timeout_unless_its_stamp_is_in_doubt() -> None:
    peer = sender()
    peer.take(command_at(GO, 600), 0, "unproven")
    assert not peer.is_live(600 * MS)
    assert peer.doubtful(850 * MS)
    assert not peer.doubtful(850 * MS + 1)
    peer.take(command_at(GO, 610), 0)
    assert peer.is_live(860 * MS)
    assert not peer.is_live(860 * MS + 1)
    assert not peer.doubtful(610 * MS)
    peer.refuse(command_at(GO, 620), "stale")
    assert (peer.doubtful(620 * MS), peer.doubt, peer.noticed_ns) == (True, "stale", 620 * MS)
    assert peer.is_live(860 * MS)


# neutral first


def test_a_new_arbiter_requires_a_zero_first() -> None:
    arbiter = Arbiter(CommandsConfig(sources=(HIGH,)))
    assert arbiter.accept(Command("high", GO, NS_PER_S)) == ""
    assert arbiter.choose(NS_PER_S).twist is None


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
    assert bench.arbiter.accept(zero) == "stale"
    bench.send(HIGH)
    assert bench.driver() == ""


def test_a_source_stays_armed_through_its_own_silence() -> None:
    bench = Bench(HIGH)
    bench.send(HIGH)
    bench.wait(60_000).send(HIGH)
    assert bench.driver() == "high"


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


def test_without_neutral_first_the_first_command_drives() -> None:
    bench = Bench(HIGH, neutral_first=False, armed=False)
    bench.send(HIGH)
    assert bench.driver() == "high"
    bench.arbiter.require_neutral()
    assert bench.driver() == ""
    bench.send(HIGH)
    assert bench.driver() == "high"


def test_a_zero_that_waits_never_counts_once_its_delay_proved_wrong() -> None:
    bench = Bench(HIGH, armed=False).prove_clock(HIGH)
    bench.arbiter.require_neutral(bench.now_ns + 1)
    bench.wait(50).stamped(HIGH)
    bench.wait(300_000)  # long enough that its clock counts as new
    for age in range(3000, -1, -50):
        bench.wait(10).stamped(HIGH, age, twist=REST if age == 3000 else GO)
    for _ in range(20):
        bench.wait(50).stamped(HIGH)
    assert bench.choice().wait.what == "neutral"


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
    assert bench.arbiter.accept(cancelled) == ""
    assert bench.driver() == ""
    bench.send(HIGH, GO)
    assert bench.driver() == ""


def test_a_twist_that_cancels_out_is_followed_if_its_sender_is_armed() -> None:
    bench = Bench(HIGH)
    assert bench.arbiter.accept(Command("high", REST, bench.now_ns, cancelled=True)) == ""
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
            refused = bench.arbiter.accept(
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


@each(
    ("number", "clock", "after_ms", "twist"),
    [
        (7, "b", 1, REST),
        (7, "b", 300, REST),
        (7, "b", 301, GO),
        (9, "b", 1, GO),
        (None, "b", 1, GO),
        (7, "a", 1, GO),
    ],
)  # fmt: skip
@pytest.mark.parametrize("verdict", ["fresh", "unproven"])
def test_a_numbered_speed_of_another_clock_that_a_zero_overtook_does_not_move_the_robot(
    verdict: Verdict, number: int | None, clock: str, after_ms: int, twist: Twist
) -> None:
    """A ROS node stamps its speeds, and sends `TwistStamped()` without a stamp as its zero.

    The zero then has the stamp of clock "a", another clock than that of the speeds.
    """

    def sent_by(clock: str, number: int | None, twist: Twist, at_ms: int) -> Command:
        at_ns = at_ms * MS
        return Command("high", twist, at_ns, at_ns, clock, "node", sequence=number)

    peer = sender()
    peer.take(sent_by("b", 5, REST, 0), 0)
    peer.take(sent_by("b", 6, GO, 50), 0)
    peer.take(sent_by("a", 8, REST, 100), 0, verdict)
    assert peer.twist == REST
    peer.take(sent_by(clock, number, GO, 100 + after_ms), 0)
    assert peer.twist == twist
    peer.take(sent_by("b", 10, GO, 200), 0)
    assert peer.twist == GO


def test_a_speed_that_the_first_zero_of_a_sender_overtook_does_not_move_the_robot() -> None:
    """The zero arms the sender, although the clock that stamps it is not proven yet."""
    peer = sender()
    peer.take(Command("high", GO, 0, 0, "b", "node", sequence=7), 0, "unproven")
    peer.take(Command("high", REST, 100 * MS, 100 * MS, "a", "node", sequence=9), 0, "unproven")
    assert peer.armed(100 * MS)
    peer.take(Command("high", GO, 102 * MS, 50 * MS, "b", "node", sequence=8), 0)
    assert peer.twist == REST
    peer.take(Command("high", GO, 150 * MS, 150 * MS, "b", "node", sequence=10), 0)
    assert peer.twist == GO


def test_the_first_zero_after_a_demand_for_zeros_ends_older_speeds_whatever_came_before() -> None:
    """A program has restarted with a new clock and lower sequence numbers."""
    peer = sender()
    peer.take(Command("high", REST, 0, 0, "b", "node", sequence=500), 0)
    peer.require_neutral()
    peer.take(Command("high", REST, 100 * MS, 100 * MS, "a", "node", sequence=11), 0, "unproven")
    peer.take(Command("high", GO, 102 * MS, 50 * MS, "c", "node", sequence=10), 0)
    assert peer.twist == REST


def test_a_doubtful_zero_does_not_stop_a_sender_whose_commands_have_neither_stamp_nor_number() -> (
    None
):
    peer = sender()
    peer.take(Command("high", REST, 0, None, "", "node"), 0)
    peer.take(Command("high", GO, 50 * MS, None, "", "node"), 0)
    peer.refuse(Command("high", REST, 60 * MS, 10 * MS, "a", "node", sequence=3), "stale")
    assert peer.twist == GO
