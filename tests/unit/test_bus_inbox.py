"""What arrives on the bus is queued, bounded and counted."""

from __future__ import annotations

import threading
from functools import partial
from types import SimpleNamespace
from typing import Any

import pytest
import zenoh

from acsard.core.incoming.commands import Arrival
from acsard.core.incoming.queries import Reply
from acsard.core.messages.keys_and_roles import IMU
from acsard.core.values import BRIDGES
from acsard.daemon.bus.inbox import (
    COMMAND_BUFFER,
    MAX_DISPLACED,
    MAX_OPEN_QUERIES,
    MAX_TOKENS,
    STOP_BUFFER,
    Inbox,
    Replies,
)


class Loop:
    """A stand-in for the control loop that records each reason for a wake-up."""

    def __init__(self) -> None:
        self.woken: list[str] = []

    def command(self) -> None:
        self.woken.append("command")

    def stop(self) -> None:
        self.woken.append("stop")


def arrived(inbox: Inbox, *keys: str) -> None:
    """Let a sample arrive on each of these keys, as a thread of Zenoh does."""
    for key in keys:
        sample: Any = SimpleNamespace(
            key_expr=f"acsard/r7/{key}",
            payload=None,
            encoding="",
            kind=zenoh.SampleKind.PUT,
            timestamp=None,
            attachment=None,
        )
        (partial(inbox.on_stop, "native") if key == "stop" else inbox.on_sample)(sample)


def an_inbox(rate_hz: float = 100.0) -> tuple[Inbox, Loop]:
    loop = Loop()
    return Inbox("acsard/r7/", Replies("acsard/r7/", []), ("app", "nav"), loop, rate_hz), loop


def keys_of(inbox: Inbox) -> list[str]:
    return [arrival.key for arrival in inbox.take(8).arrivals]


def test_a_step_gets_the_stops_first_and_other_samples_in_the_order_of_arrival() -> None:
    inbox, loop = an_inbox()
    arrived(inbox, "cmd/nav", IMU, "cmd/app", "stop", "cmd/nav", "cmd/unlisted")
    # Neither a sample of the gyro nor a command that is repeated soon wakes the loop.
    assert loop.woken == ["command", "command", "stop", "command"]
    assert keys_of(inbox) == ["stop", "cmd/nav", IMU, "cmd/app", "cmd/nav", "cmd/unlisted"]
    assert keys_of(inbox) == []


def command(payload: bytes, at_ns: int, key: str = "cmd/app") -> Arrival:
    return Arrival(key, True, payload, "", at_ns, None, "")


@pytest.mark.parametrize(
    ("after", "wakes"),
    [
        (command(b"1", 50_000_000), False),
        (command(b"2", 50_000_000), True),
        (command(b"1", 101_000_000), True),
        (command(b"1", 50_000_000, "cmd/nav"), True),
        (command(b"1", 50_000_000, "cmd/unlisted"), True),
    ],
)
def test_a_command_repeated_soon_waits_for_the_next_step(after: Arrival, wakes: bool) -> None:
    inbox, loop = an_inbox()
    for arrival in (command(b"1", 0), after):
        inbox._put(inbox._buffer(arrival.key), arrival)
    assert loop.woken == ["command"] * (1 + wakes)
    assert len(inbox.take(8).arrivals) == 2


def test_a_flood_on_a_key_displaces_only_samples_of_that_key_and_is_counted() -> None:
    inbox, _ = an_inbox()
    arrived(inbox, "cmd/nav", "stop", *["cmd/app"] * (COMMAND_BUFFER + 5))
    batch = inbox.take(8)
    assert [arrival.key for arrival in batch.arrivals] == [
        "stop",
        "cmd/nav",
        *["cmd/app"] * COMMAND_BUFFER,
    ]
    assert (batch.overrun, [lost.key for lost in batch.displaced]) == (5, ["cmd/app"])
    arrived(inbox, "cmd/app")
    batch = inbox.take(8)
    assert (batch.overrun, batch.displaced) == (0, ())


def test_the_newest_displaced_command_of_each_sender_is_returned_for_16_senders() -> None:
    inbox, _ = an_inbox()
    senders = [f"session {number % 20}" for number in range(60)] + ["last"] * COMMAND_BUFFER
    for at_ns, sender in enumerate(senders):
        arrival = Arrival("cmd/app", True, b"", "", at_ns, None, sender)
        inbox._put(inbox._buffer("cmd/app"), arrival)
    lost = {arrival.sender: arrival.arrived_ns for arrival in inbox.take(8).displaced}
    assert lost == {f"session {number}": 40 + number for number in range(MAX_DISPLACED)}


@pytest.mark.parametrize(("rate_hz", "room"), [(10.0, 160), (20.0, 80), (100.0, 16), (300.0, 16)])
def test_a_slow_control_rate_has_larger_buffers_so_that_a_lawful_sender_loses_nothing(
    rate_hz: float, room: int
) -> None:
    inbox, _ = an_inbox(rate_hz)
    arrived(inbox, *["cmd/app"] * room)
    assert inbox.take(8).overrun == 0
    arrived(inbox, *["cmd/app"] * (room + 1))
    assert inbox.take(8).overrun == 1


