"""Decodes the speed limits (nav2_msgs/SpeedLimit) that arrive on the key `speed_limit`."""

from __future__ import annotations

import math

from acsard.core.incoming.commands import Arrival, caller_name
from acsard.core.messages.encodings import DecodeError, StrictDecoder
from acsard.core.messages.keys_and_roles import SPEED_LIMIT
from acsard.core.messages.refusals import MAX_COMMAND_BYTES
from acsard.core.messages.schema import SpeedLimit
from acsard.core.values import SpeedCap

NO_LIMIT_VALUE = 0.0  # of nav2_msgs/SpeedLimit, in m/s and in %


_decoder = StrictDecoder(SpeedLimit)


def decode_limit(arrival: Arrival, configured: float) -> SpeedCap:
    """Return the speed limit in a sample; % are of `configured`, m/s. Raises `DecodeError`."""
    if not arrival.put:
        raise DecodeError("not_a_put", "a DELETE is not a speed limit: send a PUT")
    if len(arrival.payload) > MAX_COMMAND_BYTES:
        raise DecodeError("too_big", f"{len(arrival.payload)} bytes are too many for a speed limit")
    message = _decoder.decode(arrival.encoding, arrival.payload)
    value = message.speed_limit
    if not math.isfinite(value):
        raise DecodeError("not_finite", "the speed limit is NaN or infinity; send 0.0 to lift it")
    if value < 0.0 or (message.percentage and value > 100.0):
        unit = " %" if message.percentage else " m/s"
        most = " to 100 %" if message.percentage else " m/s or more"
        raise DecodeError("out_of_range", f"{value:g}{unit}: send 0{most}; 0 lifts the limit")
    by = f"{caller_name(arrival.via, arrival.attachment, arrival.sender)} on the key {SPEED_LIMIT}"
    if value == NO_LIMIT_VALUE:
        return SpeedCap(None, by)
    return SpeedCap(value / 100.0 * configured if message.percentage else value, by)
