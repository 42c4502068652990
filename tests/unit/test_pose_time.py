"""The time of each sample: from the wire, the board's clock, or the lines that it answers."""

from __future__ import annotations

import math
from time import process_time
from typing import Any, Literal

import pytest

from acsard.core.config.settings import FeedbackConfig, McuConfig, WheelMap
from acsard.core.link.checked_line import Reading
from acsard.core.link.feedback import Line, Timeline
from acsard.core.link.link_output import Output
from acsard.core.link.link_setup import LinkSetup
from acsard.core.values import AT_REST, Instant, WheelSpeeds
from tests.each import each

MS = 1_000_000
SPEEDS = WheelSpeeds(1.0, 2.0, 3.0, 4.0)
LENGTH = 36
WIRE_NS = 3_125_000
COUNTS = 3600
DEGREE = math.tau / 360
"""The angle of ten counts, rad."""


class Bench:
    """The sample-time estimation under test, with simulated clocks of the host and the MCU."""

    def __init__(
        self, wheels: WheelMap | None = None, counts: int = COUNTS, period: float = 0.0
    ) -> None:
        wheels = wheels or WheelMap()
        check: Literal["off", "on"] = "on" if counts and not period else "off"
        mcu = McuConfig(wheels=wheels, encoder_counts=counts, link_check=check, reply_period=period)
        self.setup = LinkSetup.of(mcu, 100.0, FeedbackConfig(wheel_speed=80.0))
        self.timeline, self.out = Timeline(), Output()
        self.now_ns, self.mcu_ms = 9000 * MS, 500

    def line(
        self,
        *counts: int,
        ms: float = 10,
        mcu_ms: int | None = None,
        gap: bool = False,
    ) -> Line:
        """Return the feedback of a line `ms` later on both clocks, with or without counts."""
        self.now_ns += int(ms * MS)
        self.mcu_ms += int(ms) if mcu_ms is None else mcu_ms
        reading = None
        if counts:
            a, b, c, d = (count % 65536 for count in counts)
            reading = Reading(self.mcu_ms % 65536, (a, b, c, d))
        (sample,) = self.read(0, reading=reading, gap=gap)
        return sample

    def read(
        self,
        ms: float,
        lines: int = 1,
        reading: Reading | None = None,
        gap: bool = False,
        asked_ns: int | None = None,
    ) -> list[Line]:
        """Read this many lines at once, `ms` later: this computer was late.

        With `gap`, the first one follows a silence.
        """
        self.now_ns += int(ms * MS)
        at = Instant(self.now_ns, self.now_ns + 7)
        self.timeline.process_read(self.setup, self.out, at, LENGTH * lines, lines, 0)
        return [
            self.timeline.place(
                self.setup, self.out, SPEEDS, reading, LENGTH * behind, LENGTH,
                gap and behind == lines - 1, asked_ns, int(ms * MS),
            )
            for behind in reversed(range(lines))
        ]  # fmt: skip

    def sends(self, ms: float) -> None:
        """Let a line leave `ms` from now."""
        at_ns, line = self.now_ns + int(ms * MS), self.setup.codec.encode(SPEEDS)
        self.out.wrote(self.setup, line, at_ns, at_ns, AT_REST, SPEEDS, silent=False, trip=False)

    def answered(
        self, sent_ms: float, came_ms: float, *lost: float, gap: bool = False
    ) -> list[Line]:
        """Read at `came_ms` the answer to a line that left at `sent_ms`; `lost` are later lines."""
        began_ns = 9000 * MS
        self.now_ns = began_ns + int(sent_ms * MS)
        for ms in (0, *lost):
            self.sends(ms)
        self.now_ns = began_ns
        return self.read(came_ms, gap=gap, asked_ns=began_ns + int(sent_ms * MS))


def test_the_first_line_has_a_time_but_neither_dt_nor_gap() -> None:
    bench = Bench()
    sample = bench.line()
    made_ns = bench.now_ns - WIRE_NS
    assert sample.at == Instant(made_ns, made_ns + 7)
    found = sample.speeds, sample.dt, sample.gap, sample.heard_ns
    assert found == (SPEEDS, 0.0, 0.0, bench.now_ns)


Given = dict[str, Any]
Sample = tuple[float, float, tuple[int, ...] | None]
ZERO = {"counts": (0, 0, 0, 0)}
ONE = {"counts": (10, 10, 10, 10)}
COUNTED: dict[str, tuple[list[Given], Sample]] = {
    # Lines, and dt, gap and the angles of the last one in tenths of a degree.
    "the host's clock": ([{}, {"ms": 12}], (0.012, 0.0, None)),
    "the board's clock": (
        [ZERO, {"counts": (10, -20, 30, 0), "ms": 17, "mcu_ms": 10}], (0.01, 0.0, (10, -20, 30, 0)),
    ),
    "the first counts": ([{}, ONE], (0.01, 0.0, None)),
    "a line without counts": ([ZERO, {}, ONE], (0.01, 0.0, None)),
    "after that line": ([ZERO, {}, ZERO, ONE], (0.01, 0.0, (10, 10, 10, 10))),
    "a gap that counts fill": (
        [ZERO, {"counts": (170, 340, 520, 690), "ms": 300, "gap": True}],
        (0.0, 0.3, (170, 340, 520, 690)),
    ),
    "a gap in which they may wrap": ([ZERO, ONE | {"ms": 3000, "gap": True}], (0.0, 3.0, None)),
    "a leap": ([ZERO, {"counts": (9000, 0, 0, 0)}], (0.01, 0.0, None)),
    "a restart": ([ZERO, ZERO | {"mcu_ms": -500}], (0.0, 0.01, None)),
    "behind a restart": ([ZERO, ZERO | {"mcu_ms": -500}, ONE], (0.01, 0.0, (10, 10, 10, 10))),
}  # fmt: skip


