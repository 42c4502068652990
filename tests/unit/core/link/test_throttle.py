"""A throttle lets one event through at once and the next one only after a while."""

from __future__ import annotations

from itertools import pairwise

from hypothesis import given
from hypothesis import strategies as st

from acsard.core.link.throttle import Throttle


def test_the_first_goes_at_once_whatever_the_time() -> None:
    assert Throttle().lets(0, 100)
    assert Throttle().lets(-(10**18), 100)


def test_the_next_goes_when_the_wait_is_over_and_not_before() -> None:
    throttle = Throttle()
    assert [throttle.lets(at, 100) for at in (7, 8, 106, 107, 206, 207)] == [
        True, False, False, True, False, True,
    ]  # fmt: skip


def test_who_is_not_let_through_does_not_prolong_the_wait() -> None:
    throttle = Throttle()
    throttle.lets(0, 100)
    assert not throttle.lets(99, 100)
    assert throttle.last_ns == 0
    assert throttle.lets(100, 100)


def test_one_that_did_not_leave_uses_nothing_up() -> None:
    throttle = Throttle()
    assert throttle.lets(0, 100)
    throttle.undo()
    assert throttle.lets(1, 100)
    assert throttle.lets(101, 100)
    throttle.undo()
    assert [throttle.lets(at, 100) for at in (100, 101)] == [False, True]


@given(st.lists(st.integers(0, 50), max_size=60), st.integers(1, 100))
def test_any_two_that_go_are_the_wait_apart(steps: list[int], wait_ns: int) -> None:
    throttle, now_ns, went = Throttle(), 0, []
    for step in steps:
        now_ns += step
        if throttle.lets(now_ns, wait_ns):
            went.append(now_ns)
    assert all(b - a >= wait_ns for a, b in pairwise(went))
