"""`acsard drive` shows the whole reason, the units and the help at any width."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.motion.modes import Mode
from acsard.top.drive_screen import HELP, Teleop, last_report_lines, lines, report_lines
from acsard.top.text import MODE_STYLES
from tests.each import each
from tests.unit.top.screens import STATE

SEEN = Teleop("acsar", "tcp/127.0.0.1:7448", "teleop", 0.5, 1.0, STATE, 0.1)

LONG = (
    "teleop may be late: its delays must be steady for 0.25 s if its clock is new here, for 1.5 s "
    "if that was set; the microcontroller's lines come 0.50 s apart; if it reports by its own "
    "clock, set mcu.reply_period = 0.50, and look at the cable"
)
WIDTHS = (40, 57, 80, 118, 160)


def of(**what: object) -> Teleop:
    return replace(SEEN, state=replace(STATE, **what))


def joined(lines: list[str]) -> str:
    """Return the lines as one text with single spaces."""
    return " ".join(" ".join(lines).split())


def texts(data: Teleop, width: int, height: int | None = 24) -> list[str]:
    return [line.plain for line in lines(data, width, height)]


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


def test_only_the_mode_has_its_colour_and_not_the_reason_below_it() -> None:
    rows = lines(of(mode="waiting", reason=LONG), 40)
    coloured = [
        span for line in rows for span in line.spans if span.style == MODE_STYLES["waiting"]
    ]
    assert [rows[1].plain[span.start : span.end] for span in coloured] == [" WAITING "]


def test_the_screen_does_not_move_while_figures_change() -> None:
    still = texts(of(x=0.0, y=0.0, yaw=0.0, linear=0.0, angular=0.0), 80)
    moved = texts(of(x=-123.456, y=99.9, yaw=-3.1, linear=-0.55, angular=1.25), 80)
    assert [len(line) for line in still] == [len(line) for line in moved]


def test_help_stays_on_a_screen_of_few_lines() -> None:
    rows = texts(of(reason=LONG), 40, 10)
    assert len(rows) == 10
    assert rows[-len(HELP) :] == list(HELP)


@each("mode", list(Mode))
def test_the_mode_is_shown_once_with_its_reason(mode: Mode) -> None:
    data = of(mode=mode.value, reason="because")
    assert texts(data, 80)[1].split() == [mode.value.upper(), "because"]
    assert report_lines(data, 80)[0].startswith(f"{mode.value}: because; ")


@each("width", WIDTHS)
def test_without_a_screen_no_word_and_no_figure_is_broken_at_the_edge(width: int) -> None:
    rows = report_lines(of(mode="waiting", reason=LONG, x=1.5), width)
    assert max(map(len, rows)) <= width
    assert LONG in joined(rows)
    assert sum("x   +1.500 m" in line for line in rows) == 1
    assert sum("turn -0.60 rad/s" in line for line in rows) == 1


@given(
    st.text(max_size=300),
    st.floats(),
    st.integers(20, 200),
    st.integers(1, 60),
)
def test_any_text_and_number_fits_the_screen_and_is_printable(
    text: str, number: float, width: int, height: int
) -> None:
    data = of(mode=text[:9], reason=text, x=number, linear=number, yaw=0.0)
    data = replace(data, robot_id=text, objection=text)
    rows = texts(data, width, height)
    assert len(rows) <= height
    rows += [*report_lines(data, width), *last_report_lines(data, width)]
    assert all(len(line) <= width and line.isprintable() for line in rows)
