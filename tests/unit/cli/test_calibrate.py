"""Tests of `acsard calibrate` on files, inside this process."""

from __future__ import annotations

import errno
import json
import math
import os
import re
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import CompressionType

from acsard.cli import parser
from acsard.core.config.parsing import parse
from acsard.host.errors import Exit, MendableError, UnreachableError, UsageError
from tests.pages import blocks
from tests.unit.calibration.bags import (
    PERIOD_S,
    imu,
    in_order,
    joint_states,
    write_bag,
    write_mcap,
)
from tests.unit.calibration.cut import usual
from tests.unit.calibration.robots import GUIDED

GOOD = usual().csv(places=False)


def called(where: Path, log: str, *words: str, text: str = "# mine\n") -> int:
    """Return the exit code of `acsard calibrate --log drive.csv` with these further arguments."""
    (where / "acsard.toml").write_text(text)
    (where / "drive.csv").write_text(log)
    options = [
        "calibrate",
        "--log",
        str(where / "drive.csv"),
        "--config",
        str(where / "acsard.toml"),
    ]
    args = parser(["calibrate"]).parse_args([*options, *words])
    return int(args.main(args))


def test_the_result_is_printed_as_text_and_the_file_stays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert called(tmp_path, GOOD) == 0
    out = capsys.readouterr().out
    assert "wheel_separation_multiplier" in out
    assert "heading error after a turn of 360 deg" in out
    assert (tmp_path / "acsard.toml").read_text() == "# mine\n"


