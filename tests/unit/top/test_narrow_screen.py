"""A narrow screen shows every figure of the wide screen without shortening it."""

from __future__ import annotations

from rich.cells import cell_len

from tests.each import each
from tests.unit.top.screens import STATE, lines_of, of, painted

WIDTHS = (40, 60, 80, 160)

REASON = "the microcontroller's lines come 0.50 s apart; set mcu.reply_period = 0.50 in acsard.toml"

FULL = of(
    mode="waiting",
    reason=REASON,
    refused="source nav: the twist contains NaN or infinity",
    certificate_expiry="expires in 12 days",
    gyro="used",
    counters=STATE.counters
    | {"lines_superseded": 12_345, "bus_overrun": 7, "line_malformed": 30, "command_stale": 4},
)


def read(width: int) -> str:
    return " ".join(" ".join(lines_of(FULL, width, None)).split())


@each("width", WIDTHS)
def test_every_figure_is_on_a_screen_of_any_width(width: int) -> None:
    text, lines = read(width), lines_of(FULL, width, None)
    for figure in (
        "WAITING", REASON, "x +1.250 m", "y -0.500 m", "yaw +57.3°", "forward +0.500 m/s",
        "turn -0.600 rad/s", "+12.00", "+8.00", "+12.50", "-7.50", "100 -", "50 0.0 s",
        "10 3.0 s", "app has priority: wait until it is silent", "link up",
        "expires in 12 days", "in 100.0/s of 1,300", "out 100.0/s of 1,301", "superseded 12,345",
        "20.0/s of 220", "missed periods 3", "bus overrun 7", "malformed 30", "stale 4",
        "the twist contains NaN or infinity", "gyro used",
    ):  # fmt: skip
        assert figure in text, figure
    assert text.count("63 µs 891 µs 9.7 ms") == text.count("56 µs 112 µs 8.0 ms") == 6
    assert max(map(cell_len, lines)) <= width
    assert not any(line.endswith("…") for line in lines[1:])


def test_on_few_lines_the_figures_since_the_start_go_first() -> None:
    lines = lines_of(of(sources=STATE.sources[:1]), 40, 24)
    assert len(lines) == 24
    assert any("last minute" in line for line in lines)
    assert not any("since start" in line for line in lines)


def test_growing_counters_stand_out_on_a_narrow_screen() -> None:
    grown = of(counters=STATE.counters | {"missed_periods": 4})
    assert "\x1b[33mmissed periods 4\x1b[0m" in painted(grown, 40, None)
