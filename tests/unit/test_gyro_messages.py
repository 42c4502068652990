"""The daemon reads gyro samples in every encoding, or refuses a sample and gives the reason."""

from __future__ import annotations

import json
import math
from collections import Counter
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st
from msgspec.structs import replace

from acsard.core.incoming.commands import Arrival
from acsard.core.incoming.imu import (
    MAX_RATE,
    SILENCE_TIMEOUT_NS,
    SIMULATOR_SENDER,
    GyroFollower,
    reading,
)
from acsard.core.messages.encodings import FORMATS, DecodeError, Format, encode, encoding_name
from acsard.core.messages.schema import Header, Imu, Quaternion, Time, Vector3
from acsard.core.messages.signature import Signature
from acsard.core.values import Event, GyroSample
from tests.each import each

ZEROS = [0.0] * 9
FULL = Imu(
    header=Header(Time(12, 5), "imu_link"),
    orientation=Quaternion(0.1, 0.2, 0.3, 0.9),
    orientation_covariance=[-1.0, *ZEROS[1:]],
    angular_velocity=Vector3(0.01, -0.02, 0.75),
    angular_velocity_covariance=[1e-4, 0.0, 0.0, 0.0, 1e-4, 0.0, 0.0, 0.0, 4e-4],
    linear_acceleration=Vector3(0.1, 0.0, 9.81),
)


def arrival(
    payload: bytes, encoding: str = "", at_ns: int = 7, who: str = "imu", put: bool = True
) -> Arrival:
    return Arrival("imu", put, payload, encoding, at_ns, None, who)


def imu_message(at_ns: int = 7, sender: str = "imu", **fields: Any) -> Arrival:
    """Return a sample in hand-written JSON."""
    return arrival(json.dumps(fields).encode(), at_ns=at_ns, who=sender)


def turning(rate: float, at_ns: int = 7, sender: str = "imu") -> Arrival:
    return imu_message(at_ns, sender, angular_velocity={"z": rate})


@each("named", [True, False])
@each("form", FORMATS)
def test_an_imu_is_read_in_every_encoding(form: Format, named: bool) -> None:
    encoding = encoding_name(form, "Imu") if named else ""
    sample, frame = reading(arrival(encode(FULL, form), encoding))
    assert frame == "imu_link"
    assert sample == GyroSample(7, 12_000_000_005, 0.75, 4e-4)


@given(st.binary(max_size=400))
def test_any_payload_is_a_sample_or_is_counted_as_refused(payload: bytes) -> None:
    counters = Counter[str]()
    sample = GyroFollower().receive(arrival(payload), counters, [])
    assert counters.total() == (sample is None)


@given(st.floats(allow_nan=True, allow_infinity=True))
def test_a_turn_rate_beyond_the_maximum_is_refused(rate: float) -> None:
    imu = Imu(angular_velocity=Vector3(z=rate))
    if abs(rate) <= MAX_RATE:
        assert reading(arrival(encode(imu, "cdr")))[0].rate == rate
        return
    with pytest.raises(DecodeError) as refused:
        reading(arrival(encode(imu, "cdr")))
    assert refused.value.reason == ("out_of_range" if math.isfinite(rate) else "not_finite")


REFUSED: dict[str, Arrival] = {
    "wrong_shape": imu_message(linear_acceleration={"z": 9.81}),
    "malformed": arrival(encode(FULL, "cdr")[:100]),
    "unknown_encoding": arrival(b"0.5"),
    "not_finite": arrival(encode(Imu(angular_velocity=Vector3(x=math.nan)), "cdr")),
    "out_of_range": turning(50.1),
    "no_rate": imu_message(
        angular_velocity={"z": 0.1}, angular_velocity_covariance=[-1.0, *ZEROS[1:]]
    ),
    "too_big": arrival(b"{" + b" " * 5000),
    "not_a_put": arrival(encode(FULL, "json"), put=False),
}


@each("reason", REFUSED)
def test_a_refused_sample_is_counted_and_reported_with_its_reason(reason: str) -> None:
    counters, events = Counter[str](), list[Event]()
    assert GyroFollower().receive(REFUSED[reason], counters, events) is None
    assert counters == {f"imu_{reason}": 1}
    (event,) = events
    assert (event.name, event.kind, event.level) == ("imu_refused", reason, "warning")


S = SILENCE_TIMEOUT_NS
STORIES = [
    [(0, "one", "used"), (S // 2, "other", "refused"), (S - 1, "one", "used"),
     (2 * S - 2, "other", "refused"), (2 * S, "other", "anew"), (2 * S + 1, "one", "refused")],
    [(0, "one", "used"), (10 * S, "one", "used")],
    [(0, "", "used"), (1, "abc", "refused"), (2 * S, "abc", "anew"), (2 * S + 1, "abc", "used")],
]  # fmt: skip
"""Times and senders of samples; each is refused or used, or is the first of another gyro."""


@each("story", STORIES)
def test_the_first_of_two_gyros_counts_until_its_silence(
    story: list[tuple[int, str, str]],
) -> None:
    gyro, counters = GyroFollower(), Counter[str]()
    gyro.receive(REFUSED["out_of_range"], counters, [])  # takes no place
    for at_ns, sender, expected in story:
        # On an rmw key only the attachment names the sender.
        sample = replace(turning(0.1, at_ns, sender), via="native" if sender else "rmw")
        found = gyro.receive(sample, counters, [])
        assert (found is None) == (expected == "refused")
        assert found is None or found.anew == (expected == "anew")
    refused = sum(expected == "refused" for *_, expected in story)
    assert counters["imu_second_sender"] == refused


def test_a_robot_with_its_own_gyro_never_follows_another_one() -> None:
    counters, events = Counter[str](), list[Event]()
    follower = GyroFollower(own=True)
    for sender in ("other", SIMULATOR_SENDER):
        # The second one has the simulator's secret as the id of its session.
        assert follower.receive(turning(0.2, 0, sender), counters, events) is None
    own = replace(
        turning(0.1, 10 * SILENCE_TIMEOUT_NS, ""), attachment=Signature(SIMULATOR_SENDER).pack()
    )
    assert follower.receive(own, counters, events) is not None
    assert (
        follower.receive(turning(0.2, 20 * SILENCE_TIMEOUT_NS, "other"), counters, events) is None
    )
    assert counters == {"imu_second_sender": 3}
    assert "simulat" in events[0].text
