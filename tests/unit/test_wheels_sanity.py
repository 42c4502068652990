"""Impossible feedback is rejected with a reason; repeated rejection is a fault."""

from __future__ import annotations

import math
from typing import Any

import pytest
from msgspec.structs import replace

from acsard.core.link.feedback import Line
from acsard.core.motion import sanity as module
from acsard.core.motion.sanity import Sanity
from acsard.core.values import WHEELS, Event, Instant, WheelSpeeds
from tests.each import each
from tests.wheels import MAPS

UNKNOWN, COARSE = math.inf, 58.9
"""The change of a speed by one count of encoders that are not declared, rad/s; 0: they are fine."""


def only(wheel: int, speed: float, others: float = 0.0) -> WheelSpeeds:
    return WheelSpeeds(*(speed if i == wheel else others for i in range(4)))


def line(speed: float, wheel: int = 1, others: float = 0.0, **more: Any) -> Line:
    """Return a line with the speed of one wheel; `step` says that the counts are not declared."""
    speeds, dt, counts = only(wheel, speed, others), more.pop("dt", 0.01), more.pop("counts", 3200)
    if (step := more.pop("step", None)) is None:
        count = math.tau / counts
        step = count / dt if dt else 0.0
    else:
        count = 0.0
    if (number := more.pop("proven", None)) is not None:  # so many counts of this wheel
        more["counted"] = tuple(count * number * (i == wheel or others != 0.0) for i in range(4))
    if (number := more.pop("board", None)) is not None:
        more["turned"] = tuple(count * number * (i == wheel or others != 0.0) for i in range(4))
    return Line(Instant(0, 0), speeds, dt, count=count, step=step, **more)


def lines(*speeds: float, **more: Any) -> list[Line]:
    return [line(speed, **more) for speed in speeds]


def ten(speed: float, **more: Any) -> Line:
    return line(speed, others=speed, **more)


