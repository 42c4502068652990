"""Counts what the TLS gateway reports about itself, for the counters in `state`."""

from __future__ import annotations

from collections.abc import MutableMapping

from acsard.incoming.commands import Arrival
from acsard.messages.encodings import DecodeError, Decoder
from acsard.messages.schema import DoorState

KEY = "door"

_decoder = Decoder(DoorState)


class DoorTold:
    """Follower of the TLS gateway's reports, also across restarts of the gateway."""

    def __init__(self) -> None:
        self._last = DoorState(0, 0, 0)

    def hear(self, arrival: Arrival, counters: MutableMapping[str, int]) -> int | None:
        """Count the news in a report.

        Return the wall time at which the certificate ends, if it is known.
        """
        try:
            told = _decoder.decode(arrival.encoding, arrival.payload)
        except DecodeError:
            return None  # only local programs may write on this key, so a bad report is ignored
        last = self._last
        if told.opened != last.opened:
            counters["door_opened"] += 1
            last = DoorState(told.opened, 0, 0)
        if told.crowded > last.crowded:
            counters["door_crowded"] += told.crowded - last.crowded
        self._last = told
        return told.certificate_ends or None
