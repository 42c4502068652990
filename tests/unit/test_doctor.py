"""The doctor: the daemon's reports, the file, this computer, and its ports."""

from __future__ import annotations

import errno
import os
import pty
import re
import resource
import socket
import stat
import subprocess
import sys
import time
from collections.abc import Iterable
from contextlib import nullcontext
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from msgspec.structs import replace

from acsard.bus.address import Address
from acsard.client.identity import ClientIdentity
from acsard.core.config.parsing import effective
from acsard.core.config.settings import BusConfig, Config, McuConfig
from acsard.core.messages.encodings import DecodeError
from acsard.core.messages.schema import DiagnosticStatus, Info, KeyValue, Time
from acsard.daemon.serial.device import refusal
from acsard.host import clock, real_time
from acsard.host.errors import CertificateError, NoAnswerError
from acsard.host.kernel_counters import Kernel
from acsard.machine import examination, local_findings, versions
from acsard.machine.authority import Authority
from acsard.machine.examination import (
    Running,
    clocks,
    compared,
    examine,
    gateway,
    local,
    query_or_finding,
    reported,
    routers,
)
from acsard.machine.finding import Finding
from acsard.machine.local_findings import (
    clock_year,
    computer,
    scheduling,
    serial_port,
    slowness,
    unused_version,
)
from acsard.machine.serial_ports import BOARDS
from tests.unit.kernel_files import COUNT, HWMON, POLICY, QUIET, write

INFO = Info("acsar", "1.2", 77, "/dev/pts/3", False, 100.0, [], [])
FILE = Config()

SETTINGS = (
    "correct your file; `acsard check --new FILE` writes all settings with their explanations"
)


def running(config: Config = FILE, **more: float) -> Running:
    return Running(INFO, config, (), "", **more)  # type: ignore[arg-type]


def row(name: str, level: int, message: str, advice: str = "", code: str = "") -> DiagnosticStatus:
    pairs = {"a": "b", "advice": advice, "code": code}
    values = [KeyValue(key, value) for key, value in pairs.items() if value]
    return DiagnosticStatus(level, f"acsard: {name}", message, "acsar", values)


def test_a_reason_of_two_reports_is_printed_once_where_it_is_not_ok() -> None:
    waits = row("mode", 2, "nothing came", code="received_nothing")
    link = row("serial link", 2, "down: nothing came", "check", code="received_nothing")
    assert list(reported((waits, link, row("recording", 0, "on")))) == [
        Finding("serial link", "received_nothing", "failure", "down: nothing came", "check"),
        Finding("recording", "", "ok", "on"),
    ]
    both = [row(name, 0, "sound", code="routers_connected") for name in ("bus", "routers")]
    assert [one.subject for one in reported(tuple(both))] == ["bus", "routers"]
    (alone,) = reported((waits,))
    assert (alone.subject, alone.code) == ("mode", "received_nothing")


class Answering:
    """A daemon whose clock is ahead of this computer's by this time, s."""

    def __init__(self, ahead_s: float) -> None:
        self._ahead_s = ahead_s

    def get(self, key: str) -> Any:
        now_ns = clock.now().wall_ns + round(self._ahead_s * 1e9)
        answers = {
            "info": INFO, "config": effective(FILE), "diagnostics": SimpleNamespace(status=[]),
            "state": SimpleNamespace(stamp=Time.from_ns(now_ns)),
        }  # fmt: skip
        return answers[key]

    def whoami(self) -> ClientIdentity:
        return ClientIdentity("maintainer", "", "0123")


