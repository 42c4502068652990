"""Each wheel's counts, and the step of its speed, are learned from its speeds and then used."""

from __future__ import annotations

import math
import random

import pytest

from acsard.core.link import quantization
from acsard.core.link.quantization import (
    BLOCK,
    FIRST,
    LEARNED_FROM,
    MOST_TOLD,
    OWED_FOR,
    Steps,
    WheelCounter,
)
from acsard.core.link.quantization_step import STEEP, Search
from tests.each import each

PERIOD = 0.01


def reports(counts: int, lines: int, seed: int = 1) -> list[tuple[int, float]]:
    """Return whole counts and the speeds that firmware derives from them.

    The wheel turns randomly.
    """
    dice, quantum, rows, speed, phase = (
        random.Random(seed),
        math.tau / counts / PERIOD,
        [],
        0.0,
        0.0,
    )
    for i in range(lines):
        if i % 100 == 0:
            goal = dice.uniform(-25.0, 25.0)
        speed += max(-0.3, min(0.3, goal - speed))
        before, phase = math.floor(phase), phase + speed / quantum
        whole = math.floor(phase) - before
        rows.append((whole, round(whole * quantum, 2)))
    return rows


def learned(counts: int, lines: int = 2000) -> WheelCounter:
    wheel = WheelCounter()
    for _, speed in reports(counts, lines):
        wheel.learn(speed)
        wheel.go_on()
    return wheel


@each("counts", [16, 20, 96, 400, 1000, 4000])
def test_a_wheel_that_turns_about_shows_its_counts(counts: int) -> None:
    wheel = learned(counts)
    assert wheel.show(PERIOD)
    assert wheel.counts == counts


@pytest.mark.parametrize("counts", [20, 400])
def test_each_speed_is_then_the_angle_of_whole_counts(counts: int) -> None:
    wheel = learned(counts)
    wheel.show(PERIOD)
    for whole, speed in reports(counts, 500, seed=2):
        assert wheel.turned(speed, 0.0137, 0.0) == pytest.approx(
            whole * math.tau / counts, abs=1e-12
        )
    assert wheel.off == 0


def test_a_speed_that_is_none_of_them_counts_as_it_stands_and_as_a_stray() -> None:
    wheel = learned(400)
    wheel.show(PERIOD)
    assert wheel.turned(8.0, 0.01, 0.0) == 0.08
    assert wheel.off == 1


def test_what_nobody_reported_is_added_at_the_speed_of_the_report() -> None:
    wheel = learned(400)
    wheel.show(PERIOD)
    quantum = math.tau / 400 / PERIOD
    assert wheel.turned(round(5 * quantum, 2), 0.03, 0.02) == pytest.approx(
        15 * math.tau / 400, rel=1e-3
    )


def test_a_wheel_whose_counts_are_unknown_turns_by_its_speed() -> None:
    assert WheelCounter().turned(8.0, 0.01, 0.5) == 0.08


def test_what_rounding_cost_until_the_counts_were_known_is_made_good() -> None:
    rows = reports(400, 2000)
    wheel = learned(400, 2000)
    wheel.show(PERIOD)
    exact = sum(whole for whole, _ in rows) * math.tau / 400
    folded = sum(speed for _, speed in rows) * PERIOD
    assert wheel.owed(PERIOD) == pytest.approx(exact - folded, abs=1e-9)
    assert abs(exact - folded) > 1e-5
    assert wheel.owed(PERIOD) == 0.0


def test_what_was_owed_to_another_pose_is_not_made_good() -> None:
    wheel = learned(400)
    wheel.forgive()
    wheel.show(PERIOD)
    assert wheel.owed(PERIOD) == 0.0


def test_what_was_owed_long_ago_is_not_made_good() -> None:
    wheel, speed = WheelCounter(), 12.57  # the exact speed is 12.566
    for _ in range(20 * OWED_FOR):
        wheel.learn(speed)
    for _, varied in reports(400, 2000):
        wheel.learn(varied)
        wheel.go_on()
    wheel.show(PERIOD)
    assert abs(wheel.owed(PERIOD)) <= OWED_FOR * PERIOD * 0.005


