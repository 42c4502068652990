"""What the door to the network says of itself -> what `state` counts of it."""

from __future__ import annotations

from collections.abc import MutableMapping

from acsard.incoming.commands import Arrival
from acsard.messages.encodings import DecodeError, Decoder
from acsard.messages.schema import DoorState

KEY = "door"

_decoder = Decoder(DoorState)


class DoorTold:
    """Follows one door after the other."""

    def __init__(self) -> None:
        self._last = DoorState(0, 0, 0)

    def hear(self, arrival: Arrival, counters: MutableMapping[str, int]) -> int | None:
        """Count what is new in it; when the certificate ends, if it tells."""
        try:
            told = _decoder.decode(arrival.encoding, arrival.payload)
        except DecodeError:
            return None  # only who is at the machine may write here: not worth more
        last = self._last
        if told.opened != last.opened:
            counters["door_opened"] += 1
            last = DoorState(told.opened, 0, 0)
        if told.crowded > last.crowded:
            counters["door_crowded"] += told.crowded - last.crowded
        self._last = told
        return told.certificate_ends or None
