"""Tests of the arbiter: priorities, timeouts, the order of senders, and waiting sources."""

from __future__ import annotations

import math
import random

import pytest

from acsard.core.config.settings import CommandsConfig, Source
from acsard.core.motion.arbiter import Arbiter, Choice
from acsard.core.values import NS_PER_S, REST, Command, Echo, SourceStatus, Twist, Wait
from tests.each import each
from tests.unit.core.motion.commanders import BACK, GO, HIGH, LEFT, LOW, MS, RIGHT, SLOW, Bench

# one source


def test_no_source_is_followed_without_a_command() -> None:
    choice = Bench(HIGH, LOW).choice()
    assert (choice.source, choice.twist, choice.arrived_ns) == ("", None, None)
    assert choice.wait == Wait("command")


def test_a_command_is_followed_and_the_choice_names_its_source() -> None:
    bench = Bench(HIGH)
    assert bench.send(HIGH) == ""
    assert bench.choice() == Choice("high", GO, Wait("nothing"), bench.now_ns)


def test_the_newest_command_counts() -> None:
    bench = Bench(HIGH)
    bench.send(HIGH, GO)
    bench.send(HIGH, BACK)
    assert bench.choice().twist == BACK


@pytest.mark.parametrize("source", [HIGH, SLOW, Source("quick", 1, timeout=0.02)])
def test_a_command_counts_until_the_timeout_of_its_source(source: Source) -> None:
    bench = Bench(source)
    bench.send(source)
    bench.wait(source.timeout * 1000)
    assert bench.driver() == source.name
    bench.wait(0.000001)
    assert bench.driver() == ""


def test_each_command_restarts_the_timeout() -> None:
    bench = Bench(HIGH)
    for _ in range(10):
        bench.send(HIGH)
        assert bench.wait(240).driver() == "high"


# refusals


@pytest.mark.parametrize(
    "twist",
    [
        Twist(math.nan, 0.0),
        Twist(0.0, math.nan),
        Twist(math.inf, 0.0),
        Twist(0.0, -math.inf),
    ],
)
def test_a_twist_that_is_not_finite_is_refused(twist: Twist) -> None:
    bench = Bench(HIGH)
    assert bench.send(HIGH, twist) == "not_finite"
    assert bench.driver() == ""


def test_an_unknown_source_is_refused_and_never_listed() -> None:
    bench = Bench(HIGH)
    assert bench.send("stranger") == "unknown_source"
    assert bench.driver() == ""
    assert [s.name for s in bench.statuses()] == ["high"]


def test_a_huge_command_is_accepted_for_the_limits_to_clamp() -> None:
    bench = Bench(HIGH)
    assert bench.send(HIGH, Twist(1e308, -1e308)) == ""


def test_a_refused_command_changes_no_twist_and_refreshes_no_timeout() -> None:
    bench = Bench(HIGH)
    bench.send(HIGH)
    bench.wait(200)
    assert bench.send(HIGH, Twist(math.nan, 0.0)) == "not_finite"
    assert bench.choice().twist == GO
    assert bench.wait(60).driver() == ""


# several sources


def test_a_source_of_higher_priority_takes_over_immediately() -> None:
    bench = Bench(HIGH, LOW)
    bench.send(LOW)
    assert bench.driver() == "low"
    bench.send(HIGH, BACK)
    assert bench.choice().twist == BACK


def test_when_the_higher_priority_falls_silent_the_lower_takes_over_with_its_own_command() -> None:
    bench = Bench(HIGH, LOW)
    bench.send(HIGH, GO)
    bench.wait(200).send(LOW, BACK)
    assert bench.driver() == "high"
    assert bench.wait(51).choice().twist == BACK


def test_an_expired_lower_command_does_not_count_when_the_higher_source_falls_silent() -> None:
    bench = Bench(SLOW, LOW)
    bench.send(SLOW)
    bench.send(LOW)
    bench.wait(1000)
    assert bench.driver() == "slow"
    assert bench.wait(1).driver() == ""


