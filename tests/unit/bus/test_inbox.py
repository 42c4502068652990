"""A step takes a bounded part of the inbox while another thread keeps adding to it."""

from __future__ import annotations

from collections import deque

from acsard.bus.inbox import ARRIVALS, most_of, taken_of


class Flooded(deque[int]):
    """A queue that gains one item for each item that is taken out."""

    def popleft(self) -> int:
        first = super().popleft()
        self.append(first + 1)
        return first


def test_a_flood_that_goes_on_gives_a_step_no_more_than_is_held_of_it() -> None:
    held = Flooded(range(5), maxlen=ARRIVALS)
    assert len(taken_of(held, most_of(held))) == ARRIVALS


def test_what_is_taken_is_the_oldest_and_the_rest_stays() -> None:
    held = deque([1, 2, 3])
    assert taken_of(held, 2) == [1, 2]
    assert list(held) == [3]
    assert most_of(held) == 1
