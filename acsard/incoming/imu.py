"""A sample on `imu` -> what the gyro says about base_link's z, or the reason it is refused.

A sensor_msgs/Imu in any encoding; of JSON and msgpack only `angular_velocity` is required. Its z
points up: a turn to the left is positive. Of several that send the first is followed, and another
one once that is silent: two gyros have two biases, so that its first sample is marked.
"""

from __future__ import annotations

import math
from collections.abc import MutableMapping

from msgspec import Struct
from msgspec.structs import replace

from acsard.incoming.commands import MAX_COMMAND_BYTES, Arrival, sender
from acsard.messages.encodings import DecodeError, Decoder, decode_cdr, detect
from acsard.messages.schema import Covariance3, Header, Imu, Quaternion, Vector3
from acsard.messages.signature import public_name
from acsard.values import NS_PER_S, Event, GyroSample

MAX_RATE = 50.0
"""rad/s; no base turns so fast, and no gyro on one measures it."""

FOLLOWED_NS = NS_PER_S // 2
"""How long who was heard last is waited for."""

OWN = "gyro of the simulator/own"
"""The sender id with which the simulator signs the samples of its gyro."""

MOST_WHO = 64
"""Characters of a sender's name that are told."""

UNTOLD = [0.0] * 9


class _Reading(Struct, frozen=True, kw_only=True, forbid_unknown_fields=True):
    """An Imu of which only the turn rate must be there."""

    header: Header = Header()
    orientation: Quaternion = Quaternion()
    orientation_covariance: Covariance3 = []
    angular_velocity: Vector3
    angular_velocity_covariance: Covariance3 = []
    linear_acceleration: Vector3 = Vector3()
    linear_acceleration_covariance: Covariance3 = []


_readings = Decoder(_Reading)


class ImuTold:
    """Follows the gyros on the bus, one at a time."""

    def __init__(self, own: bool = False) -> None:
        """`own`: the robot is the simulated one, which has a gyro and follows no other."""
        self._own = own
        self._followed = public_name(OWN) if own else ""
        self._heard_ns = -FOLLOWED_NS

    def hear(
        self, arrival: Arrival, counters: MutableMapping[str, int], events: list[Event]
    ) -> GyroSample | None:
        """The sample; None for one that is refused, which is counted and told by its reason."""
        try:
            sample = reading(arrival)
            anew = self._follow(sender(arrival), arrival.arrived_ns)
        except DecodeError as error:
            counters[f"imu_{error.reason}"] = counters.get(f"imu_{error.reason}", 0) + 1
            events.append(Event("imu_refused", str(error), "warning", kind=error.reason))
            return None
        return replace(sample, anew=True) if anew else sample

    def _follow(self, who: str, now_ns: int) -> bool:
        """Whether another one was followed until now."""
        other = who != self._followed
        if other and (self._own or now_ns - self._heard_ns < FOLLOWED_NS):
            raise DecodeError("second_sender", f"{who[:MOST_WHO]} sends beside {self._followed}")
        before, self._followed, self._heard_ns = self._followed, who, now_ns
        return other and before != ""


def reading(arrival: Arrival) -> GyroSample:
    """What one sample says; raises `DecodeError`. Orientation and acceleration do not matter."""
    if not arrival.put:
        raise DecodeError("not_a_put", "a DELETE is not a sample")
    if len(arrival.payload) > MAX_COMMAND_BYTES:
        raise DecodeError("too_big", f"{len(arrival.payload)} bytes")
    got: Imu | _Reading
    if detect(arrival.encoding, arrival.payload) == "cdr":
        got = decode_cdr(Imu, arrival.payload)
    else:
        got = _readings.decode(arrival.encoding, arrival.payload)
    rate, variances = got.angular_velocity, got.angular_velocity_covariance or UNTOLD
    said = (rate.x, rate.y, rate.z, variances[8])
    if not all(map(math.isfinite, said)):
        raise DecodeError("not_finite", "NaN or infinity in the angular velocity")
    if variances[0] == -1.0:  # so sensor_msgs/Imu says that it has none
        raise DecodeError("no_rate", "this IMU measures no angular velocity")
    if variances[8] < 0.0:
        raise DecodeError("wrong_shape", f"a variance of {variances[8]:g}")
    if max(map(abs, said[:3])) > MAX_RATE or variances[8] > MAX_RATE**2:
        raise DecodeError("absurd", f"over {MAX_RATE:g} rad/s, or a variance of that squared")
    stamp_ns = got.header.stamp.to_ns()
    return GyroSample(arrival.arrived_ns, stamp_ns if stamp_ns > 0 else None, rate.z, variances[8])
