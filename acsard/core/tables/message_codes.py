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
    -> write one of these sources into the key or topic, or add this one to commands.sources
WARN not_finite
    the command contains NaN or infinity
    -> look in the program for a division by zero or a value that is not set yet
WARN too_many_senders
    {seconds:g} other senders of this source are active
    -> end one first
WARN malformed
    the payload is not valid JSON, msgpack or CDR
    -> encode the message with a library for JSON, msgpack or CDR, and send it whole
WARN wrong_shape
    the payload is not a message of the type of its key
    -> compare it with the type of its key (`acsard topics`, page reference/messages of the manual)
WARN wrong_wheels
    the message does not have one velocity for each wheel
    -> send one velocity for each wheel of mcu.wheels, in the order of the key wheel_states
WARN unknown_encoding
    the payload is not a JSON object, a msgpack map or CDR
    -> send a JSON object, a msgpack map or CDR, and name it as the encoding of the sample
WARN unknown_format
    the message has no form in the requested format
    -> ask for fmt=json or fmt=msgpack; only messages that ROS has are there as fmt=cdr
WARN too_big
    the payload is too long
    -> send only the fields of the type of the key (page reference/messages of the manual)
WARN not_a_put
    the message is a DELETE
    -> send a PUT
WARN wildcard
    a command came on a key with a wildcard
    -> put it on the exact key, such as acsard/ROBOT/cmd/app
WARN displaced
    messages came too fast, so older ones were dropped
    -> send fewer: 20 commands a second are enough
WARN other_certificate
    another certificate already uses this sender id
    -> give each program a sender id of its own, and choose it anew at each start
WARN second_sender
    the daemon already uses the gyro of another sender
    -> end one of the two programs that send gyro samples
WARN no_rate
    the IMU does not measure the angular velocity
    -> let the driver of the IMU publish angular_velocity; -1 in the first element of its covariance
    says that there is none
WARN out_of_range
    the turn rate or its variance is out of range
    -> send the turn rate in rad/s, and its variance in (rad/s)^2
WARN no_attachment
    a ROS message has no attachment
    -> send with rmw_zenoh, which adds one to each message, or over the bridge (page howto/ros of
    the manual)
WARN bad_attachment
    a ROS message has a damaged attachment
    -> bring the sender's rmw_zenoh to the version of Jazzy 0.2.4 or later
WARN bad_echo
    the echo in the attachment is not a beat, or there is no sequence beside it
    -> copy the newest message of the key beat into the field `echo`, and number the commands in
    `sequence`
""",
)
