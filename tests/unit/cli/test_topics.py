"""`acsard topics --ros` lists the topics that a ROS machine will see.

It lists no topic if the configuration switches off both ROS transports.
"""

from __future__ import annotations

import subprocess
import sys

import pytest

from acsard.cli import VERBS
from acsard.cli.topics import ros_table
from acsard.core.config.settings import CommandsConfig, Config, RosConfig, Source
from acsard.core.messages.keys_and_roles import PUBLISHED
from acsard.core.ros.transports import PARAMETERS_PREFIX, left_out, ros_names


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
