"""Tests of the doctor's findings about a daemon whose settings differ from its file."""

from __future__ import annotations

import re
from typing import get_args

import pytest
from msgspec.structs import replace

from acsard.bus.address import Address
from acsard.bus.zenoh_sessions import answers
from acsard.core.config.live import differences
from acsard.core.config.parsing import parse
from acsard.core.config.settings import (
    BatteryConfig,
    BusConfig,
    Config,
    DriveConfig,
    McuConfig,
    RobotConfig,
    SafetyConfig,
)
from acsard.core.messages.encodings import DecodeError
from acsard.core.messages.schema import (
    BatterySummary,
    DiagnosticStatus,
    Info,
    RobotState,
    Time,
)
from acsard.core.values import GyroDoes
from acsard.host.errors import CertificateError, NoAnswerError, UsageError
from acsard.machine import daemon_findings
from acsard.machine.daemon_findings import (
    MAX_KEYS,
    Running,
    certificate,
    clocks,
    compared,
    daemon,
    gyro,
    late,
    link,
    refused,
    unanswered_lines,
)
from acsard.machine.finding import Finding
from tests.each import each

LISTENS = "check whether another program listens at that address"

INFO = Info("acsar", "1.2", 77, "/dev/pts/3", False, 100.0, [], [])
STATE = RobotState(
    Time(), "ready", "", 0.0, 0.0, 0.0, 0.0, 0.0, [0.0] * 4, "up", "", [], "", {}
)  # fmt: skip
FILE = Config()


def running(config: Config) -> Running:
    return Running(INFO, config, STATE, STATE, 0)


def test_a_daemon_with_the_settings_of_the_file_is_ok() -> None:
    (finding,) = compared(running(FILE), FILE)
    assert finding.level == "ok"
    assert "pid 77" in finding.text


def test_each_key_that_differs_from_the_file_is_reported_with_both_values() -> None:
    runs = replace(FILE, mcu=McuConfig(port="/dev/pts/3", baud_rate=57600))
    assert [difference.describe(key) for key, difference in differences(runs, FILE).items()] == [
        'mcu.port = "/dev/pts/3", not "sim"',
        "mcu.baud_rate = 57600, not 115200",
    ]
    (finding,) = compared(running(runs), FILE)
    assert finding.level == "ok"
    assert 'mcu.port = "/dev/pts/3", not "sim"' in finding.text
    assert "to keep these values after a restart, write" in finding.mend
    assert "anew" not in finding.mend  # a restart would lead back to the simulator


def test_values_of_command_line_options_are_offered_as_lines_for_the_file() -> None:
    bus = BusConfig(listen=("tcp/127.0.0.1:1", "tcp/127.0.0.1:2"))
    runs = replace(FILE, mcu=McuConfig(port="/dev/pts/3"), bus=bus)
    (finding,) = compared(running(runs), FILE)
    keep = finding.mend.partition("into the configuration file: ")[2]
    assert parse("\n".join(re.split(r"; |(?<=]) (?=\w)", keep)).encode()) == runs


def test_a_difference_in_a_key_without_an_option_is_a_warning() -> None:
    (finding,) = compared(running(replace(FILE, odometry=replace(FILE.odometry, gyro=True))), FILE)
    assert (finding.level, "odometry.gyro = true, not false" in finding.text) == ("warning", True)
    assert "if the daemon runs with another file, name that file with --config" in finding.mend


def test_settings_changed_at_run_time_are_reported_separately_from_options() -> None:
    sources = (replace(FILE.commands.sources[0], timeout=0.4), *FILE.commands.sources[1:])
    runs = replace(
        FILE,
        limits=replace(FILE.limits, linear_speed=0.4),
        commands=replace(FILE.commands, sources=sources),
    )
    (finding,) = compared(running(runs), FILE)
    assert "limits.linear_speed = 0.4, not 1.0" in finding.text
    assert f"commands.sources.{sources[0].name}.timeout = 0.4, not 0.25" in finding.text
    assert "set while the daemon ran" in finding.text
    assert "acsard set KEY VALUE --keep" in finding.mend
    assert "options" not in finding.text + finding.mend
    both = replace(runs, mcu=McuConfig(port="/dev/pts/3"))
    by_option, by_set = compared(running(both), FILE)
    assert "mcu.port" in by_option.text
    assert "mcu.port" not in by_set.text


