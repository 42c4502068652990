"""Tests of lowered limits that survive a restart, and of the effect of an edited file on them."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from acsard.core.config.lowered import lowered, with_lowered
from acsard.core.config.settings import Config, LimitsConfig
from tests.each import each

FILE = LimitsConfig(linear_speed=1.0, linear_jerk=5.0)
SOFT = 0.5


@each(
    ("now", "limits"),
    [
        (FILE, {}),
        (LimitsConfig(linear_speed=0.3, linear_jerk=5.0), {"limits.linear_speed": 0.3}),
        (LimitsConfig(linear_speed=1.5, linear_jerk=5.0), {}),
        (LimitsConfig(linear_jerk=2.0), {"limits.linear_jerk": 2.0}),
        # A lower deceleration brakes more softly, so it is not the safer value.
        (replace(FILE, linear_deceleration=SOFT, angular_deceleration=SOFT), {}),
        (replace(FILE, linear_stop_deceleration=SOFT, angular_stop_deceleration=SOFT), {}),
        (replace(FILE, linear_acceleration=SOFT), {"limits.linear_acceleration": SOFT}),
        # Zero means an unlimited jerk, which is more than any limit.
        (LimitsConfig(linear_jerk=0.0), {}),
    ],
)
def test_a_limit_below_that_of_the_file_is_kept(
    now: LimitsConfig, limits: dict[str, float]
) -> None:
    assert lowered(FILE, now) == limits


def test_a_jerk_limit_is_lower_than_no_jerk_limit() -> None:
    limited = LimitsConfig(angular_jerk=20.0)
    assert lowered(LimitsConfig(), limited) == {"limits.angular_jerk": 20.0}
    config, events = with_lowered(Config(), {"limits.angular_jerk": 20.0})
    assert config.limits == limited
    assert len(events) == 1


def test_without_kept_limits_the_configuration_is_unchanged_without_an_event() -> None:
    config = Config()
    assert with_lowered(config, {}) == (config, [])


@pytest.mark.parametrize(
    "limits",
    [
        {"limits.linear_speed": 1.5},
        {"limits.flying_height": 0.1},
        {"limits.linear_deceleration": 0.5},
    ],
)
def test_a_kept_limit_that_lowers_nothing_now_is_left_out(limits: dict[str, float]) -> None:
    config = Config()
    assert with_lowered(config, limits) == (config, [])


def test_a_limit_that_contradicts_the_rest_is_dropped_and_an_event_names_it() -> None:
    limits = {"limits.linear_acceleration": 0.001, "limits.angular_speed": 2.0}
    config, events = with_lowered(Config(), limits)
    assert config.limits == LimitsConfig(angular_speed=2.0)
    dropped, used = events
    assert (dropped.name, dropped.level) == ("set", "warning")
    assert dropped.text.startswith(
        "limits.linear_acceleration was lowered to 0.001 before the restart. "
    )
    assert used.text == (
        "limits.angular_speed = 2.0 (was 4.0): it was lowered before the restart and stays lowered"
    )


def test_several_limits_that_stay_lowered_are_reported_together() -> None:
    limits = {"limits.linear_speed": 0.5, "limits.angular_speed": 2.0}
    _, (event,) = with_lowered(Config(), limits)
    assert event.text == (
        "limits.linear_speed = 0.5 (was 1.0), limits.angular_speed = 2.0 (was 4.0): they were "
        "lowered before the restart and stay lowered"
    )
