"""Who drives: priorities, timeouts, the order of senders, and what the others wait for."""

from __future__ import annotations

import random
from collections.abc import Callable
from pathlib import Path
from typing import get_args

from acsard.core.codes import Reason
from acsard.core.config.settings import CommandsConfig, Source
from acsard.core.link.step_times import StepTimes
from acsard.core.motion.ages import MAX_CLOCKS
from acsard.core.motion.arbiter import Arbiter, Choice
from acsard.core.motion.arbiter_text import (
    MAX_SENDER_LENGTH,
    CommandEvents,
    chosen,
    missed,
    refused,
    waiting,
)
from acsard.core.motion.modes import Mode
from acsard.core.tables.message_codes import ObjectionCode
from acsard.core.tables.sender_codes import WaitCode
from acsard.core.values import NS_PER_S, REST, Command, Echo, Event, Refusal, Wait
from tests.each import each
from tests.unit.commanders import GO, MS, SOURCES, Commanders, begin

ARMED = {
    "nobody without a command": "> -",
    "the newest command counts": "high go > high; high back > high back",
    "a command counts for the timeout": "high go; 250 > high; 0.000001 > - ? high command",
    "each source has its timeout": "slow go; 1000 > slow; 0.000001 > -",
    "each command restarts it": "high go; 240 high go; 240 high go; 240 > high",
    "a refused one does not": "high go; 200 high nan ! not_finite > high; 60 > -",
    "no infinity": "high inf ! not_finite > -",
    "the limits clamp": "high huge > high huge",
    "a stranger": "stranger go ! unknown_source > -",
    "a higher priority at once": "low go > low; high back > high back ? low higher",
    "the lower one's own command": "high go; 200 low back > high; 51 > low back",
    "a lower one that expired": "slow go; low go; 1000 > slow; 1 > -",
    "a refused one takes nothing": "low go; high.a nan ! not_finite; high.a unreadable > low",
    "the first of equals": "right go > right; 10 left go > right ? left equal",
    "the second of equals keeps it": "left go > left; 200 right go; 51 > right; left go > right",
    "the first one after a higher one": "right go > right; 10 left go; right go; high go > high; "
    "100 left go; right go; 100 left go; right go; 100 left go; right go > right",
    "opposites that cancel": "high cancelled > high zero",
    "forget all at a reset": "low go; reset > - ? low command",
    "a reset forgets who was first": "right go > right; reset; 10 left zero > left zero; "
    "10 right zero > left zero",
}
SENDERS = {
    "a zero first": "high go > - ? high neutral; 50 high zero > high zero; high go > high",
    "a negative zero too": "high negative-zero; high go > high",
    "a tiny speed is none": "high tiny; high go > -",
    "nor are opposites": "high cancelled > -; high go > -",
    "nor is what is refused": "high nan ! not_finite; high go > -",
    "of its own source": "low zero; high go > -",
    "of its own": "high.a go; 50 high.b zero; high.a go > high.b zero; 251 high.a go > -",
    "an unarmed one of its source does not hinder": "high.a go > -; 50 high.b zero; "
    "50 high.a go; high.b back > high.b back",
    "an unarmed higher source does": "low zero; low go > low; high go > - ? low higher",
    "the first of two": "high.a zero; 20 high.b zero; 20 high.a go > high.a; "
    "20 high.b back > high.a ? high senders; 20 high.a go > high.a",
    "the second when the first is silent": "high.a zero; 20 high.b zero; 20 high.a go; "
    "200 high.b back; 50 > high.a; 1 > high.b back ? high nothing; high.a go > high.b back",
    "the first if it is armed last waits": "high.a go; 50 high.b zero > high.b zero; "
    "50 high.b go; high.a zero; high.a back > high.b; 260 high.a back > high.a back",
    "the first of equal sources": "right.r zero; 10 left.l zero; right.r go; left.l back > right.r",
    "each sender again after a reset": "high.a zero; high.b zero; reset; 50 high.a go > -; "
    "high.b go > -",
    "before the first choice": "reset; high zero ? high nothing",
}


@each("stories", [ARMED, SENDERS])
@each("reverse", [False, True])
def test_stories(stories: dict[str, str], reverse: bool) -> None:
    for name, story in stories.items():
        try:
            Commanders(stories is ARMED, reverse).play(story)
        except AssertionError as error:
            error.add_note(name)
            raise


def test_a_stall_of_the_daemon_changes_no_sender_and_brings_none_back() -> None:
    for other in ("left", "right"):
        one = Commanders().play("wake; left.a zero; 50 wake; left.a zero")
        one.play(f"{other}.b zero; 50 wake; left.a zero; {other}.b go > left.a zero")
        one.play(
            f"400 wake; {other}.b go ! stalled > - ? left stalled; 5 left.a zero > left.a zero"
        )
    one = Commanders().play("wake; high zero; 100 wake; 200 wake > - ? high stalled")
    one.play("100 wake; 100 wake; 100 wake; 200 wake > - ? high command")


