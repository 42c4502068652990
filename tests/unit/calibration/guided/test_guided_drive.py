"""Tests of the method that a guided drive uses, and of the file that its result may go to."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace

from acsard.calibration.guided.drive_plan import GuideError
from acsard.calibration.guided.guided_drive import (
    DriveOptions,
    choose_method,
    other_robot,
    require_same_robot,
)
from acsard.core.config.settings import Config, DriveConfig, OdometryConfig
from acsard.core.messages.schema import Info
from acsard.host.errors import UsageError

WITH_GYRO = Config(odometry=OdometryConfig(gyro=True))


@pytest.mark.parametrize(
    ("options", "config", "method"),
    [
        (DriveOptions(), Config(), "tape"),
        (DriveOptions(), WITH_GYRO, "gyro"),
        (DriveOptions("tape"), WITH_GYRO, "tape"),
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


INFO = Info("acsar", "0.1.0", 7, "/dev/pts/1", True, 100.0, [], [])


def answers(info: Info, settings: object) -> Any:
    return SimpleNamespace(get={"info": info, "config": settings}.__getitem__)


def test_a_simulator_that_was_restarted_may_be_calibrated_on() -> None:
    now = replace(INFO, pid=8, port="/dev/pts/2")
    require_same_robot(answers(now, {"a": 1}), INFO, {"a": 1})


@pytest.mark.parametrize(
    ("was", "now", "text"),
    [
        (INFO, replace(INFO, port="/dev/ttyUSB0", simulated=False), "now drives /dev/ttyUSB0"),
        (replace(INFO, port="/dev/a", simulated=False),
         replace(INFO, port="/dev/b", simulated=False), "now drives /dev/b instead of /dev/a"),
    ],
)  # fmt: skip
def test_a_daemon_with_another_board_ends_a_calibration(was: Info, now: Info, text: str) -> None:
    with pytest.raises(GuideError, match=text):
        require_same_robot(answers(now, {}), was, {})


def test_settings_that_change_during_a_calibration_end_it() -> None:
    with pytest.raises(GuideError, match="settings were changed"):
        require_same_robot(answers(INFO, {"a": 2}), INFO, {"a": 1})
