"""The daemon's inbox accepts or drops messages of real Zenoh sessions. No daemon runs."""

from __future__ import annotations

from functools import partial

import zenoh

from acsard.daemon.bus.inbox import MAX_OPEN_QUERIES, Inbox, Replies
from tests.system.harness import Bus, client_config, free_endpoint, until


class Deaf:
    """A stand-in for the control loop, which the inbox notifies of messages. It does nothing."""

    def command(self) -> None:
        """Ignore the notification of a possible command."""

    def stop(self) -> None:
        """Ignore the notification of a stop."""


def test_a_stop_query_counts_even_if_too_many_queries_are_open_to_answer_it() -> None:
    prefix, endpoint = "acsard/acsar/", free_endpoint()
    # The input is never started, so no query is answered, as with clients that read no reply.
    inbox = Inbox(prefix, Replies(prefix, []), (), Deaf())
    with zenoh.open(client_config(endpoint, "router")) as robot, Bus(endpoint) as bus:
        topics = ("info", "srv/stop")
        queryables = [
            robot.declare_queryable(prefix + t, partial(inbox.on_query, t)) for t in topics
        ]
        asked = [
            bus.session.get(f"{prefix}info", timeout=60.0) for _ in range(MAX_OPEN_QUERIES + 1)
        ]
        # One more query is dropped at once, and so is the stop itself; but the stop counts.
        assert list(bus.session.get(f"{prefix}info", timeout=60.0)) == []
        assert inbox.take(0).arrivals == ()
        assert list(bus.session.get(f"{prefix}srv/stop", timeout=60.0)) == []
        assert [arrival.key for arrival in inbox.take(0).arrivals] == ["stop"]
        del queryables, asked


def test_a_step_takes_at_most_one_query_for_settings() -> None:
    prefix, endpoint = "acsard/acsar/", free_endpoint()
    inbox = Inbox(prefix, Replies(prefix, []), (), Deaf())
    with zenoh.open(client_config(endpoint, "router")) as robot, Bus(endpoint) as bus:
        topics = ("srv/set", "srv/clear")
        queryables = [
            robot.declare_queryable(prefix + t, partial(inbox.on_query, t)) for t in topics
        ]
        asked = [bus.session.get(prefix + t, payload=b"{}", timeout=60.0) for t in topics * 5]
        names: list[str] = []

        def all_here() -> bool:
            batch = [query.topic for query in inbox.take(8).queries]
            assert batch.count("srv/set") <= 1
            names.extend(batch)
            return len(names) == 10

        until(all_here, 5.0, "all of them")
        assert names.count("srv/set") == 5
        del queryables, asked