def test_json_is_one_object(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert called(tmp_path, GOOD, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert 1.5 < result["wheel_separation_multiplier"] < 1.8
    assert result["reference"] == "yaw_rate"


@pytest.mark.slow
def test_write_keeps_the_comments_and_a_second_time_finds_nothing_to_improve(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert called(tmp_path, GOOD, "--write", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    text = (tmp_path / "acsard.toml").read_text()
    assert text.startswith("# mine\n")
    config = parse(text.encode())
    for name in ("wheel_separation", "left_wheel_radius", "right_wheel_radius"):
        key = f"{name}_multiplier"
        assert getattr(config.drive, key) == pytest.approx(result[key], abs=1e-5)
    assert "yaw_variance_per_metre" in result["odometry"]
    for name, value in result["odometry"].items():
        assert getattr(config.odometry, name) == value
    with pytest.raises(MendableError, match="not clearly better") as end:
        called(tmp_path, GOOD, "--json", "--write", text=text)
    assert end.value.code == Exit.FAILURE
    assert (tmp_path / "acsard.toml").read_text() == text


@pytest.mark.slow
def test_a_result_that_cannot_be_written_is_printed_before_the_error(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def full(*_: object) -> None:
        raise OSError(errno.ENOSPC, os.strerror(errno.ENOSPC))

    monkeypatch.setattr(os, "replace", full)
    with pytest.raises(MendableError, match=r"was not changed.*edit the file by hand"):
        called(tmp_path, GOOD, "--write")
    assert "wheel_separation_multiplier = " in capsys.readouterr().out
    assert (tmp_path / "acsard.toml").read_text() == "# mine\n"


@pytest.mark.slow
def test_a_distance_measures_the_wheels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    straight = usual(plan=[(1, 0, 0), (10, 0.4, 0), (1, 0, 0)])
    metres = 1.1 * abs(straight.where[-1])
    log = usual().csv(places=False, run="turns")
    log += straight.csv(places=False, run="straight").partition("\n")[2]
    words = ["--distance", "straight=" + f"{metres:.3f}", "--write", "--json"]
    assert called(tmp_path, log, *words) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["scale"] == "distance"
    assert result["left_wheel_radius"] == pytest.approx(0.055, rel=0.02)
    written = parse((tmp_path / "acsard.toml").read_bytes())
    assert written.drive.left_wheel_radius_multiplier == pytest.approx(1.1, rel=0.02)
    # The tape's common uncertainty of all distances is stated apart, because it does not affect the
    # heading.
    deviations = result["odometry"]
    assert written.odometry.distance_scale_std == deviations["distance_scale_std"] > 0.0


@pytest.mark.slow
def test_in_two_joined_logs_the_distance_belongs_to_the_straight_drive(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    straight = usual(plan=[(1, 0, 0), (10, 0.4, 0), (1, 0, 0)])
    metres = 1.1 * abs(straight.where[-1])
    header, *rows = straight.csv(places=False).splitlines()
    later = [
        ",".join([f"{float(t) + 300.0:.6f}", *rest])
        for t, *rest in (row.split(",") for row in rows)
    ]
    log = "\n".join([GOOD.rstrip("\n"), header, *later, ""])
    assert called(tmp_path, log, "--distance", f"{metres:.3f}", "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["left_wheel_radius"] == pytest.approx(0.055, rel=0.02)


def test_a_refusal_ends_with_failure_and_an_object(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(MendableError, match="column") as end:
        called(tmp_path, "a,b\n1,2\n", "--json", "--write")
    assert end.value.code == Exit.FAILURE
    assert "column" in json.loads(capsys.readouterr().out)["refused"]
    assert (tmp_path / "acsard.toml").read_text() == "# mine\n"


def test_a_refusal_contains_the_notes_about_the_log(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    rows = [f"{i / 100},1,1,0.1" for i in range(500)]
    rows[100] = "1,1,1,900"
    with pytest.raises(MendableError, match="\\nnote: 1 cell of yaw_rate left out"):
        called(tmp_path, "t,left,right,yaw_rate\n" + "\n".join(rows), "--json")
    assert "1 cell of yaw_rate" in json.loads(capsys.readouterr().out)["notes"][0]


def test_a_missing_log_is_reported(tmp_path: Path) -> None:
    args = parser(["calibrate"]).parse_args(["calibrate", "--log", str(tmp_path / "none.csv")])
    with pytest.raises(MendableError, match="correct --log"):
        args.main(args)


# ROS 2 bags


def of_bag(where: Path, log: Path, *words: str) -> int:
    """Return the exit code of `acsard calibrate --json --log` with a bag."""
    (where / "acsard.toml").write_text("")
    options = ["calibrate", "--json", "--log", str(log), "--config", str(where / "acsard.toml")]
    args = parser(["calibrate"]).parse_args([*options, *words])
    return int(args.main(args))


@pytest.mark.slow
@pytest.mark.parametrize("form", ["directory", "file"])
def test_a_bag_that_another_library_wrote_is_read(
    form: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = write_bag(tmp_path / "bag", usual())
    if form == "file":
        (log,) = log.glob("*.mcap")
    assert of_bag(tmp_path, log) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["reference"] == "yaw_rate and positions"
    assert result["wheel_separation_multiplier"] == pytest.approx(1.6 * 1.06, abs=0.05)
    assert result["notes"][0].startswith("used: the wheels from /joint_states (JointState)")


@pytest.mark.slow
def test_the_options_of_a_bag_choose_its_sensor(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = write_bag(tmp_path / "bag", usual())
    assert of_bag(tmp_path, log, "--topic", "/imu/data", "--yaw-axis=z") == 0
    assert json.loads(capsys.readouterr().out)["reference"] == "yaw_rate"
    with pytest.raises(MendableError, match="no topic /imu that can be used"):
        of_bag(tmp_path, log, "--topic", "/imu")


@pytest.mark.variations(3)
@pytest.mark.parametrize("compression", list(CompressionType))
def test_a_bag_that_was_cut_off_is_read_up_to_the_cut(
    compression: CompressionType, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = usual(plan=GUIDED[:10])
    log = write_mcap(tmp_path / "bag.mcap", in_order(joint_states(drive), imu(drive)), compression)
    log.write_bytes(log.read_bytes()[: log.stat().st_size * 8 // 10])
    assert of_bag(tmp_path, log) == 0
    assert "bag.mcap is cut off" in json.loads(capsys.readouterr().out)["notes"][0]


def test_a_bag_with_an_impossible_time_is_read_up_to_that_time(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = usual(plan=GUIDED[:10])
    messages = in_order(joint_states(drive), imu(drive))
    last = messages[-1]._replace(wall_ns=1 << 63)
    log = write_mcap(tmp_path / "bag.mcap", [*messages, last])
    assert of_bag(tmp_path, log) == 0
    note = json.loads(capsys.readouterr().out)["notes"][0]
    assert note.endswith("are used: a message has the impossible time 9223372036854775808 ns")


@pytest.mark.slow
def test_the_files_of_a_bag_are_one_log(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    drive = usual(plan=GUIDED[:10])
    messages = in_order(joint_states(drive), imu(drive))
    bag = tmp_path / "bag"
    bag.mkdir()
    for number in range(12):
        part = messages[number * len(messages) // 12 : (number + 1) * len(messages) // 12]
        write_mcap(bag / f"bag_{number}.mcap", part)
    assert of_bag(tmp_path, bag) == 0
    result = json.loads(capsys.readouterr().out)
    assert result["runs"] == 1
    assert result["seconds"] == pytest.approx(drive.t[-1], abs=0.1)


@pytest.mark.parametrize(
    ("name", "data", "why"),
    [
        ("bag_0.db3", b"SQLite format 3\0" + bytes(100), "ros2 bag convert"),
        ("drive.bag", b"#ROSBAG V2.0\n" + bytes(100), "rosbags-convert"),
        ("bag_0.mcap.zstd", b"\x28\xb5\x2f\xfd" + bytes(100), "zstd -d"),
    ],
)
def test_another_kind_of_bag_is_refused_with_the_command_that_converts_it(
    name: str, data: bytes, why: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "bag").mkdir()
    (tmp_path / "bag" / name).write_bytes(data)
    for log in (tmp_path / "bag", tmp_path / "bag" / name):
        with pytest.raises(MendableError, match=why):
            of_bag(tmp_path, log)
    assert "deploy/calibration/README.md" in capsys.readouterr().out


def test_a_directory_that_is_not_a_bag_is_refused(tmp_path: Path) -> None:
    with pytest.raises(MendableError, match="directory contains no MCAP file"):
        of_bag(tmp_path, tmp_path)


@pytest.mark.parametrize("word", ["--topic=/imu", "--yaw-axis=x"])
def test_the_options_of_a_bag_are_refused_for_a_csv_file(word: str, tmp_path: Path) -> None:
    with pytest.raises(MendableError, match="are only for a ROS 2 bag, and this log is not"):
        called(tmp_path, GOOD, word)


# the converters of deploy/calibration/README.md


def converted(name: str, where: Path, *words: str) -> str:
    """Run a converter exactly as the page gives it, and return the CSV file that it makes."""
    (script,) = (block.text for block in blocks("python") if f"# {name}:" in block.text)
    (where / name).write_text(script)
    command = [sys.executable, name, *words, "drive.csv"]
    done = subprocess.run(command, cwd=where, capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr
    return (where / "drive.csv").read_text()


@pytest.mark.slow
@pytest.mark.parametrize("sqlite", [False, True])
def test_the_page_s_converter_makes_a_log_of_a_bag(
    sqlite: bool, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    write_bag(tmp_path / "drive", usual(), sqlite=sqlite)
    assert called(tmp_path, converted("bag_to_csv.py", tmp_path, "drive"), "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["reference"] == "yaw_rate and positions"
    assert result["wheel_separation_multiplier"] == pytest.approx(1.6 * 1.06, abs=0.05)


@pytest.mark.slow
def test_the_page_s_converter_makes_a_log_of_counts(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    drive = usual()
    rows = [(t, f"{t:.6f},,,{rate:.6f}") for t, rate in zip(drive.gyro_t, drive.gyro, strict=True)]
    per_rad = 1440 / math.tau
    left, right = (
        (65000 + np.floor(np.cumsum(side) * PERIOD_S * per_rad)) % 65536
        for side in (drive.left, drive.right)
    )
    rows += [
        (t, f"{t + PERIOD_S / 2:.6f},{a:.0f},{b:.0f},")
        for t, a, b in zip(drive.t, left, right, strict=True)
    ]
    text = "\n".join(["t,left_counts,right_counts,yaw_rate", *(row for _, row in sorted(rows))])
    (tmp_path / "counts.csv").write_text(text + "\n")
    assert called(tmp_path, converted("counts_to_csv.py", tmp_path, "counts.csv"), "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert result["wheel_separation_multiplier"] == pytest.approx(1.6 * 1.06, abs=0.05)


@pytest.mark.parametrize("word", ["0", "nan", "a=b", "-3", "1e9"])
def test_a_distance_is_a_length_in_metres(tmp_path: Path, word: str) -> None:
    with pytest.raises(SystemExit):
        called(tmp_path, GOOD, f"--distance={word}")


# without a log


def driving(*words: str) -> int:
    """Return the exit code of a guided `acsard calibrate` with these arguments and no terminal."""
    args = parser(["calibrate"]).parse_args(["calibrate", *words])
    return int(args.main(args))


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ([], "person at the terminal"),
        (["--distance", "2.0"], "--distance needs --log"),
        (["--method", "positions"], "--positions KEY"),
        (["--method", "tape", "--positions", "sim/pose"], "leave one of them out"),
        (["--positions-at", "tcp/127.0.0.1:7447"], "--positions KEY"),
        (["--positions", "odom"], "odom cannot show the errors of the wheels"),
        (["--positions", "acsard/acsar/odom"], "odom cannot show the errors of the wheels"),
        (["--log", "drive.csv", "--method", "tape"], "--method is for a guided drive"),
        (["--log", "drive.csv", "--imu", "imu"], "--imu is for a guided drive"),
        (["--method", "tape", "--imu", "imu"], "--imu is for --method gyro, not for --method tape"),
        (["--positions", "sim/pose", "--imu", "x/imu"], "not for --positions"),
        (["--topic", "/imu"], "--topic and --yaw-axis need --log"),
        (["--yaw-axis=x"], "--topic and --yaw-axis need --log"),
        (["--log", "drive.csv", "--yes"], "--yes is for a guided drive"),
    ],
)
def test_contradictory_options_are_refused_before_a_connection_is_made(
    words: list[str], why: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.stdin", open(os.devnull))  # noqa: SIM115
    with pytest.raises(UsageError, match=re.escape(why)):
        driving(*words)


def test_without_a_daemon_the_verb_ends_as_unreachable(tmp_path: Path) -> None:
    with pytest.raises(UnreachableError):
        driving("--yes", "--connect", "tcp/127.0.0.1:9")
