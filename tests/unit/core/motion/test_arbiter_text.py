"""Tests of the sentences and events about modes, commanders and refused commands."""

from __future__ import annotations

from typing import get_args

from acsard.core.codes import Code, ObjectionCode, Reason, WaitCode
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
    (
        Wait("neutral", "high", 0.5, shared=True),
        "send a zero first: high must send a zero, and then no speed for 0.5 s, before it can "
        "drive",
    ),
    (
        Wait("neutral", "nav", 1.0, pause=True),
        "send a zero first: nav must send a zero, or nothing for 1 s, before it can drive",
    ),
    (
        Wait("neutral", "nav", 1.0, lasts=3.0, ros=True),
        "send a zero first: nav must send a zero before it can drive; it has sent speeds for over "
        '3 s (`ros2 topic pub` with a speed never sends a zero; the section "After a clear" of '
        "deploy/ros2/README.md lists tools that send one)",
    ),
    (
        Wait("zeros", "ros2_control", lasts=600.0, kept="nav"),
        "ros2_control commands zero speed: it has sent only zeros for over 10 min; the speeds "
        "of nav have no effect",
    ),
    (
        Wait("senders", senders=1),
        "1 other sender of this source must wait until the sender that drives falls silent",
    ),
]


@each(("wait", "text"), SENTENCES)
def test_the_text_of_a_wait_has_the_details_of_the_wait(wait: Wait, text: str) -> None:
    assert waiting(wait).text == text


@each("what", (*get_args(WaitCode), *get_args(ObjectionCode)))
def test_the_reason_of_a_wait_has_the_code_of_the_wait(what: WaitCode | ObjectionCode) -> None:
    assert waiting(Wait(what, "app", 1.0, lasts=3600.0, senders=15)).code == what


@each(
    ("choice", "code"),
    [
        (Choice(), "no_command"),
        (Choice(wait=Wait("unproven", "app", 2.0)), "unproven"),
        (Choice("app", REST, Wait("nothing"), 1), "commanded"),
        (Choice("app", None, Wait("neutral", "app", 0.25)), "neutral"),
    ],
)
def test_the_reason_of_a_choice_is_that_a_source_is_followed_or_what_is_missing(
    choice: Choice, code: str
) -> None:
    assert chosen(choice).code == code


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
    assert reporter.changes(Mode.READY, NOBODY, why("stale")) == []


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