GAP: dict[str, Any] = {"dt": 0.0, "gap": 0.5}
TWENTY: dict[str, Any] = {"counts": 20}  # one count in 10 ms is 31.4 rad/s
Row = tuple[float, float, list[Line], str]
ROWS: dict[str, Row] = {
    # The limit of the speed; the limit of a change is 100 rad/s2 x 10 ms and 2 rad/s.
    "three in a row": (80, 1e9, lines(99, 99, 0, 99, 99, 99), "xx.xxF"),
    "three at the start": (80, 1e9, lines(99, 99, 99), "xxF"),
    "the most a wheel can do": (80, 100, lines(0, 3.2, 0, -3.5), "...x"),
    "a change": (80, 100, lines(0, 3.5, 2.9), ".x."),
    "a real step in time": (80, 400, [line(0), *[ten(10)] * 3], ".x.."),
    "the first line, and a gap": (80, 10, [ten(10, dt=0.0), ten(0, **GAP)], ".."),
    # The speed of a long line is a mean: it may have changed since the middle of its time.
    "after a pause": (80, 100, [ten(5), ten(10, dt=0.25), ten(20), ten(0)], "...x"),
    "a damaged first line": (80, 1500, lines(79, 0, 0, 0), ".x.."),
    "a speed that no wheel reaches": (80, 1500, lines(79, 80.9, 80.9, 80.9), ".xxF"),
    "a jump from what two lines agreed on": (80, 1500, lines(0, 0, 79, 79, 79), "..xxF"),
    # A wheel may change by as much in a long line, so a damaged one behind it proves nothing.
    "damage behind a pause": (
        80, 1500, [*lines(0, 0), line(0, dt=0.81, bridged=0.7), *lines(79, 0, 0, 0, 0)],
        "....x...",
    ),
    "a burst of lines": (
        80, 1500, [*lines(10, 10, step=0.0), *lines(17, 10, step=0.0, dt=0.001)], "....",
    ),
    "lines that agree with no other": (80, 1500, lines(20, 79, -79, -30), ".xxF"),
    "every second line is damaged": (
        80, 1500, lines(0, 79, 0, -60, 0, 35, 0, -79, 0, 60, 0), ".x.x.x.x.x.",
    ),
    "a gap": (80, 1500, [*lines(0, 0, 79), line(0, **GAP), line(79)], "..x.x"),
    # Coarse encoders: twice 31.4 rad/s more, and one proven count above the speed.
    "a count at each end": (80, 100, lines(0, 65.7, -0.2, **TWENTY), "..x"),
    "two fine counts": (80, 100, lines(0, 3.9, counts=1600), ".x"),
    "one proven count": (31, 1500, lines(62.8, 62.8, proven=2, **TWENTY), "xx"),
    "the limit and a proven count": (32, 1500, lines(62.8, 31.4, 62.8, proven=2, **TWENTY), "..x"),
    # Speeds over the limit are summed as angles: a count excuses once, not in every line.
    "lasting speeds": (80, 1500, [ten(95, **TWENTY)] * 7, "....xxF"),
    "lasting speeds by counts": (80, 1500, [ten(94.2, proven=3, **TWENTY)] * 5, "..xxF"),
    "lasting speeds, unknown": (10, 1500, [ten(39, step=UNKNOWN)] * 5, "..xxF"),
    "what slow lines make up for": (80, 1500, lines(95, 95, 50, **TWENTY) * 5, "." * 15),
    "an impossible line adds nothing": (80, 1500, lines(95, 99.99, 70, 94, counts=64), ".x.."),
    # The pose fills the time of an impossible line with the speeds of the next one.
    "its time counts in the next line": (
        20, 1500, lines(60, -60, 60, counts=32), "xx" "F",
    ),
    "a repeated line": (
        80, 1500, [ten(94.2, proven=3 * (n % 2), **TWENTY) for n in range(6)], ".....x",
    ),
    "the sum ends at a gap": (
        80, 1500, [*[ten(95, **TWENTY)] * 4, ten(95, **GAP, **TWENTY), ten(95, **TWENTY)], "......",
    ),
    "damage before fast lines": (
        20, 1500, lines(70, 21, 21, 21, 10.5, 10.5, counts=64) * 10, "x....." * 10,
    ),
    # A board that is asked 300 times a second counts for 4 to 8 ms, as the simulated one does. A
    # wheel whose every count is dropped would run on unseen.
    "one count of 16 in 4 ms": (
        80, 1500, lines(98.17, 98.17, 0, 98.17, dt=0.00333, counts=16), "....",
    ),
    # The board's counts and clock decide, and it may repeat a measurement, or filter its speeds.
    "one count of the board": (
        5, 1500, [line(39.27, board=n == 0, dt=0.01 * (n == 0), counts=16) for n in range(9)],
        "." * 9,
    ),
    "filtered speeds of the board": (5, 1500, lines(16, 9, 6, dt=0.004, board=0, counts=16), "..."),
    "a wheel that rocks": (
        5, 1500,
        [line(39 * sign, board=sign, dt=0.01, counts=16) for sign in (1, 0, -1, 1, -1, 0, 1)],
        "." * 7,
    ),
    "the board is too fast": (5, 1500, lines(39, 39, 39, 39, board=1, counts=16), ".xxF"),
    # Counts that seem to be too many are a wrong `mcu.encoder_counts`.
    "counts that contradict the speeds": (5, 1500, lines(4, 4, 4, 4, board=1, counts=16), "...."),
    # Fine encoders without declared counts: no more than a motor's own changes, as 17 in 10 ms, but
    # up to two counts of 200 above the limit, as a measurement may be repeated.
    "undeclared, a damaged line": (80, 1500, lines(8, 8, 28, 8, step=0.0), "..x."),
    "undeclared, two counts of 200": (10, 1500, lines(13.1, 13.1, 9, 13.2, step=0.0), "...x"),
    "coarse, two counts": (5, 1500, lines(39.27, 39.27, 0, 39.27, step=COARSE), "...x"),
    "unknown, but over the limit": (80, 1500, lines(0, 84.9, 85.1, step=UNKNOWN), "..x"),
    "unknown, from the first line": (80, 1500, lines(99, 99, 99, step=UNKNOWN), "xxF"),
    # One count of 16 in 10 ms is 39.27 rad/s; 39.3 are allowed, because lines have rounded speeds.
    "unknown, one count of 16": (10, 1500, lines(39.27, 4, step=UNKNOWN), ".."),
    "unknown, more than that": (10, 1500, lines(39.31, 4, step=UNKNOWN), "x."),
    # In the time of the line or 4 ms, but not in a line without a time, which adds no motion.
    "without a time": (10, 1500, lines(10, 10.02, dt=0.0, step=UNKNOWN), ".x"),
    "in 4 ms": (10, 1500, lines(98.17, 98.26, dt=1e-6, step=UNKNOWN), ".x"),
    "in 20 ms": (10, 1500, lines(19.63, 19.66, dt=0.02, step=UNKNOWN), ".x"),
    "a stall": (25, 1500, [line(39, dt=0.2, step=COARSE), *lines(39, 0, step=COARSE)], "..."),
    "lost lines do not count": (10, 1500, [line(39, dt=0.05, bridged=0.04, step=UNKNOWN)], "."),
}  # fmt: skip


