"""Tests of the doctor's findings about a daemon whose settings differ from its file."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, get_args

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
    FeedbackConfig,
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
from acsard.core.motion.consistency import NO_ENCODERS
from acsard.core.values import GyroDoes
from acsard.host.errors import CertificateError, NoAnswerError, UsageError
from acsard.machine import daemon_findings
from acsard.machine.daemon_findings import (
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


def test_values_of_command_line_options_are_offered_as_lines_for_the_file() -> None:
    bus = BusConfig(listen=("tcp/127.0.0.1:1", "tcp/127.0.0.1:2"))
    runs = replace(FILE, mcu=McuConfig(port="/dev/pts/3"), bus=bus)
    (finding,) = compared(running(runs), FILE)
    keep = finding.mend.partition("into the configuration file: ")[2]
    assert parse("\n".join(re.split(r"; |(?<=]) (?=\w)", keep)).encode()) == runs


def test_a_source_that_only_the_file_has_is_reported() -> None:
    runs = replace(FILE, commands=replace(FILE.commands, sources=FILE.commands.sources[1:]))
    assert f"commands.sources.{FILE.commands.sources[0].name}.priority" in differences(runs, FILE)


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


def test_a_late_answer_is_not_taken_for_a_wrong_clock() -> None:
    assert (
        list(clocks(running_daemon(-0.5, trip=1.0)))
        == list(clocks(running_daemon(0.5, trip=1.0)))
        == []
    )
    assert len(list(clocks(running_daemon(-2.0, trip=1.0)))) == 1


def test_a_daemon_on_this_machine_has_its_clock() -> None:
    assert list(clocks(running_daemon(-3.0, here=True))) == []


CONFIG = Config(mcu=McuConfig(port="/dev/ttyX"))


@pytest.mark.parametrize("here", [True, False])
def test_changed_settings_of_a_daemon_on_another_machine_are_a_warning(here: bool) -> None:
    running = running_daemon(0.0, here=here)
    running = replace(running, state=replace(running.state, settings_differ="rates.odom = 7.5"))
    texts = [finding.text for finding in daemon(running) if finding.subject == "configuration"]
    words = "settings were changed since the daemon's start: rates.odom = 7.5"
    # On the daemon's own machine the doctor compares with the file itself.
    assert texts == ([] if here else [words])


def link_findings(
    before: dict[str, int], after: dict[str, int], config: Config = CONFIG, **state: Any
) -> list[Finding]:
    first, two = replace(STATE, counters=before), replace(STATE, counters=after, **state)
    return list(link(Running(INFO, config, first, two, 0)))


def settings_findings(**changes: Any) -> list[Finding]:
    """Return the findings about a daemon whose settings differ in this way from its file."""
    return list(compared(running(replace(FILE, **changes)), FILE))


def board(config: Config = CONFIG, **state: Any) -> list[Finding]:
    """Return the findings about the inputs and wheels of a board with a sound link."""
    seen = replace(STATE, **state)
    return [item for item in link(Running(INFO, config, seen, seen, 0)) if item.subject != "link"]


def state_findings(subject: str, here: bool = False, **state: Any) -> list[Finding]:
    seen = running_daemon(0.0, here=here)
    found = daemon(replace(seen, state=replace(seen.state, **state)))
    return [finding for finding in found if finding.subject == subject]


BEFORE, AFTER = {"lines": 5, "lines_sent": 900}, {"lines": 104, "lines_sent": 1000}
"""The counters of a sound link, a second apart."""
FREE = Config(mcu=McuConfig(port="/dev/ttyX", reply_period=0.1))
FRONT_REAR = replace(CONFIG, safety=SafetyConfig(bumpers=("front", "rear")))
BATTERY = replace(CONFIG, battery=BatteryConfig(warning_below=22.0, stop_below=21.0))
SOURCES = (replace(FILE.commands.sources[0], timeout=0.4), *FILE.commands.sources[1:])
SET = {
    "limits": replace(FILE.limits, linear_speed=0.4),
    "commands": replace(FILE.commands, sources=SOURCES),
}
CERTIFICATE = DiagnosticStatus(
    1, "acsard: certificate", "expires in 9 days (certificate of the router tls/x:7447)", "", []
)
MISSED = DiagnosticStatus(1, "acsard: control loop", "600 of 6000 periods missed", "acsar", [])
MONTHS = running_daemon(0.0, lines_sent=345_600_000, missed_periods=600)


def situations() -> dict[str, Iterable[Finding]]:
    """Return the findings of each situation."""
    return {
        "the settings of the file": settings_findings(),
        "options of the command line": settings_findings(
            mcu=McuConfig(port="/dev/pts/3", baud_rate=57600)
        ),
        "another key than those of options": settings_findings(
            odometry=replace(FILE.odometry, gyro=True)
        ),
        "settings that were set": settings_findings(**SET),
        "an option and settings that were set": settings_findings(
            **SET, mcu=McuConfig(port="/dev/pts/3")
        ),
        "a different file": settings_findings(
            robot=RobotConfig("other"),
            mcu=McuConfig("/dev/x", 9600, True, 0.1, "on", 400),
            bus=BusConfig(listen=("tcp/127.0.0.1:1",)),
            drive=DriveConfig(0.06, 0.31, 1.1, 1.01, 0.99),
        ),
        "settings that were changed, on another machine": state_findings(
            "configuration", settings_differ="rates.odom = 7.5"
        ),
        "settings that were changed, here": state_findings(
            "configuration", here=True, settings_differ="rates.odom = 7.5"
        ),
        "a clock ahead": clocks(running_daemon(3600.0)),
        "a clock behind": clocks(running_daemon(-0.5)),
        "stamps that were replaced": clocks(running_daemon(0.0, stamps_replaced=12)),
        "missed periods since the start": late(MONTHS),
        "missed periods in the last minute": late(replace(MONTHS, rows=(MISSED,))),
        **{
            f"a gyro: {does}": gyro(does, {})
            for does in ("off", *get_args(GyroDoes), "what is new")
        },
        "rejected samples of a gyro": gyro(
            "used", {"imu_out_of_range": 3, "imu_second_sender": 12}
        ),
        "a latch file that cannot be written": state_findings("latch file", latch_file_error="why"),
        "an expiring certificate, here": certificate(CERTIFICATE, is_local=True),
        "an expiring certificate, elsewhere": certificate(CERTIFICATE, is_local=False),
        "a fault of the board": state_findings("daemon", mode="fault", code="impossible_speeds"),
        "a fault of acsard": state_findings("daemon", mode="fault", code="guard_too_fast"),
        "a sound link": link_findings(BEFORE, AFTER),
        "a sound link to a board with its own clock": link_findings(BEFORE, AFTER, FREE),
        "too few lines to judge": link_findings(BEFORE, {"lines": 44, "lines_sent": 939}),
        "a missing link": link_findings(
            {}, {}, link="booting", mode="waiting", reason="nothing came"
        ),
        "a link that this computer lost": link_findings(
            {}, {}, link="stale", mode="waiting", code="host_late"
        ),
        "lines that are not answered": link_findings(
            {"lines": 80, "lines_sent": 100}, {"lines": 160, "lines_sent": 200}
        ),
        "losses by a late computer": link_findings({}, {"link_lost": 3, "link_lost_host_stall": 3}),
        "losses by the board, too": link_findings({}, {"link_lost": 5, "link_lost_host_stall": 3}),
        "losses of the simulator": link_findings({}, {"link_lost": 2}, Config()),
        "a wheel fault": board(wheel_fault="rear left: its encoder stands"),
        "no encoders": board(
            replace(CONFIG, feedback=FeedbackConfig(encoders=False)), wheel_fault=NO_ENCODERS
        ),
        **{
            f"an emergency stop: {now}": board(emergency_stop=now)
            for now in ("pressed", "silent", "released")
        },
        "a missing emergency stop": board(replace(CONFIG, safety=SafetyConfig(estop="required"))),
        "a pressed bumper": board(FRONT_REAR, bumpers=[True, False]),
        "released bumpers": board(FRONT_REAR, bumpers=[False, False]),
        "missing bumpers": board(FRONT_REAR),
        "a full battery": board(BATTERY, battery=BatterySummary(24.0, 80.0, -1.0, "ok")),
        "a low battery": board(BATTERY, battery=BatterySummary(21.5, None, None, "warning")),
        "an empty battery": board(BATTERY, battery=BatterySummary(20.5, None, None, "stop")),
        "an unknown battery": board(BATTERY, battery=BatterySummary(None, None, None, "unknown")),
        "a missing battery": board(BATTERY),
        "a board without inputs": board(),
    }


def test_each_situation_has_its_findings(approved: Callable[[Path, str], None]) -> None:
    """To write the file anew, add `--approve`, and then read `git diff`."""
    page = ""
    for name, findings in situations().items():
        page += f"--- {name}\n"
        for finding in findings:
            page += f"{finding.level} {finding.subject}: {finding.text}\n"
            page += f"  -> {finding.mend}\n" if finding.mend else ""
    approved(Path(__file__).with_name("daemon_findings.txt"), page)


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


THRESHOLDS = BatteryConfig(warning_below=22.0, stop_below=21.0)


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
