"""The inputs of the board: emergency stop and bumpers, each with its own rules."""

from __future__ import annotations

from itertools import product
from typing import get_args

from acsard.core.codes import Reason, joined, reason
from acsard.core.config.settings import Place, SafetyConfig
from acsard.core.link.board_status import BoardStatus
from acsard.core.link.step_times import LATE_NS
from acsard.core.motion import bumpers as bumpers_module
from acsard.core.motion.bumpers import Bumpers, pressed_words
from acsard.core.motion.emergency_stop import PRESSED_REASON, TRANSITIONS, EmergencyStop, Sign
from acsard.core.values import REST, EstopState, Twist
from tests.each import each
from tests.unit.rig import MS

DRAWN = """
              ok        pressed   silence
    unknown   released  pressed   unknown
    released  released  pressed   silent
    pressed   released  pressed   pressed
    silent    released  pressed   silent
"""
"""The whole table of the emergency stop, drawn by hand."""


def test_the_table_is_the_one_drawn_by_hand() -> None:
    head, *rows = [line.split() for line in DRAWN.strip().splitlines()]
    drawn = {(row[0], sign): cell for row in rows for sign, cell in zip(head, row[1:], strict=True)}
    assert {state or "unknown" for state in get_args(EstopState)} == {row[0] for row in rows}
    assert set(get_args(Sign)) == set(head)
    for state, sign in product(get_args(EstopState), get_args(Sign)):
        new = TRANSITIONS.get((state, sign), state) or "unknown"
        assert new == drawn[state or "unknown", sign]


