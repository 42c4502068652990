"""`acsard drive` shows the whole reason, the units and the help at any width."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace
from rich.cells import cell_len

from acsard.core.motion.modes import Mode
from acsard.top.drive_screen import HELP, Teleop, last_report, screen
from tests.each import each
from tests.unit.top.screens import STATE, drawn

SEEN = Teleop("acsar", "tcp/127.0.0.1:7448", "teleop", 0.5, 1.0, STATE, 0.1)

LONG = (
    "teleop may be late: its delays must be steady for 0.25 s if its clock is new here, for 1.5 s "
    "if that was set; the microcontroller's lines come 0.50 s apart; if it reports by its own "
    "clock, set mcu.reply_period = 0.50, and look at the cable"
)
WIDTHS = (40, 57, 80, 118, 160)


def of(**what: object) -> Teleop:
    return replace(SEEN, state=replace(STATE, **what))


def texts(data: Teleop, width: int) -> list[str]:
    return [line.rstrip() for line in drawn(screen(data), width).splitlines()]


@each("width", WIDTHS)
def test_every_width_shows_the_whole_reason_the_units_of_the_pose_and_the_help(
    width: int,
) -> None:
    rows = texts(of(mode="waiting", reason=LONG, x=1.5, y=-2.25, yaw=1.0), width)
    assert max(map(len, rows)) <= width
    assert len(rows) < 24
    words = " ".join(" ".join(rows).split())
    for phrase in (LONG, "WAITING", "x +1.500 m", "y -2.250 m", "yaw +57.3°", "m/s", "rad/s"):
        assert phrase in words
    assert rows[-len(HELP) :] == list(HELP)


def test_the_screen_does_not_move_while_figures_change() -> None:
    still = texts(of(x=0.0, y=0.0, yaw=0.0, linear=0.0, angular=0.0), 80)
    moved = texts(of(x=-123.456, y=99.9, yaw=-3.1, linear=-0.55, angular=1.25), 80)
    assert [len(line) for line in still] == [len(line) for line in moved]


@each("mode", list(Mode))
def test_the_mode_is_shown_once_with_its_reason(mode: Mode) -> None:
    data = of(mode=mode.value, reason="because")
    assert texts(data, 80)[1].split() == [mode.value.upper(), "because"]


@given(st.text(max_size=300), st.floats(), st.integers(20, 200))
def test_any_text_and_number_fits_the_screen_and_is_printable(
    text: str, number: float, width: int
) -> None:
    data = of(mode=text[:9], reason=text, x=number, linear=number, yaw=0.0)
    data = replace(data, robot_id=text, objection=text)
    rows = [*texts(data, width), *drawn(last_report(data), width).splitlines()]
    assert all(cell_len(line) <= width and line.isprintable() for line in rows)
