"""Signs the commands of one sender: each has its number and the newest beat of the robot's daemon.

The daemon computes the age of a command from this echo, so a command that a network holds back is
refused, however constant the delay is.
"""

from __future__ import annotations

from typing import Any

import zenoh

from acsard.bus.subscription import direct, encoded, has_exact_key
from acsard.core.messages.encodings import DecodeError, Decoder
from acsard.core.messages.schema import Beat
from acsard.core.messages.signature import Signature
from acsard.core.values import Ns

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


class CommandSigner:
    def __init__(self, sender_id: str) -> None:
        self._id, self._sequence, self._newest_ns = sender_id, 0, 0

    def sign(self, stamp_ns: Ns | None, echo: Beat | None, *, zero: bool = False) -> Signature:
        """Return the signature of the next command, with its sequence number.

        A zero gets a stamp after all others of this sender, so that it is not refused as older,
        even if the sender's clock advances in coarse steps.
        """
        self._sequence += 1
        # The daemon refuses a command whose stamp is older than that of an earlier command. If a
        # sender uses two sources, its commands may be signed in another order than their stamps.
        if stamp_ns is not None:
            if zero:
                stamp_ns = max(stamp_ns, self._newest_ns + 1)
            self._newest_ns = max(stamp_ns, self._newest_ns)
        return Signature(self._id, stamp_ns, self._sequence, echo)
