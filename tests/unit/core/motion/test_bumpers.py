"""Tests of the bumpers: their states, their texts, and the motion that each of them allows."""

from __future__ import annotations

from collections.abc import Callable
from itertools import product
from typing import get_args

import pytest

from acsard.core.codes import Reason, joined, reason
from acsard.core.config.settings import Place, SafetyConfig
from acsard.core.link.board_status import BoardStatus
from acsard.core.motion.bumpers import (
    DIRECTIONS,
    SILENT_REASON,
    Bumpers,
    pressed_words,
)
from acsard.core.values import REST, Event, Twist

MS = 1_000_000
FOUR: tuple[Place, ...] = ("front", "rear", "left", "right")


class Pins:
    """Bumper inputs with a simulated time. The first step is at 10 s."""

    def __init__(self, safety: SafetyConfig) -> None:
        self.bumpers = Bumpers()
        self.safety = safety
        self.now_ms = 10_000
        self.events: list[Event] = []

    @property
    def missing(self) -> bool:
        return self.bumpers.missing(self.safety)

    @property
    def limiting(self) -> bool:
        return self.bumpers.limiting(self.safety)

    @property
    def clear_refusal(self) -> Reason | None:
        return self.bumpers.clear_refusal(self.safety)

    def step(self, *reports: str, ms: int = 10) -> str:
        """Process status lines with these bumpers ("" for none) after `ms`. Return the state."""
        self.now_ms += ms
        statuses = [
            (self.now_ms * MS, BoardStatus(bumpers=tuple(mark == "X" for mark in marks) or None))
            for marks in reports
        ]
        now_ns = self.now_ms * MS
        self.events += self.bumpers.process_reports(statuses, now_ns, self.safety)
        return self.bumpers.state

    def quiet(self, ms: int) -> str:
        """Run steps without a report of the board for this time."""
        for _ in range(ms // 10):
            self.step()
        return self.bumpers.state


def stop(*places: Place) -> Pins:
    return Pins(SafetyConfig(bumpers=places))


def away(*places: Place) -> Pins:
    return Pins(SafetyConfig(bumpers=places, bumper="away"))


TWISTS = [Twist(v, w) for v, w in product((-0.8, -0.1, -0.04, 0.0, 0.04, 0.1, 0.8), (-2, 0, 2))]


@pytest.mark.parametrize(
    ("pressed", "sign"),
    [
        ("X...", -1), (".X..", 1), ("..X.", 0), ("...X", 0), ("XX..", 0), ("X.X.", 0),
        (".X.X", 0), ("..XX", 0), ("XXXX", 0),
    ],
)  # fmt: skip
def test_each_place_allows_only_the_straight_motion_that_leads_away(
    pressed: str, sign: int
) -> None:
    pins = away(*FOUR)
    pins.step(pressed)
    for twist in TWISTS:
        allowed = pins.bumpers.away(twist, pins.safety)
        if twist == REST:
            assert allowed == REST
        elif twist.linear * sign <= 0:
            assert allowed is None
        else:
            assert allowed == Twist(sign * min(0.1, abs(twist.linear)), 0.0)


def pressed(bumpers: str) -> Reason:
    words = f"{bumpers} pressed"
    return reason("bumper", part=words, bumpers=words)


def test_two_bumpers_at_one_place_allow_the_same_motion_as_one() -> None:
    pins = away("front", "front", "rear")
    for pressed in ("X..", ".X.", "XX."):
        pins.step(pressed)
        assert pins.bumpers.away(Twist(-0.5, 1.0), pins.safety) == Twist(-0.1, 0.0)
        assert joined(pins.bumpers.limit(pins.safety)).code == "bumper_away"


def test_every_place_has_a_direction() -> None:
    assert set(DIRECTIONS) == set(get_args(Place))


@pytest.mark.parametrize(
    ("pressed", "code"),
    [("X...", "bumper_away"), (".X..", "bumper_away"), ("..X.", "bumper_blocks"),
     ("XX..", "bumper_blocks")],
)  # fmt: skip
def test_a_pressed_bumper_that_limits_says_whether_it_allows_a_motion(
    pressed: str, code: str
) -> None:
    pins = away(*FOUR)
    pins.step("....")
    pins.step(pressed)
    assert pins.limiting
    assert pins.clear_refusal is None
    assert joined(pins.bumpers.limit(pins.safety)).code == code
    event = pins.events[-1]
    assert (event.name, event.level, event.code) == ("bumper_pressed", "error", "bumper")


def test_the_text_names_the_place_or_the_number_of_each_pressed_bumper() -> None:
    assert pressed_words(FOUR, (True, False, True, False)) == "front and left bumpers pressed"
    assert pressed_words((), (False, True)) == "bumper 2 pressed"
    assert pressed_words((), (True, False, True)) == "bumpers 1 and 3 pressed"


def test_a_press_counts_immediately_until_the_release() -> None:
    pins = stop("front", "rear")
    pins.step("..")
    assert pins.step("X.") == "pressed"
    assert pins.bumpers.pressed == (True, False)
    assert pins.bumpers.pressed_now == pins.clear_refusal == pressed("front bumper")
    assert not pins.limiting
    pins.step("X.")
    assert pins.bumpers.pressed_now is None
    assert pins.clear_refusal == pressed("front bumper")
    assert pins.step("..") == "released"
    assert (pins.clear_refusal, pins.bumpers.pressed) == (None, (False, False))
    assert [(event.name, event.code) for event in pins.events] == [
        ("bumper_released", ""), ("bumper_pressed", "bumper"), ("bumper_released", ""),
    ]  # fmt: skip


def test_a_second_pressed_bumper_is_a_new_press_but_the_release_of_one_bumper_is_not() -> None:
    pins = stop("front", "rear")
    pins.step("X.")
    pins.step("XX")
    assert pins.bumpers.pressed_now == pressed("front and rear bumpers")
    pins.step(".X")
    assert pins.bumpers.pressed_now is None
    assert pins.clear_refusal == pressed("rear bumper")
    assert len(pins.events) == 2
    pins.step("XX", ".X", "..")
    assert (pins.bumpers.pressed_now, pins.bumpers.state) == (
        pressed("front and rear bumpers"), "released",
    )  # fmt: skip


@pytest.mark.parametrize("choice", [stop, away])
@pytest.mark.parametrize("pressed", ["..", "X."])
def test_half_a_second_of_silence_latches_with_both_choices(
    choice: Callable[..., Pins], pressed: str
) -> None:
    pins = choice("front", "rear")
    pins.step(pressed)
    assert pins.quiet(500) != "silent"
    assert pins.step("") == "silent"
    assert pins.bumpers.pressed == (True, True)
    assert pins.bumpers.pressed_now == pins.clear_refusal == SILENT_REASON
    assert not pins.limiting
    assert pins.events[-1].code == "bumpers_silent"
    assert pins.step("..") == "released"


def test_a_release_says_that_a_stop_stays_only_if_there_is_one() -> None:
    pins = away("front", "rear")
    pins.step("..")
    pins.step("X.")
    pins.step("..")
    assert pins.events[-1].text == "the bumpers are released and allow every direction again"
    pins.quiet(600)
    pins.step("..")
    text = "the bumpers are released; a latched stop lasts until srv/clear is called"
    assert pins.events[-1].text == text


def test_bumpers_with_places_are_missing_until_the_board_reports_their_number() -> None:
    pins = stop("front", "rear")
    assert pins.missing
    for wrong in (".", "...", "XXX", ""):
        assert pins.step(wrong) == ""
    assert (pins.missing, pins.bumpers.pressed, pins.events) == (
        True,
        None,
        [],
    )
    pins.step("..")
    assert not pins.missing


def test_a_line_with_the_wrong_number_of_bumpers_does_not_count_as_a_report() -> None:
    pins = stop("front", "rear")
    pins.step("X.")
    for _ in range(6):
        state = pins.step("...", ms=100)
    assert state == "silent"


def test_without_places_every_bumper_counts_wherever_it_is() -> None:
    pins = stop()
    assert not pins.missing
    assert pins.step("....") == ""
    assert pins.step("....") == "released"
    assert pins.step("..X.") == "pressed"
    assert pins.clear_refusal == pressed("bumper 3")


def test_without_places_the_first_line_with_another_number_of_bumpers_releases_nothing() -> None:
    pins = stop()
    assert pins.step("X...") == "pressed"
    assert pins.step("...") == "pressed"
    assert pins.step("....") == "pressed"
    assert pins.step("....") == "released"
    assert pins.step("X") == "pressed"
    assert pins.bumpers.pressed_now == pressed("bumper 1")


def test_without_places_no_motion_leads_away_so_a_press_latches() -> None:
    pins = away()
    pins.step("X")
    assert (pins.limiting, pins.clear_refusal) == (
        False,
        pressed("bumper 1"),
    )


def test_bumpers_that_are_off_are_ignored() -> None:
    pins = Pins(SafetyConfig(bumpers=("front",), bumper="off"))
    assert pins.step("X") == pins.quiet(1000) == ""
    assert (pins.missing, pins.bumpers.pressed, pins.events) == (
        False,
        None,
        [],
    )
