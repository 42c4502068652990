"""`acsard calibrate` on files, inside this process."""

from __future__ import annotations

import errno
import json
import os
from pathlib import Path
from unittest.mock import MagicMock

import pytest

from acsard.calibration.log import read
from acsard.cli import calibrate, parser
from acsard.core.config.parsing import parse
from acsard.core.config.settings import Config
from acsard.host.errors import Exit, MendableError, UnreachableError
from acsard.terminal.output import MAX_TEXT_WIDTH
from acsard.terminal.prompt import TerminalPrompt
from tests.unit.calibration_logs import usual

GOOD = usual().csv(places=False)


def called(where: Path, log: str, *words: str, text: str = "# mine\n") -> int:
    """Return the exit code of `acsard calibrate log drive.csv` with these further arguments."""
    (where / "acsard.toml").write_text(text)
    (where / "drive.csv").write_text(log)
    options = [
        "calibrate",
        "log",
        str(where / "drive.csv"),
        "--config",
        str(where / "acsard.toml"),
    ]
    args = parser(["calibrate"]).parse_args([*options, *words])
    return int(args.main(args))


def test_json_is_one_object(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert called(tmp_path, GOOD, "--json") == 0
    result = json.loads(capsys.readouterr().out)
    assert 1.5 < result["found"]["wheel_separation_multiplier"] < 1.8
    assert result["reference"] == "gyro"


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
        assert getattr(config.drive, key) == pytest.approx(result["found"][key], abs=1e-4)
    assert "odometry.wheel_separation_multiplier_std" in result["settings"]
    for key, value in result["settings"].items():
        section, _, name = key.partition(".")
        assert getattr(getattr(config, section), name) == value
    with pytest.raises(MendableError, match=r"agrees\swith\sits\sconfiguration: nothing") as end:
        called(tmp_path, GOOD, "--json", "--write", text=text)
    assert end.value.code == Exit.FAILURE
    assert max(map(len, str(end.value).splitlines())) <= MAX_TEXT_WIDTH
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


def test_a_refusal_ends_with_failure_and_an_object(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    with pytest.raises(MendableError, match="first line") as end:
        called(tmp_path, "a,b\n1,2\n", "--json", "--write")
    assert end.value.code == Exit.FAILURE
    assert "t,left,right,yaw_rate" in json.loads(capsys.readouterr().out)["refused"]
    assert (tmp_path / "acsard.toml").read_text() == "# mine\n"


# without a log


def driving(*words: str) -> int:
    """Return the exit code of a guided `acsard calibrate` with these arguments and no terminal."""
    args = parser(["calibrate"]).parse_args(["calibrate", "drive", *words])
    return int(args.main(args))


@pytest.mark.parametrize(
    ("text", "answer", "says"),
    [
        ("# mine\n", "yes", "restart the daemon"),
        ("# mine\n", "no", ""),
        ("[mcu]\nport = '/dev/acsar_mcu'\n", "yes", "the values of the simulator"),
        ("", "yes", "no configuration file"),
    ],
)
def test_after_a_guided_drive_the_person_says_whether_its_result_is_written(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
    text: str, answer: str, says: str,
) -> None:  # fmt: skip
    monkeypatch.chdir(tmp_path)
    file = tmp_path / "acsard.toml"
    # The package has installed a file in /etc.
    monkeypatch.setattr("acsard.host.config_file.SEARCH_PATHS", (file,))
    if text:
        file.write_text(text)
    questions = []

    def ask(_: TerminalPrompt, question: str, answers: object) -> str:
        questions.append(question)
        return answer

    monkeypatch.setattr("sys.stdin", MagicMock())
    monkeypatch.setattr(TerminalPrompt, "ask", ask)
    monkeypatch.setattr(calibrate, "open_connection", MagicMock())
    monkeypatch.setattr(calibrate, "_prompt", MagicMock())
    monkeypatch.setattr(calibrate, "drive", lambda *_: (read(GOOD.encode()), Config()))
    assert driving() == 0
    out, err = capsys.readouterr()
    assert says in err
    assert ("nothing was written" in out) is (answer == "no")
    changed = file.exists() and file.read_text() != text
    assert changed is ("acsard.toml: written" in out) is (says == "restart the daemon")
    assert len(questions) == (text == "# mine\n")


def test_without_a_daemon_the_verb_ends_as_unreachable(tmp_path: Path) -> None:
    with pytest.raises(UnreachableError):
        driving("--yes", "--connect", "tcp/127.0.0.1:9")