def test_the_order_of_configuration_does_not_matter() -> None:
    for sources in ((HIGH, LEFT, LOW), (LOW, LEFT, HIGH), (LEFT, HIGH, LOW)):
        bench = Bench(*sources)
        for source in sources:
            bench.send(source)
        assert bench.driver() == "high"


@pytest.mark.parametrize("sources", [(LEFT, RIGHT), (RIGHT, LEFT)])
def test_the_second_equal_source_takes_over_from_a_silent_first_and_keeps_the_robot(
    sources: tuple[Source, ...],
) -> None:
    bench = Bench(*sources)
    bench.send(LEFT)
    assert bench.driver() == "left"
    bench.wait(200).send(RIGHT)
    assert bench.wait(51).driver() == "right"
    bench.send(LEFT)
    assert bench.driver() == "right"


@pytest.mark.parametrize("sources", [(LEFT, RIGHT, HIGH), (RIGHT, LEFT, HIGH)])
def test_the_first_equal_source_drives_again_after_a_source_of_higher_priority(
    sources: tuple[Source, ...],
) -> None:
    bench = Bench(*sources)
    bench.send(RIGHT)
    assert bench.driver() == "right"
    bench.wait(10).send(LEFT)
    bench.send(RIGHT)
    bench.send(HIGH)
    assert bench.driver() == "high"
    for _ in range(3):
        bench.wait(100).send(LEFT)
        bench.send(RIGHT)
    assert bench.driver() == "right"


# the senders of one source


def test_a_zero_of_one_sender_does_not_arm_another_sender_of_its_source() -> None:
    bench = Bench(HIGH, armed=False)
    for step in range(40):
        bench.send(HIGH, GO, "a")
        if step == 10:
            bench.send(HIGH, REST, "b")
        assert bench.choice().twist in (None, REST)
        bench.wait(50)


def test_an_armed_sender_drives_although_another_sender_of_its_source_is_not_armed() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, GO, "a")
    assert bench.driver() == ""
    bench.wait(50).send(HIGH, REST, "b")
    for _ in range(10):
        bench.wait(50).send(HIGH, GO, "a")
        bench.send(HIGH, BACK, "b")
        assert bench.choice().twist == BACK


def test_only_the_first_of_two_senders_of_a_source_is_followed_and_the_other_is_reported() -> None:
    bench = Bench(HIGH, armed=False)
    for sender in ("a", "b"):
        bench.send(HIGH, REST, sender)
        bench.wait(20)
    for _ in range(50):
        bench.send(HIGH, GO, "a")
        assert bench.choice().twist == GO
        bench.wait(20).send(HIGH, BACK, "b")
        assert bench.choice().twist == GO
        assert bench.status(HIGH).waits_for == Wait("senders", senders=1)
        bench.wait(20)


def test_the_second_sender_of_a_source_takes_over_from_a_silent_first_and_keeps_the_robot() -> None:
    bench = Bench(HIGH, armed=False)
    for sender in ("a", "b"):
        bench.send(HIGH, REST, sender)
        bench.wait(20)
    bench.send(HIGH, GO, "a")
    bench.wait(200).send(HIGH, BACK, "b")
    assert bench.wait(50).choice().twist == GO
    assert bench.wait(1).choice().twist == BACK
    assert bench.status(HIGH).waits_for == Wait("nothing")
    bench.send(HIGH, GO, "a")
    assert bench.choice().twist == BACK


def test_a_sender_that_came_first_and_is_armed_later_waits_until_the_other_is_silent() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, sender="unarmed")
    bench.wait(50).send(HIGH, REST, sender="armed")
    assert bench.choice().sender == "armed"
    for n in range(20):
        bench.wait(50).send(HIGH, GO, sender="armed")
        bench.send(HIGH, BACK if n % 5 else REST, sender="unarmed")
        assert bench.choice().sender == "armed"
    bench.wait(260).send(HIGH, BACK, sender="unarmed")
    assert bench.choice().sender == "unarmed"


