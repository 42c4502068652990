"""systemd's own assessment of the unit, and tests of the drop-ins that a container can test."""

from __future__ import annotations

import json
import os
import re
import signal
from pathlib import Path

import pytest

from tests.system.harness import ROOT, until
from tests.systemd.container import (
    ACSARD,
    CONFIG,
    GATEWAY,
    PAGE,
    PORT,
    UNIT,
    USUAL,
    ZERO,
    Board,
    Container,
)

pytestmark = pytest.mark.systemd

DEPLOY = ROOT / "deploy" / "systemd"

EXPOSURE = 1.5

TLS = "/etc/acsard/tls"


def test_systemd_finds_nothing_wrong_with_the_units_and_their_drop_ins(
    container: Container,
) -> None:
    container.drop_in("lan.conf", (DEPLOY / "lan.conf").read_text())
    for unit in (UNIT, GATEWAY, PAGE):
        file = f"/etc/systemd/system/{unit}"
        checked = container.run("systemd-analyze", "verify", file)
        assert (checked.code, checked.out, checked.err) == (0, "", "")
        words = ["security", "--offline=yes", "--no-pager", file]
        text = container.run("systemd-analyze", *words).out.splitlines()[-1]
        print(text.strip(" →"))
        assert float(text.partition(f"{unit}:")[2].split()[0]) <= EXPOSURE


def opened(container: Container) -> None:
    """Run the service and its TLS gateway, with the drop-in for the local network."""
    made = container.run(ACSARD, "tls", "init", "--force", "--address", "127.0.0.1")
    assert made.code == 0, made.err
    listen = ["tcp/127.0.0.1:7448", "tls/0.0.0.0:7449"]
    container.write(
        CONFIG, f'mcu.port = "{PORT}"\nbus.listen = {json.dumps(listen)}\nbus.tls = "{TLS}"\n'
    )
    container.drop_in("lan.conf", (DEPLOY / "lan.conf").read_text(), GATEWAY)
    for unit in (UNIT, GATEWAY):
        started = container.start(unit)
        assert started.code == 0, started.err + container.messages(unit)
    is_open(container)


def is_open(container: Container) -> None:
    until(lambda: "open at" in container.show("StatusText", GATEWAY), 10.0, "the gateway opens")


@pytest.mark.nightly
def test_a_reload_gives_the_services_a_new_certificate_while_the_robot_drives(
    container: Container, board: Board
) -> None:
    container.drop_in("lan.conf", (DEPLOY / "lan.conf").read_text())  # as for a router
    opened(container)
    daemon = container.main_pid()
    user = str(Path(f"/proc/{daemon}").stat().st_uid)
    assert container.run(ACSARD, "tls", "renew", "--days", "9").code == 0
    container.types("systemctl reload acsard && systemctl try-reload-or-restart acsard-gateway")
    viewer = ("--connect", "tls/127.0.0.1:7449", "--tls", f"{TLS}/clients/viewer")
    words = (ACSARD, "get", "state", *viewer)
    until(
        lambda: "expires in 9 days" in container.run(*words).out,
        20.0,
        "the gateway uses the new one",
    )
    for name in ("ca.pem", "certificate.pem", "key.pem"):
        assert container.run("cmp", f"{TLS}/{name}", f"/run/acsard/{name}").code == 0
        about = container.run("stat", "-Lc", "%u %a", f"/run/acsard/{name}", "/run/acsard/.")
        assert about.out.split() == [user, "400", user, "700"]
    assert container.main_pid() == daemon


def test_a_gateway_has_limits_and_if_it_is_killed_it_is_restarted_and_the_daemon_keeps_running(
    container: Container, board: Board
) -> None:
    opened(container)
    for name, value in (("MemoryMax", 256 << 20), ("CPUQuotaPerSecUSec", "800ms")):
        assert container.show(name, GATEWAY) == str(value)
    limits = Path(f"/proc/{container.main_pid(GATEWAY)}/limits").read_text()
    assert re.search(rf"Max data size +{192 << 20} +{192 << 20}", limits)
    daemon, first = container.main_pid(), container.show("MainPID", GATEWAY)
    os.kill(container.main_pid(GATEWAY), signal.SIGKILL)
    # Until systemd starts the unit again, MainPID is 0, and StatusText is the killed process's.
    until(
        lambda: container.show("MainPID", GATEWAY) not in {"0", first}, 10.0, "it is started again"
    )
    is_open(container)
    assert container.show("NRestarts", GATEWAY) == "1"
    assert container.main_pid() == daemon


def test_lan_conf_without_its_key_fails_the_start_of_the_unit(
    container: Container, board: Board
) -> None:
    container.path(TLS).mkdir(parents=True, exist_ok=True)
    container.path(f"{TLS}/key.pem").unlink(missing_ok=True)
    container.drop_in("lan.conf", (DEPLOY / "lan.conf").read_text())
    assert container.start().code != 0
    # These are the lines of the stop script, which runs after any end.
    assert {entry.line for entry in board.since(0.0)} <= {ZERO, b"-"}