def test_a_source_that_only_the_file_has_is_reported() -> None:
    runs = replace(FILE, commands=replace(FILE.commands, sources=FILE.commands.sources[1:]))
    assert f"commands.sources.{FILE.commands.sources[0].name}.priority" in differences(runs, FILE)


def test_for_a_different_file_only_the_first_differences_are_listed() -> None:
    runs = replace(
        FILE,
        robot=RobotConfig("other"),
        mcu=McuConfig("/dev/x", 9600, True, 0.1, "auto", 400),
        bus=BusConfig(listen=("tcp/127.0.0.1:1",)),
        drive=DriveConfig(0.06, 0.31, 1.1, 1.01, 0.99),
    )
    by_option, finding = compared(running(runs), FILE)
    assert by_option.text.count(", not ") == 4
    assert finding.text.count(", not ") == MAX_KEYS
    assert f"and {len(differences(runs, FILE)) - 4 - MAX_KEYS} more" in finding.text


NOW = 1_800_000_000_000_000_000
S = 10**9


def running_daemon(apart: float, trip: float = 0.0, here: bool = False, **counters: int) -> Running:
    """Return the doctor's view of a daemon.

    The daemon's clock is `apart` s ahead, and the query took `trip` s.
    """
    state = replace(STATE, stamp=Time.from_ns(NOW + int(apart * S)), counters=counters)
    return Running(INFO, Config(), state, state, NOW, int(trip * S), (), here)


@pytest.mark.parametrize("apart", [0.0, 0.3, -0.3])
def test_clocks_that_agree_cause_no_finding(apart: float) -> None:
    assert list(clocks(running_daemon(apart, commands=7))) == []


@pytest.mark.parametrize(
    ("apart", "words"), [(3600.0, "3600.0 s ahead of"), (-0.5, "0.5 s behind")]
)
def test_clocks_that_disagree_are_a_warning_with_a_remedy(apart: float, words: str) -> None:
    (finding,) = clocks(running_daemon(apart))
    assert (finding.subject, finding.level) == ("clock", "warning")
    assert words in finding.text
    assert "timedatectl" in finding.mend


def test_a_late_answer_is_not_taken_for_a_wrong_clock() -> None:
    assert (
        list(clocks(running_daemon(-0.5, trip=1.0)))
        == list(clocks(running_daemon(0.5, trip=1.0)))
        == []
    )
    assert len(list(clocks(running_daemon(-2.0, trip=1.0)))) == 1


def test_a_daemon_on_this_machine_has_its_clock() -> None:
    assert list(clocks(running_daemon(-3.0, here=True))) == []


def test_stamps_that_were_replaced_are_reported() -> None:
    (finding,) = clocks(running_daemon(0.0, stamps_replaced=12))
    assert "12 commands" in finding.text


def test_periods_missed_in_the_last_minute_are_a_warning_after_months() -> None:
    running = running_daemon(0.0, lines_sent=345_600_000, missed_periods=600)
    assert not list(late(running))
    row = DiagnosticStatus(1, "acsard: control loop", "600 of 6000 periods missed", "acsar", [])
    (finding,) = late(replace(running, rows=(row,)))
    assert finding.level == "warning"
    assert "600 of 6000" in finding.text


@pytest.mark.parametrize("does", ["off", "used", "waiting for rest", "waiting for turn"])
def test_a_gyro_that_works_causes_no_warning(does: str) -> None:
    assert [finding.level for finding in gyro(does, {})] == ([] if does == "off" else ["ok"])


