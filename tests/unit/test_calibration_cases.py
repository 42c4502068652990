"""Situations of real logs, each with its right value or with the cause that must be named.

`-n 0 -s -m "slow or not slow"` prints what is found.
"""

from __future__ import annotations

import shlex
import subprocess
import sys
from collections.abc import Callable, Sequence
from pathlib import Path

import numpy as np
import pytest

from acsard.calibration.log import LogError, read
from acsard.calibration.result import Result, calibrate
from acsard.core.config.settings import Config
from tests.unit import calibration_bags as bags
from tests.unit.calibration_bags import END, SCRIPT, START, WHEELS, Bag, at, bag, converted

pytestmark = pytest.mark.slow

BY_GYRO, BY_POSES = (1.4925, 0.9950, 1.0050), (1.500, 1.000, 1.010)
GYRO, POSES = ("--imu", "/imu/data"), ("--positions", "/pose", "--yaw")


def found(data: bytes, truth: Sequence[float]) -> Result:
    """Calibrate with this log, and compare what is found with the truth."""
    result = calibrate(read(data), Config(), "drive.csv")
    print(result.found, result.deviations)
    assert result.better
    assert list(result.found.values()) == pytest.approx(truth, abs=0.008)
    # The noise never states more than a few degrees for a sound log.
    noise = result.settings.get("odometry.yaw_variance_per_radian", 0.0)
    assert noise <= Config().odometry.yaw_variance_per_radian
    return result


# wheels whose joints are odd

Joints = Callable[[Bag, int, float, float, float], None]


def joints(kind: str) -> Joints:
    t, step = bags.DRIVE["t"], bags.STEP
    up = {name: np.cumsum(np.abs(bags.DRIVE[name])) * step for name in ("left", "right")}

    def joint(made: Bag, number: int, time: float, left: float, right: float) -> None:
        recorded, stamp, names = START + time + 0.002, START + time, WHEELS
        angles, speeds = [left, right] * 2, None
        match kind:
            case "two publishers":
                made.joints(recorded + 0.01, recorded + 0.008, WHEELS, [0.0] * 4)
            case "one channel":
                angles = [float(np.interp(time, t, up[name])) for name in ("left", "right")] * 2
            case "one side is copied":
                angles, speeds = [right] * 4, [at("left", time), at("right", time)] * 2
            case "the stamp 0":  # the network delivers in bursts, so the stamps are needed
                recorded = START + float(np.ceil(time / 0.2)) * 0.2 + 0.001 * (number % 10)
                stamp = stamp if number else 0.0
            case "arm":
                names, angles = (*WHEELS, "arm"), [*angles, 0.3]
                if number % 3 == 0:
                    made.joints(START + time + 0.001, stamp, ("arm",), [0.3])
            case "jumps" if number in (900, 2000, 2001, 2002, 2003, 2004):
                angles = [angle + 21.0 for angle in angles]
            case "restart" if time > 45:
                zero = [at("left_angle", 45.0), at("right_angle", 45.0)] * 2
                angles = [a - b for a, b in zip(angles, zero, strict=True)]
            case "NaN" if time < 2 or number % 97 == 0:
                angles = [float("nan")] * 4
            case "turn":
                angles = [float(angle % (2 * np.pi)) for angle in angles]
            case "old" if number == 0:
                stamp -= 3000.0
        made.joints(recorded, stamp, names, angles, speeds)

    return joint


@pytest.mark.parametrize(
    ("kind", "note"),
    [
        ("one side is copied", "the driver copies one side"),
        ("the stamp 0", "/joint_states: 1 messages with a wrong stamp are left out"),
        *[pytest.param(kind, "", marks=pytest.mark.nightly)
          for kind in ("arm", "jumps", "restart", "NaN", "turn", "old")],
    ],
)  # fmt: skip
def test_odd_joints_give_the_same_values(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], kind: str, note: str
) -> None:
    data = converted(bag(joints(kind)).write(tmp_path / "drive"), *GYRO)
    assert note in capsys.readouterr().err
    found(data, BY_GYRO)


@pytest.mark.parametrize(
    ("kind", "cause"),
    [
        ("two publishers", r"two series of angles alternate.*joint_state_publisher"),
        ("one channel", r"never turn backwards.*encoders have one channel"),
    ],
)
def test_joints_of_a_known_fault_are_refused_with_the_cause(
    tmp_path: Path, kind: str, cause: str
) -> None:
    directory = bag(joints(kind)).write(tmp_path / "drive")
    with pytest.raises((SystemExit, LogError), match=cause):
        found(converted(directory, *GYRO), BY_GYRO)


# sensors


