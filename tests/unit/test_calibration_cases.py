"""Situations of real logs, each with its right value or with the cause that must be named.

`-n 0 -s -m "slow or not slow"` prints them as a table.
"""

from __future__ import annotations

import os
import shlex
import subprocess
import sys
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path

import numpy as np
import pytest

from acsard.calibration.log import LogError, read
from acsard.calibration.result import Result, calibrate
from acsard.core.config.settings import Config
from tests.unit import calibration_bags as bags
from tests.unit.calibration_bags import (
    END,
    RADIUS,
    SCRIPT,
    START,
    WHEELS,
    Bag,
    at,
    bag,
    converted,
)  # fmt: skip

pytestmark = pytest.mark.slow

BY_GYRO, BY_POSES = (1.4925, 0.9950, 1.0050), (1.500, 1.000, 1.010)
GYRO, POSES = ("--imu", "/imu/data"), ("--positions", "/pose", "--yaw")


def found(data: bytes) -> Result:
    return calibrate(read(data), Config(), "drive.csv")


def row(found: str) -> None:
    name = os.environ["PYTEST_CURRENT_TEST"].split("::")[1].split(" ")[0]
    print(f"\n| {name.removeprefix('test_').replace('_', ' ')} | {found} |")


@contextmanager
def refused(cause: str, error: type[BaseException] = LogError) -> Iterator[None]:
    with pytest.raises(error, match=cause) as caught:
        yield
    row(f"refused: {caught.value}")


def require(result: Result, truth: Sequence[float], within: float = 0.008) -> None:
    values = list(result.found.values())
    row(", ".join(
        f"{value:.4f} +- {deviation:.4f} ({true:.4f})"
        for value, deviation, true in zip(values, result.deviations.values(), truth, strict=True)
    ))  # fmt: skip
    assert result.better
    assert values == pytest.approx(truth, abs=within)
    # The noise never states more than a few degrees for a sound log.
    noise = result.settings.get("odometry.yaw_variance_per_radian", 0.0)
    assert noise <= Config().odometry.yaw_variance_per_radian


def rows(header: str, lines: Sequence[str]) -> bytes:
    return "\n".join([header, *lines, ""]).encode()


@pytest.mark.parametrize("first", ["driver", "publisher"])
def test_zeros_of_a_second_publisher_are_refused_with_the_cause(tmp_path: Path, first: str) -> None:
    def joint(made: Bag, number: int, t: float, left: float, right: float) -> None:
        late = 0.012 if first == "driver" else 0.001
        made.joints(START + t + 0.002, START + t, WHEELS, [left, right] * 2)
        made.joints(START + t + late, START + t + late - 0.002, WHEELS, [0.0] * 4)

    directory = bag(joint).write(tmp_path / "drive")
    with refused(r"two series of angles alternate.*joint_state_publisher", SystemExit):
        converted(directory, *GYRO)


@pytest.mark.parametrize("gyro", [True, False])
def test_positions_at_1_hz_give_all_three_values(tmp_path: Path, gyro: bool) -> None:
    made = bag(gyro=bags.usual_gyro if gyro else None, pose_hz=1.0)
    data = converted(made.write(tmp_path / "drive"), *(GYRO if gyro else ()), *POSES)
    result = found(data)
    require(result, BY_POSES)
    assert result.position_error is not None
    assert result.position_error.new < result.position_error.now