@each("does", [*get_args(GyroDoes)[4:], "what a later one does"])
def test_a_gyro_that_does_not_work_is_a_warning_with_a_remedy(does: str) -> None:
    (finding,) = gyro(does, {})
    assert (finding.subject, finding.level) == ("gyro", "warning")
    assert finding.text
    assert finding.mend


def test_rejected_samples_of_a_gyro_are_reported_with_their_reasons() -> None:
    counters = {"imu_out_of_range": 3, "imu_second_sender": 12, "imu_not_finite": 0, "lines": 9}
    _, finding = gyro("used", counters)
    assert finding.level == "warning"
    assert "12 second sender, 3 out of range" in finding.text
    assert finding.mend


def test_a_stop_that_a_restart_would_lose_is_a_warning_with_a_remedy() -> None:
    trouble = (
        "a stop would not survive a restart: the latch file (/x/a.latches.json) cannot be written: "
        "Read-only file system"
    )
    running = running_daemon(0.0)
    running = replace(running, state=replace(running.state, latch_file_error=trouble))
    (finding,) = (item for item in daemon(running) if item.subject == "latch file")
    assert (finding.level, finding.text) == ("warning", trouble)
    assert "control.state_directory" in finding.mend


CONFIG = Config(mcu=McuConfig(port="/dev/ttyX"))


@pytest.mark.parametrize(
    ("here", "mend"),
    [
        (True, "try-reload-or-restart acsard-gateway acsard-web"),
        (True, "if the robot connects to a router, also `sudo systemctl reload acsard`"),
        (False, "`acsard doctor` on the daemon's machine"),
    ],
)
def test_an_expiring_certificate_in_use_is_a_warning_with_a_remedy(here: bool, mend: str) -> None:
    words = "expires in 9 days (certificate of the router tls/router.local:7447)"
    row = DiagnosticStatus(1, "acsard: certificate", words, "acsar", [])
    (finding,) = certificate(row, here)
    assert (finding.subject, finding.level) == ("certificates", "warning")
    assert finding.text.endswith(words)
    assert mend in finding.mend
    assert list(certificate(replace(row, level=0), here)) == list(certificate(None, here)) == []


@pytest.mark.parametrize("here", [True, False])
def test_changed_settings_of_a_daemon_on_another_machine_are_a_warning(here: bool) -> None:
    running = running_daemon(0.0, here=here)
    running = replace(running, state=replace(running.state, settings_differ="rates.odom = 7.5"))
    texts = [finding.text for finding in daemon(running) if finding.subject == "configuration"]
    words = "settings were changed since the daemon's start: rates.odom = 7.5"
    # On the daemon's own machine the doctor compares with the file itself.
    assert texts == ([] if here else [words])


def link_findings(before: dict[str, int], after: dict[str, int], **state: str) -> list[Finding]:
    first, two = replace(STATE, counters=before), replace(STATE, counters=after, **state)
    return list(link(Running(INFO, CONFIG, first, two, 0)))


