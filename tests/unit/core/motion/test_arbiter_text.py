"""Tests of the sentences and events about modes, commanders and refused commands."""

from __future__ import annotations

from typing import get_args, get_type_hints

import pytest

from acsard.core.codes import Code, Reason
from acsard.core.motion.arbiter import Choice
from acsard.core.motion.arbiter_text import (
    MAX_SENDER_LENGTH,
    CommandEvents,
    chosen,
    missed,
    refused,
    waiting,
)
from acsard.core.motion.modes import Mode
from acsard.core.values import REST, Event, Refusal, Twist, Wait
from tests.each import each

SENTENCES = [
    (Wait("nothing"), ""),
    (Wait("command"), "a command"),
    (
        Wait("neutral", "slow", 1.0),
        "send a zero first: slow must send a zero before it can drive",
    ),
    (
        Wait("neutral", "high", 0.5, shared=True),
        "send a zero first: high must send a zero, and then no speed for 0.5 s, before it can "
        "drive",
    ),
    (
        Wait("neutral", "nav", 1.0, lasts=3.0, ros=True),
        "send a zero first: nav must send a zero before it can drive; it has sent speeds for over "
        '3 s (`ros2 topic pub` with a speed never sends a zero; the section "After a clear" of '
        "deploy/ros2/README.md lists tools that send one)",
    ),
    (
        Wait("zeros", "app", lasts=3.0),
        "app commands zero speed: it has sent only zeros for over 3 s",
    ),
    (
        Wait("zeros", "ros2_control", lasts=600.0, kept="nav"),
        "ros2_control commands zero speed: it has sent only zeros for over 10 min; the speeds "
        "of nav have no effect",
    ),
    (
        Wait("zeros", "app", lasts=3600.0),
        "app commands zero speed: it has sent only zeros for over 1 h",
    ),
    (
        Wait("proof", "high", 0.25),
        "high is new: the robot follows it when its commands have arrived with steady delays for "
        "0.25 s",
    ),
    (
        Wait("late", "high", 0.25),
        "commands of high arrive more than 0.25 s too late: the network delays them, or the "
        "sender's clock was set; if this goes on, check the network, then restart the sender",
    ),
    (
        Wait("stalled", "high"),
        "the daemon stalled: waiting for the next command of high",
    ),
    (Wait("higher", "high"), "high has priority: wait until it is silent"),
    (Wait("equal", "right"), "right has the same priority and came first: wait until it is silent"),
    (
        Wait("senders", senders=15),
        "15 other senders of this source must wait until the sender that drives falls silent",
    ),
    (
        Wait("senders", senders=1),
        "1 other sender of this source must wait until the sender that drives falls silent",
    ),
]


@each(("wait", "text"), SENTENCES)
def test_the_text_of_a_wait_says_what_the_source_waits_for(wait: Wait, text: str) -> None:
    assert (waiting(wait).code, waiting(wait).text) == (wait.what, text)


def test_the_table_of_sentences_has_every_kind_of_wait() -> None:
    kinds = get_args(get_type_hints(Wait)["what"])
    assert {wait.what for wait, _ in SENTENCES} == set(kinds)


@pytest.mark.parametrize(
    ("choice", "text"),
    [
        (Choice(), "waiting for a command: no source has sent one within its timeout"),
        (
            Choice(wait=Wait("proof", "app", 2.0)),
            "app is new: the robot follows it when its commands have arrived with steady delays "
            "for 2 s",
        ),
        (Choice("app", REST, Wait("nothing"), 1), "commanded by app"),
        (
            Choice("app", None, Wait("neutral", "app", 0.25)),
            "send a zero first: app must send a zero before it can drive",
        ),
    ],
)
def test_the_text_of_a_choice_names_the_followed_source_or_what_is_missing(
    choice: Choice, text: str
) -> None:
    assert chosen(choice).text == text


def why(code: Code) -> Reason:
    return Reason(code, "")


NOBODY = Choice()


def by(source: str, sender: str) -> Choice:
    return Choice(source, REST, Wait("nothing"), 1, sender)


def test_the_first_mode_is_not_reported() -> None:
    assert CommandEvents(Mode.WAITING).changes(Mode.WAITING, NOBODY, why("booting")) == []


def test_a_change_of_mode_is_reported_once_with_its_reason() -> None:
    reporter = CommandEvents(Mode.WAITING)
    assert reporter.changes(Mode.READY, NOBODY, why("no_command")) == [
        Event("mode", "", kind="waiting -> ready", code="no_command")
    ]
    assert reporter.changes(Mode.READY, NOBODY, why("late")) == []


