"""Tests of `acsard calibrate` on files, inside this process."""

from __future__ import annotations

import json
import os
import re
from pathlib import Path

import pytest
from mcap.writer import Writer

from acsard.cli import parser
from acsard.core.config.parsing import parse
from acsard.host.errors import Exit, MendableError, UnreachableError, UsageError
from tests.unit.calibration.cut import usual

GOOD = usual().csv(places=False)


def called(where: Path, log: str, *words: str, text: str = "# mine\n") -> int:
    """Return the exit code of `acsard calibrate --log drive.csv` with these further arguments."""
    (where / "acsard.toml").write_text(text)
    (where / "drive.csv").write_text(log)
    given = ["calibrate", "--log", str(where / "drive.csv"), "--config", str(where / "acsard.toml")]
    args = parser(["calibrate"]).parse_args([*given, *words])
    return int(args.main(args))


def test_people_are_told(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert called(tmp_path, GOOD) == 0
    out = capsys.readouterr().out
    assert "wheel_separation_multiplier" in out
    assert "error of a turn of 360 deg" in out
    assert (tmp_path / "acsard.toml").read_text() == "# mine\n"


def test_json_is_one_object(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert called(tmp_path, GOOD, "--json") == 0
    found = json.loads(capsys.readouterr().out)
    assert 1.5 < found["wheel_separation_multiplier"] < 1.8
    assert found["reference"] == "yaw_rate"


def test_write_keeps_the_comments_and_a_second_time_finds_nothing_to_improve(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert called(tmp_path, GOOD, "--write", "--json") == 0
    found = json.loads(capsys.readouterr().out)
    text = (tmp_path / "acsard.toml").read_text()
    assert text.startswith("# mine\n")
    config = parse(text.encode())
    for name in ("wheel_separation", "left_wheel_radius", "right_wheel_radius"):
        key = f"{name}_multiplier"
        assert getattr(config.drive, key) == pytest.approx(found[key], abs=1e-5)
        assert getattr(config.odometry, f"{key}_std") == found["odometry"][f"{key}_std"]
    with pytest.raises(MendableError, match="not surely better") as end:
        called(tmp_path, GOOD, "--json", "--write", text=text)
    assert end.value.code == Exit.FAILURE
    assert (tmp_path / "acsard.toml").read_text() == text


def test_a_distance_measures_the_wheels(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    straight = usual(plan=[(1, 0, 0), (10, 0.4, 0), (1, 0, 0)])
    metres = 1.1 * abs(straight.where[-1])
    log = usual().csv(places=False, run="turns")
    log += straight.csv(places=False, run="straight").partition("\n")[2]
    words = ["--distance", "straight=" + f"{metres:.3f}", "--write", "--json"]
    assert called(tmp_path, log, *words) == 0
    found = json.loads(capsys.readouterr().out)
    assert found["scale"] == "distance"
    assert found["left_wheel_radius"] == pytest.approx(0.055, rel=0.02)
    written = parse((tmp_path / "acsard.toml").read_bytes())
    assert written.drive.left_wheel_radius_multiplier == pytest.approx(1.1, rel=0.02)
    # The tape's common uncertainty of all distances is stated apart, because it does not affect the
    # heading.
    deviations = found["odometry"]
    assert written.odometry.distance_scale_std == deviations["distance_scale_std"] > 0.0


def test_of_two_logs_put_together_a_distance_is_the_straight_one_s(
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
    found = json.loads(capsys.readouterr().out)
    assert found["left_wheel_radius"] == pytest.approx(0.055, rel=0.02)


def test_a_refusal_ends_with_failure_and_an_object(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(MendableError, match="column") as end:
        called(tmp_path, "a,b\n1,2\n", "--json", "--write")
    assert end.value.code == Exit.FAILURE
    assert "column" in json.loads(capsys.readouterr().out)["refused"]
    assert (tmp_path / "acsard.toml").read_text() == "# mine\n"


def test_a_refusal_has_what_was_told_of_the_log(
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


@pytest.mark.parametrize("what", ["a bag", "an MCAP of others"])
def test_what_ros_records_is_told_to_be_exported(
    what: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    log = tmp_path / "bag"
    if what == "a bag":
        log.mkdir()
    else:
        with log.open("wb") as stream:
            writer = Writer(stream)
            writer.start("ros2", "libmcap")
            schema = writer.register_schema("nav_msgs/msg/Odometry", "ros2msg", b"")
            channel = writer.register_channel("/odom", "cdr", schema)
            writer.add_message(channel, 1, b"\0\1\0\0", 1)
            writer.finish()
    args = parser(["calibrate"]).parse_args(["calibrate", "--json", "--log", str(log)])
    with pytest.raises(MendableError, match="export it as CSV"):
        args.main(args)
    assert "export it as CSV" in json.loads(capsys.readouterr().out)["refused"]


@pytest.mark.parametrize("word", ["0", "nan", "a=b", "-3", "1e9"])
def test_a_distance_is_a_length_in_metres(tmp_path: Path, word: str) -> None:
    with pytest.raises(SystemExit):
        called(tmp_path, GOOD, f"--distance={word}")


# without a log


def driving(*words: str) -> int:
    """Return the exit code of `acsard calibrate` with these arguments and no terminal."""
    args = parser(["calibrate"]).parse_args(["calibrate", *words])
    return int(args.main(args))


@pytest.mark.parametrize(
    ("words", "why"),
    [
        ([], "person at the terminal"),
        (["--distance", "2.0"], "--distance goes with --log"),
        (["--method", "positions"], "--positions KEY"),
        (["--method", "tape", "--positions", "sim/pose"], "leave one out"),
        (["--positions-at", "tcp/127.0.0.1:7447"], "--positions KEY"),
        (["--positions", "odom"], "computed from the wheels themselves"),
        (["--positions", "acsard/acsar/odom"], "computed from the wheels themselves"),
        (["--log", "drive.csv", "--method", "tape"], "--method is for a guided drive"),
        (["--log", "drive.csv", "--imu", "imu"], "--imu is for a guided drive"),
        (["--method", "tape", "--imu", "imu"], "--imu is for --method gyro, not for --method tape"),
        (["--positions", "sim/pose", "--imu", "x/imu"], "not for --positions"),
        (["--log", "drive.csv", "--yes"], "--yes is for a guided drive"),
        (["--log", "drive.csv", "--json-lines"], "--json-lines is for a guided drive"),
        (["--yes", "--json-lines"], "--json-lines asks them through a program"),
    ],
)
def test_what_cannot_be_meant_is_said_before_anything_is_connected_to(
    words: list[str], why: str, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr("sys.stdin", open(os.devnull))  # noqa: SIM115
    with pytest.raises(UsageError, match=re.escape(why)):
        driving(*words)


def test_without_a_daemon_it_is_said_where_none_is(tmp_path: Path) -> None:
    with pytest.raises(UnreachableError):
        driving("--yes", "--connect", "tcp/127.0.0.1:9")