@pytest.mark.parametrize("sources", [(LEFT, RIGHT), (RIGHT, LEFT)])
def test_the_first_sender_among_equal_sources_is_followed(sources: tuple[Source, ...]) -> None:
    bench = Bench(*sources)
    bench.send(RIGHT, REST, "r")
    bench.wait(10).send(LEFT, REST, "l")
    bench.send(RIGHT, GO, "r")
    bench.send(LEFT, BACK, "l")
    assert bench.choice().twist == GO


def test_each_sender_must_send_a_zero_again_after_neutral_is_required() -> None:
    bench = Bench(HIGH, armed=False)
    for sender in ("a", "b"):
        bench.send(HIGH, REST, sender)
    bench.arbiter.require_neutral(bench.now_ns)
    for sender in ("a", "b"):
        bench.wait(50).send(HIGH, GO, sender)
        assert bench.driver() == ""


@pytest.mark.parametrize("before", [REST, GO])
def test_a_command_that_arrived_before_neutral_was_required_arms_no_sender(
    before: Twist,
) -> None:
    bench = Bench(HIGH, armed=False)
    bench.arbiter.require_neutral(bench.now_ns + 100 * MS)
    bench.send(HIGH, before, "a")
    bench.wait(300).send(HIGH, GO, "a")
    assert bench.driver() == ""


def test_a_requirement_of_a_zero_with_an_earlier_time_does_not_replace_a_later_one() -> None:
    """In one step the board restarts, and a `clear` from before the restart also requires a zero.

    The later time counts.
    """
    bench = Bench(HIGH, armed=False)
    bench.arbiter.require_neutral(bench.now_ns + 100 * MS)
    bench.arbiter.require_neutral(bench.now_ns)
    bench.wait(50).send(HIGH, REST, "a")
    bench.wait(100).send(HIGH, GO, "a")
    assert bench.driver() == ""


def test_a_source_s_age_is_that_of_the_last_command_of_any_sender() -> None:
    bench = Bench(HIGH, armed=False)
    for sender in ("a", "b", "a", "b"):
        bench.wait(50).send(HIGH, REST, sender)
    assert bench.wait(20).status(HIGH).age_s == 0.02
    bench.send(HIGH, REST, "a")
    assert bench.wait(10).status(HIGH).age_s == 0.01


# senders whose stamps are in doubt


def test_late_commands_do_not_restore_the_priority_of_a_silent_source() -> None:
    bench = Bench(HIGH, LOW).prove_clock(HIGH, "clock", "a")
    bench.wait(300)
    for _ in range(20):
        bench.wait(50).send(LOW)
        bench.stamped(HIGH, 9000.0, "clock", REST, "a")
        assert bench.driver() == "low"


@each("other", [LEFT, RIGHT])
def test_a_stall_of_the_daemon_does_not_change_the_followed_sender(other: Source) -> None:
    bench = Bench(LEFT, RIGHT, armed=False)
    for at in range(100):
        bench.arbiter.begin(bench.now_ns, bench.commands)
        bench.send(LEFT, REST, "a")
        if at > 5:
            bench.send(other, REST if at == 6 else GO, "b")
        assert bench.choice().sender == "a"
        bench.wait(50)
    bench.wait(400).arbiter.begin(bench.now_ns, bench.commands)
    bench.send(other, GO, "b")
    assert (bench.choice().sender, bench.choice().twist) == ("a", None)
    assert bench.choice().wait == bench.status(LEFT).waits_for == Wait("stalled", "left")
    bench.wait(5).send(LEFT, REST, "a")
    assert (bench.choice().sender, bench.choice().twist) == ("a", REST)


