"""What the kernel, and the programs that run, say about this computer."""

from __future__ import annotations

import os
import pty
import subprocess
import sys
from collections.abc import Iterable, Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from types import SimpleNamespace

import pytest

from acsard.core.values import NS_PER_S
from acsard.host.kernel_counters import Conditions, Kernel, Reading, SlowClock, slow_clock
from acsard.machine import local_findings, serial_ports
from tests.unit.kernel_files import COOLER, COUNT, FIRMWARE, HWMON, POLICY, QUIET, write


def test_a_computer_without_these_files_has_zeros(tmp_path: Path) -> None:
    assert Kernel(tmp_path).read() == Reading()


@pytest.mark.parametrize(
    ("files", "expected"),
    [
        ({HWMON + "in0_lcrit_alarm": "1\n"}, Conditions(undervoltage=True, throttled=2)),
        ({FIRMWARE: "50005\n"}, Conditions(undervoltage=True, throttled=2)),
        # The firmware remembers low voltages and heat of the past, which cause nothing now.
        ({FIRMWARE: "f0000\n"}, Conditions(throttled=2)),
        ({FIRMWARE: "80008\n"}, Conditions(slowed_by_heat=True, throttled=2)),
        ({FIRMWARE: "e0006\n"}, Conditions(slowed_by_heat=True, throttled=2)),
        ({COOLER + "cur_state": "2\n"}, Conditions(slowed_by_heat=True, throttled=2)),
        ({COUNT: "5\n"}, Conditions(throttled=5)),
        (
            {POLICY + "scaling_governor": "powersave\n"},
            Conditions(throttled=2, slow_clock=SlowClock("powersave", 600, 1500)),
        ),
    ],
)
def test_each_condition_is_read_from_its_file(
    files: dict[str, str], expected: Conditions, tmp_path: Path
) -> None:
    assert Kernel(write(tmp_path, QUIET | files)).read().conditions == expected


@pytest.mark.parametrize(
    ("driver", "governor", "highest", "limit"),
    [
        ("cpufreq-dt", "ondemand", "1500000", None),
        ("cpufreq-dt", "ondemand", "900000", None),
        ("cpufreq-dt", "schedutil", "800000", 800),
        ("cpufreq-dt", "powersave", "1500000", 600),
        ("cpufreq-dt", "userspace", "1500000", 700),
        # This driver chooses the clock by the load with the governor of this name.
        ("intel_pstate", "powersave", "1500000", None),
    ],
)
def test_a_clock_is_slow_if_its_limit_is_far_below_the_full_clock(
    driver: str, governor: str, highest: str, limit: int | None
) -> None:
    policy = {
        "scaling_driver": driver,
        "scaling_governor": governor,
        "scaling_max_freq": highest,
        "scaling_min_freq": "600000",
        "scaling_setspeed": "700000" if governor == "userspace" else "<unsupported>",
        "cpuinfo_max_freq": "1500000",
    }
    result = slow_clock(policy)
    assert result == (None if limit is None else SlowClock(governor, limit, 1500))


@pytest.mark.parametrize(
    ("later", "taken"),
    # In ticks of 10 ms: of each processor for the host of the virtual machine, since its start.
    [((18419, 19567), False), ((18421, 19567), False), ((18419, 19578), True), ((18430,), True)],
)
def test_a_host_that_takes_a_processor_of_the_virtual_machine_is_named(
    later: tuple[int, ...], taken: bool, tmp_path: Path
) -> None:
    kernel = Kernel(write(tmp_path, QUIET))
    before = kernel.read()
    rows = [
        f"cpu{n} 4563760 1967646 673613 1415998 7026 0 17675 {k} 0 0" for n, k in enumerate(later)
    ]
    write(tmp_path, {"proc/stat": "\n".join(["cpu  0 0 0 0 0 0 0 0 0 0", *rows])})
    causes = local_findings.slowdowns(before, kernel.read(), 2 * NS_PER_S)
    assert [cause.code for cause in causes] == ["computer_steal"] * taken
    assert all("0.11 s" in cause.text for cause in causes)


