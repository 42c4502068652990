"""Counters of the TLS gateway in `state` are right for any input.

The gateway, or an impostor, may publish anything.
"""

from __future__ import annotations

from collections import Counter

import pytest

from acsard.incoming.commands import Arrival
from acsard.incoming.door import KEY, DoorTold
from acsard.messages.encodings import encode, encoding_name
from acsard.messages.schema import DoorState


def arrival(payload: bytes, encoding: str = "") -> Arrival:
    return Arrival(KEY, True, payload, encoding, 0, None, "")


class Daemon:
    """The daemon's record of the gateway's reports."""

    def __init__(self) -> None:
        self.told, self.counters = DoorTold(), Counter[str]()

    def hears(self, state: DoorState) -> int | None:
        heard = arrival(encode(state, "msgpack"), encoding_name("msgpack", "DoorState"))
        return self.told.hear(heard, self.counters)


def test_each_opening_and_each_look_at_a_crowd_counts_once() -> None:
    daemon = Daemon()
    for opened, crowded in ((7, 0), (7, 3), (7, 3), (7, 4), (9, 0), (9, 2)):
        daemon.hears(DoorState(opened, 255, crowded))
    assert daemon.counters == {"door_opened": 2, "door_crowded": 6}


def test_a_crowd_that_was_there_before_the_daemon_counts_whole() -> None:
    daemon = Daemon()
    daemon.hears(DoorState(7, 255, 40))
    assert daemon.counters == {"door_opened": 1, "door_crowded": 40}


def test_it_tells_when_the_certificate_ends_if_it_knows() -> None:
    daemon = Daemon()
    assert daemon.hears(DoorState(7, 0, 0, 1_800_000_000_000_000_000)) == 1_800_000_000_000_000_000
    assert daemon.hears(DoorState(7, 0, 0)) is None


@pytest.mark.parametrize(
    "payload",
    [
        b"",
        b"\xff",
        b"{}",
        b'{"opened": "now"}',
        b"[]",
        b'{"opened": -1, "connections": 0, "crowded": 0}',
        b'{"opened": 1, "connections": 0, "crowded": 1' + b"0" * 30 + b"}",
        b'{"opened": 1, "connections": 0, "crowded": 0, "certificate_ends": 1' + b"0" * 400 + b"}",
    ],
)
def test_what_cannot_be_read_counts_nothing(payload: bytes) -> None:
    counters = Counter[str]()
    assert DoorTold().hear(arrival(payload), counters) is None
    assert not counters