@each("name", COUNTED)
def test_the_time_and_the_angles_of_a_line(name: str) -> None:
    bench, (lines, (dt, gap, angles)) = Bench(), COUNTED[name]
    for line in lines:
        more = {name: value for name, value in line.items() if name != "counts"}
        sample = bench.line(*line.get("counts", ()), **more)
    assert (sample.dt, sample.gap) == (dt, gap)
    tenths = None if sample.turned is None else [angle / DEGREE * 10 for angle in sample.turned]
    assert tenths == (None if angles is None else pytest.approx(angles))
    assert bench.timeline.restarted == (name == "a restart")
    assert bench.timeline.leaps == (name == "a leap")


def test_counts_have_the_wheel_map_and_are_used_only_if_they_are_configured() -> None:
    bench = Bench(WheelMap("-d", "+c", "-b", "+a"))
    bench.line(0, 0, 0, 0)
    angles = bench.line(10, 20, 30, 40).turned
    assert angles == pytest.approx((-4 * DEGREE, 3 * DEGREE, -2 * DEGREE, DEGREE))
    bench.timeline.forget()
    assert bench.line(20, 20, 30, 40).turned is None
    bench = Bench(counts=0)
    bench.line(0, 0, 0, 0)
    assert bench.line(10, 10, 10, 10).turned is None


# boards without counts


@pytest.mark.parametrize("period", [20, 50])
def test_a_board_with_its_own_rate_has_its_own_period(period: int) -> None:
    bench = Bench(counts=0, period=period / 1000)
    for _ in range(80):
        bench.line(ms=period)
    samples = bench.read(period * 6, 6, gap=True)
    assert [(f.dt, f.gap) for f in samples] == [(period / 1000, 0.0)] * 6


def prompted() -> Bench:
    """Send a line every 10 ms, and let the board answer it 8 ms later.

    The host stalls once. The missing answers in this stall show that the board is prompted.
    """
    bench = Bench(counts=0)
    for number in range(80):
        bench.sends(2)
        bench.line(ms=160 if number == 50 else 10)
        if number == 50:
            bench.sends(-8)
    return bench


def test_the_dt_of_an_answer_is_the_time_between_the_prompting_lines() -> None:
    bench = prompted()
    bench.sends(202)
    sample = bench.line(ms=210, gap=True)
    assert sample.dt == pytest.approx(0.21, abs=1e-3)
    assert (sample.gap, sample.bridged) == (0.0, 0.0)


def test_replies_that_waited_in_a_stall_beyond_the_open_commands_cover_no_time_of_it() -> None:
    """A prompted board samples only when a command arrives, and no command arrived in the stall."""
    bench = prompted()
    bench.sends(2)
    samples = bench.read(1200, 3)
    assert sum(line.dt for line in samples) < 0.03
    assert all(line.gap == line.bridged == 0.0 for line in samples)


def test_the_dt_of_an_answer_that_names_its_line_is_that_of_the_named_lines() -> None:
    bench = Bench(counts=0)
    for sent_ms, came_ms, dt in ((0, 10, 0.0), (10, 13, 0.01), (20, 38, 0.01), (37, 39, 0.017)):
        (sample,) = bench.answered(sent_ms, came_ms)
        assert sample.dt == pytest.approx(dt, abs=0.0005)


def test_a_stall_counts_once_if_replies_name_their_line_and_many_are_lost() -> None:
    bench, total = Bench(counts=0), 0.0
    for number in range(200):
        # A stall of 100 ms begins behind line 100. The reply to that line waits for its end.
        sent_ms = 10 * number + 100 * (number > 100)
        lost = (3, 6) if number < 95 else ()  # the replies to these lines
        late = 109 if number == 100 else 9
        (sample,) = bench.answered(sent_ms, sent_ms + late, *lost, gap=number == 100)
        total += sample.dt
        if number > 90:
            assert total == pytest.approx(sent_ms / 1000, abs=0.005), number


def test_a_free_running_board_that_was_silent_for_a_day_costs_no_period() -> None:
    bench = Bench(counts=0, period=0.01)
    for _ in range(100):
        bench.line()
    begin = process_time()
    line = bench.line(ms=86_400_000.0, gap=True)
    assert process_time() - begin < 0.02
    assert line.gap == pytest.approx(86_400.0, abs=0.02)
    for _ in range(100):
        assert bench.line().dt == pytest.approx(0.01)
