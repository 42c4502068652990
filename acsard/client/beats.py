"""The beats of a robot's daemon, of which each command of this program echoes the newest.

The daemon computes the age of a command from the echo, so a command that a network holds back is
refused, however constant the delay is.
"""

from __future__ import annotations

from typing import Any

import zenoh

from acsard.bus.subscription import direct, encoded, has_exact_key
from acsard.core.messages.encodings import DecodeError, Decoder
from acsard.core.messages.schema import Beat

_decoder = Decoder(Beat)


class Beats:
    """The subscription to the beats of one robot, which begins when the first one is asked for."""

    def __init__(self, session: zenoh.Session, key: str) -> None:
        self._session, self._key = session, key
        self._subscriber: Any = None
        self._newest: Beat | None = None

    def newest(self) -> Beat | None:
        """Return the beat that arrived last, or None before the first one."""
        if self._subscriber is None:
            self._subscriber = self._session.declare_subscriber(self._key, direct(self._take))
        return self._newest

    def _take(self, sample: zenoh.Sample) -> None:
        if not has_exact_key(self._key, sample):
            return
        try:
            self._newest = _decoder.decode(*encoded(sample))
        except DecodeError:
            pass  # of another version: the daemon would refuse its echo