# sixteen senders of a source are remembered


def sixteen(first: int = 16) -> Commanders:
    return Commanders().play(";".join(f"10 high.{number} zero" for number in range(first)))


def test_a_seventeenth_sender_replaces_the_one_that_was_silent_longest() -> None:
    one = sixteen().play("300 high.0 go; 300 high.more zero")
    # The last of these is a new sender, which takes a place again.
    one.play("300 high.more go > high.more; 300 high.0 go > high.0; 300 high.2 go > high.2")
    one.play("300 high.1 go > -")


def test_a_seventeenth_sender_is_refused_while_sixteen_are_live() -> None:
    one = Commanders().play("high.a zero; 20 high.a go")
    one.play(";".join(f"1 high.{number} zero" for number in range(15)))
    one.play("1 high.more zero ! too_many_senders > high.a; 14 high.a go > high.a")
    one.play("10 high.more zero ! too_many_senders > high.a ? high senders")


def test_what_is_refused_displaces_nobody_and_each_source_has_its_own_places() -> None:
    one = sixteen().play("300 high.more nan ! not_finite; low.a zero")
    one.play(";".join(f"300 high.{number} go > high.{number}" for number in range(16)))
    one.play("300 low.a go > low.a")


# commands that last and do not move the robot


def after(one: Commanders, story: str, seconds: float) -> Wait:
    """Play this story ten times a second. Return why the robot waits then."""
    for _ in range(round(10 * seconds)):
        one.wait(100).play(story)
    return one.choice().wait


def test_zeros_hold_the_robot_and_are_reported_after_three_seconds() -> None:
    one = Commanders(armed=True)
    assert after(one, "high zero", 3.0) == Wait("nothing")
    assert after(one, "high zero", 0.2) == Wait("zeros", "high")
    assert after(one, "high zero; low go > high zero", 0.2).kept == "low"
    assert after(one, "high zero; high.b go > high zero", 0.2).kept == "another sender of high"


# what a refused sender waits for


@each(("advance", "kept"), [(0.0, "they stand still"), (0.5, "by 0.5 s in a second")])
def test_stamps_that_are_no_times(advance: float, kept: str) -> None:
    one = Commanders(armed=True).prove_clock("high.a")
    for number in range(100):
        one.wait(50).act("high.a", f"zero@{50 * number * (1 - advance)}")
    assert one.status("high").waits_for == Wait("stamps", "high", 0.25, kept=kept)


def test_a_clock_that_was_set_back() -> None:
    one = Commanders(armed=True).prove_clock("high.a")
    for _ in range(60):
        one.wait(50).act("high.a", "zero@5000")
    assert one.status("high").waits_for == Wait("set_back", "high", 5.0)


