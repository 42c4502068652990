"""Decodes samples on the key `imu` into turn rates about the z axis of base_link, or refuses them.

A sample is a sensor_msgs/Imu, of which JSON and msgpack need only `angular_velocity`. z points up,
so left is positive. Only one gyro is used: one sender, and one frame, because programs without a
name look alike. After its silence another one may be, whose first sample is marked
(`GyroSample.anew`), so that the bias of the old one is forgotten.
"""

from __future__ import annotations

import math
from collections.abc import MutableMapping

from msgspec.structs import replace

from acsard.core.incoming.commands import Arrival, claimed_identity
from acsard.core.messages.encodings import DecodeError, StrictDecoder
from acsard.core.messages.refusals import MAX_COMMAND_BYTES
from acsard.core.messages.schema import Imu
from acsard.core.messages.signature import public_name
from acsard.core.values import NS_PER_S, Event, GyroSample, Ns

MAX_RATE = 50.0  # rad/s; no robot turns that fast

SILENCE_TIMEOUT_NS = NS_PER_S // 2  # of the gyro in use, after which another one may be used

SIMULATOR_SENDER = "gyro of the simulator/own"  # of the built-in simulator's gyro

MAX_NAME_LENGTH = 64  # characters of a sender's name in a text

_decoder = StrictDecoder(Imu)


class GyroFollower:
    """Decodes the samples of one gyro; while it sends, those of others are refused."""

    def __init__(self, own: bool = False) -> None:
        # `own`: accept only the gyro of this daemon's simulator.
        self._own = own
        self._followed: tuple[str | None, str] | None = None
        if own:
            self._followed = (public_name(SIMULATOR_SENDER), "")
        self._heard_ns = -SILENCE_TIMEOUT_NS

    def receive(
        self, arrival: Arrival, counters: MutableMapping[str, int], events: list[Event]
    ) -> GyroSample | None:
        """Return the turn rate in a sample, or None if it is refused, which is counted."""
        try:
            sample, frame = reading(arrival)
            sender = claimed_identity(arrival).sender
            changed = self._follow((sender, "" if self._own else frame), arrival.arrived_ns)
        except DecodeError as error:
            counters[f"imu_{error.reason}"] = counters.get(f"imu_{error.reason}", 0) + 1
            why = str(error)
            events.append(
                Event("imu_refused", why, "warning", kind=error.reason, code=error.reason)
            )
            return None
        return replace(sample, anew=True) if changed else sample

    def _follow(self, gyro: tuple[str | None, str], now_ns: Ns) -> bool:
        # True: another gyro was used before. Raises `DecodeError` while another gyro sends.
        before, other = self._followed, gyro != self._followed
        heard = self._own or now_ns - self._heard_ns < SILENCE_TIMEOUT_NS
        if before is not None and other and heard:
            raise DecodeError(
                "second_sender",
                f"{_named(*gyro)} sends gyro samples, but the daemon already uses those of "
                f"{_named(*before)}: end one of the two programs",
            )
        self._followed, self._heard_ns = gyro, now_ns
        return other and before is not None


def _named(sender: str | None, frame: str) -> str:
    # The name of a sender without an id is "", or its key, which is the same for all.
    nameless = not sender or sender.endswith("/")
    name = "a sender without a name" if nameless else str(sender)[:MAX_NAME_LENGTH]
    return f"{name} (frame {frame[:MAX_NAME_LENGTH]})" if frame else name


def reading(arrival: Arrival) -> tuple[GyroSample, str]:
    """Return the turn rate in a sample, and its frame. Raises `DecodeError`."""
    if not arrival.put:
        raise DecodeError("not_a_put", "a DELETE is not a sample: send a PUT")
    if len(arrival.payload) > MAX_COMMAND_BYTES:
        raise DecodeError("too_big", f"{len(arrival.payload)} bytes are too many for an Imu")
    message = _decoder.decode(arrival.encoding, arrival.payload)
    rate, variances = message.angular_velocity, message.angular_velocity_covariance
    numbers = (rate.x, rate.y, rate.z, variances[8])
    if not all(map(math.isfinite, numbers)):
        raise DecodeError("not_finite", "the angular velocity contains NaN or infinity")
    # sensor_msgs/Imu marks an absent measurement by -1 in the first variance.
    if variances[0] == -1.0:
        raise DecodeError("no_rate", "this IMU does not measure the angular velocity")
    if variances[8] < 0.0:
        raise DecodeError(
            "wrong_shape", f"the variance of the turn rate is below zero: {variances[8]:g}"
        )
    if max(map(abs, numbers[:3])) > MAX_RATE or variances[8] > MAX_RATE**2:
        raise DecodeError(
            "out_of_range",
            f"the turn rate is over {MAX_RATE:g} rad/s, or its variance is over the square of "
            "this limit: send the turn rate in rad/s",
        )
    stamp_ns = message.header.stamp.to_ns()
    sampled_ns = stamp_ns if stamp_ns > 0 else None
    sample = GyroSample(arrival.arrived_ns, sampled_ns, rate.z, variances[8])
    return sample, message.header.frame_id
