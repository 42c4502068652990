"""The udev rules in a real udev give the right boards the name and the right properties."""

from __future__ import annotations

from typing import NamedTuple

import pytest

from acsard.machine.serial_ports import BOARDS
from tests.system.harness import ROOT
from tests.systemd.container import Container

pytestmark = pytest.mark.systemd

RULES = "/etc/udev/rules.d/70-acsar.rules"

USB = "/devices/pci0000:00/0000:00:14.0/usb1/1-1"

OTHERS = ["2341:8036", "1a86:5523", "0403:6010", "1234:0042", "0042:2341"]


class Verdict(NamedTuple):
    """The result of udev's rules for a device."""

    properties: dict[str, str]
    log: str

    @property
    def links(self) -> list[str]:
        return self.properties.get("DEVLINKS", "").split()


def tree(ids: str, serial: str, driver: str) -> str:
    """A USB serial port as the kernel would show it."""
    vendor, product = ids.split(":")
    return f"""\
P: {USB}
E: DEVTYPE=usb_device
E: SUBSYSTEM=usb
A: idVendor={vendor}
A: idProduct={product}
A: bcdDevice=0001
A: serial={serial}

P: {USB}/1-1:1.0
E: DEVTYPE=usb_interface
E: SUBSYSTEM=usb
A: bInterfaceClass=02
A: bInterfaceNumber=00
A: bInterfaceSubClass=02
A: bInterfaceProtocol=01

P: {USB}/1-1:1.0/ttyUSB0
E: SUBSYSTEM=usb-serial
E: DRIVER={driver}
L: driver=../../../../../../bus/usb-serial/drivers/{driver}
A: latency_timer=16

P: {USB}/1-1:1.0/ttyUSB0/tty/ttyUSB0
N: ttyUSB0
E: DEVNAME=/dev/ttyUSB0
E: SUBSYSTEM=tty
E: MAJOR=188
E: MINOR=0
L: device=../../../ttyUSB0
"""


def verdict(
    container: Container,
    ids: str,
    *,
    serial: str = "75430",
    driver: str = "cp210x",
    action: str = "add",
) -> Verdict:
    container.write(RULES, (ROOT / "deploy" / "udev" / "70-acsar.rules").read_text())
    container.write("/tmp/board", tree(ids, serial, driver))
    udevadm = ["udevadm", "test", f"--action={action}", f"{USB}/1-1:1.0/ttyUSB0/tty/ttyUSB0"]
    ran = container.run("umockdev-run", "-d", "/tmp/board", "--", *udevadm)
    assert ran.code == 0, ran.err
    properties = [line.strip() for line in ran.out.splitlines() if "=" in line]
    return Verdict(dict(line.split("=", 1) for line in properties), ran.err)


@pytest.mark.variations(8)
@pytest.mark.parametrize("ids", BOARDS)
def test_a_usual_board_gets_the_name_and_starts_the_service(container: Container, ids: str) -> None:
    board = verdict(container, ids)
    assert "/dev/acsar" in board.links
    assert board.properties["ID_MM_DEVICE_IGNORE"] == "1"
    assert board.properties["SYSTEMD_WANTS"] == "acsard.service"
    assert ":systemd:" in board.properties["TAGS"]
    ours = [line for line in board.log.splitlines() if "70-acsar.rules" in line]
    assert any("GROUP" in line for line in ours), ours
    assert any("0660" in line for line in ours), ours
    assert not [line for line in ours if "nvalid" in line or "gnoring" in line]


@pytest.mark.parametrize("ids", OTHERS)
def test_any_other_device_is_left_alone(container: Container, ids: str) -> None:
    other = verdict(container, ids)
    assert "/dev/acsar" not in other.links
    assert "ID_MM_DEVICE_IGNORE" not in other.properties
    assert "SYSTEMD_WANTS" not in other.properties


def test_the_latency_timer_of_an_ftdi_chip_is_set_to_1_ms(container: Container) -> None:
    def writes(driver: str) -> bool:
        log = verdict(container, "0403:6001", driver=driver).log
        return any("latency_timer' writing '1'" in line for line in log.splitlines())

    assert writes("ftdi_sio")
    assert not writes("cp210x")


def test_an_earlier_rules_file_can_add_and_exclude_boards(
    container: Container,
) -> None:
    own = "/etc/udev/rules.d/69-my-robot.rules"
    container.write(
        own,
        'ENV{ID_VENDOR_ID}=="1234", ENV{ID_MODEL_ID}=="0042", ENV{ACSAR_MCU}="1"\n'
        'ENV{ID_VENDOR_ID}=="2341", ENV{ID_SERIAL_SHORT}!="75430", ENV{ACSAR_MCU}="0"\n',
    )
    try:
        assert "/dev/acsar" in verdict(container, "1234:0042").links
        assert "/dev/acsar" in verdict(container, "2341:0042").links
        assert "/dev/acsar" not in verdict(container, "2341:0042", serial="9").links
    finally:
        container.path(own).unlink()


def test_a_newer_udev_finds_nothing_wrong_with_the_rules(container: Container) -> None:
    container.write(RULES, (ROOT / "deploy" / "udev" / "70-acsar.rules").read_text())
    checked = container.run("udevadm", "verify", RULES)
    if "Unknown command verb" in checked.err:
        pytest.skip("this udev cannot check rules")
    assert checked.code == 0, checked.err
