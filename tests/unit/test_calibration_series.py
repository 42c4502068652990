"""What is a wrong value, and what are two series, up to the bounds that real sensors need.

Each row of a table is a pair of series on both sides of one bound.
"""

from __future__ import annotations

import numpy as np
import pytest

from acsard.calibration.series import Floats, apart, by_chance, by_turns, in_blocks

each = pytest.mark.parametrize


def jump(to: float, back: float = 2.0, rows: int = 100) -> Floats:
    """Return a steady speed of 2 with one other value, and the value behind it."""
    values = np.full(rows, 2.0)
    values[rows // 2 : rows // 2 + 2] = to, back
    return values


@each(
    ("sound", "wrong"),
    [
        (jump(7.9), jump(8.1)),  # by three times the usual size
        (jump(-3.9), jump(-4.1)),
        (jump(10.0, 3.65), jump(10.0, 3.55)),  # and back by 80 % of the way
        (jump(10.0, 0.35), jump(10.0, 0.45)),
    ],
)
def test_a_single_speed_that_jumps_and_returns_is_wrong(sound: Floats, wrong: Floats) -> None:
    assert not apart(sound).any()
    assert np.flatnonzero(apart(wrong)).tolist() == [len(wrong) // 2]


@each(("short", "bound"), [(0, 1.2), (40, 0.5)])
def test_a_single_position_far_from_the_way_is_wrong(short: int, bound: float) -> None:
    """It is farther than 12 small steps, and than 5 usual ones."""
    steps = np.where(np.arange(100) < short, 0.001, 0.1) * np.resize((1.0, -1.0), 100)
    for off, wrong in ((0.97 * bound, False), (1.03 * bound, True)):
        way = np.cumsum(steps) + 0j
        way[70] += 1j * off
        assert np.flatnonzero(apart(way)).tolist() == [70] * wrong
    way[70] = 9j
    assert apart(way[66:74]).any()
    assert not apart(way[67:74]).any()


BLOCK = 12  # rows of 6 cycles of 2


def blocks(*parts: tuple[int, float, float]) -> Floats:
    """Return parts of (blocks, speed, share by which every second row is less)."""
    made = [np.full(count * BLOCK, speed) for count, speed, _ in parts]
    for values, (_, _, less) in zip(made, parts, strict=True):
        values[::2] *= 1 - less
    return np.concatenate(made)


SLOW = 3, 0.1, 0.0


@each(
    ("one", "two"),
    [
        # A difference of 15 % of the mean from the mean
        (blocks(SLOW, (10, 2.0, 0.25)), blocks(SLOW, (10, 2.0, 0.28))),
        # in more than 30 % of the blocks that move, of which 5 count at least,
        (
            blocks(SLOW, (3, 2.0, 0.5), (7, 2.0, 0.0), (1, 2.0, 0.0)),
            blocks(SLOW, (5, 2.0, 0.5), (7, 2.0, 0.0), (1, 2.0, 0.0)),
        ),
        (blocks(SLOW, (1, 2.0, 0.5), (2, 2.0, 0.0)), blocks(SLOW, (3, 2.0, 0.5), (1, 2.0, 0.0))),
        # if slow speeds do not jump alike: else of 60 % of the usual speed.
        (blocks((10, 2.0, 1.15)), blocks((10, 2.0, 1.3))),
        (blocks((10, 2.0, 0.5)), blocks(SLOW, (10, 2.0, 0.5))),
        (blocks((1, 0.1, 0.0), (10, 2.0, 0.5)), blocks((2, 0.1, 0.0), (10, 2.0, 0.5))),
        # Blocks that hardly move show nothing, and those that stand not even the step.
        (blocks((3, 0.0037, 0.0), (10, 2.0, 0.5)), blocks((3, 0.0043, 0.0), (10, 2.0, 0.5))),
        (
            blocks((3, 0.1, 0.0), (4, 2.0, 0.0), (9, 0.65, 0.5)),
            blocks((3, 0.1, 0.0), (4, 2.0, 0.0), (9, 0.95, 0.5)),
        ),
        (blocks((3, 2.0, 1.5))[:37], blocks((4, 2.0, 1.5))[:39]),
    ],
)
def test_speeds_that_alternate_are_two_series(one: Floats, two: Floats) -> None:
    assert not by_turns(one)
    assert by_turns(two)


def coarse(slow: float, fast: float) -> Floats:
    """Return speeds that jump to and fro by these sizes at slow and at high speed."""
    signs = np.resize((1.0, -1.0), 8 * BLOCK)
    return np.concatenate((0.55 + slow * signs, 2.0 + fast * signs))


def test_a_step_that_is_no_larger_at_high_speed_is_one_of_a_coarse_encoder() -> None:
    assert not by_turns(coarse(0.5, 0.58))
    assert by_turns(coarse(0.5, 0.62))


def test_two_receivers_are_farther_apart_than_the_robot_drives_meanwhile() -> None:
    way = 0.01 * np.arange(200) + 0j
    for off, two in ((0.037, False), (0.043, True)):
        other = way + 1j * off * (np.arange(200) % 2)
        assert by_turns(other) is two
    # A noise that is not the same in each cycle is none.
    rng = np.random.default_rng(1)
    assert not by_turns(way + 0.1j * rng.normal(size=200))


def sides(
    factor: float = 0.5, jumps: int = 60, rows: int = 400, left: float = 2.0, right: float = 3.0,
    others: int = 0, otherwise: float = 0.2, uneven: float = 0.0, rise: float = 0.0, slow: int = 0,
) -> Floats:  # fmt: skip
    """Return two sides whose every fourth row is that of another writer, `jumps` times.

    `others` of these have a factor that is `otherwise` as large. `uneven` is the difference of the
    factors of the sides. Speeds rise by a share around a jump, and the first `slow` jumps are at
    1/20 of the speed.
    """
    at = 4 * np.arange(jumps) + 2
    made = np.array([np.full(rows, left), np.full(rows, right)])
    made[:, : 4 * slow] /= 20
    made[:, at + 1] *= 1 + rise
    made[:, at] *= np.array([[factor], [factor + uneven]])
    made[:, at[:others]] *= otherwise
    return made


@each(
    ("one", "two"),
    [
        (sides(0.87), sides(0.83)),
        (sides(1.13), sides(1.17)),
        (sides(jumps=29), sides(jumps=30)),
        (sides(jumps=36, rows=1002), sides(jumps=38, rows=1002)),  # 4 % of the rows
        (sides(right=2.5), sides(right=2.7)),  # coarse sides jump alike at one speed
        (sides(right=-2.5), sides(right=-2.7)),
        (sides(others=8), sides(others=5)),  # one factor in 90 %
        (sides(others=8, otherwise=1.12), sides(others=8, otherwise=1.08)),
        (sides(others=30, otherwise=3.0), sides(others=30, otherwise=4.0)),  # or its inverse
        (sides(uneven=0.06), sides(uneven=0.04)),
        (sides(rise=0.12), sides(rise=0.08)),  # the rows beside them agree
        (sides(slow=31), sides(slow=29)),
    ],
)
def test_sides_that_jump_by_one_factor_have_two_writers(one: Floats, two: Floats) -> None:
    assert not by_chance(one)
    assert by_chance(two)


STEADY = np.repeat([2.0, 0.0, -1.0, 3.0], 100)


def shares(
    low: float = 0.5, every: int = 10, of: int = 2, noise: float = 0.0, until: int = 400,
    between: float = 0.0, at: float = 0.5,
) -> Floats:  # fmt: skip
    """Return a series that has a lower share of `STEADY` in one of `of` blocks of `every` rows."""
    n = np.arange(len(STEADY))
    share = np.where((n // every % of < 1) & (n < until), low, 1.0)
    share += noise * np.resize((1.0, -1.0), len(n))
    share[(n % 100) < 100 * between] = at + (1 - at) * low
    return np.asarray(share * STEADY)


@each(
    ("one", "two"),
    [
        (shares(0.82), shares(0.78)),  # 20 % apart
        (shares(1.23), shares(1.27)),
        (shares(of=11, every=1), shares(of=9, every=1)),  # in 10 % of the rows
        (shares(every=49, until=390), shares(every=49)),  # and changes 6 times
        (shares(noise=0.045), shares(noise=0.04)),  # of 8 spreads
        (shares(between=0.32), shares(between=0.28)),  # near one of them in 70 %
        (shares(between=0.32, at=0.73), shares(between=0.32, at=0.77)),
    ],
)
def test_a_series_with_two_shares_of_a_steady_one_has_two_writers(one: Floats, two: Floats) -> None:
    assert in_blocks(one, STEADY) is None
    assert in_blocks(-one, STEADY) is None
    levels, mirrored = in_blocks(two, STEADY), in_blocks(-two, STEADY)
    assert levels
    assert mirrored
    assert levels.low < levels.high
    assert (-mirrored.high, -mirrored.low) == pytest.approx((levels.low, levels.high))
    assert levels.changes == mirrored.changes >= 6
    assert 1.0 in (pytest.approx(levels.low, abs=0.05), pytest.approx(levels.high, abs=0.05))


def test_only_rows_count_in_which_the_other_series_is_fast_and_stays() -> None:
    n = np.arange(200)
    for slow, two in ((0.85, False), (0.95, True)):  # 30 % of the usual size
        other = np.where(n < 30, 3.0, slow)
        mixed = np.where((n // 10 % 2 < 1) & (n >= 30), 0.5, 1.0) * other
        assert bool(in_blocks(mixed, other)) is two
    for rise, two in ((0.06, False), (0.04, True)):  # 5 % from row to row
        other = 2.0 * (1 + rise) ** np.minimum(n % 20, 19 - n % 20)
        mixed = np.where((n + 5) // 10 % 2 < 1, 0.5, 1.0) * other
        assert bool(in_blocks(mixed, other)) is two
    for every, two in ((4, False), (3, True)):  # rows from one to the next
        other = np.where(n % every, 0.0, 3.0)
        mixed = np.where(n // every % 10 < 5, 0.5, 1.0) * other
        assert bool(in_blocks(mixed, other)) is two
    for fast, two in ((19, False), (20, True)):
        other = np.where(n < fast, 3.0, 0.0)
        assert bool(in_blocks(np.where(n % 2, 0.5, 1.0) * other, other)) is two
