"""Tests of the sentences about the arbiter's decisions in `state` and `diagnostics`."""

from __future__ import annotations

from typing import get_args, get_type_hints

import pytest

from acsard.core.motion.arbiter import Choice, Objection
from acsard.core.motion.arbiter_text import REFUSED, chosen, waiting
from acsard.core.values import REST, Wait

SENTENCES = [
    (Wait("nothing"), ""),
    (Wait("command"), "a command"),
    (
        Wait("neutral", "slow", 1.0),
        "send a zero first: slow must send a zero before it can drive",
    ),
    (
        Wait("neutral", "high", 0.5, shared=True),
        "send a zero first: high must send a zero, and no speed for 0.5 s after it, before it can "
        "drive",
    ),
    (
        Wait("neutral", "nav", 1.0, lasts=3.0, ros=True),
        "send a zero first: nav must send a zero before it can drive; it has sent speeds for over "
        '3 s (`ros2 topic pub` of a speed sends none: "After a clear" in deploy/ros2/README.md has '
        "tools that do)",
    ),
    (Wait("zeros", "app", lasts=3.0), "held by app, which sends nothing but zeros for over 3 s"),
    (
        Wait("zeros", "ros2_control", lasts=600.0, kept="nav"),
        "held by ros2_control, which sends nothing but zeros for over 10 min; nav sends speeds "
        "and is kept waiting",
    ),
    (Wait("zeros", "app", lasts=3600.0), "held by app, which sends nothing but zeros for over 1 h"),
    (
        Wait("proof", "high", 0.25),
        "high is new here: it drives once its delays have been steady for 0.25 s",
    ),
    (
        Wait("late", "high", 0.25),
        "commands of high come too late, by more than 0.25 s: the network holds them up, or the "
        "sender's clock was set; if this goes on, look at the network, then restart the sender",
    ),
    (Wait("higher", "high"), "high has the higher priority: until it is silent"),
    (Wait("equal", "right"), "right, of the same priority, came first: until it is silent"),
    (Wait("senders", senders=15), "15 more of its senders: the first until it is silent"),
]


@pytest.mark.parametrize(("wait", "text"), SENTENCES)
def test_what_a_source_waits_for_is_a_sentence(wait: Wait, text: str) -> None:
    assert waiting(wait) == text


def test_every_wait_has_its_sentence_above() -> None:
    kinds = get_args(get_type_hints(Wait)["what"])
    assert {wait.what for wait, _ in SENTENCES} == set(kinds)


@pytest.mark.parametrize(
    ("choice", "text"),
    [
        (Choice(), "waiting for a command: no source has sent one within its timeout"),
        (
            Choice(wait=Wait("proof", "app", 2.0)),
            "app is new here: it drives once its delays have been steady for 2 s",
        ),
        (Choice("app", REST, Wait("nothing"), 1), "commanded by app"),
        (
            Choice("app", None, Wait("neutral", "app", 0.25)),
            "send a zero first: app must send a zero before it can drive",
        ),
    ],
)
def test_whose_command_is_followed_or_why_nobody_s_is_a_sentence(choice: Choice, text: str) -> None:
    assert chosen(choice) == text


def test_whatever_a_command_is_refused_for_is_said_in_words() -> None:
    assert {"", *REFUSED} == {*get_args(Objection)}
    assert REFUSED["too_many_senders"] == "16 other senders of this source are live"
