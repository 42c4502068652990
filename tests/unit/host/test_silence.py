"""Tests of the duration of a silence, measured only while the listener itself was running."""

from __future__ import annotations

from hypothesis import given
from hypothesis import strategies as st

from acsard.host.child import Silence

S = 10**9
MOST = 3 * S


def test_it_is_too_long_when_it_is_longer() -> None:
    silence = Silence(MOST)
    assert [silence.too_long(False, S // 2) for _ in range(7)] == [False] * 6 + [True]


def test_who_says_something_has_all_the_time_again() -> None:
    silence = Silence(MOST)
    for _ in range(5):
        assert not any(silence.too_long(False, S // 2) for _ in range(6))
        assert not silence.too_long(True, S // 2)


@given(st.lists(st.integers(0, 10**13), max_size=6))
def test_however_long_the_machine_stands_still_that_is_nobodys_silence(stalls: list[int]) -> None:
    silence = Silence(MOST)
    assert not any(silence.too_long(False, stall) for stall in stalls)