@each(("advance", "kept"), [(0.0, "they stand still"), (0.5, "by 0.5 s in a second")])
def test_the_wait_for_stamps_that_are_no_times_says_how_they_advance(
    advance: float, kept: str
) -> None:
    bench = Bench(HIGH).prove_clock(HIGH, "clock", "a")
    for number in range(100):
        late_ms = 50 * number * (1 - advance)
        bench.wait(50).stamped(HIGH, late_ms, "clock", REST, "a")
    assert bench.status(HIGH).waits_for == Wait("stamps", "high", 0.25, kept=kept)


def test_the_wait_for_a_long_round_trip_has_its_length_and_its_limit() -> None:
    bench = Bench(HIGH)
    for number in range(60):
        bench.wait(50)
        echo = Echo(1, bench.now_ns - 430 * MS)
        bench.accept(Command("high", GO, bench.now_ns, sequence=number, echo=echo, age_ns=430 * MS))
    assert bench.status(HIGH).waits_for == Wait("round_trip", "high", 0.3, kept="0.5")


def test_a_sender_of_zeros_for_hours_is_reported_with_the_longest_duration() -> None:
    bench = Bench(HIGH)
    bench.send(HIGH, REST)
    bench.arbiter.sources["high"].senders[""].zeros_ns = bench.now_ns - 7200 * NS_PER_S
    assert bench.choice().wait.lasts == 3600.0
    assert bench.arbiter.until_ns > bench.now_ns


# how many senders are remembered


def armed_in_turn(bench: Bench, senders: list[str]) -> None:
    for sender in senders:
        bench.wait(10).send(HIGH, REST, sender)


def drives(bench: Bench, sender: str) -> bool:
    """Send as this sender while all others are silent, and return whether it drives.

    The sender is silent again afterwards.
    """
    bench.wait(300).send(HIGH, GO, sender)
    allowed = bench.driver() == "high"
    bench.wait(300)
    return allowed


def test_a_seventeenth_sender_replaces_the_sender_that_was_silent_longest() -> None:
    bench = Bench(HIGH, armed=False)
    senders = [f"sender {number}" for number in range(16)]
    armed_in_turn(bench, senders)
    # now the first sender is the one noticed longest ago
    bench.wait(300).send(HIGH, GO, senders[0])
    assert bench.wait(300).send(HIGH, REST, "one more") == ""
    # That sender is checked last, because a forgotten sender takes a place again when it returns.
    asked = ("one more", senders[0], senders[2], senders[1])
    assert [drives(bench, sender) for sender in asked] == [True, True, True, False]


def test_a_seventeenth_sender_is_refused_while_sixteen_are_live_and_the_first_drives_on() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, REST, "holder")
    bench.wait(20).send(HIGH, GO, "holder")
    answers = [bench.wait(1).send(HIGH, REST, f"stranger {number}") for number in range(16)]
    assert answers == [""] * 15 + ["too_many_senders"]
    assert bench.choice().twist == GO
    assert bench.wait(14).send(HIGH, GO, "holder") == ""
    assert bench.choice().twist == GO


def test_a_refused_command_of_a_new_sender_displaces_no_known_sender() -> None:
    bench = Bench(HIGH, armed=False)
    senders = [f"sender {number}" for number in range(16)]
    armed_in_turn(bench, senders)
    bench.wait(300)
    assert bench.send(HIGH, Twist(math.nan, 0.0), "one more") == "not_finite"
    assert all(drives(bench, sender) for sender in senders)


def test_senders_that_are_not_armed_are_forgotten_first_if_there_are_more_than_sixteen() -> None:
    bench = Bench(HIGH, armed=False)
    senders = [f"sender {number}" for number in range(15)]
    armed_in_turn(bench, senders)
    for number in range(100):
        bench.wait(1).send(HIGH, BACK, f"stranger {number}")
    assert all(drives(bench, sender) for sender in senders)


def test_many_new_senders_of_zeros_do_not_displace_the_driving_sender() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, REST, "a")
    for number in range(200):
        if number % 8 == 0:
            bench.send(HIGH, GO, "a")
        bench.wait(1).send(HIGH, REST, f"stranger {number}")
        assert bench.choice().twist == GO
    assert bench.status(HIGH).waits_for == Wait("senders", senders=15)


