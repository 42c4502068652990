"""`topics --ros`, `ports`, and the faults in the help of `sim`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import msgspec
import pytest
from msgspec.structs import replace

from acsard.cli import main
from acsard.cli.topics import ros_table
from acsard.core.config.settings import CommandsConfig, Config, RosConfig, Source
from acsard.core.ros.transports import PARAMETERS_PREFIX, ros_names, unused_keys
from acsard.host.processes import Holder
from acsard.machine.serial_ports import SerialDevice


def test_every_ros_name_is_listed_with_what_it_stands_for() -> None:
    table = ros_table(Config(ros=RosConfig(namespace="robot1")))
    rows = [(row.key, row.direction, row.type) for row in table.topics]
    names = ros_names(unused_keys(Config()))
    assert rows == [(f"/robot1/{n.name}", n.direction, n.type) for n in names]
    for row, name in zip(table.topics, names, strict=True):
        if not name.native.startswith(PARAMETERS_PREFIX):
            assert row.note.startswith(f"as {name.native}")


def test_a_topic_of_an_unconfigured_source_is_listed_as_refused() -> None:
    config = Config(commands=CommandsConfig(sources=(Source("nav", 10),)))
    notes = {row.key: row.note for row in ros_table(config).topics}
    assert notes["/cmd_vel"] == "as cmd/nav"
    refused = "refused, because no [[commands.sources]] has this name"
    assert notes["/cmd_vel_dock"] == f"as cmd/dock: {refused}"
    assert notes["/joint_commands"] == f"as wheel_cmd/ros2_control: {refused}"


ON_THE_MAINBOARD = SerialDevice("/dev/ttyS0", [], "port", "", "", "", [])
UNKNOWN = SerialDevice("/dev/ttyUSB0", [], "pl2303", "067b:2303", "USB Serial", "", [])
MEGA = SerialDevice(
    "/dev/ttyACM0", ["/dev/acsar"], "cdc_acm", "2341:0042", "", "Arduino Mega 2560 R3", []
)


def test_the_ports_and_what_looks_like_a_board_are_told_in_the_approved_words(
    monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
    approved: Callable[[Path, str], None],
) -> None:
    text = ""
    held = replace(MEGA, holders=[Holder(77, "acsard")])
    for found in (
        [],
        [ON_THE_MAINBOARD],
        [ON_THE_MAINBOARD, UNKNOWN],
        [UNKNOWN, MEGA],
        [MEGA, held],
    ):
        monkeypatch.setattr("acsard.cli.ports.serial_devices", lambda found=found: found)
        code = main(["ports"])
        out, err = capsys.readouterr()
        text += f"--- {len(found)} ports, exit {code}\n{out}{err}"
        assert main(["ports", "--json"]) == code
        printed = msgspec.json.decode(capsys.readouterr().out, type=list[SerialDevice])
        assert printed == found
    approved(Path(__file__).with_name("words") / "ports.txt", text)