@pytest.mark.parametrize("later", [{}, {COUNT: "3\n"}, {COOLER + "cur_state": "2\n"}])
def test_a_processor_that_became_hot_between_two_looks_is_named(
    later: dict[str, str], tmp_path: Path
) -> None:
    kernel = Kernel(write(tmp_path, QUIET))
    before = kernel.read()
    write(tmp_path, later)
    causes = local_findings.slowdowns(before, kernel.read(), NS_PER_S)
    assert [cause.code for cause in causes] == ["computer_hot"] * bool(later)


@pytest.mark.parametrize(
    ("usb_id", "board"), [("2341:0042", "Arduino Mega 2560 R3"), ("dead:beef", ""), ("", "")]
)
def test_a_serial_port_has_its_links_its_board_and_its_users(
    usb_id: str, board: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    vid, pid = (int(part or "0", 16) for part in (usb_id or ":").split(":"))
    ends = pty.openpty()
    path = os.ttyname(ends[1])
    by_id = tmp_path / "by-id"
    by_id.mkdir()
    for name, target in (("usb-b", path), ("usb-a", path), ("usb-other", "/dev/null")):
        (by_id / name).symlink_to(target)
    (by_id / "file").touch()
    ports = [
        SimpleNamespace(
            device=device, vid=vid if usb_id else None, pid=pid, description=description
        )
        for device, description in ((path, "USB2.0-Serial"), ("/dev/a", "n/a"))
    ]
    monkeypatch.setattr("serial.tools.list_ports.comports", lambda: ports)
    monkeypatch.setattr(serial_ports, "BY_ID", by_id)
    try:
        first, second = serial_ports.serial_devices()
    finally:
        for end in ends:
            os.close(end)
    assert (first.device, first.names, first.description) == ("/dev/a", [], "")
    assert (second.device, second.description) == (path, "USB2.0-Serial")
    assert second.names == [str(by_id / "usb-a"), str(by_id / "usb-b")]
    assert (second.usb_id, second.board) == (usb_id, board)
    assert [holder.pid for holder in second.holders] == [os.getpid()]
    monkeypatch.setattr(serial_ports, "BY_ID", tmp_path / "none")
    assert serial_ports.serial_devices()[1].names == []


@contextmanager
def running(where: Path, names: Iterable[str]) -> Iterator[None]:
    """Run a process of each of these names, and put it into the directory `proc`."""
    with ExitStack() as programs:
        for name in names:
            (where / name).symlink_to(os.path.realpath(sys.executable))
            begun = "import sys; print(flush=True); sys.stdin.read()"
            words, pipe = [str(where / name), "-I", "-S", "-c", begun], subprocess.PIPE
            program = programs.enter_context(subprocess.Popen(words, stdin=pipe, stdout=pipe))
            assert program.stdout is not None
            program.stdout.readline()  # before it, the kernel may not have named the process yet
            (where / "proc" / str(program.pid)).symlink_to(f"/proc/{program.pid}")
        yield


@pytest.mark.parametrize("ruled", [False, True])
@pytest.mark.parametrize(
    "programs", [{"brltty"}, {"ModemManager"}, {"brltty", "ModemManager"}, set()]
)
def test_programs_that_take_serial_ports_are_named_unless_a_rule_keeps_them_off(
    programs: set[str], ruled: bool, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    rules = tmp_path / "70-acsar.rules"
    if ruled:
        rules.touch()
    (tmp_path / "proc").mkdir()
    # The other processes of this computer are none of the test.
    monkeypatch.setattr("acsard.host.processes.PROC", tmp_path / "proc")
    monkeypatch.setattr(local_findings, "UDEV_RULES", (str(rules),))
    with running(tmp_path, programs):
        named = {each.code for each in local_findings.port_grabbers()}
    kept_off = {"ModemManager"} if ruled else set()
    assert named == {f"{name.lower()}_running" for name in programs - kept_off}