@pytest.mark.nightly
@pytest.mark.parametrize("unit", [GATEWAY, PAGE])
def test_without_its_key_the_gateway_or_page_stays_down_and_doctor_names_the_key(
    container: Container, board: Board, unit: str
) -> None:
    opened(container)
    container.drop_in("lan.conf", (DEPLOY / "lan.conf").read_text(), unit)
    container.run("systemctl", "stop", unit)
    key = container.path(f"{TLS}/key.pem")
    contents = key.read_bytes()
    key.unlink()
    container.start(unit)
    until(lambda: container.show("ActiveState", unit) == "failed", 5.0, "it is left alone")
    assert container.show("ExecMainStatus", unit) == "243"
    assert container.show("NRestarts", unit) == "0"
    output = container.run(ACSARD, "doctor", "--config", CONFIG).out
    assert f"cannot read {TLS}/key.pem" in output
    key.write_bytes(contents)
    container.run("systemctl", "enable", unit)  # as installed
    container.run("systemctl", "restart", UNIT)
    until(lambda: container.show("SubState", unit) == "running", 10.0, "it is there again")
    container.run("systemctl", "disable", unit)


# the sandbox


def reaches(container: Container, address: str) -> bool:
    """Return whether a client at this address can connect to the daemon at the same address."""
    code = (
        "import socket, sys; "
        "socket.create_connection((sys.argv[1], 7448), 1.0, (sys.argv[1], 0)).close()"
    )
    return container.run("python3", "-c", code, address).code == 0


def test_a_bus_that_is_opened_by_mistake_cannot_be_reached_from_other_computers(
    container: Container, board: Board
) -> None:
    container.run("ip", "address", "replace", "10.9.8.7/32", "dev", "lo")
    container.write(CONFIG, f'{USUAL}[bus]\nlisten = ["tcp/0.0.0.0:7448"]\ninsecure = true\n')
    assert container.start().code == 0
    assert reaches(container, "127.0.0.1")
    assert not reaches(container, "10.9.8.7")
    container.run("systemctl", "stop", UNIT)
    allowed = "[Service]\nIPAddressAllow=10.0.0.0/8\n"
    container.drop_in("open.conf", allowed)
    assert container.start().code == 0
    assert reaches(container, "10.9.8.7"), "it was the unit that closed it"


PRIVATE = ("10.9.8.7", "172.16.9.8", "192.168.9.8", "169.254.9.8", "fd00::9")


def test_lan_conf_admits_every_network_that_is_private_or_link_local(
    container: Container, board: Board
) -> None:
    networks = re.findall(r"^IPAddressAllow=.*\n", (DEPLOY / "lan.conf").read_text(), re.M)
    container.drop_in("networks.conf", "[Service]\n" + "".join(networks))
    for address in PRIVATE:
        container.run("ip", "address", "replace", address, "dev", "lo")
    listen = [f"tcp/{f'[{at}]' if ':' in at else at}:7448" for at in PRIVATE]
    container.write(CONFIG, f"{USUAL}[bus]\nlisten = {json.dumps(listen)}\ninsecure = true\n")
    try:
        assert container.start().code == 0
        assert all(reaches(container, address) for address in PRIVATE)
    finally:
        for address in PRIVATE:
            container.run("ip", "address", "delete", address, "dev", "lo")


DEVICES = {
    "ttyUSB": (188, 200), "ttyACM": (166, 200), "ttyS": (4, 127), "ttyAMA": (204, 100),
    "fuse": (10, 229),
}  # fmt: skip
"""Numbers of devices without hardware. If one may be opened, opening it blocks or fails later."""


def codes(container: Container, numbers: tuple[int, int], group: str, mode: str) -> str:
    """Return the exit code of the service on a port that is this device."""
    container.run("mknod", PORT, "c", *map(str, numbers))
    try:
        container.run("chgrp", group, PORT)
        container.run("chmod", mode, PORT)
        container.start()
        return container.show("ExecMainStatus")
    finally:
        container.path(PORT).unlink()
        container.reset()


def test_serial_ports_may_be_opened_and_no_other_device(container: Container) -> None:
    ended = {
        kind: codes(container, numbers, "dialout", "0660") for kind, numbers in DEVICES.items()
    }
    assert ended == dict.fromkeys(DEVICES, "0") | {"fuse": "77"}


def test_a_port_that_the_service_may_not_open_is_named_with_two_remedies(
    container: Container,
) -> None:
    """A login console gives the port this group and mode. The unit sees neither of them."""
    assert codes(container, DEVICES["ttyS"], "tty", "0620") == "77"
    said = container.messages()
    assert f"{PORT} is not open to the group dialout" in said
    assert "`sudo acsard doctor` names a login console" in said