def test_a_new_commander_is_reported_with_the_mode_and_as_the_commander() -> None:
    mode, commander = CommandEvents(Mode.READY).changes(
        Mode.DRIVING, by("app", "joe"), why("commanded")
    )
    kind = "ready -> driving"
    assert mode == Event("mode", "commanded by app", by="app (joe)", kind=kind, code="commanded")
    assert commander == Event("commander", "", by="app (joe)", kind="no sender -> app (joe)")


def test_a_change_of_commander_is_reported_with_the_previous_commander() -> None:
    reporter = CommandEvents(Mode.READY)
    reporter.changes(Mode.DRIVING, by("app", "joe"), why("commanded"))
    (source,) = reporter.changes(Mode.DRIVING, by("nav", "joe"), why("commanded"))
    (sender,) = reporter.changes(Mode.DRIVING, by("nav", "ann"), why("commanded"))
    assert (source.kind, source.by) == ("app (joe) -> nav (joe)", "nav (joe)")
    assert sender.kind == "nav (joe) -> nav (ann)"


def test_a_commander_that_drives_on_after_a_rest_is_not_reported_again() -> None:
    reporter = CommandEvents(Mode.READY)
    reporter.changes(Mode.DRIVING, by("app", "joe"), why("commanded"))
    reporter.changes(Mode.READY, NOBODY, why("no_command"))
    (event,) = reporter.changes(Mode.DRIVING, by("app", "joe"), why("commanded"))
    assert event.name == "mode"


def test_a_sender_to_a_stopped_robot_is_not_reported_as_commander() -> None:
    reporter = CommandEvents(Mode.STOPPED)
    choice = Choice("app", Twist(1.0, 0.0), Wait("nothing"), 1, "joe")
    assert reporter.changes(Mode.STOPPED, choice, why("stopped")) == []


def test_a_source_whose_speeds_have_no_effect_for_three_seconds_is_reported_once() -> None:
    reporter = CommandEvents(Mode.READY)
    early = Choice("nav", None, Wait("neutral", "nav", 1.0, ros=True), sender="joe")
    assert reporter.changes(Mode.READY, early, why("neutral")) == []
    late = Choice("nav", None, Wait("neutral", "nav", 1.0, lasts=3.0, ros=True), sender="joe")
    (event,) = reporter.changes(Mode.READY, late, why("commanded"))
    assert (event.name, event.level, event.by) == (
        "commands_without_effect",
        "warning",
        "nav (joe)",
    )
    assert "ros2 topic pub" in event.text
    later = Choice("nav", None, Wait("neutral", "nav", 1.0, lasts=10.0, ros=True), sender="joe")
    assert reporter.changes(Mode.READY, later, why("neutral")) == []
    reporter.changes(Mode.READY, NOBODY, why("commanded"))
    assert len(reporter.changes(Mode.READY, late, why("neutral"))) == 1


def test_a_source_held_up_by_zeros_is_reported_once_however_often_it_pauses() -> None:
    reporter = CommandEvents(Mode.READY)
    reporter.changes(Mode.DRIVING, by("app", "joe"), why("commanded"))

    def zeros(source: str) -> list[Event]:
        choice = Choice("app", REST, Wait("zeros", "app", lasts=3.0, kept=source), 1, "joe")
        return reporter.changes(Mode.DRIVING, choice, why("commanded"))

    assert zeros("") == []
    (event,) = zeros("nav")
    assert (event.name, event.by, event.kind) == ("commands_without_effect", "app (joe)", "nav")
    assert event.text.endswith("only zeros for over 3 s; the speeds of nav have no effect")
    assert zeros("") + zeros("nav") == []
    assert [event.kind for event in zeros("teleop")] == ["teleop"]


def test_a_sender_to_a_stopped_robot_is_not_reported_as_waiting() -> None:
    choice = Choice("nav", None, Wait("neutral", "nav", 1.0, lasts=3.0), sender="joe")
    assert CommandEvents(Mode.STOPPED).changes(Mode.STOPPED, choice, why("stopped")) == []


def test_the_event_of_a_refusal_has_its_reason_its_text_and_its_sender() -> None:
    event = refused(Refusal("stale", "source app: late", "app", "joe" * 100))
    assert event == Event(
        "command_refused",
        "source app: late",
        "warning",
        ("joe" * 100)[:MAX_SENDER_LENGTH],
        "stale",
        news=False,
        code="stale",
    )


def test_the_event_of_missed_periods_counts_each_period() -> None:
    assert missed(3, 10_000_000) == Event(
        "missed_periods",
        "late by 0.03 s: no control step ran in 3 successive control periods",
        "warning",
        kind="missed",
        count=3,
        news=False,
    )
