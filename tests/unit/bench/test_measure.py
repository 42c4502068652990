"""Tests of the configuration that a benchmark gives to its daemon."""

from __future__ import annotations

from pathlib import Path

import pytest

from acsard.bench.matching import staircase
from acsard.bench.measure import bench_config, write
from acsard.core.config.parsing import parse
from acsard.core.config.settings import BusConfig, Config, ControlConfig, LimitsConfig, McuConfig


@pytest.mark.parametrize("simulated", [True, False])
def test_the_bench_daemon_has_its_own_name_and_a_local_address(
    tmp_path: Path, simulated: bool
) -> None:
    users = Config(
        bus=BusConfig(listen=("tls/0.0.0.0:7449",), tls="/etc/acsard/tls"),
        mcu=McuConfig(trailing_comma=True),
    )
    config = bench_config(users, simulated=simulated)
    assert parse(write(config, tmp_path).read_bytes()) == config
    assert config.robot.id != users.robot.id
    assert config.bus.listen[0].startswith("tcp/127.0.0.1:")
    assert not config.bus.tls
    assert config.mcu == users.mcu


def test_on_a_real_port_the_configured_limits_and_feedback_checks_stay() -> None:
    users = Config(limits=LimitsConfig(linear_speed=0.2))
    config = bench_config(users, simulated=False)
    assert (config.limits, config.feedback, config.drive) == (
        users.limits,
        users.feedback,
        users.drive,
    )


def test_on_the_simulator_every_speed_is_within_the_limits() -> None:
    config = bench_config(Config(), simulated=True)
    fastest = max(staircase(number) for number in range(1000))
    assert fastest < config.limits.wheel_speed
    assert fastest * config.drive.wheel_radius < config.limits.linear_speed


def test_on_the_simulator_lines_are_plain_and_the_robot_is_active_whatever_is_configured() -> None:
    users = Config(
        mcu=McuConfig(link_check="auto", encoder_counts=3200, trailing_comma=True),
        control=ControlConfig(rate=50.0, auto_activate=False),
    )
    config = bench_config(users, simulated=True)
    assert config.mcu == McuConfig(trailing_comma=True)
    assert config.control == ControlConfig(rate=50.0)
    real = bench_config(users, simulated=False)
    assert (real.mcu, real.control) == (users.mcu, users.control)
