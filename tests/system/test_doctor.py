"""`acsard doctor` and `acsard ports` find each fault and name its remedy."""

from __future__ import annotations

import json
import os
import pty
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from acsard.host.processes import holders, masters_of
from tests.system.harness import (
    Bus,
    Daemon,
    FarPeer,
    Program,
    acsard,
    environment,
    free_endpoint,
)

pytestmark = pytest.mark.network


def examined(
    where: Path, text: str, *options: str, **variables: str
) -> tuple[int, dict[str, list[dict[str, str]]]]:
    """Return the exit code and the findings by subject for a configuration."""
    file = where / "doctor.toml"
    file.write_text(text)
    words = [*acsard("doctor", "--json", "--config", str(file)), *options]
    env = environment(**variables)
    done = subprocess.run(words, capture_output=True, text=True, timeout=60, check=False, env=env)
    assert done.stderr == ""
    findings: dict[str, list[dict[str, str]]] = {}
    for finding in json.loads(done.stdout):
        findings.setdefault(finding["subject"], []).append(finding)
    return done.returncode, findings


def toml(port: str = "sim", more: str = "") -> str:
    return f'[mcu]\nport = "{port}"\n[bus]\nlisten = ["{free_endpoint()}"]\n{more}'


def worst(findings: list[dict[str, str]]) -> dict[str, str]:
    return max(findings, key=lambda finding: ("ok", "warning", "failure").index(finding["level"]))


@pytest.fixture
def terminal() -> Iterator[str]:
    ends = pty.openpty()
    yield os.ttyname(ends[1])
    for end in ends:
        os.close(end)


def test_a_machine_with_the_simulator_and_no_daemon_has_warnings_only(tmp_path: Path) -> None:
    code, findings = examined(tmp_path, toml())
    assert code == 0
    assert findings["configuration"][0]["level"] == "ok"
    assert "simulator" in worst(findings["port"])["text"]
    assert "acsard run" in worst(findings["daemon"])["mend"]


def test_the_process_that_holds_the_port_is_named_with_its_pid(
    tmp_path: Path, terminal: str
) -> None:
    holder = subprocess.Popen(
        [sys.executable, "-c", f"import os, time; os.open({terminal!r}, os.O_RDWR | os.O_NOCTTY)\n"
         "print('held', flush=True); time.sleep(30)"],
        stdout=subprocess.PIPE, text=True,
    )  # fmt: skip
    try:
        assert holder.stdout is not None
        assert holder.stdout.readline() == "held\n"
        code, findings = examined(tmp_path, toml(terminal))
    finally:
        holder.terminate()
        holder.wait(5)
    assert code == 1
    failures = [finding for finding in findings["port"] if f"(pid {holder.pid})" in finding["text"]]
    assert [finding["level"] for finding in failures] == ["failure"]
    assert "unless it belongs to your simulator" in failures[0]["mend"]  # as it is a pty


CONTAINER = """\
mount -t devpts -o newinstance,ptmxmode=666 devpts /dev/pts && mount --bind /dev/pts/ptmx /dev/ptmx
exec "$0" -c "$1" "$2"
"""

SAME_PTY = """\
import os, pty, sys
ends = []
while not ends or os.ttyname(ends[-1][1]) != sys.argv[1]:
    ends.append(pty.openpty())
print("held", flush=True)
sys.stdin.read()
"""


@pytest.mark.skipif(os.geteuid() != 0, reason="makes a mount namespace")
def test_a_pty_of_a_container_that_has_the_same_name_is_another_one(
    tmp_path: Path, terminal: str
) -> None:
    words = ["unshare", "--mount", "sh", "-c", CONTAINER, sys.executable, SAME_PTY, terminal]
    with Program(words, tmp_path, stdin=subprocess.PIPE) as container:
        container.says("held")
        assert container.pid not in {holder.pid for holder in holders(terminal)}
        assert [holder.pid for holder in masters_of(terminal)] == [os.getpid()]


def test_doctor_uses_the_running_daemon_s_values_and_reports_where_the_file_differs(
    tmp_path: Path,
) -> None:
    with FarPeer(tmp_path) as peer, Daemon(tmp_path, words=("--port", str(peer.path))) as daemon:
        peer.awaits(b"ap00.00")
        directory = tmp_path / "daemon.states"
        file = (
            f'[bus]\nlisten = ["{daemon.endpoint}"]\n[control]\nstate_directory = "{directory}"\n'
        )
        _, findings = examined(tmp_path, file)
        (other,) = [
            finding for finding in findings["configuration"] if "other values" in finding["text"]
        ]
        assert other["level"] == "ok"  # it is intentional: the manual says so
        # A long value is cut in the text.
        assert f'mcu.port = "{str(peer.path)[:40]}' in other["text"]
        assert 'not "sim"' in other["text"]
        assert f"pid {daemon.pid}" in findings["daemon"][0]["text"]
        assert not any("simulator" in finding["text"] for finding in findings["port"])
        assert any(str(peer.path) in finding["text"] for finding in findings["port"])
        # On a busy machine the board may have to wait, and doctor then rightly says so.
        with Bus(daemon.endpoint) as bus:
            assert worst(findings["serial link"])["level"] == "ok" or bus.count("link_lost"), (
                findings
            )


@pytest.mark.skipif(os.geteuid() != 0, reason="makes a process namespace")
def test_doctor_does_not_check_the_local_port_for_a_daemon_on_another_machine(
    tmp_path: Path,
) -> None:
    apart = ("unshare", "--pid", "--fork", "--kill-child")
    with FarPeer(tmp_path) as peer, Daemon(tmp_path, peer.path, before=apart) as daemon:
        peer.awaits(b"ap00.00")
        text = f'[mcu]\nport = "/dev/acsar_that_is_not"\n[bus]\nlisten = ["{daemon.endpoint}"]\n'
        _, findings = examined(tmp_path, text)
    assert "runs on another machine" in findings["daemon"][-1]["text"]
    assert "port" not in findings
    assert [finding["level"] for finding in findings["configuration"]] == ["ok"]


def test_ports_lists_the_serial_ports_or_refers_to_dmesg() -> None:
    words = [sys.executable, "-m", "acsard", "ports", "--json"]
    done = subprocess.run(words, capture_output=True, text=True, timeout=30, check=False)
    ports: list[dict[str, Any]] = json.loads(done.stdout)
    assert done.returncode == (0 if ports else 1)
    assert all(os.path.exists(port["device"]) for port in ports)
    plain = subprocess.run(words[:-1], capture_output=True, text=True, timeout=30, check=False)
    assert plain.returncode == done.returncode
    assert any(port["usb_id"] for port in ports) or "dmesg" in plain.stderr