def test_many_senders_of_unreadable_messages_do_not_displace_an_armed_sender() -> None:
    bench = Bench(HIGH, armed=False)
    bench.send(HIGH, REST, "a")
    for number in range(100):
        bench.wait(1).unreadable(HIGH, f"stranger {number}")
    bench.wait(951).send(HIGH, GO, "a")
    assert bench.driver() == "high"


def test_many_senders_of_one_source_do_not_displace_a_sender_of_another_source() -> None:
    bench = Bench(HIGH, LOW, armed=False)
    bench.send(LOW, REST, "a")
    for number in range(100):
        bench.send(HIGH, REST, f"stranger {number}")
    bench.wait(300).send(LOW, GO, "a")
    assert bench.driver() == "low"


# commands that last but do not move the robot


def wait_after(bench: Bench, source: Source, seconds: float, twist: Twist = REST) -> Wait:
    """Send this twist ten times a second for this time, and return why the robot waits."""
    for _ in range(round(10 * seconds)):
        bench.wait(100).send(source, twist)
    return bench.choice().wait


def test_a_sender_of_only_zeros_holds_the_robot_and_is_reported_after_three_seconds() -> None:
    bench = Bench(HIGH)
    assert wait_after(bench, HIGH, 3.0) == Wait("nothing")
    assert wait_after(bench, HIGH, 0.2) == Wait("zeros", "high", lasts=3.0)
    assert bench.choice().twist == REST
    assert wait_after(bench, HIGH, 60.0) == Wait("zeros", "high", lasts=60.0)
    assert bench.status(HIGH).waits_for == Wait("nothing")


def test_a_speed_or_a_silence_restarts_the_time_of_only_zeros() -> None:
    bench = Bench(HIGH)
    wait_after(bench, HIGH, 5.0)
    bench.wait(100).send(HIGH, GO)
    assert bench.choice().wait == Wait("nothing")
    assert wait_after(bench, HIGH, 2.9) == Wait("nothing")
    bench.wait(300)
    assert wait_after(bench, HIGH, 2.9) == Wait("nothing")
    assert wait_after(bench, HIGH, 0.3).what == "zeros"


def test_wheel_speeds_that_cancel_out_do_not_count_as_zeros() -> None:
    bench = Bench(HIGH)
    for _ in range(40):
        command = Command("high", REST, bench.wait(100).now_ns, cancelled=True)
        assert bench.accept(command) == ""
    assert bench.choice().wait == Wait("nothing")


def test_the_report_of_only_zeros_names_the_lower_source_that_must_wait() -> None:
    bench = Bench(HIGH, LOW)
    for _ in range(100):
        bench.wait(100).send(HIGH, REST)
        bench.send(LOW, GO)
    assert bench.driver() == "high"
    assert bench.choice().wait == Wait("zeros", "high", lasts=3.0, kept="low")


def test_the_report_of_only_zeros_names_another_sender_of_the_source_that_must_wait() -> None:
    bench = Bench(HIGH)
    for _ in range(50):
        bench.wait(100).send(HIGH, REST, "a")
        bench.send(HIGH, GO, "b")
    assert bench.choice().wait.kept == "another sender of high"


def test_an_unarmed_sender_that_keeps_sending_speeds_is_reported_after_three_seconds() -> None:
    bench = Bench(HIGH, armed=False)
    assert wait_after(bench, HIGH, 3.0, GO) == Wait("neutral", "high", 1.0)
    assert wait_after(bench, HIGH, 0.2, GO) == Wait("neutral", "high", 1.0, lasts=3.0)


# the published state


def test_the_sources_are_listed_by_priority() -> None:
    statuses = Bench(LOW, HIGH, LEFT).statuses()
    assert [(s.name, s.priority) for s in statuses] == [("high", 100), ("left", 50), ("low", 10)]


