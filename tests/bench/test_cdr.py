"""Compare the time of acsard's CDR encoding with the time of the library rosbags.

    pytest -s tests/bench/test_cdr.py

Both are measured in the same run, because the speed of the machine differs between runs.
"""

from __future__ import annotations

from collections.abc import Callable
from statistics import median
from time import perf_counter_ns

import pytest

from acsard.core.messages.cdr import Cdr
from acsard.core.messages.schema import Message, Odometry
from tests.unit.core.messages.test_cdr import (
    ROS_NAMES,
    STORE,
    built,
    odometry,
    oracle_bytes,
    samples,
)

ROUNDS, CALLS = 41, 200


def side_by_side(
    ours: Callable[[], object], theirs: Callable[[], object]
) -> tuple[float, float, float]:
    """Return the median time of each function in us, and the median of the ratios theirs / ours.

    Each round calls both functions, so that a disturbance of the machine slows both.
    """

    def one(call: Callable[[], object]) -> float:
        began = perf_counter_ns()
        for _ in range(CALLS):
            call()
        return (perf_counter_ns() - began) / CALLS / 1000

    one(ours), one(theirs)  # for everything that is built on first use
    rounds = [(one(ours), one(theirs)) for _ in range(ROUNDS)]
    return (
        median(mine for mine, _ in rounds),
        median(other for _, other in rounds),
        median(other / mine for mine, other in rounds),
    )


@pytest.mark.slow
@pytest.mark.parametrize("message", samples(), ids=lambda message: type(message).__name__)
def test_a_message_takes_the_time_printed_here(message: Message) -> None:
    codec, name = Cdr(type(message)), ROS_NAMES[type(message)]
    theirs, payload = built(message, name), oracle_bytes(message)
    encode = side_by_side(lambda: codec.encode(message), lambda: STORE.serialize_cdr(theirs, name))
    decode = side_by_side(
        lambda: codec.decode(payload), lambda: STORE.deserialize_cdr(payload, name)
    )
    print(f"\n{type(message).__name__}, {len(payload)} bytes")
    for what, (mine, other, ratio) in (("encode", encode), ("decode", decode)):
        print(f"  {what} {mine:6.2f} us, rosbags {other:6.2f} us, {ratio:5.2f} times as fast")


def test_odometry_is_encoded_no_slower_than_by_rosbags() -> None:
    """Compare only the encoding: the message for rosbags is built before the measurement."""
    message = odometry("odom", "base_link")
    codec, name = Cdr(Odometry), ROS_NAMES[Odometry]
    theirs = built(message, name)
    mine, other, ratio = side_by_side(
        lambda: codec.encode(message), lambda: STORE.serialize_cdr(theirs, name)
    )
    print(f"\nOdometry {mine:.2f} us, rosbags {other:.2f} us, {ratio:.2f} times as fast")
    assert ratio >= 0.8
