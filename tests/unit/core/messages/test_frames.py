"""A message from a prepared frame equals the output of the ordinary encoder, byte by byte."""

from __future__ import annotations

from unittest.mock import Mock

import pytest
from hypothesis import given
from hypothesis import strategies as st

from acsard.core.config.settings import Config, JointsConfig, OdometryConfig
from acsard.core.messages.encodings import FORMATS, encode
from acsard.core.messages.frames import EXAMPLE
from acsard.core.messages.report import Report
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

CONFIG = Config(
    odometry=OdometryConfig(odom_frame="map/odom", base_frame="base", publish_tf=True),
    joints=JointsConfig(front_right="a rather long name of a joint"),
)

any_float = st.floats()
wall_ns = st.one_of(
    st.integers(1_600_000_000 * NS_PER_S, (1 << 31) * NS_PER_S - 1),
    # Values that msgpack encodes in fewer bytes, or that do not fit the field `sec`.
    st.builds(
        lambda sec, nanosec: sec * NS_PER_S + nanosec,
        st.one_of(st.integers(-10, 1 << 17), st.integers((1 << 31) - 2, (1 << 32) + 2)),
        st.integers(0, 1 << 17),
    ),
)


def some(count: int) -> st.SearchStrategy[tuple[float, ...]]:
    return st.tuples(*[any_float] * count)


estimates = st.builds(
    Estimate,
    st.builds(Instant, st.just(0), wall_ns),
    st.builds(Pose, any_float, any_float, st.floats(-4.0, 4.0)),
    st.builds(Twist, any_float, any_float),
    some(6).map(lambda values: PoseCovariance(*values)),
    some(3).map(lambda values: TwistVariances(*values)),
    some(4),
    some(4).map(lambda values: WheelSpeeds(*values)),
)


@pytest.mark.parametrize("form", FORMATS)
@given(several=st.lists(estimates, min_size=1, max_size=5))
def test_a_frame_equals_the_encoders_output(form: str, several: list[Estimate]) -> None:
    report = Report(CONFIG, Instant(0, 0))
    for estimate in several:
        for topic in report._feedback:
            assert topic.encode(estimate, form) == encode(topic.build(estimate), form)  # type: ignore[arg-type]


def test_only_the_first_message_of_an_encoding_is_built() -> None:
    """Otherwise the frames would save no time."""
    for topic in Report(CONFIG, Instant(0, 0))._feedback:
        topic.build = Mock(wraps=topic.build)
        for _ in range(10):
            topic.encode(EXAMPLE, "msgpack")
            topic.encode(EXAMPLE, "cdr")
        assert topic.build.call_count == 2