class Input:
    """An input of the board in a simulated time; the first step is at 10 s.

    Bumpers are reported as `X.`, the emergency stop as `!` (pressed) or `.`; "": a line without it.
    """

    def __init__(self, part: EmergencyStop | Bumpers, safety: SafetyConfig) -> None:
        self.part, self.safety, self.now_ms, self.up = part, safety, 10_000, True
        self.events: list[tuple[str, str]] = []

    def step(self, *reports: str, ms: int = 10) -> str:
        self.now_ms += ms
        now_ns, lines = self.now_ms * MS, []
        for marks in reports:
            if isinstance(self.part, Bumpers):
                line = BoardStatus(bumpers=tuple(mark == "X" for mark in marks) or None)
            else:
                line = BoardStatus(estop=marks == "!" if marks else None)
            lines.append((now_ns, line))
        late = ms * MS > LATE_NS
        events = self.part.process_reports(lines, now_ns, self.safety, up=self.up, late=late)
        self.events += [(event.name, event.code) for event in events]
        return self.part.state

    def quiet(self, ms: int) -> str:
        return [self.step() for _ in range(ms // 10)][-1]

    @property
    def why(self) -> Reason | None:
        """Why `clear` is refused now."""
        if isinstance(self.part, Bumpers):
            return self.part.clear_refusal(self.safety)
        return self.part.why(self.safety)

    @property
    def missing(self) -> bool:
        return self.part.missing(self.safety)


def button(use: str = "auto") -> Input:
    return Input(EmergencyStop(), SafetyConfig(estop=use))  # type: ignore[arg-type]


def bumpers(*places: Place, bumper: str = "stop") -> Input:
    safety = SafetyConfig(bumpers=places, bumper=bumper)  # type: ignore[arg-type]
    return Input(Bumpers(), safety)


def pressed(words: str) -> Reason:
    return reason("bumper", f"{words} pressed", bumpers=f"{words} pressed")


# the same for both


@each(
    ("what", "press", "free", "why", "code"),
    [
        (button, "!", ".", PRESSED_REASON, "emergency_stop"),
        (lambda: bumpers("front", "rear"), "X.", "..", pressed("front bumper"), "bumper"),
        (lambda: bumpers("front", "rear", bumper="away"), "X.", "..", None, "bumper"),
    ],
)
def test_a_press_counts_at_once_until_the_release_and_silence_after_half_a_second(
    what: type, press: str, free: str, why: Reason | None, code: str
) -> None:
    pin: Input = what()
    assert pin.step(free) == "released"
    assert pin.step(press) == "pressed"
    assert pin.part.pressed_now is not None
    assert pin.why == why
    assert pin.step(press) == "pressed"
    assert pin.part.pressed_now is None
    assert pin.why == why
    assert pin.step(free) == "released"
    assert pin.why is None
    assert pin.step(press, free) == "released"  # in one read
    assert pin.part.pressed_now is not None
    name = "bumper_pressed" if code == "bumper" else code
    assert [event for event in pin.events if event[1]] == [(name, code)] * 2
    for before in (press, free):
        pin.step(before)
        assert pin.quiet(500) == ("pressed" if before == press else "released")
        silent = pin.step("")  # a line without the input is no report of it
        assert pin.part.pressed_now is not None or silent == "pressed"
        assert pin.why is not None
    assert pin.quiet(1000) == "silent"
    assert pin.part.pressed_now is None
    assert pin.step(free) == "released"


def test_an_input_that_is_off_or_never_reported_is_never_pressed() -> None:
    for pin in (button("off"), bumpers("front", bumper="off")):
        assert pin.step("!X"[isinstance(pin.part, Bumpers)]) == pin.quiet(1000) == ""
        assert (pin.part.pressed_now, pin.missing, pin.events) == (None, False, [])
    pin = button()
    assert pin.quiet(2000) == pin.step("") == ""
    assert (pin.why, pin.missing, pin.events) == (None, False, [])
    assert pin.step("!") == "pressed"  # the first report may be a press


def test_a_late_computer_first_reads_the_lines_that_waited_and_is_excused_once() -> None:
    pin = button()
    pin.step(".")
    assert pin.step(ms=3000) == pin.step(".") == "released"
    assert [pin.step(ms=3000), pin.quiet(100), pin.step()] == ["released", "released", "silent"]
    pin.step(".")
    states = [pin.step(ms=200) for _ in range(5)]
    assert states == ["released", "released", "released", "silent", "silent"]


# the emergency stop


@each("before", [".", "!"])
def test_a_new_board_must_report_a_required_button_itself(before: str) -> None:
    pin = button("required")
    assert pin.missing
    pin.step(before)
    assert not pin.missing
    pin.part.reopen()
    assert pin.missing
    assert pin.step() == ("pressed" if before == "!" else "released")
    pin.step(".")
    assert not pin.missing


# bumpers

FOUR: tuple[Place, ...] = ("front", "rear", "left", "right")
TWISTS = [Twist(v, w) for v, w in product((-0.8, -0.1, -0.04, 0.0, 0.04, 0.1, 0.8), (-2, 0, 2))]


@each(
    ("marks", "sign"),
    [
        ("X...", -1), (".X..", 1), ("..X.", 0), ("...X", 0), ("XX..", 0), ("X.X.", 0),
        (".X.X", 0), ("..XX", 0), ("XXXX", 0),
    ],
)  # fmt: skip
def test_each_place_allows_only_the_straight_motion_that_leads_away(marks: str, sign: int) -> None:
    pin = bumpers(*FOUR, bumper="away")
    assert isinstance(pin.part, Bumpers)
    pin.step(marks)
    assert pin.part.limiting(pin.safety)
    code = "bumper_away" if sign else "bumper_blocks"
    assert joined(pin.part.limit(pin.safety)).code == code
    for twist in TWISTS:
        allowed = pin.part.away(twist, pin.safety)
        if twist == REST:
            assert allowed == REST
        elif twist.linear * sign <= 0:
            assert allowed is None
        else:
            assert allowed == Twist(sign * min(0.1, abs(twist.linear)), 0.0)


def test_each_new_bumper_is_a_press_but_the_release_of_one_is_not() -> None:
    pin = bumpers("front", "rear")
    for marks, press, why in (
        ("X.", "front bumper", "front bumper"),
        ("XX", "front and rear bumpers", "front and rear bumpers"),
        (".X", "", "rear bumper"),
    ):
        pin.step(marks)
        assert pin.part.pressed_now == (pressed(press) if press else None)
        assert pin.why == pressed(why)
    assert pin.step("XX", ".X", "..") == "released"
    assert pin.part.pressed_now == pressed("front and rear bumpers")
    assert pressed_words(FOUR, (True, False, True, False)) == "front and left bumpers pressed"
    assert pressed_words((), (True, False, True)) == "bumpers 1 and 3 pressed"


def test_bumpers_with_places_are_missing_until_the_board_reports_their_number() -> None:
    pin = bumpers("front", "rear")
    for wrong in (".", "...", "XXX", ""):
        assert (pin.step(wrong), pin.missing) == ("", True)
    assert (pin.part.pressed, pin.events) == (None, [])
    pin.step("..")
    assert not pin.missing
    assert [pin.step("...", ms=100) for _ in range(6)][-1] == "silent"
    assert pin.part.pressed == (True, True)
    assert pin.why == bumpers_module.SILENT_REASON


def test_without_places_a_new_number_of_bumpers_counts_from_its_second_line_on() -> None:
    pin = bumpers()
    assert not pin.missing
    assert [pin.step(marks) for marks in ("....", "....", "..X.")] == ["", "released", "pressed"]
    assert pin.why == pressed("bumper 3")
    assert [pin.step(m) for m in ("...", "....", "....")] == ["pressed", "pressed", "released"]
    assert pin.step("X") == "pressed"
    assert pin.part.pressed_now == pressed("bumper 1")
    pin = bumpers(bumper="away")  # no motion leads away, so a press latches
    pin.step("X")
    assert isinstance(pin.part, Bumpers)
    assert (pin.part.limiting(pin.safety), pin.why) == (False, pressed("bumper 1"))