def verdicts(sanity: Sanity, some: list[Line], fastest: float = 80.0) -> str:
    """Return for each line: `.` possible, `x` impossible, `F` a fault."""
    found = ""
    for each_line in some:
        why = sanity.impossible(each_line, fastest, WHEELS)
        found += "F" if sanity.failed else "x" if why else "."
    return found


@pytest.mark.parametrize("name", ROWS)
def test_lines(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    fastest, acceleration, some, expected = ROWS[name]
    monkeypatch.setattr(module, "MAX_WHEEL_ACCELERATION", acceleration)
    assert verdicts(Sanity(), some, fastest) == expected


@each(("names", "wheel"), [(maps.names, n) for maps in MAPS for n in range(len(maps.names))])
def test_the_reason_names_the_wheel_and_the_setting(names: tuple[str, ...], wheel: int) -> None:
    def alone(speed: float) -> Line:
        """Return a line with the speed of this wheel; of two, the rear ones do as the front."""
        speeds = list(only(wheel, speed).as_tuple())
        if len(names) == 2:
            speeds[3 - wheel] = speed
        return replace(line(speed), speeds=WheelSpeeds(*speeds))

    assert Sanity().impossible(alone(-81.0), 80.0, names).startswith(names[wheel])
    sanity = Sanity()
    assert verdicts(sanity, lines(0, 0)) == ".."
    why = sanity.impossible(alone(60), 80.0, names)
    assert why == f"{names[wheel]} jumps from 0.00 to 60.00 rad/s, which is over 1500 rad/s2"


def test_forgetting_starts_over_but_the_last_line_is_still_compared() -> None:
    sanity = Sanity()
    verdicts(sanity, lines(0, 99, 99, 99))
    sanity.forget()
    assert not sanity.failed
    assert verdicts(sanity, lines(79, 0)) == "x."
    sanity, fast = Sanity(), [ten(95, **TWENTY)] * 4
    assert verdicts(sanity, fast) == "...."
    sanity.forget()
    assert verdicts(sanity, fast) == "...."


@each("number", [1, 2])
def test_one_count_is_never_too_fast_and_two_in_its_time_are(number: int) -> None:
    """A host that catches up after a stall may ask again after 4 ms.

    One count of 16 in this time is then 98 rad/s.
    """
    speed = number * math.tau / 16 / 0.004
    for given in ("board", "proven"):
        fast = line(speed, 0, counts=16, dt=0.004, **{given: number})
        assert verdicts(Sanity(), [fast], 50) == ".x"[number == 2]


@each("counts", [16, 40, 96, 200])
@each("rate", [50, 100])
@each("limit", [4.0, 10.0])
def test_no_wheel_within_its_limit_is_too_fast_before_its_step_is_known(
    counts: int, rate: int, limit: float
) -> None:
    count, angle, before, some = math.tau / counts, 0.0, 0, []
    for number in range(400):
        angle += limit * min(1.0, number / 20) / rate
        now = math.floor(angle / count)
        some.append(line((now - before) * count * rate, 3, step=UNKNOWN, dt=1 / rate))
        before = now
    assert verdicts(Sanity(), some, 1.1 * limit) == "." * 400


def warnings(sanity: Sanity, bad: int) -> list[Event]:
    """Return the warnings after a window of 1000 lines whose first `bad` ones are impossible."""
    found = []
    for i in range(1000):
        sanity.impossible(ten(200.0 if i < bad else 10.0), 80.0, WHEELS)
        found.append(sanity.warning)
    assert all(warning is None for warning in found[:10])
    return [warning for warning in found if warning is not None]


def test_more_than_one_line_in_a_hundred_is_one_warning() -> None:
    sanity = Sanity()
    assert [len(warnings(sanity, bad)) for bad in (10, 11, 10, 511)] == [0, 1, 0, 1]
    (event,) = warnings(sanity, 1000)
    assert (event.name, event.level) == ("lines_implausible", "warning")
    assert event.text.startswith("11 of 11 lines")
    assert "front_right at 200.00 rad/s is over feedback.wheel_speed" in event.text
