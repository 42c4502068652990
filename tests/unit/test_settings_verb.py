"""`acsard set`: values as in the file, how long they last, and --keep."""

from __future__ import annotations

import tomllib
from pathlib import Path
from tempfile import mkdtemp

import pytest

from acsard.cli import main
from acsard.cli.set import pairs
from acsard.core.messages.schema import Info, ServiceReply
from tests.each import each


@each(
    ("word", "value"),
    [
        ("0.8", 0.8), ("-1", -1), ("true", True), ("debug", "debug"), ('"debug"', "debug"),
        ("[1, 2.5]", [1, 2.5]), ("nan and more", "nan and more"), ("1\nother = 2", "1\nother = 2"),
        ("", ""), ("'", "'"), ("2026-01-01", "2026-01-01"), ("{a = 1}", "{a = 1}"),
    ],
)  # fmt: skip
def test_a_value_is_as_in_the_file_and_a_bare_word_is_a_text(word: str, value: object) -> None:
    settings = pairs(["log.level", word])
    assert settings == {"log.level": value}
    assert type(settings["log.level"]) is type(value)


PID = 1 << 30
"""No process of this computer has this id."""


class Robot:
    """A robot that sets everything."""

    def __init__(self) -> None:
        self.settings: dict[str, object] = {}

    def __enter__(self) -> Robot:
        return self

    def __exit__(self, *words: object) -> None: ...

    def get(self, key: str) -> Info:
        assert key == "info"
        return Info("acsar", "0", PID, "sim", True, 100.0, [], [])

    def set(self, settings: dict[str, object]) -> ServiceReply:
        self.settings = settings
        return ServiceReply(True, "rates.telemetry = 5.0 (was 10.0)")


def test_the_answer_says_how_long_the_setting_lasts(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setattr("acsard.cli.robot_options.open_connection", lambda *words, **more: Robot())
    assert main(["set", "rates.telemetry", "5"]) == 0
    text = "rates.telemetry = 5.0 (was 10.0); a set lasts until the daemon's next start\n"
    assert capsys.readouterr().out == text


def test_keep_writes_the_file_of_the_robot_on_which_it_is_typed(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    file = tmp_path / "robot.toml"
    file.write_text("# mine\n")
    monkeypatch.setattr("acsard.cli.robot_options.open_connection", lambda *words, **more: Robot())
    monkeypatch.setattr("acsard.cli.set.is_daemon_here", lambda pid: True)
    assert main(["set", "rates.telemetry", "5", "--keep", "--config", str(file)]) == 0
    assert capsys.readouterr().out == f"rates.telemetry = 5.0 (was 10.0); written to {file}\n"
    assert "# mine\n" in file.read_text()
    assert tomllib.loads(file.read_text()) == {"rates": {"telemetry": 5}}


@each("started", ["--config", "--config=", "ACSARD_CONFIG", "./acsard.toml"])
@each("same", [True, False])
def test_keep_says_that_the_daemon_uses_another_file(
    started: str,
    same: bool,
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    tmp_path: Path,
) -> None:
    where = Path(mkdtemp(dir=tmp_path))
    used, other, process = (where / name for name in ("acsard.toml", "robot2.toml", str(PID)))
    used.touch()
    other.touch()
    process.mkdir()
    (process / "cwd").symlink_to(where)
    words = {"--config": ("--config", "acsard.toml"), "--config=": ("--config=acsard.toml",)}
    command = ("/bin/acsard", "run", *words.get(started, ()))
    (process / "cmdline").write_text("\0".join(command))
    variable = "ACSARD_CONFIG=acsard.toml" if started == "ACSARD_CONFIG" else ""
    (process / "environ").write_text(f"HOME=/\0{variable}\0")
    monkeypatch.setattr("acsard.host.processes.PROC", where)
    monkeypatch.setattr("acsard.cli.robot_options.open_connection", lambda *words, **more: Robot())
    file = used if same else other
    assert main(["set", "rates.telemetry", "5", "--keep", "--config", str(file)]) == 0
    advice = f", but the daemon uses {used}: start it with `--config {other}`\n"
    assert capsys.readouterr().out.partition(f"written to {file}")[2] == ("\n" if same else advice)


@each("why", ["another machine", "it is read-only", "no configuration file"])
def test_keep_sets_nothing_if_it_cannot_write_the_file(
    why: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], tmp_path: Path
) -> None:
    monkeypatch.chdir(tmp_path)
    file, robot = tmp_path / "acsard.toml", Robot()
    file.unlink(missing_ok=True)
    if why != "no configuration file":
        file.touch(0o444 if why == "it is read-only" else 0o644)
    monkeypatch.setattr("acsard.host.config_file.SEARCH_PATHS", (file,))
    monkeypatch.setattr("acsard.cli.robot_options.open_connection", lambda *words, **more: robot)
    monkeypatch.setattr("acsard.cli.set.is_daemon_here", lambda pid: why != "another machine")
    assert main(["set", "rates.telemetry", "5", "--keep"]) == 1
    assert why in capsys.readouterr().err
    assert not robot.settings


def test_a_timeout_of_a_source_is_not_kept_and_then_nothing_is_set(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    robot = Robot()
    monkeypatch.setattr("acsard.cli.robot_options.open_connection", lambda *words, **more: robot)
    both = ["rates.telemetry", "5", "commands.sources.app.timeout", "0.3"]
    assert main(["set", *both, "--keep"]) == 2
    assert "[[commands.sources]] cannot be kept" in capsys.readouterr().err
    assert not robot.settings