def test_one_message_with_the_stamp_0_is_left_out(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The network delivers the messages in bursts of 0.2 s, so the stamps are needed."""

    def joint(made: Bag, number: int, t: float, left: float, right: float) -> None:
        recorded = START + float(np.ceil(t / 0.2)) * 0.2 + 0.001 * (number % 10)
        made.joints(recorded, START + t if number else 0.0, WHEELS, [left, right] * 2)

    data = converted(bag(joint).write(tmp_path / "drive"), *GYRO)
    assert "/joint_states: 1 messages with a wrong stamp are left out" in capsys.readouterr().err
    require(found(data), BY_GYRO)


def test_the_command_of_the_page_converts_a_bag(tmp_path: Path) -> None:
    page = (SCRIPT.parents[1] / "manual/pages/howto/bag.md").read_text()
    name = f"$ python3 {SCRIPT.name} "
    (command,) = (line for line in page.splitlines() if line.startswith(name))

    def joint(made: Bag, number: int, t: float, left: float, right: float) -> None:
        names = ("left_wheel", "right_wheel")
        made.joints(START + t + 0.002, START + t, names, [left, right])

    bag(joint).write(tmp_path / "drive")
    words = [sys.executable, str(SCRIPT), *shlex.split(command.removeprefix(name))]
    ended = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "", "")
    require(found((tmp_path / "drive.csv").read_bytes()), BY_GYRO)


@pytest.mark.parametrize("column", ["left (in/s)", "left_ips", "left [rpm]"])
def test_a_unit_in_the_header_is_an_error_with_the_right_unit(column: str) -> None:
    with refused(r"name it left, and write its values in rad/s"):
        found(rows(f"t,{column},right,yaw_rate", ["0.0,1.0,1.0,0.0"]))


def set_back(t: float) -> float:
    return START + t - (3.0 if t > 40 else 0.0)


def test_a_clock_that_is_set_back_begins_a_new_run_of_a_csv_file() -> None:
    lines = [
        f"{set_back(t):.3f},{at('left', t):.4f},{at('right', t):.4f},{at('w', t) + 0.01:.5f}"
        for t in np.arange(0, END, 0.02)
    ]
    result = found(rows("t,left,right,yaw_rate", lines))
    require(result, BY_GYRO)
    assert result.runs == 2


def test_a_gyro_that_hangs_is_used_up_to_there(tmp_path: Path) -> None:
    last = [0.0]

    def gyro(made: Bag, t: float, rate: float) -> None:
        last[0] = rate if t < 45 else last[0]
        made.imu(START + t + 0.002, START + t, last[0])

    result = found(converted(bag(gyro=gyro).write(tmp_path / "drive"), *GYRO))
    require(result, BY_GYRO)
    assert any("yaw_rate repeats" in note and "from 45 s" in note for note in result.notes)


def test_angles_of_one_side_that_are_copied_to_the_other_give_way_to_the_speeds(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    def joint(made: Bag, number: int, t: float, left: float, right: float) -> None:
        speeds = [at("left", t), at("right", t)] * 2
        made.joints(START + t + 0.002, START + t, WHEELS, [right] * 4, speeds)

    data = converted(bag(joint).write(tmp_path / "drive"), *GYRO)
    assert "the driver copies one side" in capsys.readouterr().err
    require(found(data), BY_GYRO)


def test_encoders_without_direction_are_named_as_the_cause(tmp_path: Path) -> None:
    t, step = bags.DRIVE["t"], bags.STEP
    up = {name: np.cumsum(np.abs(bags.DRIVE[name])) * step for name in ("left", "right")}

    def joint(made: Bag, number: int, time: float, left: float, right: float) -> None:
        angles = [float(np.interp(time, t, up[name])) for name in ("left", "right")] * 2
        made.joints(START + time + 0.002, START + time, WHEELS, angles)

    data = converted(bag(joint).write(tmp_path / "drive"), *GYRO)
    with refused(r"never turn backwards.*encoders with one channel"):
        found(data)


def test_poses_whose_y_axis_points_up_need_the_option_that_the_error_names(tmp_path: Path) -> None:
    made = bag(gyro=None, pose_hz=20.0, pose=lambda b, t, x, y, yaw: b.pose(
        START + t, START + t, (x, 0.02, -y), yaw, axis=1))  # fmt: skip
    directory = made.write(tmp_path / "drive")
    with refused(r"turn about their y axis.*add --up y", SystemExit):
        converted(directory, *POSES)
    require(found(converted(directory, *POSES, "--up", "y")), BY_POSES)


# What held before, and must go on holding.


def odd_joints(kind: str) -> bags.Joint:
    def joint(made: Bag, number: int, t: float, left: float, right: float) -> None:
        angles, stamp, names = [left, right] * 2, START + t, WHEELS
        match kind:
            case "arm":
                names, angles = (*WHEELS, "arm"), [*angles, 0.3]
                if number % 3 == 0:
                    made.joints(START + t + 0.001, stamp, ("arm",), [0.3])
            case "jumps" if number in (900, 2000, 2001, 2002, 2003, 2004):
                angles = [angle + 21.0 for angle in angles]
            case "restart" if t > 45:
                zero = [at("left_angle", 45.0), at("right_angle", 45.0)] * 2
                angles = [a - b for a, b in zip(angles, zero, strict=True)]
            case "NaN" if t < 2 or number % 97 == 0:
                angles = [float("nan")] * 4
            case "turn":
                angles = [float(angle % (2 * np.pi)) for angle in angles]
            case "old" if number == 0:
                stamp -= 3000.0
        made.joints(START + t + 0.002, stamp, names, angles)

    return joint


@pytest.mark.nightly
@pytest.mark.parametrize("kind", ["arm", "jumps", "restart", "NaN", "turn", "old"])
def test_odd_joints_give_the_same_values(tmp_path: Path, kind: str) -> None:
    made = bag(odd_joints(kind)).write(tmp_path / "drive")
    require(found(converted(made, *GYRO)), BY_GYRO)


def test_two_frames_on_a_topic_are_refused_with_the_cause(tmp_path: Path) -> None:
    def gyro(made: Bag, t: float, rate: float) -> None:
        made.imu(START + t, START + t, rate)
        made.imu(START + t + 0.001, START + t, 0.0, "lidar_imu")

    made = bag(gyro=gyro).write(tmp_path / "drive")
    with refused("imu_link and lidar_imu, so two programs", SystemExit):
        converted(made, *GYRO)


def test_a_topic_or_joint_that_is_missing_is_named(tmp_path: Path) -> None:
    directory = bag(gyro=None).write(tmp_path / "drive", sqlite=True)
    with refused(r"no topic /imu/data; its topics are /joint_states", SystemExit):
        converted(directory, *GYRO)
    words = [str(directory), "unused", "--wheels", "/joint_states", "--left", "wheel", "--right"]
    args = bags.script["parser"].parse_args([*words, WHEELS[1]])
    with refused("no joint wheel; the joints are front_left_wheel_joint", SystemExit):
        bags.script["convert"](args)
    assert Config().drive.wheel_radius == RADIUS
