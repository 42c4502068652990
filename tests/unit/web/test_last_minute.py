"""A page that opens receives the states of the last minute.

They are thinned, limited in number, and contain no invented values.
"""

from __future__ import annotations

import msgspec
from msgspec.structs import replace

from acsard.core.messages.schema import (
    BatterySummary,
    Latency,
    RobotState,
    Spread,
    Time,
    Twist,
    Vector3,
)
from acsard.core.values import NS_PER_S
from acsard.web.last_minute import MAX_ROWS, MINUTE_NS, STEP_NS, Minute, Plotted
from tests.each import each

SPREAD = Spread(10, 5.0, 20.0, 80.0)

STATE = RobotState(
    Time(1, 0), "driving", "commanded by app", 1.0, 2.0, 0.5, 0.25, -0.5,
    [1.0, 2.0, 3.0, 4.0], "up", "app", [], "", {},
    latencies={"period_lateness": Latency(SPREAD, SPREAD)},
)  # fmt: skip

WISHED = Twist(Vector3(0.3, 0.0, 0.0), Vector3(0.0, 0.0, -0.6))


def minute_after(seconds: float, look_ns: int = NS_PER_S // 10) -> Minute:
    """Return the stored last minute after the robot has sent states for this time."""
    minute = Minute()
    for at_ns in range(0, int(seconds * NS_PER_S) + 1, look_ns):
        if minute.due(at_ns):
            minute.add(at_ns, replace(STATE, linear=at_ns / NS_PER_S), WISHED)
    return minute


def columns(plotted: Plotted) -> list[list[float | None]]:
    series = msgspec.to_builtins(plotted)
    wheels = series.pop("wheels")
    return [*series.values(), *wheels]


def test_a_row_has_what_each_line_of_the_plots_shows() -> None:
    minute = Minute()
    minute.add(NS_PER_S, replace(STATE, battery=BatterySummary(24.5, 87.0, None, "ok")), WISHED)
    plot = minute.plotted(3 * NS_PER_S)
    assert plot.age == [2000]
    assert (plot.linear, plot.angular) == ([0.25], [-0.5])
    assert (plot.wished_linear, plot.wished_angular) == ([0.3], [-0.6])
    assert plot.wheels == [[1.0], [2.0], [3.0], [4.0]]
    assert (plot.late_p99, plot.late_max, plot.volts) == ([0.02], [0.08], [24.5])


def test_the_plots_show_only_the_last_minute_of_a_longer_run() -> None:
    plot = minute_after(150.0).plotted(150 * NS_PER_S)
    assert 0.98 * MINUTE_NS / STEP_NS < len(plot.age) <= MINUTE_NS // STEP_NS + 1
    assert max(plot.age) <= MINUTE_NS // 1_000_000
    assert plot.age == sorted(plot.age, reverse=True)
    assert plot.linear[-1] == 150.0
    assert {len(column) for column in columns(plot)} == {len(plot.age)}


@each("look_ns", [1_000_000, 30_000_000, 90_000_000, 110_000_000])
def test_the_plots_are_bounded_and_cover_a_minute_at_any_sampling_interval(look_ns: int) -> None:
    plot = minute_after(100.0, look_ns).plotted(100 * NS_PER_S)
    assert len(plot.age) <= MAX_ROWS
    assert max(plot.age) > 0.98 * MINUTE_NS / 1_000_000


def test_an_unknown_value_is_null() -> None:
    minute = Minute()
    unknown = replace(STATE, linear=None, angular=None, wheels=[], latencies={})
    minute.add(0, unknown, None)
    plot = minute.plotted(1)
    assert plot.age == [0]
    assert {value for column in columns(plot)[1:] for value in column} == {None}


def test_before_the_first_state_the_plots_are_empty() -> None:
    assert {len(column) for column in columns(Minute().plotted(NS_PER_S))} == {0}


def test_without_new_states_the_plots_become_empty_within_a_minute() -> None:
    minute = minute_after(10.0)
    assert 0 < len(minute.plotted(65 * NS_PER_S).age) < len(minute.plotted(10 * NS_PER_S).age)
    assert minute.plotted(71 * NS_PER_S).age == []


def test_a_whole_minute_is_less_than_32_kib_of_json() -> None:
    """Values have at most three decimals, so that the page opens fast on a phone."""
    minute = Minute()
    for n in range(1000):
        if minute.due(n * STEP_NS):
            minute.add(n * STEP_NS, replace(STATE, linear=n / 7, angular=-n / 7), WISHED)
    assert len(msgspec.json.encode(minute.plotted(1000 * STEP_NS))) < 32768
