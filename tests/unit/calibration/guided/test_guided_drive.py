"""Tests of the method that a guided drive uses, and of the file that its result may go to."""

from __future__ import annotations

import pytest
from msgspec.structs import replace

from acsard.calibration.guided.guided_drive import DriveOptions, choose_method, other_robot
from acsard.core.config.settings import Config, DriveConfig, OdometryConfig
from acsard.host.errors import UsageError

WITH_GYRO = Config(odometry=OdometryConfig(gyro=True))


@pytest.mark.parametrize(
    ("options", "config", "method"),
    [
        (DriveOptions(), Config(), "tape"),
        (DriveOptions(), WITH_GYRO, "gyro"),
        (DriveOptions("wall"), WITH_GYRO, "wall"),
        (DriveOptions(positions="sim/pose"), WITH_GYRO, "positions"),
        (DriveOptions(imu="other/imu"), Config(), "gyro"),
    ],
)
def test_the_options_and_the_gyro_choose_the_method(
    options: DriveOptions, config: Config, method: str
) -> None:
    assert choose_method(options, config) == method


@pytest.mark.parametrize("options", [DriveOptions("gyro"), DriveOptions(imu="imu")])
def test_a_gyro_that_the_daemon_does_not_read_is_refused(options: DriveOptions) -> None:
    with pytest.raises(UsageError, match=r"set odometry\.gyro = true"):
        choose_method(options, Config())


def test_a_file_with_other_wheels_belongs_to_another_robot() -> None:
    other = Config(drive=replace(DriveConfig(), wheel_radius=0.07))
    assert "drive.wheel_radius = 0.07" in other_robot(other, Config(), "acsard.toml")
    assert other_robot(Config(), Config(), "acsard.toml") == ""
