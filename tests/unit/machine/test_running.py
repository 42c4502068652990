"""Tests of the doctor's findings about a daemon whose settings differ from its file."""

from __future__ import annotations

import re

from msgspec.structs import replace

from acsard.core.config.live import differences
from acsard.core.config.parsing import parse
from acsard.core.config.settings import BusConfig, Config, DriveConfig, McuConfig, RobotConfig
from acsard.core.messages.schema import Info, RobotState, Time
from acsard.machine.running import SHOWN, Running, compared

INFO = Info("acsar", "1.2", 77, "/dev/pts/3", False, 100.0, [], [])
STATE = RobotState(
    Time(), "ready", "", 0.0, 0.0, 0.0, 0.0, 0.0, [0.0] * 4, "up", "", [], "", {}
)  # fmt: skip
FILE = Config()


def running(config: Config) -> Running:
    return Running(INFO, config, STATE, STATE, 0)


def test_a_daemon_that_runs_with_the_file_has_it() -> None:
    (finding,) = compared(running(FILE), FILE)
    assert finding.level == "ok"
    assert "pid 77" in finding.text


def test_each_key_that_is_otherwise_is_reported_with_both_values() -> None:
    runs = replace(FILE, mcu=McuConfig(port="/dev/pts/3", baud_rate=57600))
    assert [one.words(key) for key, one in differences(runs, FILE).items()] == [
        'mcu.port = "/dev/pts/3", not "sim"',
        "mcu.baud_rate = 57600, not 115200",
    ]
    (finding,) = compared(running(runs), FILE)
    assert finding.level == "ok"
    assert 'mcu.port = "/dev/pts/3", not "sim"' in finding.text
    assert "to keep them, write" in finding.mend
    assert "anew" not in finding.mend  # a restart would lead back to the simulator


def test_what_run_was_told_by_an_option_is_offered_as_lines_of_the_file() -> None:
    bus = BusConfig(listen=("tcp/127.0.0.1:1", "tcp/127.0.0.1:2"))
    runs = replace(FILE, mcu=McuConfig(port="/dev/pts/3"), bus=bus)
    (finding,) = compared(running(runs), FILE)
    keep = finding.mend.partition("into the file: ")[2]
    assert parse("\n".join(re.split(r"; |(?<=]) (?=\w)", keep)).encode()) == runs


def test_what_is_no_option_of_run_is_a_warning() -> None:
    (finding,) = compared(running(replace(FILE, odometry=replace(FILE.odometry, gyro=True))), FILE)
    assert (finding.level, "odometry.gyro = true, not false" in finding.text) == ("warning", True)
    assert "if it runs with another file, name that with --config" in finding.mend


def test_what_was_set_while_it_ran_is_told_apart_from_options() -> None:
    sources = (replace(FILE.commands.sources[0], timeout=0.4), *FILE.commands.sources[1:])
    runs = replace(
        FILE,
        limits=replace(FILE.limits, linear_speed=0.4),
        commands=replace(FILE.commands, sources=sources),
    )
    (finding,) = compared(running(runs), FILE)
    assert "limits.linear_speed = 0.4, not 1.0" in finding.text
    assert f"commands.sources.{sources[0].name}.timeout = 0.4, not 0.25" in finding.text
    assert "set while it ran" in finding.text
    assert "acsard set KEY VALUE --write" in finding.mend
    assert "options" not in finding.text + finding.mend
    both = replace(runs, mcu=McuConfig(port="/dev/pts/3"))
    by_option, by_set = compared(running(both), FILE)
    assert "mcu.port" in by_option.text
    assert "mcu.port" not in by_set.text


def test_a_source_that_only_the_file_has_is_reported() -> None:
    runs = replace(FILE, commands=replace(FILE.commands, sources=FILE.commands.sources[1:]))
    assert f"commands.sources.{FILE.commands.sources[0].name}.priority" in differences(runs, FILE)


def test_another_file_is_not_told_key_by_key() -> None:
    runs = replace(
        FILE,
        robot=RobotConfig("other"),
        mcu=McuConfig("/dev/x", 9600, True, 0.1, "auto", 400),
        bus=BusConfig(listen=("tcp/127.0.0.1:1",)),
        drive=DriveConfig(0.06, 0.31, 1.1, 1.01, 0.99),
    )
    by_option, finding = compared(running(runs), FILE)
    assert by_option.text.count(", not ") == 4
    assert finding.text.count(", not ") == SHOWN
    assert f"and {len(differences(runs, FILE)) - 4 - SHOWN} more" in finding.text