def test_of_too_many_different_speeds_nothing_is_owed() -> None:
    wheel = learned(20_000, 2 * MOST_TOLD + 2000)
    assert wheel.owed(PERIOD) == 0.0


def test_a_steady_speed_teaches_nothing() -> None:
    wheel = WheelCounter()
    for _ in range(100 * LEARNED_FROM):
        wheel.learn(9.42)
        wheel.go_on()
    assert wheel.lattice is None


def test_a_stream_without_a_lattice_is_looked_at_less_and_less_often(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    searched: list[int] = []

    class Watched(Search):
        def go_on(self) -> bool:
            searched.append(number)
            return super().go_on()

    monkeypatch.setattr(quantization, "Search", Watched)
    wheel, dice = WheelCounter(), random.Random(1)
    for number in range(30_000):  # noqa: B007
        wheel.learn(round(dice.uniform(0.1, 30.0), 2))
        wheel.go_on()
    assert wheel.lattice is None
    assert sum(line < 5000 for line in searched) > 1000
    assert sum(line >= 20_000 for line in searched) < 0.2 * 10_000


def test_its_quantum_is_its_count_once_that_is_known() -> None:
    wheel = learned(20)
    assert wheel.quantum == 0.0
    wheel.show(PERIOD)
    assert wheel.quantum == pytest.approx(math.tau / 20 / PERIOD)
    assert wheel.quantum > STEEP


def steps_after(speeds: list[float], steps: Steps | None = None) -> Steps:
    steps = steps or Steps()
    for speed in speeds:
        steps.add(speed)
    return steps


def fine_speeds(count: int = 2 * BLOCK) -> list[float]:
    dice = random.Random(1)
    return [round(10 + dice.uniform(-0.2, 0.2) + 0.02 * i, 2) for i in range(count)]


def test_nothing_is_known_until_enough_steps_were_seen() -> None:
    speeds = [0.1 * (i % 2) for i in range(FIRST)]
    steps = steps_after(speeds)
    assert steps.size == math.inf
    steps.add(0.2)
    assert steps.size < 0.3


def test_rest_and_flicker_teach_nothing() -> None:
    steps = steps_after([0.0] * 1000 + [0.01 * (i % 2) for i in range(1000)])
    assert steps.size == math.inf


@pytest.mark.parametrize("counts", [16, 20, 96])
def test_counts_step_by_a_count(counts: int) -> None:
    quantum, dice = math.tau / counts / 0.01, random.Random(2)
    steps = steps_after([quantum * dice.randint(0, 1) for _ in range(6 * BLOCK)])
    assert steps.size == pytest.approx(quantum)


def test_a_fine_encoder_hardly_steps() -> None:
    assert steps_after(fine_speeds()).size < 0.5


@pytest.mark.parametrize("share", [0.3, 0.5, 0.8])
def test_a_filter_behind_coarse_counts_leaves_of_a_step_its_share(share: float) -> None:
    speed, speeds, quantum = 0.0, [], 31.4
    for i in range(400):
        speed += share * ((0.0 if i % 9 else quantum) - speed)
        speeds.append(round(speed, 2))
    assert steps_after([0.0, *speeds]).size > 0.4 * share * quantum


def test_one_damaged_line_does_not_change_the_quantization_step() -> None:
    steps = steps_after(fine_speeds(2 * BLOCK + 8))
    steps_after([40.0, 12.0], steps)
    assert steps.size < 0.5


def test_what_does_not_recur_is_forgotten() -> None:
    steps = steps_after([0.0, 30.0] * BLOCK)
    assert steps.size == 30.0
    steps_after(fine_speeds(3 * BLOCK), steps)
    assert steps.size < 0.5
