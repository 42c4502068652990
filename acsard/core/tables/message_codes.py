"""The codes of refused messages of clients."""

from __future__ import annotations

from typing import Literal

from acsard.core.tables.finding_table import table

ObjectionCode = Literal["unknown_source", "not_finite", "too_many_senders"]

MessageCode = Literal[
    ObjectionCode, "malformed", "wrong_shape", "wrong_wheels", "unknown_encoding", "too_big",
    "not_a_put", "wildcard", "displaced", "other_certificate", "second_sender", "no_rate",
    "out_of_range", "no_attachment", "bad_attachment", "bad_echo", "unknown_format",
]  # fmt: skip

MESSAGES = table(
    MessageCode,
    """
WARN unknown_source
    this source is not in commands.sources
WARN not_finite
    the command contains NaN or infinity
WARN too_many_senders
    {seconds:g} other senders of this source are active
    -> end one first
WARN malformed
    the payload is not valid JSON, msgpack or CDR
WARN wrong_shape
    the payload is not a message of the type of its key
WARN wrong_wheels
    the message does not have one velocity for each wheel
WARN unknown_encoding
    the payload is not a JSON object, a msgpack map or CDR
WARN unknown_format
    the message has no form in the requested format
WARN too_big
    the payload is too long
WARN not_a_put
    the message is a DELETE
    -> send a PUT
WARN wildcard
    a command came on a key with a wildcard
WARN displaced
    messages came too fast, so older ones were dropped
WARN other_certificate
    another certificate already uses this sender id
WARN second_sender
    the daemon already uses the gyro of another sender
WARN no_rate
    the IMU does not measure the angular velocity
WARN out_of_range
    the turn rate or its variance is out of range
WARN no_attachment
    a ROS message has no attachment
WARN bad_attachment
    a ROS message has a damaged attachment
WARN bad_echo
    the echo in the attachment is not a beat, or there is no sequence beside it
    -> copy the newest message of the key beat into the field `echo`, and number the commands in
    `sequence`
""",
)