@pytest.mark.parametrize("gyro", [True, False])
def test_positions_at_1_hz_give_all_three_values(tmp_path: Path, gyro: bool) -> None:
    made = bag(gyro=bags.usual_gyro if gyro else None, pose_hz=1.0)
    data = converted(made.write(tmp_path / "drive"), *(GYRO if gyro else ()), *POSES)
    result = found(data, BY_POSES)
    assert result.position_error is not None
    assert result.position_error.new < result.position_error.now


def test_a_gyro_that_hangs_is_used_up_to_there(tmp_path: Path) -> None:
    last = [0.0]

    def gyro(made: Bag, t: float, rate: float) -> None:
        last[0] = rate if t < 45 else last[0]
        made.imu(START + t + 0.002, START + t, last[0])

    result = found(converted(bag(gyro=gyro).write(tmp_path / "drive"), *GYRO), BY_GYRO)
    assert any("yaw_rate repeats" in note and "from 45 s" in note for note in result.notes)


def test_poses_whose_y_axis_points_up_need_the_option_that_the_error_names(tmp_path: Path) -> None:
    made = bag(gyro=None, pose_hz=20.0, pose=lambda b, t, x, y, yaw: b.pose(
        START + t, START + t, (x, 0.02, -y), yaw, axis=1))  # fmt: skip
    directory = made.write(tmp_path / "drive")
    with pytest.raises(SystemExit, match=r"turn about their y axis.*add --up y"):
        converted(directory, *POSES)
    found(converted(directory, *POSES, "--up", "y"), BY_POSES)


# the whole way


def test_a_clock_that_is_set_back_begins_a_new_run_of_a_csv_file() -> None:
    lines = [
        f"{START + t - (3.0 if t > 40 else 0.0):.3f},{at('left', t):.4f},{at('right', t):.4f},"
        f"{at('w', t) + 0.01:.5f}"
        for t in np.arange(0, END, 0.02)
    ]
    data = "\n".join(["t,left,right,yaw_rate", *lines, ""]).encode()
    assert found(data, BY_GYRO).runs == 2


def test_the_command_of_the_page_converts_a_bag(tmp_path: Path) -> None:
    page = (SCRIPT.parents[1] / "manual/pages/howto/calibrate-log.md").read_text()
    name = f"$ python3 {SCRIPT.name} "
    (command,) = (line for line in page.splitlines() if line.startswith(name))

    def joint(made: Bag, number: int, t: float, left: float, right: float) -> None:
        made.joints(START + t + 0.002, START + t, ("left_wheel", "right_wheel"), [left, right])

    bag(joint).write(tmp_path / "drive")
    words = [sys.executable, str(SCRIPT), *shlex.split(command.removeprefix(name))]
    ended = subprocess.run(words, cwd=tmp_path, capture_output=True, text=True, timeout=60)
    assert (ended.returncode, ended.stdout, ended.stderr) == (0, "", "")
    found((tmp_path / "drive.csv").read_bytes(), BY_GYRO)


def test_a_topic_or_joint_that_is_missing_is_named(tmp_path: Path) -> None:
    directory = bag(gyro=None).write(tmp_path / "drive", sqlite=True)
    with pytest.raises(SystemExit, match="no topic /imu/data; its topics are /joint_states"):
        converted(directory, *GYRO)
    with pytest.raises(SystemExit, match="no joint wheel; the joints are front_left_wheel_joint"):
        converted(directory, left=["wheel"])


def test_a_topic_of_another_type_is_named(tmp_path: Path) -> None:
    directory = bag(pose_hz=1.0).write(tmp_path / "drive")
    for options in (["--imu", "/pose"], ["--positions", "/imu/data"]):
        with pytest.raises(
            SystemExit, match=f"{options[1]} is a topic of type .*{options[0]} needs"
        ):
            converted(directory, *options)
    words = [str(directory), "unused", "--wheels", "/pose", "--left", "a", "--right", "b"]
    with pytest.raises(SystemExit, match="type PoseStamped, but --wheels needs JointState"):
        bags.script["convert"](bags.script["parser"].parse_args(words))


def test_two_imus_with_one_frame_on_one_topic_are_named(tmp_path: Path) -> None:
    rng = np.random.default_rng(3)

    def gyro(made: Bag, t: float, rate: float) -> None:
        made.imu(START + t + 0.002, START + t, rate)
        made.imu(START + t + 0.005, START + t + 0.003, float(rng.normal(0, 0.004)))

    with pytest.raises(LogError, match="in yaw_rate, two series of values alternate"):
        found(converted(bag(gyro=gyro).write(tmp_path / "drive"), *GYRO), BY_GYRO)