@pytest.mark.parametrize("ahead_s", [0.0, 5.0, -3600.0])
def test_the_clock_of_a_daemon_is_compared_by_the_time_of_its_answer(
    ahead_s: float, monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = nullcontext(Answering(ahead_s))
    monkeypatch.setattr(examination, "open_connection", lambda _: robot)
    found = examination.query(FILE, Address("tcp/127.0.0.1:1", "acsar", ""))
    assert 0.0 <= found.round_trip_s < 1.0
    assert abs(found.ahead_s - ahead_s) <= found.round_trip_s
    assert (found.config, found.info) == (FILE, INFO)
    assert codes(clocks(found)) == ["clock_apart"] * bool(ahead_s)


def test_each_remedy_is_said_once() -> None:
    text = b"[mcu]\nbaud_rate = 1\nreply_period = -1"
    assert [finding.mend for finding in examine("x", text, {})] == [SETTINGS, ""]


@pytest.mark.parametrize(
    ("text", "wanted"),
    [
        ('listen = ["tcp/127.0.0.1:9"]\n[mcu]\nport = "TLS/key.pem"',
         "daemon_absent port_not_serial"),
        ('listen = ["tcp/127.0.0.1:9", "tls/0.0.0.0:9"]\ntls = "TLS"',
         "configuration_doubtful gateway_absent"),
        ('mode = "client"\nconnect = ["tcp/127.0.0.1:9"]', "daemon_behind_router router_absent"),
    ],
)  # fmt: skip
def test_what_does_not_answer_has_its_code(
    text: str, wanted: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(examination, "computer", lambda *_: ())  # of the machine of the tests
    Authority.make(tmp_path, "test", 60).issue(tmp_path, "robot", ["localhost"], 60)
    text = f"[bus]\n{text}\n".replace("TLS", str(tmp_path))
    assert {found.code for found in examine("robot.toml", text.encode(), {})} >= {*wanted.split()}


def test_the_file_s_values_are_ok() -> None:
    assert [(one.code, one.level) for one in compared(FILE, FILE)] == [("configuration_same", "ok")]


def test_values_of_command_line_options_are_no_warning() -> None:
    bus = BusConfig(listen=("tcp/127.0.0.1:1", "tcp/127.0.0.1:2"))
    runs = replace(FILE, mcu=McuConfig(port="/dev/pts/3"), bus=bus)
    (finding,) = compared(runs, FILE)
    assert (finding.level, finding.mend) == ("ok", "")
    assert "mcu.port = " in finding.text


@pytest.mark.parametrize(
    ("own", "endpoint", "subjects"),
    [
        (["127.0.0.1"], "tcp/127.0.0.1:{}", ["bus"]),  # the router listens on this one, too
        ([], "tcp/127.0.0.1:{}", []),
        ([], "tcp/router.local:{}", ["bus"]),
        ([], "tls/router.local:{}", []),
    ],
)
def test_a_router_without_tls_is_warned_of_unless_only_this_machine_reaches_it(
    own: list[str], endpoint: str, subjects: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("acsard.machine.examination.own_addresses", lambda: own)
    with socket.create_server(("127.0.0.1", 0)) as server:
        bus = BusConfig(connect=(endpoint.format(server.getsockname()[1]),))
        found = list(routers(replace(FILE, bus=bus), running=True))
    assert [finding.subject for finding in found] == subjects


def test_the_file_of_another_robot_is_not_compared() -> None:
    runs = replace(FILE, robot=replace(FILE.robot, id="robot1"))
    (finding,) = compared(runs, FILE)
    assert (finding.level, finding.mend) == ("ok", "")
    assert "it is for robot " in finding.text


class OfAnotherRobot:
    """A connection whose role may not read the configuration."""

    def get(self, key: str) -> object:
        raise NoAnswerError(key)


@pytest.mark.parametrize(("config", "code"), [(FILE, ""), (None, "configuration_secret")])
def test_a_daemon_with_the_simulator_has_no_port_and_may_keep_its_values_secret(
    config: Config | None, code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert FILE.mcu.simulated
    running = Running(INFO, config, (), "")
    monkeypatch.setattr(examination, "query_or_finding", lambda *_: running)
    monkeypatch.setattr(examination, "computer", lambda *_: ())
    found = codes(examine("x", b"", {}))
    assert "port_simulated" not in found
    assert found[-1:] == [code] or not code
    texts = [finding.text for finding in examine("x", b"[limits]\nlinear_speed = 0.3\n", {})]
    daemon = f"limits.linear_speed = {FILE.limits.linear_speed}, not 0.3"
    assert any(daemon in text for text in texts) is (config is not None)


@pytest.mark.parametrize(("robot", "judged"), [("acsar", True), ("robot1", False)])
def test_a_robot_is_judged_by_its_own_file_only(
    robot: str, judged: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    info = replace(INFO, id=robot)
    config = examination._configuration(OfAnotherRobot(), info, FILE)  # type: ignore[arg-type]
    monkeypatch.setattr(examination, "query_or_finding", lambda *_: Running(info, config, (), ""))
    found = list(examine("x", b"", {}))
    assert ("port" in {finding.subject for finding in found}) is judged
    assert any("file is of another robot" in finding.text for finding in found) is not judged


def test_values_that_were_set_and_sources_that_only_the_file_has_are_a_warning() -> None:
    limits = replace(FILE.limits, linear_speed=0.4)
    commands = replace(FILE.commands, sources=FILE.commands.sources[1:])
    (finding,) = compared(replace(FILE, limits=limits, commands=commands), FILE)
    assert finding.level == "warning"
    assert "limits.linear_speed = 0.4, not " in finding.text
    assert f"commands.sources.{FILE.commands.sources[0].name}.priority" in finding.text
    assert "`acsard set`" in finding.mend


@pytest.mark.parametrize(("count", "rest"), [(6, ""), (8, "and 2 more")])
def test_six_values_that_differ_are_named_and_the_number_of_the_others(
    count: int, rest: str
) -> None:
    names = [
        "linear_speed", "angular_speed", "linear_acceleration", "angular_acceleration",
        "linear_deceleration", "angular_deceleration", "linear_stop_deceleration",
        "angular_stop_deceleration",
    ][:count]  # fmt: skip
    limits = replace(FILE.limits, **dict.fromkeys(names, 0.123))
    (finding,) = compared(replace(FILE, limits=limits), FILE)
    assert finding.text.count("limits.") == 6
    assert finding.text.endswith(rest)


@pytest.mark.parametrize(
    ("ahead_s", "trip_s", "words"),
    [(0.3, 0.0, ""), (-0.8, 1.0, ""), (-2.0, 1.0, " 2.0 s behind"), (3600.0, 0.0, "s ahead of")],
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

    monkeypatch.setattr(examination, "answers", lambda _: True)
    monkeypatch.setattr(examination, "query", fail)
    finding = examination.query_or_finding(FILE, Address("tcp/127.0.0.1:7448", "acsar", ""))
    assert isinstance(finding, Finding)
    assert (finding.level, finding.text) == ("failure", str(error))
    assert finding.mend.endswith(mend) if mend else not finding.mend


WANTED = True


@pytest.mark.parametrize(
    ("capable", "limit", "level"),
    [(False, 0, "warning"), (False, 9, "warning"), (False, 10, "ok"), (False, -1, "ok"),
     (True, 0, "ok")],
)  # fmt: skip
def test_root_without_the_capability_needs_a_real_time_limit(
    capable: bool, limit: int, level: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "geteuid", lambda: 0)
    monkeypatch.setattr(resource, "getrlimit", lambda _: (limit, limit))
    monkeypatch.setattr(real_time, "_capable", lambda _: capable)
    (finding,) = scheduling(WANTED, None)
    assert finding.level == level
    assert bool(finding.mend) == (level == "warning")


@pytest.mark.parametrize(
    ("policy", "level"),
    [(os.SCHED_OTHER, "warning"), (os.SCHED_FIFO | os.SCHED_RESET_ON_FORK, "ok")],
)
def test_the_scheduling_policy_of_a_running_daemon_is_reported(
    policy: int, level: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(os, "sched_getscheduler", lambda _: policy)
    (finding,) = scheduling(WANTED, 77)
    assert (finding.level, "pid 77" in finding.text) == (level, True)


# A person's own simulator of their board often keeps both ends of its pty open.


@pytest.mark.skipif(os.geteuid() != 0, reason="needs root, to make a device file")
def test_a_device_file_without_a_device_is_named_by_doctor_and_daemon(tmp_path: Path) -> None:
    path = str(tmp_path / "ttyUSB0")
    os.mknod(path, 0o660 | stat.S_IFCHR, os.makedev(188, 199))
    (finding,) = serial_port(path, simulated=False)
    assert (finding.code, finding.level) == ("port_orphan", "failure")
    assert finding.text in str(refusal(path, OSError(errno.ENXIO, "no such device")))
    assert next(serial_port("/dev/null", simulated=False)).level == "ok"


@pytest.mark.parametrize(
    ("name", "code", "level"),
    [("other", "port_held", "failure"), ("acsard", "port_held_by_acsard", "ok")],
)
def test_a_program_that_uses_the_port_is_a_failure_unless_it_is_acsard(
    name: str, code: str, level: str, tmp_path: Path
) -> None:
    board, port = pty.openpty()
    path = os.ttyname(port)
    opened = f"os.open({path!r}, os.O_RDWR | os.O_NOCTTY)"
    program = f"import os, sys; {opened}; print(flush=True); sys.stdin.read()"
    (tmp_path / name).symlink_to(os.path.realpath(sys.executable))
    words, pipe = [str(tmp_path / name), "-I", "-S", "-c", program], subprocess.PIPE
    with subprocess.Popen(words, stdin=pipe, stdout=pipe, text=True) as other:
        assert other.stdout is not None
        other.stdout.readline()
        findings = list(serial_port(path, simulated=False))
        assert other.stdin is not None
        other.stdin.close()
    for end in (board, port):
        os.close(end)
    (used,) = [finding for finding in findings if f"(pid {other.pid})" in finding.text]
    assert (used.code, used.level) == (code, level)
    advice = "end that program, unless it belongs to your simulator of the board"
    assert used.mend == ("" if level == "ok" else advice)


def codes(findings: Iterable[Finding]) -> list[str]:
    return [finding.code for finding in findings]


def test_the_simulator_needs_no_port_and_a_file_is_none(tmp_path: Path) -> None:
    file = tmp_path / "port"
    file.touch()
    assert codes(serial_port("sim", simulated=True)) == ["port_simulated"]
    assert codes(serial_port("sim", simulated=False)) == []
    assert codes(serial_port(str(file), simulated=False)) == ["port_not_serial"]
    assert codes(serial_port(str(tmp_path / "none"), simulated=False)) == ["port_missing"]


@pytest.mark.skipif(os.geteuid() != 0, reason="root has a port that another user may not open")
def test_a_port_that_this_user_may_not_open_is_named_with_the_remedy() -> None:
    board, port = pty.openpty()
    try:
        os.setresuid(65534, 65534, 0)
        try:
            first = next(serial_port(os.ttyname(port), simulated=False))
        finally:
            os.setresuid(0, 0, 0)
    finally:
        for end in (board, port):
            os.close(end)
    assert (first.code, first.level) == ("port_denied", "failure")
    assert first.mend


def test_a_router_a_gateway_and_a_daemon_are_looked_for_where_they_should_listen() -> None:
    with socket.create_server(("127.0.0.1", 0)) as server:
        here = f"127.0.0.1:{server.getsockname()[1]}"
        with socket.create_server(("127.0.0.1", 0)) as closed:
            nowhere = f"127.0.0.1:{closed.getsockname()[1]}"
        both = [f"tls/{here}", f"tls/{nowhere}"]
        bus = BusConfig(listen=("tcp/127.0.0.1:1", *both))
        assert codes(gateway(replace(FILE, bus=bus))) == ["gateway_open", "gateway_absent"]
        config = replace(FILE, bus=BusConfig(connect=tuple(both)))
        (absent,) = routers(config, running=False)
        assert (absent.code, nowhere in absent.text) == ("router_absent", True)
        assert codes(routers(config, running=True)) == []
    for bus, code in (
        (BusConfig(), "daemon_absent"),
        (BusConfig(connect=(f"tcp/{nowhere}",)), "daemon_absent"),
        (BusConfig(mode="client", connect=(f"tcp/{nowhere}",)), "daemon_behind_router"),
    ):
        at = Address(f"tcp/{nowhere}", "acsar", "")
        found = query_or_finding(replace(FILE, bus=bus), at)
        assert isinstance(found, Finding)
        assert found.code == code


@pytest.mark.parametrize(
    ("calibrated", "port", "warned"),
    [(False, "/dev/null", True), (True, "/dev/null", False), (False, "sim", False)],
)
def test_a_real_robot_without_a_calibration_is_warned_of(
    calibrated: bool, port: str, warned: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(examination, "computer", lambda *_: ())
    std: Any = 0.01 if calibrated else "uncalibrated"
    odometry = replace(FILE.odometry, wheel_separation_multiplier_std=std)
    config = replace(FILE, odometry=odometry, mcu=McuConfig(port=port))
    found = codes(local(config, Address("tcp/127.0.0.1:1", "acsar", ""), "", 1))
    assert ("not_calibrated" in found) is warned


@pytest.mark.parametrize(("vid", "found"), [(0x2341, []), (0xDEAD, ["port_unknown_board"])])
def test_a_board_of_another_maker_is_named_with_those_that_are_known(
    vid: int, found: list[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    two = [
        SimpleNamespace(device=device, vid=number, pid=0x42, description="n/a")
        for device, number in (("/dev/null", vid), ("/dev/zero", 0xBEEF))
    ]
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: two)
    others = [one for one in serial_port("/dev/null", simulated=False) if "board" in one.code]
    assert codes(others) == found
    assert all("dead:0042" in one.text and "2341:0042" in one.text + one.mend for one in others)


def test_a_setting_with_a_surprising_effect_is_a_warning_also_without_a_daemon() -> None:
    with socket.create_server(("127.0.0.1", 0)) as closed:
        nowhere = f"tcp/127.0.0.1:{closed.getsockname()[1]}"
    text = b"commands.sources = []\n[mcu]\nport = '/dev/none'\n"
    found = list(examine("x", text, {}, lambda _: Address(nowhere, "acsar", "")))
    (doubtful,) = [one for one in found if one.code == "configuration_doubtful"]
    assert "no program can drive this robot" in doubtful.text
    assert doubtful.level == "warning"
    assert "port_missing" in codes(found)
    assert "port_simulated" not in codes(found)


@pytest.mark.parametrize(("year", "code"), [(1970, "clock_wrong"), (2026, "clock_right")])
def test_a_computer_without_a_clock_starts_long_ago(
    year: int, code: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    wall_ns = (year - 1970) * 31_557_600 * 10**9 + 10**15
    monkeypatch.setattr(clock, "now", lambda: SimpleNamespace(wall_ns=wall_ns))
    (found,) = clock_year()
    assert found.code == code
    assert str(year) in found.text


@pytest.mark.parametrize("runs", [True, False])
@pytest.mark.parametrize("wanted", [True, False])
def test_the_computer_is_examined_for_the_daemon_that_runs(
    wanted: bool, runs: bool, monkeypatch: pytest.MonkeyPatch
) -> None:
    pid = os.getpid() if runs else None
    monkeypatch.setattr(local_findings, "slowness", lambda: ())  # a measurement of 0.3 s
    assert [*scheduling(wanted, pid)] == [*computer(wanted, pid)][-1:]


def test_without_real_time_in_the_configuration_no_warning_is_given() -> None:
    (finding,) = scheduling(False, 77)
    assert finding.level == "ok"


def test_each_present_cause_of_lateness_is_a_warning_with_a_remedy(tmp_path: Path) -> None:
    files = {HWMON + "in0_lcrit_alarm": "1\n", POLICY + "scaling_governor": "powersave\n"}
    assert codes(slowness(Kernel(write(tmp_path, QUIET)))) == ["computer_well"]
    findings = list(slowness(Kernel(write(tmp_path, QUIET | files))))
    assert [finding.level for finding in findings] == ["warning", "warning"]
    assert "supply voltage is too low" in findings[0].text
    assert "power supply" in findings[0].mend
    assert "powersave keeps the processor at 600 of 1500 MHz" in findings[1].text
    assert "schedutil" in findings[1].mend


def test_heat_or_steal_during_the_measurement_is_named_and_that_of_before_is_not(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    kernel = Kernel(write(tmp_path, QUIET | {COUNT: "5\n"}))
    stolen = (
        "cpu  0 0 0 0 0 0 0 0 0 0\ncpu0 4563760 1967646 673613 1415998 7026 0 17675 99999 0 0\n"
    )
    for files, code in (
        ({COUNT: "5\n"}, "computer_well"), ({COUNT: "6\n"}, "computer_hot"),
        ({COUNT: "6\n"}, "computer_well"), ({"proc/stat": stolen}, "computer_steal"),
        ({"proc/stat": stolen}, "computer_well"),
    ):  # fmt: skip
        monkeypatch.setattr(time, "sleep", lambda _, f=files: write(tmp_path, f))
        assert codes(slowness(kernel)) == [code]


def test_a_newer_version_that_is_not_in_use_is_a_warning_with_the_command(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    assert list(unused_version()) == []
    monkeypatch.setattr(versions, "unused", lambda: "0.3.0")
    (finding,) = unused_version()
    assert finding.level == "warning"
    assert "`sudo acsard service upgrade /opt/acsard/0.3.0`" in finding.mend
    monkeypatch.setattr(versions, "previous", lambda: "0.3.0")
    (finding,) = unused_version()
    assert (finding.level, finding.mend) == ("ok", ""), "the operator has left this version"


RULES = Path(__file__).parents[2] / "deploy" / "udev" / "70-acsar.rules"

LINE = 'ENV{ID_VENDOR_ID}=="%s", ENV{ID_MODEL_ID}=="%s", ENV{ACSAR_MCU}="1"'


def test_the_udev_rules_name_exactly_the_usual_boards() -> None:
    lines = re.findall(re.escape(LINE).replace("%s", r"([\w|]+)"), RULES.read_text())
    named = [f"{vendor}:{model}" for vendor, models in lines for model in models.split("|")]
    assert sorted(named) == sorted(BOARDS)
