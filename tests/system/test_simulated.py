"""What is true of the simulated robot, beside what the daemon believes, on a real bus."""

from __future__ import annotations

import itertools
import math
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from tests.system.harness import Bus, Daemon, Peer, seconds, until

SKIDDING: dict[str, dict[str, object]] = {"sim": {"track_multiplier": 1.6}}


@pytest.fixture(scope="module")
def skidding(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Bus]:
    """A client of a daemon whose simulated robot turns less than its wheels say."""
    where = tmp_path_factory.mktemp("skidding")
    with Daemon(where, config=SKIDDING) as daemon, Bus(daemon.endpoint) as bus:
        bus.linked()
        yield bus


def yaw(pose: Any) -> float:
    turn = pose["orientation"]
    return 2 * math.atan2(turn["z"], turn["w"])


def test_the_truth_is_another_than_odometry_by_what_the_robot_truly_is(skidding: Bus) -> None:
    with skidding.commanding(0.0, 1.0):
        until(lambda: skidding.state()["yaw"] > 1.6, 10.0, "most of a quarter turn")
    skidding.at_rest()
    believed = yaw(skidding.get("odom")["pose"]["pose"])
    assert yaw(skidding.get("sim/pose")["pose"]) == pytest.approx(believed / 1.6, rel=0.02)


def test_the_truth_comes_a_hundred_times_a_second_with_the_time_of_each_look(
    skidding: Bus,
) -> None:
    with skidding.follow("sim/pose") as poses:
        until(lambda: len(poses.seen) > 50, 5.0, "half a second of looks")
        stamps = [seconds(seen.value["header"]["stamp"]) for seen in list(poses.seen)]
    apart = [b - a for a, b in itertools.pairwise(stamps)]
    assert apart == pytest.approx([0.01] * len(apart), abs=1e-4)
    assert {seen.value["header"]["frame_id"] for seen in list(poses.seen)} == {"sim"}


def test_where_there_is_a_real_port_nobody_has_the_truth(tmp_path: Path, peer: Peer) -> None:
    with Daemon(tmp_path, port=peer.path) as daemon, Bus(daemon.endpoint) as bus:
        bus.linked()
        assert bus.ask("sim/pose") == []
        assert not [row for row in bus.get("topics")["topics"] if "sim" in row["key"]]
