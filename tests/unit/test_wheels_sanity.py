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

UNKNOWN = math.inf
"""The largest change by one count of encoders that are not known yet, rad/s."""


def only(wheel: int, speed: float, others: float = 0.0) -> WheelSpeeds:
    return WheelSpeeds(*(speed if i == wheel else others for i in range(4)))


def line(speed: float, wheel: int = 1, others: float = 0.0, **more: Any) -> Line:
    """Return a line with the speed of one wheel; `step` is that of all encoders.

    3200 counts a turn are declared, unless `count` is 0 or the step unknown.
    """
    speeds, step, dt = only(wheel, speed, others), more.pop("step", 0.0), more.pop("dt", 0.01)
    if more.pop("proven", False):  # the line has whole counts
        more |= {"counted": tuple(dt * each for each in speeds.as_tuple()), "count": step * dt}
    count = more.pop("count", 0.0 if step == UNKNOWN else math.tau / 3200)
    return Line(Instant(0, 0), speeds, dt, count=count, step=step, **more)


def lines(*speeds: float, **more: Any) -> list[Line]:
    return [line(speed, **more) for speed in speeds]


def ten(speed: float, **more: Any) -> Line:
    return line(speed, others=speed, **more)


GAP: dict[str, Any] = {"dt": 0.0, "gap": 0.5}
COARSE: dict[str, Any] = {"step": 6.54}
FINE: dict[str, Any] = {"step": 0.2}
Row = tuple[float, float, list[Line], str]
ROWS: dict[str, Row] = {
    # The limit of the speed; the limit of a change is 100 rad/s2 x 10 ms and 2 rad/s.
    "three in a row": (80, 1e9, lines(99, 99, 0, 99, 99, 99), "xx.xxF"),
    "three at the start": (80, 1e9, lines(99, 99, 99), "xxF"),
    "the most a wheel can do": (80, 100, lines(0, 3.0, 0, -3.01), "...x"),
    "a change": (80, 100, lines(0, 3.5, 2.9), ".x."),
    "a real step in time": (80, 400, [line(0), *[ten(10)] * 3], ".x.."),
    "the first line, and a gap": (80, 10, [ten(10, dt=0.0), ten(0, **GAP)], ".."),
    # The board repeats the mean of a pause.
    "a pause": (
        80, 100, [ten(10), ten(10, dt=0.25), ten(10), ten(10), *[ten(0)] * 26, ten(10)],
        "." * 30 + "x",
    ),
    "a damaged first line": (80, 1500, lines(79, 0, 0, 0), ".x.."),
    "a speed that no wheel reaches": (80, 1500, lines(79, 80.1, 80.1, 80.1), ".xxF"),
    "a jump from what two lines agreed on": (80, 1500, lines(0, 0, 79, 79, 79), "..xxF"),
    "lines that agree with no other": (80, 1500, lines(20, 79, -79, -30), ".xxF"),
    "a damaged line of unknown encoders": (
        80, 1500, [line(0), line(79, step=UNKNOWN), *lines(0, 0, 0, 0)], "..x...",
    ),
    "every second line is damaged": (
        80, 1500, lines(0, 79, 0, -60, 0, 35, 0, -79, 0, 60, 0), ".x.x.x.x.x.",
    ),
    "a gap": (80, 1500, [*lines(0, 0, 79), line(0, **GAP), line(79)], "..x.x"),
    # Coarse encoders: twice 31.4 rad/s more, and one proven count above the speed.
    "a count at each end": (80, 100, lines(0, 65.7, -0.2, step=31.4), "..x"),
    "two fine counts": (80, 100, lines(0, 4.0, step=0.5), ".."),
    "one proven count": (40, 1500, lines(70, 71.5, step=31.4, proven=True), ".x"),
    "the limit and a proven count": (40, 1500, lines(71.25, step=31.25, proven=True), "."),
    "the limit and a coarse count": (
        5, 1500, lines(11.54, 0, 0, -11.54, 0, 0, 11.55, **COARSE), "......x",
    ),
    # Speeds over the limit are summed as angles: one count excuses once, not in every line.
    "lasting speeds": (80, 1500, [ten(95, step=31.4)] * 5, "..xxF"),
    "lasting speeds by counts": (
        80, 1500, [ten(95, count=0.314, counted=(0.942,) * 4)] * 5, "..xxF",
    ),
    "lasting speeds, unknown": (10, 1500, [ten(39, step=UNKNOWN)] * 4, ".xxF"),
    "what slow lines make up for": (80, 1500, lines(95, 95, 50, step=31.4) * 5, "." * 15),
    "what they do not": (
        80, 1500, lines(95, 79.9, 95, 79.9, 95, 95, 79, 95, step=31.4), "....xx.x",
    ),
    "an impossible line adds nothing": (80, 1500, lines(95, 99.99, 70, 94, step=20), ".x.."),
    "nor does a jump": (20, 500, lines(30, -30, 24, step=20), ".x."),
    "its time counts in the next line": (20, 500, lines(30, -30, 27, step=20), ".xx"),
    "a repeated line": (
        80, 1500, [ten(95, count=0.314, counted=(0.942 * (i % 2),) * 4) for i in range(5)],
        "..xxF",
    ),
    "the sum ends at a gap": (
        80, 1500, [ten(95, step=31.4), ten(95, step=31.4), ten(95, **GAP, step=31.4)], "...",
    ),
    "no step above one count of 16": (20, 1500, [ten(70, step=60)], "x"),
    "damage before fast lines": (
        20, 1500, lines(70, 21, 21, 21, 10.5, 10.5, step=10.5) * 10, "x....." * 10,
    ),
    "a fine step delays no fault": (5, 1500, lines(5.3, 5.3, 5.3, **FINE), "xxF"),
    # A board that is asked 300 times a second counts for 4 to 8 ms, as the simulated one does. A
    # wheel whose every count is dropped would run on unseen.
    "one count of 16 in 4 ms": (
        80, 1500, lines(98.17, 98.17, 0, 98.17, dt=0.00333, step=98.17), "....",
    ),
    # Fine encoders without declared counts: no more than a motor's own changes, as 17 in 10 ms, but
    # up to one count of 200 above the limit.
    "undeclared, a damaged line": (80, 1500, lines(8, 8, 28, 8, count=0.0), "..x."),
    "undeclared, one count of 200": (10, 1500, lines(13.1, 9, 13.2, count=0.0), "..x"),
    "unknown, but over the limit": (80, 1500, lines(0, 84.9, 85.1, step=UNKNOWN), "..x"),
    "unknown, from the first line": (80, 1500, lines(99, 99, 99, step=UNKNOWN), "xxF"),
    # One count of 16 in 10 ms is 39.27 rad/s; 39.3 are allowed, because lines have rounded speeds.
    "unknown, one count of 16": (10, 1500, lines(39.27, 4, step=UNKNOWN), ".."),
    "unknown, more than that": (10, 1500, lines(39.31, 4, step=UNKNOWN), "x."),
    # In the time of the line or 4 ms, but not in a line without a time, which adds no motion.
    "without a time": (10, 1500, lines(10, 10.02, dt=0.0, step=UNKNOWN), ".x"),
    "in 4 ms": (10, 1500, lines(98.17, 98.26, dt=1e-6, step=UNKNOWN), ".x"),
    "in 20 ms": (10, 1500, lines(19.63, 19.66, dt=0.02, step=UNKNOWN), ".x"),
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

    assert Sanity().impossible(alone(-80.01), 80.0, names).startswith(names[wheel])
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
    sanity, fast = Sanity(), [ten(95, step=31.4)] * 2
    assert verdicts(sanity, fast) == ".."
    sanity.forget()
    assert verdicts(sanity, fast) == ".."


@each("number", [1, 2])
def test_one_count_is_never_too_fast_and_two_in_its_time_are(number: int) -> None:
    """A host that catches up after a stall may ask again after 4 ms.

    One count of 16 in this time is then 98 rad/s.
    """
    count = math.tau / 16
    turned = (number * count, 0.0, 0.0, 0.0)
    for given in ("turned", "counted"):
        more: dict[str, Any] = {given: turned}
        fast = line(number * count / 0.004, 0, count=count, **more)
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
