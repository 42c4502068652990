"""`topics --ros`, `ports`, and the faults in the help of `sim`."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest
from msgspec.structs import replace

from acsard.cli import VERBS, main
from acsard.cli.topics import ros_table
from acsard.core.config.settings import CommandsConfig, Config, RosConfig, Source
from acsard.core.messages.keys_and_roles import PUBLISHED
from acsard.core.ros.transports import PARAMETERS_PREFIX, left_out, ros_names
from acsard.host.processes import Holder
from acsard.machine.serial_ports import SerialDevice


def test_every_ros_name_is_listed_with_what_it_stands_for() -> None:
    table = ros_table(Config(ros=RosConfig(namespace="robot1")))
    rows = [(row.key, row.direction, row.type) for row in table.topics]
    names = ros_names(left_out(Config()))
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


def test_a_published_name_has_the_rate_of_its_native_key() -> None:
    rates = {
        row.key: row.rate
        for row in ros_table(Config(ros=RosConfig())).topics
        if row.direction == "out"
    }
    published = {topic.key: topic.rate for topic in PUBLISHED}
    assert rates["/joint_states"] == published["wheel_states"]
    assert rates["/tf_static"] == "latched"


@pytest.mark.parametrize(("bridge", "rmw"), [(True, False), (False, True)])
def test_topics_are_listed_if_either_ros_tree_is_enabled(bridge: bool, rmw: bool) -> None:
    assert ros_table(Config(ros=RosConfig(bridge=bridge, rmw=rmw))).topics


def test_without_a_ros_tree_no_topics_are_listed() -> None:
    assert ros_table(Config(ros=RosConfig(bridge=False, rmw=False))).topics == []


@pytest.mark.slow
def test_only_the_module_of_the_called_verb_is_loaded() -> None:
    code = "import sys\nfrom acsard.cli import main\nmain(['topics'])\nprint(*sys.modules)"
    run = subprocess.run(
        [sys.executable, "-c", code], capture_output=True, text=True, timeout=60.0, check=True
    )
    loaded = {name.removeprefix("acsard.cli.") for name in run.stdout.splitlines()[-1].split()}
    assert loaded & set(VERBS) == {"topics"}


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
    approved(Path(__file__).with_name("words") / "ports.txt", text)


def test_json_has_no_control_characters_from_the_description_of_a_device(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    port = replace(UNKNOWN, description="USB \x9b2J Serial")
    monkeypatch.setattr("acsard.cli.ports.serial_devices", lambda: [port])
    assert main(["ports", "--json"]) == 0
    out = capsys.readouterr().out
    assert out.strip().isprintable()
    assert json.loads(out)[0]["description"] == port.description
