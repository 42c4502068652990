"""The server stores only the newest sample of a key.

An answer to a query never replaces a published sample.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from unittest.mock import Mock

import pytest
import zenoh

from acsard.client.connection import Connection
from acsard.core.values import NS_PER_S
from acsard.host import clock
from acsard.web.streams import Stream, Streams
from tests.system.harness import until

KEY = "acsard/acsar/events"


@pytest.fixture(scope="module")
def session() -> Iterator[zenoh.Session]:
    """Yield a session that reaches no other program."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    with zenoh.open(config) as session:
        yield session


@pytest.fixture(scope="module")
def samples(session: zenoh.Session) -> list[zenoh.Sample]:
    """Return two samples of the key."""
    subscriber = session.declare_subscriber(KEY)
    for payload in (b"1", b"2"):
        session.put(KEY, payload, encoding="application/json")
    return [subscriber.recv(), subscriber.recv()]


def test_an_answer_is_the_value_until_a_message_is_published(samples: list[zenoh.Sample]) -> None:
    stream = Stream()
    stream.answered(samples[0])
    assert stream.value()[:2] == (1, b"1")
    stream.take(samples[1])
    assert stream.value()[:2] == (2, b"2")


def test_an_answer_older_than_a_published_message_is_ignored(samples: list[zenoh.Sample]) -> None:
    stream = Stream()
    stream.take(samples[1])
    stream.answered(samples[0])
    assert stream.value()[:2] == (1, b"2")


def test_the_age_of_a_message_counts_a_suspend(
    samples: list[zenoh.Sample], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The age must include the suspend, in which the monotonic clock stands still."""
    stream = Stream()
    stream.take(samples[0])
    slept_ns = clock.asleep_ns() + 3600 * NS_PER_S
    monkeypatch.setattr(clock, "asleep_ns", lambda: slept_ns)
    assert stream.value()[2] >= 3_600_000.0


def test_an_age_is_never_negative(
    samples: list[zenoh.Sample], monkeypatch: pytest.MonkeyPatch
) -> None:
    """The age comes from several clocks that are read one after the other.

    If the thread waits for a core between two readings, the difference may be negative.
    """
    stream = Stream()
    with monkeypatch.context() as patched:
        slept_ns = clock.asleep_ns() + NS_PER_S
        patched.setattr(clock, "asleep_ns", lambda: slept_ns)
        stream.take(samples[0])
    assert stream.value()[2] == 0.0


def test_a_put_on_a_wildcard_is_not_a_message_of_the_key(session: zenoh.Session) -> None:
    streams, client = Streams(), Connection(session, "acsar", "app")
    stream = streams.follow("events")
    streams.update(client)
    for key, payload in ((KEY, b"1"), ("acsard/**", b"666"), ("acsard/*/*", b"667"), (KEY, b"2")):
        session.put(key, payload, encoding="application/json")
    until(lambda: stream.value()[1] == b"2", 10.0, "it arrives on a Zenoh thread")
    assert stream.number == 2
    streams.leave("events")
    streams.update(client)
    session.put(KEY, b"3", encoding="application/json")
    time.sleep(0.1)
    assert stream.value()[:2] == (2, b"2")


def test_a_key_that_is_left_and_followed_again_keeps_its_subscription() -> None:
    streams, client = Streams(), Mock()
    first = streams.follow("odom")
    streams.update(client)
    streams.leave("odom")
    assert streams.follow("odom") is first
    streams.update(client)
    assert client.listen.call_count == 1
    assert not first.subscription.undeclare.called