@pytest.mark.parametrize(
    ("error", "mend"),
    [
        (NoAnswerError("no answer"), LISTENS),
        (CertificateError("there is no directory certs: run `acsard tls init`"), ""),
        (DecodeError("wrong_shape", "a field is missing"), "from the same version"),
    ],
)
def test_a_failed_query_of_the_daemon_has_advice_that_fits_its_error(
    error: Exception, mend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(daemon_findings, "answers", lambda _: True)
    monkeypatch.setattr(daemon_findings, "query", fail)
    finding = daemon_findings.query_or_finding(FILE, Address("tcp/127.0.0.1:7448", "acsar", ""))
    assert isinstance(finding, Finding)
    assert (finding.level, finding.text) == ("failure", str(error))
    assert finding.mend.endswith(mend) if mend else not finding.mend


@pytest.mark.parametrize(
    ("code", "mend", "unfit"),
    [
        ("impossible_speeds", "acsard mcu check", "defect of acsard"),
        ("guard_too_fast", "defect of acsard", "acsard mcu check"),
    ],
)
def test_the_advice_about_a_fault_fits_its_cause(code: str, mend: str, unfit: str) -> None:
    state = replace(STATE, mode="fault", code=code)
    first = next(daemon(Running(INFO, CONFIG, state, state, 0)))
    assert mend in first.mend
    assert unfit not in first.mend
    assert "acsard call clear" in first.mend


def test_a_sound_link_gives_one_ok_finding() -> None:
    (finding,) = link_findings({"lines": 5, "lines_sent": 900}, {"lines": 104, "lines_sent": 1000})
    assert (finding.subject, finding.level) == ("link", "ok")


@each(("period", "answers_are_counted"), [(0.0, True), (0.1, False)])
def test_a_sound_link_says_which_lines_were_judged(
    period: float, answers_are_counted: bool
) -> None:
    config = Config(mcu=McuConfig(port="/dev/ttyX", reply_period=period))
    before = replace(STATE, counters={"lines": 5, "lines_sent": 900})
    state = replace(STATE, counters={"lines": 104, "lines_sent": 1000})
    (finding,) = link(Running(INFO, config, before, state, 0))
    assert finding.level == "ok"
    assert ("almost all lines to and from the board arrive" in finding.text) is answers_are_counted
    assert ("cannot check the lines to the board" in finding.text) is not answers_are_counted
    state = replace(STATE, counters={"lines": 44, "lines_sent": 939})
    (finding,) = link(Running(INFO, config, before, state, 0))
    assert finding.level == "ok"
    assert ("sends too few lines in a second" in finding.text) is answers_are_counted


@pytest.mark.parametrize("state", ["booting", "stale"])
def test_a_missing_link_is_a_failure_with_its_reason_and_the_check_command(state: str) -> None:
    (finding,) = link_findings({}, {}, link=state, mode="waiting", reason="nothing was received")
    assert finding.level == "failure"
    assert "nothing was received" in finding.text
    assert "acsard mcu check --port /dev/ttyX" in finding.mend
    assert "kill 77" in finding.mend


def test_lines_that_are_not_answered_are_a_warning() -> None:
    (finding,) = link_findings({"lines": 80, "lines_sent": 100}, {"lines": 160, "lines_sent": 200})
    assert finding.level == "warning"
    assert "answered only 80 of the 100 lines that the daemon sent in a second" in finding.text
    assert "mcu check" in finding.mend


@each(
    ("sent", "line_count", "period", "findings"),
    [(100, 100, 0.0, 0), (100, 98, 0.0, 0), (100, 97, 0.0, 0), (100, 96, 0.0, 1),
     (100, 130, 0.0, 0), (10, 0, 0.0, 0), (100, 10, 0.1, 0)],
)  # fmt: skip
def test_unanswered_lines_are_reported_only_if_they_are_a_loss(
    sent: int, line_count: int, period: float, findings: int
) -> None:
    config = Config(mcu=McuConfig(reply_period=period))
    assert (
        len(list(unanswered_lines({"lines_sent": sent, "lines": line_count}, config))) == findings
    )


def test_rejected_lines_are_reported_by_kind_above_one_in_fifty() -> None:
    assert not list(refused({"lines": 1000, "line_malformed": 20, "lines_sent": 9}))
    (text,) = refused({"lines": 1000, "line_malformed": 12, "line_crc_error": 30})
    assert "12 malformed, 30 crc error" in text


def test_a_link_lost_because_the_computer_was_late_is_not_blamed_on_the_board() -> None:
    (late,) = link_findings({}, {"link_lost": 3, "link_lost_host_stall": 3})
    assert "lost 3 times" in late.text
    assert "the daemon's computer" in late.text
    assert "mcu check" not in late.mend
    late, board = link_findings({}, {"link_lost": 5, "link_lost_host_stall": 3})
    assert "lost 2 times" in board.text
    assert "mcu check" in board.mend
    states = replace(STATE, counters={"link_lost": 2})
    (sim,) = link(Running(INFO, Config(), STATE, states, 0))
    assert "the daemon's computer" in sim.text
    assert "mcu check" not in sim.mend
    (finding,) = link_findings({}, {}, link="stale", mode="waiting", code="host_late")
    assert "mcu check" not in finding.mend


def test_a_wheel_fault_is_a_warning() -> None:
    *_, finding = link_findings({}, {}, wheel_fault="rear left: its encoder stands")
    assert (finding.subject, finding.level) == ("wheels", "warning")


@pytest.mark.parametrize(
    ("state", "level"), [("pressed", "warning"), ("silent", "failure"), ("released", "ok")]
)
def test_the_emergency_stop_of_the_board_is_reported(state: str, level: str) -> None:
    *_, finding = link_findings({}, {}, emergency_stop=state)
    assert (finding.subject, finding.level) == ("emergency stop", level)


def test_a_required_emergency_stop_that_the_board_does_not_report_is_a_failure() -> None:
    config = replace(CONFIG, safety=SafetyConfig(estop="required"))
    *_, finding = link(Running(INFO, config, STATE, STATE, 0))
    assert (finding.subject, finding.level) == ("emergency stop", "failure")


@pytest.mark.parametrize(
    ("bumpers", "level"),
    [([True, False], "warning"), ([False, False], "ok"), (None, "failure")],
)
def test_the_bumpers_of_the_board_are_reported(bumpers: list[bool] | None, level: str) -> None:
    config = replace(CONFIG, safety=SafetyConfig(bumpers=("front", "rear")))
    state = replace(STATE, bumpers=bumpers)
    *_, finding = link(Running(INFO, config, state, state, 0))
    assert (finding.subject, finding.level) == ("bumpers", level)


THRESHOLDS = BatteryConfig(warning_below=22.0, stop_below=21.0)


@pytest.mark.parametrize(
    ("battery", "level"),
    [
        (BatterySummary(24.0, 80.0, -1.0, "ok"), "ok"),
        (BatterySummary(21.5, None, None, "warning"), "warning"),
        (BatterySummary(20.5, None, None, "stop"), "failure"),
        (BatterySummary(None, None, None, "unknown"), "warning"),
        (None, "warning"),
    ],
)
def test_the_battery_of_the_board_is_reported(battery: BatterySummary | None, level: str) -> None:
    state = replace(STATE, battery=battery)
    config = replace(CONFIG, battery=THRESHOLDS)
    *_, finding = link(Running(INFO, config, state, state, 0))
    assert (finding.subject, finding.level) == ("battery", level)


def test_a_board_without_a_battery_has_no_finding_unless_thresholds_need_it() -> None:
    assert [finding.subject for finding in link_findings({}, {})] == ["link"]


DAYS_40 = {"lines": 340_000_000, "lines_sent": 345_600_000}
"""Line counters after 40 days at 100 Hz."""


def test_after_months_only_present_problems_are_warnings() -> None:
    (finding,) = link_findings(DAYS_40, DAYS_40 | {"link_lost": 40})
    assert finding.level == "ok"
    assert "lost 40 times" in finding.text
    (finding,) = link_findings(DAYS_40, DAYS_40 | {"link_lost": 41})
    assert finding.level == "warning"
    now = {"lines": DAYS_40["lines"] + 90, "lines_sent": DAYS_40["lines_sent"] + 100}
    _, finding = link_findings(DAYS_40, now | {"line_malformed": 10})
    assert finding.level == "warning"
    assert "10 malformed" in finding.text


@pytest.mark.parametrize("host", ["a..b", "a" * 70])
def test_a_host_that_cannot_exist_is_no_endpoint(host: str) -> None:
    with pytest.raises(UsageError, match="endpoint"):
        answers(f"tcp/{host}:7448")
