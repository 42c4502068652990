"""The manual's examples in Python do what it says, against a running daemon."""

from __future__ import annotations

import json
import math
import re
import socket
import time
from contextlib import ExitStack
from typing import Any, NamedTuple

import pytest

from tests.pages import blocks
from tests.system.bystander import lost
from tests.system.harness import (
    Bus,
    Daemon,
    Finished,
    Program,
    free_endpoint,
    kept_waiting,
    silences,
)
from tests.system.strangers import command_line

DEFAULT = "tcp/127.0.0.1:7448"


class Outcome(NamedTuple):
    """An example's exit, the robot's final state, and the time lost to other programs, s."""

    ended: Finished
    state: Any
    late: float


def code_blocks() -> list[str]:
    """Return the Python code blocks of the pages about programs."""
    pages = [f"deploy/manual/pages/{name}.md" for name in ("tutorial/program", "howto/languages")]
    return [block.text for block in blocks("python") if block.page in pages]


def kind(code: str) -> str:
    """Return the name of the example that has this code."""
    if "connect_async" in code:
        return "async"
    return "first" if "acsard.client" in code else "plain zenoh"


def default_is_free() -> bool:
    """Return whether no program uses the daemon's default endpoint."""
    with socket.socket() as probe:
        probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
        try:
            probe.bind(("127.0.0.1", 7448))
        except OSError:
            return False
    return True


def at_endpoint(code: str, endpoint: str) -> str:
    """Return the example with this daemon's endpoint instead of the default one."""
    if endpoint == DEFAULT:
        return code
    changed = re.sub(r"(connect|connect_async)\(\)", rf'\1("{endpoint}")', code)
    return changed.replace(DEFAULT, endpoint)


@pytest.fixture(scope="module")
def examples(tmp_path_factory: pytest.TempPathFactory) -> dict[str, Outcome]:
    """Run all examples at the same time, each with its own robot, as each takes two seconds."""
    where = tmp_path_factory.mktemp("examples")
    codes = {kind(code): code for code in code_blocks()}
    endpoints = {name: free_endpoint() for name in codes}
    if default_is_free():
        endpoints["first"] = DEFAULT
    outcomes = {}
    with ExitStack() as stack:
        buses = {}
        for number, (name, endpoint) in enumerate(endpoints.items()):
            stack.enter_context(Daemon(where, endpoint=endpoint, name=f"daemon{number}"))
            buses[name] = stack.enter_context(Bus(endpoint))
        before = {}
        for name, bus in buses.items():
            bus.linked()
            before[name] = kept_waiting(bus.get("info")["pid"])
        samples = {name: stack.enter_context(bus.follow("cmd/app")) for name, bus in buses.items()}
        running = {
            name: stack.enter_context(
                Program(command_line(at_endpoint(code, endpoints[name])), where)
            )
            for name, code in codes.items()
        }
        for name, program in running.items():
            code = program.ended(20.0)
            took = time.monotonic() - program.started
            ended = Finished(code, program.stdout, program.stderr, took)
            state = buses[name].at_rest()
            print(
                f"{name}: exit {code}, x {state['x']:.4f} y {state['y']:.4f} yaw {state['yaw']:.4f}"
            )
            waited_s = kept_waiting(buses[name].get("info")["pid"]) - before[name]
            silent_s = silences([entry.at for entry in samples[name].seen])
            late = lost(program.started) + waited_s + silent_s
            outcomes[name] = Outcome(ended, state, late)
    return outcomes


def test_the_manual_has_the_three_examples() -> None:
    assert sorted(map(kind, code_blocks())) == ["async", "first", "plain zenoh"]


@pytest.mark.slow
def test_the_first_example_of_the_manual_drives_one_metre_turns_and_prints_the_pose(
    examples: dict[str, Outcome],
) -> None:
    ended, state, late = examples["first"]
    assert (ended.code, ended.err) == (0, "")
    assert ended.out.startswith("Pose(x=")
    # If a message comes late, the robot drives on meanwhile, at 0.02 m/s near the end.
    assert state["x"] == pytest.approx(1.0, abs=0.005 + 0.02 * late)
    assert state["yaw"] == pytest.approx(math.radians(90.0), abs=math.radians(0.5 + 3.0 * late))
    # The example prints where the robot came to a stand, not where it still rolled.
    printed = re.match(r"Pose\(x=([\d.]+),", ended.out)
    assert printed
    assert float(printed[1]) == pytest.approx(state["x"], abs=0.01)
    assert state["y"] == pytest.approx(0.0, abs=0.01)


@pytest.mark.slow
def test_the_async_example_of_the_manual_follows_the_robot_while_it_drives(
    examples: dict[str, Outcome],
) -> None:
    ended, state, late = examples["async"]
    assert (ended.code, ended.err) == (0, "")
    assert len(ended.out.splitlines()) >= 3  # one of 50 messages, 100 a second
    assert state["yaw"] == pytest.approx(0.4, abs=0.02 + 0.2 * late)
    assert state["x"] == pytest.approx(0.97, abs=0.05 + 0.5 * late)


@pytest.mark.slow
def test_the_plain_zenoh_example_of_the_manual_drives_one_metre_and_follows_the_odometry(
    examples: dict[str, Outcome],
) -> None:
    ended, state, late = examples["plain zenoh"]
    assert (ended.code, ended.err) == (0, "")
    odometry = [json.loads(line) for line in ended.out.splitlines()]
    assert len(odometry) > 10
    assert {odom["child_frame_id"] for odom in odometry} == {"base_link"}
    first, last = (
        message["pose"]["pose"]["position"]["x"] for message in (odometry[0], odometry[-1])
    )
    assert first < 0.5 * state["x"] < last
    # The example's own sleeps add up to a little more than 2 s.
    assert state["x"] == pytest.approx(1.03, abs=0.05 + 0.5 * late), state["counters"]
