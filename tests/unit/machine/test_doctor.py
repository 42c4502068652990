"""The doctor prints the daemon's reports with their advice, and compares it with its file."""

from __future__ import annotations

import re

import pytest
from msgspec.structs import replace

from acsard.bus.address import Address
from acsard.bus.zenoh_sessions import answers
from acsard.core.config.parsing import parse
from acsard.core.config.settings import BusConfig, Config, McuConfig
from acsard.core.messages.encodings import DecodeError
from acsard.core.messages.schema import DiagnosticStatus, Info, KeyValue
from acsard.host.errors import CertificateError, NoAnswerError, UsageError
from acsard.machine import doctor
from acsard.machine.doctor import Running, clocks, compared, reported
from acsard.machine.finding import Finding

INFO = Info("acsar", "1.2", 77, "/dev/pts/3", False, 100.0, [], [])
FILE = Config()


def running(config: Config = FILE, **more: float) -> Running:
    return Running(INFO, config, (), "", **more)  # type: ignore[arg-type]


def row(name: str, level: int, message: str, advice: str = "", code: str = "") -> DiagnosticStatus:
    pairs = {"a": "b", "advice": advice, "code": code}
    values = [KeyValue(key, value) for key, value in pairs.items() if value]
    return DiagnosticStatus(level, f"acsard: {name}", message, "acsar", values)


def test_each_report_of_the_daemon_is_a_finding_with_its_advice() -> None:
    rows = (row("mode", 0, "ready"), row("wheels", 1, "blocked", "look"), row("gyro", 3, "old"))
    assert list(reported(rows)) == [
        Finding("mode", "ok", "ready"),
        Finding("wheels", "warning", "blocked", "look"),
        Finding("gyro", "failure", "old"),
    ]


def test_a_reason_of_two_reports_is_printed_once_where_it_is_not_ok() -> None:
    waits = row("mode", 0, "nothing came", code="silent")
    link = row("serial link", 2, "down: nothing came", "check", code="silent")
    assert list(reported((waits, link, row("recording", 0, "on")))) == [
        Finding("serial link", "failure", "down: nothing came", "check"),
        Finding("recording", "ok", "on"),
    ]


def test_the_file_s_values_are_ok() -> None:
    assert [finding.level for finding in compared(running(), FILE)] == ["ok"]


def test_values_of_command_line_options_are_offered_as_lines_for_the_file() -> None:
    bus = BusConfig(listen=("tcp/127.0.0.1:1", "tcp/127.0.0.1:2"))
    runs = replace(FILE, mcu=McuConfig(port="/dev/pts/3"), bus=bus)
    (finding,) = compared(running(runs), FILE)
    assert finding.level == "ok"
    keep = finding.mend.partition("into the file: ")[2]
    assert parse("\n".join(re.split(r"; |(?<=]) (?=\w)", keep)).encode()) == runs


def test_values_that_were_set_and_sources_that_only_the_file_has_are_a_warning() -> None:
    limits = replace(FILE.limits, linear_speed=0.4)
    commands = replace(FILE.commands, sources=FILE.commands.sources[1:])
    (finding,) = compared(running(replace(FILE, limits=limits, commands=commands)), FILE)
    assert finding.level == "warning"
    assert "limits.linear_speed = 0.4, not " in finding.text
    assert f"commands.sources.{FILE.commands.sources[0].name}.priority" in finding.text
    assert "acsard set KEY VALUE --keep" in finding.mend


@pytest.mark.parametrize(
    ("ahead_s", "trip_s", "words"),
    [(0.3, 0.0, ""), (-0.8, 1.0, ""), (-2.0, 1.0, "2.0 s behind"), (3600.0, 0.0, "s ahead of")],
)
def test_a_clock_is_wrong_if_a_late_answer_does_not_explain_it(
    ahead_s: float, trip_s: float, words: str
) -> None:
    findings = list(clocks(running(ahead_s=ahead_s, round_trip_s=trip_s)))
    assert [finding.level for finding in findings] == ["warning"] * bool(words)
    assert all(words in finding.text for finding in findings)


@pytest.mark.parametrize(
    ("error", "mend"),
    [
        (NoAnswerError("no answer"), "check whether another program listens at that address"),
        (CertificateError("there is no directory certs: run `acsard tls init`"), ""),
        (DecodeError("wrong_shape", "a field is missing"), "from the same version"),
    ],
)
def test_a_failed_query_of_the_daemon_has_advice_that_fits_its_error(
    error: Exception, mend: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*_: object) -> None:
        raise error

    monkeypatch.setattr(doctor, "answers", lambda _: True)
    monkeypatch.setattr(doctor, "query", fail)
    finding = doctor.query_or_finding(FILE, Address("tcp/127.0.0.1:7448", "acsar", ""))
    assert isinstance(finding, Finding)
    assert (finding.level, finding.text) == ("failure", str(error))
    assert finding.mend.endswith(mend) if mend else not finding.mend


@pytest.mark.parametrize("host", ["a..b", "a" * 70])
def test_a_host_that_cannot_exist_is_no_endpoint(host: str) -> None:
    with pytest.raises(UsageError, match="endpoint"):
        answers(f"tcp/{host}:7448")
