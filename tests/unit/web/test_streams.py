"""The newest of a key: what was published is not replaced by what was asked for."""

from __future__ import annotations

from collections.abc import Iterator

import pytest
import zenoh

from acsard.web.streams import Stream

KEY = "acsard/acsar/events"


@pytest.fixture(scope="module")
def samples() -> Iterator[list[zenoh.Sample]]:
    """Two of the key, in a session that reaches nobody."""
    config = zenoh.Config()
    config.insert_json5("scouting/multicast/enabled", "false")
    config.insert_json5("listen/endpoints", "[]")
    with zenoh.open(config) as session:
        heard = session.declare_subscriber(KEY)
        for said in (b"1", b"2"):
            session.put(KEY, said, encoding="application/json")
        yield [heard.recv(), heard.recv()]


def test_an_answer_is_there_until_something_is_published(samples: list[zenoh.Sample]) -> None:
    stream = Stream(KEY)
    stream.answered(samples[0])
    assert stream.value()[:2] == (1, b"1")
    stream.take(samples[1])
    assert stream.value()[:2] == (2, b"2")


def test_an_answer_that_was_overtaken_is_left_out(samples: list[zenoh.Sample]) -> None:
    stream = Stream(KEY)
    stream.take(samples[1])
    stream.answered(samples[0])
    assert stream.value()[:2] == (1, b"2")
