"""A step takes a bounded part of the inbox while another thread keeps adding to it."""

from __future__ import annotations

import threading
from collections import deque
from types import SimpleNamespace
from typing import Any

import zenoh

from acsard.core.incoming.queries import Reply
from acsard.daemon.bus.inbox import ARRIVALS, TICKETS, Replies, most_of, taken_of


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


class Asked:
    """A query without Zenoh. It records its replies and, at the end, that it was dropped."""

    def __init__(self, gone: bool = False) -> None:
        self.told: list[str] = []
        self._gone = gone

    def reply(self, key: str, payload: bytes, **_: object) -> None:
        if self._gone:
            raise zenoh.ZError("gone")
        self.told.append(f"{key}={payload.decode()}")

    def reply_err(self, payload: bytes, **_: object) -> None:
        self.told.append(f"error={payload.decode()}")

    def drop(self) -> None:
        self.told.append("dropped")


SESSION: Any = SimpleNamespace(new_timestamp=lambda: None)


def issued(replies: Replies, query: Any, key: str = "") -> int:
    ticket = replies.issue(query, key)
    assert ticket is not None
    return ticket


def ended(replies: Replies) -> None:
    """Stop the reply thread after it has sent everything."""
    replies.start(SESSION)
    replies.stop()
    for thread in threading.enumerate():
        if thread.name == "replies":
            thread.join(5.0)


def test_each_query_hears_what_was_sent_by_its_ticket_and_then_its_end() -> None:
    replies, one, other = Replies("acsard/r7/"), Asked(), Asked()
    first, second = issued(replies, one), issued(replies, other, "acsard/stop")
    replies.send(Reply(first, "odom", b"1", ""))
    replies.send(Reply(second, "srv/stop", b"2", ""))
    replies.send(Reply(first, "tf", b"no", "", ok=False))
    replies.retire(first)
    replies.retire(second)
    ended(replies)
    assert one.told == ["acsard/r7/odom=1", "error=no", "dropped"]
    assert other.told == ["acsard/stop=2", "dropped"]  # a ROS client sent its query on another key


def test_a_client_that_has_gone_and_a_ticket_that_is_none_hold_nobody() -> None:
    replies, gone, here = Replies(""), Asked(gone=True), Asked()
    first, second = issued(replies, gone), issued(replies, here)
    for ticket in (first, 999, second):
        replies.send(Reply(ticket, "odom", b"1", ""))
        replies.retire(ticket)
        replies.retire(ticket)
    ended(replies)
    assert (gone.told, here.told) == (["dropped"], ["odom=1", "dropped"])


def test_there_is_an_end_to_the_tickets_until_some_are_retired() -> None:
    replies, queries = Replies(""), [Asked() for _ in range(2 * TICKETS)]
    tickets = [replies.issue(query, "") for query in queries]  # type: ignore[arg-type]
    held = [ticket for ticket in tickets if ticket is not None]
    assert TICKETS <= len(held) <= TICKETS + 1
    for ticket in held:
        replies.retire(ticket)
    ended(replies)
    assert all(query.told == ["dropped"] for query in queries[: len(held)])
    assert replies.issue(queries[-1], "") is not None  # type: ignore[arg-type]