class FakeQuery:
    """A stand-in for a Zenoh query. It records its replies and whether the daemon dropped it."""

    def __init__(self, gone: bool = False, closed: bool = False) -> None:
        self.told: list[str] = []
        self._gone, self._closed = gone, closed

    def reply(self, key: str, payload: bytes, **_: object) -> None:
        if self._gone:
            raise zenoh.ZError("gone")
        self.told.append(f"{key}={payload.decode()}")

    def reply_err(self, payload: bytes, **_: object) -> None:
        self.told.append(f"error={payload.decode()}")

    def drop(self) -> None:
        if self._closed:
            raise zenoh.ZError("closed")
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


def test_each_query_gets_the_replies_to_its_ticket_and_then_its_end() -> None:
    replies, query, other = Replies("acsard/r7/", []), FakeQuery(), FakeQuery()
    first, second = issued(replies, query), issued(replies, other, "acsard/stop")
    replies.send(Reply(first, "odom", b"1", ""))
    replies.send(Reply(second, "srv/stop", b"2", ""))
    replies.send(Reply(first, "tf", b"no", "", ok=False))
    replies.retire(first)
    replies.retire(second)
    ended(replies)
    assert query.told == ["acsard/r7/odom=1", "error=no", "dropped"]
    assert other.told == ["acsard/stop=2", "dropped"]  # a ROS client sent its query on another key


def test_a_query_that_left_or_cannot_be_ended_blocks_no_other_reply() -> None:
    errors: list[BaseException] = []
    replies = Replies("", errors)
    absent, closed, here = FakeQuery(gone=True), FakeQuery(closed=True), FakeQuery()
    tickets = [issued(replies, query) for query in (absent, closed, here)]
    for ticket in (*tickets[:2], 999, tickets[2]):
        replies.send(Reply(ticket, "odom", b"1", ""))
        replies.retire(ticket)
        replies.retire(ticket)
    ended(replies)
    assert (absent.told, closed.told, here.told) == (
        ["dropped"], ["odom=1"], ["odom=1", "dropped"],
    )  # fmt: skip
    assert not errors


def test_the_number_of_tickets_is_limited_until_some_are_retired() -> None:
    replies, queries = Replies("", []), [FakeQuery() for _ in range(2 * MAX_OPEN_QUERIES)]
    tickets = [replies.issue(query, "") for query in queries]  # type: ignore[arg-type]
    open_tickets = [ticket for ticket in tickets if ticket is not None]
    assert len(open_tickets) == MAX_OPEN_QUERIES
    for ticket in open_tickets:
        replies.retire(ticket)
    ended(replies)
    assert all(query.told == ["dropped"] for query in queries[: len(open_tickets)])
    assert replies.issue(queries[-1], "") is not None  # type: ignore[arg-type]


def tokens(inbox: Inbox, kind: Any, *names: str, transport: Any = "rmw") -> None:
    """Let the tokens of publishers for `nav` appear or disappear, as a thread of Zenoh does."""
    for name in names:
        sample: Any = SimpleNamespace(key_expr=name, kind=kind)
        inbox.on_token("nav", transport, sample)


def test_all_bridges_are_one_sender_and_each_change_of_them_counts() -> None:
    inbox, _ = an_inbox()
    put, delete = zenoh.SampleKind.PUT, zenoh.SampleKind.DELETE
    seen = []
    for kind, name in ((put, "one"), (put, "two"), (delete, "one"), (delete, "two")):
        tokens(inbox, kind, name, transport="bridge")
        (news,) = inbox.take(8).announced
        seen.append((news.sender, news.present))
    assert seen == [(BRIDGES, True)] * 3 + [(BRIDGES, False)]


def test_a_flood_of_tokens_never_hides_that_a_publisher_is_gone() -> None:
    inbox, _ = an_inbox()
    tokens(inbox, zenoh.SampleKind.PUT, "bridge", transport="bridge")
    tokens(inbox, zenoh.SampleKind.PUT, *[f"flood {number}" for number in range(2 * MAX_TOKENS)])
    tokens(inbox, zenoh.SampleKind.DELETE, "bridge", transport="bridge")
    news = {each.sender: each.present for each in inbox.take(8).announced}
    assert len(news) == MAX_TOKENS
    assert news[BRIDGES] is False


def test_stops_beyond_the_buffer_leave_one_stop_without_a_name() -> None:
    inbox, _ = an_inbox()
    arrived(inbox, *["stop"] * (STOP_BUFFER + 5))
    stops = inbox.take(8).arrivals
    assert len(stops) == STOP_BUFFER + 1
    assert (stops[-1].key, stops[-1].put, stops[-1].attachment) == ("stop", True, b"")
    arrived(inbox, "stop")
    assert len(inbox.take(8).arrivals) == 1
