"""Encodes the messages of a feedback line from prepared frames: only their numbers change.

A frame is the output of the ordinary encoder for an example, cut at its numbers. One call of
`struct` writes other numbers between the pieces, byte for byte as the encoder would, in a third of
its time. JSON, whose numbers vary in length, is encoded in the ordinary way.
"""

from __future__ import annotations

import math
import struct
from collections.abc import Callable, Sequence

from acsard.core.messages.encodings import Format, encode
from acsard.core.messages.schema import Message
from acsard.core.values import (
    NS_PER_S,
    Estimate,
    Instant,
    Pose,
    PoseCovariance,
    Twist,
    TwistVariances,
    WheelSpeeds,
)

Numbers = tuple[int | float, ...]  # first the stamp, then the others in the order of the message

_ORDERS: dict[Format, str] = {"msgpack": ">", "cdr": "<"}

# msgpack writes a smaller integer in fewer bytes, and the field `sec` is an int32.
_MIN_UINT32, _MAX_SEC = 1 << 16, (1 << 31) - 1


class Frame:
    """The bytes of a message, between which numbers of a fixed size change."""

    def __init__(self, example: bytes, numbers: Numbers, order: str) -> None:
        # `numbers` are those of the example, and `order` is the byte order of `struct`.
        layout, at = order, 0
        self._pieces: list[bytes | int | float] = []
        for number in numbers:
            code = "I" if isinstance(number, int) else "d"
            raw = struct.pack(order + code, number)
            start = example.index(raw, at)
            layout += f"{start - at}s{code}"
            self._pieces += [example[at:start], number]
            at = start + len(raw)
        self._pieces.append(example[at:])
        self._pack = struct.Struct(f"{layout}{len(example) - at}s").pack

    def fill(self, numbers: Sequence[int | float]) -> bytes:
        pieces = self._pieces.copy()  # another thread may be filling the same frame
        pieces[1::2] = numbers
        return self._pack(*pieces)


class FeedbackTopic:
    """A topic with a message for each feedback line, such as `odom`."""

    def __init__(
        self,
        key: str,
        build: Callable[[Estimate], Message],
        numbers: Callable[[Estimate], Numbers],
    ) -> None:
        # `numbers` returns all numbers of the message that `build` returns.
        self.key, self.build, self._numbers = key, build, numbers
        self._frames: dict[Format, Frame] = {}  # of the encodings that had a subscriber

    def encode(self, estimate: Estimate, form: Format) -> bytes:
        numbers, frame = self._numbers(estimate), self._frames.get(form)
        if not (_MIN_UINT32 <= numbers[0] <= _MAX_SEC and numbers[1] >= _MIN_UINT32):
            return encode(self.build(estimate), form)
        if frame is None:
            order = _ORDERS.get(form)
            if order is None:
                return encode(self.build(estimate), form)
            example = encode(self.build(EXAMPLE), form)
            frame = self._frames[form] = Frame(example, self._numbers(EXAMPLE), order)
        return frame.fill(numbers)


# Its numbers occur nowhere else in a message.
EXAMPLE = Estimate(
    Instant(0, 1_555_555_555_987_654_321),
    Pose(1.1e101, 1.2e101, 1.3),
    Twist(1.4e101, 1.5e101),
    PoseCovariance(2.1e101, 2.2e101, 2.3e101, 2.4e101, 2.5e101, 2.6e101),
    TwistVariances(3.1e101, 3.2e101, 3.3e101),
    (4.1e101, 4.2e101, 4.3e101, 4.4e101),
    WheelSpeeds(5.1e101, 5.2e101, 5.3e101, 5.4e101),
)


def odom_numbers(estimate: Estimate) -> Numbers:
    pose, cov, twist, var = (
        estimate.pose,
        estimate.covariance,
        estimate.twist,
        estimate.twist_variances,
    )
    sec, nanosec = divmod(estimate.at.wall_ns, NS_PER_S)
    half = pose.yaw / 2
    # fmt: off
    return (
        sec, nanosec, pose.x, pose.y, math.sin(half), math.cos(half),
        cov.xx, cov.xy, cov.xyaw, cov.xy, cov.yy, cov.yyaw, cov.xyaw, cov.yyaw, cov.yawyaw,
        twist.linear, twist.angular, var.linear, var.lateral, var.angular,
    )
    # fmt: on


def tf_numbers(estimate: Estimate) -> Numbers:
    pose = estimate.pose
    sec, nanosec = divmod(estimate.at.wall_ns, NS_PER_S)
    half = pose.yaw / 2
    return (sec, nanosec, pose.x, pose.y, math.sin(half), math.cos(half))


def wheel_states_numbers(wheels: int, estimate: Estimate) -> Numbers:
    angles, speeds = estimate.positions[:wheels], estimate.speeds.as_tuple()[:wheels]
    sec, nanosec = divmod(estimate.at.wall_ns, NS_PER_S)
    return (sec, nanosec, *angles, *speeds)