def test_a_source_that_never_sent_has_no_age_and_waits_for_a_command() -> None:
    bench = Bench(HIGH, armed=False)
    assert bench.status(HIGH) == SourceStatus("high", 100, None, Wait("command"))


def test_the_age_is_that_of_the_last_accepted_command() -> None:
    bench = Bench(HIGH)
    bench.send(HIGH)
    bench.wait(100).send(HIGH, Twist(math.nan, 0.0))
    assert bench.status(HIGH).age_s == 0.1


def test_a_command_that_arrived_now_or_during_the_step_has_an_age_of_zero() -> None:
    bench = Bench(HIGH)
    bench.send(HIGH)
    assert bench.status(HIGH).age_s == 0.0
    assert bench.wait(-1).status(HIGH).age_s == 0.0


def test_an_armed_source_waits_for_nothing_before_the_first_choice() -> None:
    bench = Bench(HIGH)
    bench.arbiter.require_neutral()
    bench.send(HIGH, REST)
    assert bench.status(HIGH).waits_for == Wait("nothing")


def test_a_silent_source_waits_for_a_command() -> None:
    bench = Bench(HIGH)
    bench.send(HIGH)
    bench.wait(251).choice()
    assert bench.status(HIGH).waits_for == Wait("command")


def test_a_source_that_sent_no_zero_is_reported_as_waiting_for_a_zero() -> None:
    bench = Bench(SLOW, armed=False)
    bench.send(SLOW)
    bench.choice()
    assert bench.status(SLOW).waits_for == Wait("neutral", "slow", 1.0)


def test_a_lower_source_is_reported_as_waiting_for_the_higher_source() -> None:
    bench = Bench(HIGH, LOW)
    bench.send(HIGH)
    bench.send(LOW)
    bench.choice()
    assert bench.status(LOW).waits_for == Wait("higher", "high")


def test_an_equal_source_is_reported_as_waiting_for_the_source_that_came_first() -> None:
    bench = Bench(LEFT, RIGHT)
    bench.send(RIGHT)
    bench.choice()
    bench.wait(10).send(LEFT)
    bench.choice()
    assert bench.status(LEFT).waits_for == Wait("equal", "right")


# settings that change


def test_a_new_timeout_applies_to_a_sender_that_drives() -> None:
    bench = Bench(HIGH)
    bench.send(HIGH)
    bench.wait(300)
    assert bench.driver() == ""
    bench.commands = CommandsConfig((Source("high", 100, timeout=0.5),))
    assert bench.driver() == "high"


# the time until which a choice holds


@pytest.mark.parametrize("seed", range(6))
def test_a_choice_holds_until_the_time_that_the_arbiter_names(seed: int) -> None:
    dice, now_ns, followed = random.Random(seed), 10 * NS_PER_S, Choice()
    commands = CommandsConfig(sources=(HIGH, LOW, Source("long", 5, timeout=3.0)))
    each_time, at_deadlines = Arbiter(), Arbiter()
    next_ns, kept = now_ns, 0
    for _ in range(4000):
        now_ns += dice.choice((1, MS, 7 * MS, 10 * MS))
        for arbiter in (each_time, at_deadlines):
            arbiter.begin(now_ns, commands)
        if now_ns >= next_ns:
            next_ns = now_ns + dice.choice((1, 20 * MS, 50 * MS, 260 * MS, 3100 * MS))
            twist, source = dice.choice((REST, REST, GO)), dice.choice(("high", "low", "long"))
            sender, stamp = f"s{dice.randrange(3)}", None
            if dice.random() < 0.5:
                stamp = now_ns - dice.choice((0, 0, 0, 400 * MS))
            shared = source == "long"
            command = Command(source, twist, now_ns, stamp, sender, sender, shared=shared)
            assert each_time.accept(command, commands) == at_deadlines.accept(command, commands)
        if now_ns >= at_deadlines.until_ns:
            followed = at_deadlines.choose(now_ns, commands)
        else:
            kept += 1
        assert each_time.choose(now_ns, commands) == followed
    assert kept > 1000