def test_more_clocks_that_came_too_late_than_are_remembered() -> None:
    one = Commanders(armed=True)
    for late_ms in (0, 1000):
        now_ns = one.wait(50).now_ns
        for number in range(MAX_CLOCKS + late_ms // 1000):
            one.accept(Command("high", GO, now_ns, now_ns - late_ms * MS, f"clock {number}", "a"))
    assert one.status("high").waits_for == Wait("too_many_clocks", "high", 0.25, kept="64")


def test_a_long_round_trip() -> None:
    one = Commanders(armed=True)
    for number in range(60):
        echo = Echo(1, one.wait(50).now_ns - 430 * MS)
        one.accept(Command("high", GO, one.now_ns, sequence=number, echo=echo, age_ns=430 * MS))
    assert one.status("high").waits_for == Wait("round_trip", "high", 0.3, kept="0.5")
    assert one.choice() == Choice(wait=Wait("round_trip", "high", 0.3, kept="0.5"))


@each("seed", range(3))
def test_a_choice_holds_until_the_time_that_the_arbiter_names(seed: int) -> None:
    dice, followed = random.Random(seed), Choice()
    long = Source("long", 5, timeout=3.0)
    commands = CommandsConfig(sources=(SOURCES[0], SOURCES[4], long))
    each_time, at_deadlines = Arbiter(), Arbiter()
    steps = {id(arbiter): StepTimes() for arbiter in (each_time, at_deadlines)}
    now_ns = next_ns = 10 * NS_PER_S
    kept = 0
    for _ in range(4000):
        now_ns += dice.choice((1, MS, 7 * MS, 10 * MS))
        for arbiter in (each_time, at_deadlines):
            begin(arbiter, steps[id(arbiter)], now_ns, commands)
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


# what the log and `state` say


def test_words(approved: Callable[[Path, str], None]) -> None:
    waits = [
        Wait(what, "nav", 1.0, lasts=True, senders=15, kept="0.5")
        for what in (*get_args(WaitCode), *get_args(ObjectionCode))
    ]
    assert [waiting(wait).code for wait in waits] == [wait.what for wait in waits]
    waits += [
        Wait("neutral", "high", 0.5, shared=True),
        Wait("neutral", "nav", 1.0, pause=True),
        Wait("neutral", "nav", 1.0, lasts=True, ros=True),
        Wait("zeros", "ros2_control"),
        Wait("senders", senders=1),
    ]
    reasons = [waiting(wait) for wait in waits]
    reasons += [chosen(Choice()), chosen(Choice("app", REST, Wait("nothing")))]
    text = "".join(f"{why.code}: {why.text}\n" for why in reasons)
    text += "".join(f"missed: {missed(periods, 10 * MS).text}\n" for periods in (1, 3))
    approved(Path(__file__).with_name("words") / "who_drives.txt", text)


def by(source: str, sender: str, wait: Wait = Wait("nothing")) -> Choice:  # noqa: B008
    return Choice(source, REST, wait, sender)


def said(events: CommandEvents, mode: Mode, choice: Choice) -> list[tuple[str, str]]:
    return [(e.name, e.kind) for e in events.changes(mode, choice, Reason("commanded", ""))]


def test_a_new_mode_and_a_new_commander_are_each_an_event() -> None:
    told, nobody = CommandEvents(Mode.WAITING), Choice()
    assert said(told, Mode.WAITING, nobody) == []
    why = Reason("no_command", "")
    (event,) = told.changes(Mode.READY, nobody, why)
    assert event == Event("mode", "", kind="waiting -> ready", code="no_command")
    mode, commander = told.changes(Mode.DRIVING, by("app", "joe"), why)
    assert (mode.text, mode.by, mode.code) == ("commanded by app", "joe", "commanded")
    assert commander == Event("commander", "", kind="no sender -> app (joe)")
    assert said(told, Mode.DRIVING, by("app", "ann")) == [("commander", "app (joe) -> app (ann)")]
    assert said(told, Mode.DRIVING, by("nav", "a" * 1000)) == [
        ("commander", f"app (ann) -> nav ({'a' * MAX_SENDER_LENGTH})")
    ]
    assert said(told, Mode.READY, nobody) == [("mode", "driving -> ready")]
    # The same commander is not new after a rest, and a stopped robot has none.
    assert said(told, Mode.DRIVING, by("nav", "a" * 1000)) == [("mode", "ready -> driving")]
    assert said(CommandEvents(Mode.STOPPED), Mode.STOPPED, by("app", "joe")) == []


def test_speeds_without_effect_for_three_seconds_are_one_warning() -> None:
    told = CommandEvents(Mode.READY)
    late = by("nav", "joe", Wait("neutral", "nav", 1.0, lasts=True))
    assert said(told, Mode.READY, by("nav", "joe", Wait("neutral", "nav", 1.0))) == []
    (event,) = told.changes(Mode.READY, late, Reason("neutral", ""))
    assert (event.level, event.by, event.code) == ("warning", "nav (joe)", "neutral")
    assert said(told, Mode.READY, late) == []
    assert said(told, Mode.READY, Choice()) == []
    assert said(told, Mode.READY, late) == [("commands_without_effect", "nav")]
    assert said(CommandEvents(Mode.STOPPED), Mode.STOPPED, late) == []


def test_a_refusal_is_an_event_with_its_reason_and_its_sender() -> None:
    sender, cut = "joe" * 100, ("joe" * 100)[:MAX_SENDER_LENGTH]
    event = refused(Refusal("stale", "late", "app", sender))
    named = Event("command_refused", "late", "warning", cut, "stale", news=False, code="stale")
    assert event == named
    event = refused(Refusal("unproven", "new", "app", "joe"))
    assert event == Event("new_sender", "new", "debug", "joe", news=False, code="unproven")
    assert missed(3, 10 * MS).count == 3


def test_a_repeated_command_from_before_a_late_step_keeps_no_choice_that_the_stall_made() -> None:
    """The command came during the stall, and is read one step later than the others."""
    one = Commanders().play("wake; 50 high zero; 20 high go; 20 wake > high")
    during_ns = one.now_ns + 100 * MS
    one.play("300 wake > -; 10 wake")
    for arrived_ns in (during_ns, one.now_ns):
        echo = Echo(1, arrived_ns)
        assert one.accept(Command("high", GO, arrived_ns, echo=echo, age_ns=0)) == ""
        assert one.arbiter.until_ns == 0  # the robot must choose again
