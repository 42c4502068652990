"""The counters of the robot and of the page's server, in the Prometheus text format 0.0.4.

This module is pure.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from typing import Literal, get_args

from acsard.core.link.link_state import State
from acsard.core.messages.schema import RobotState
from acsard.core.motion.modes import Mode

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"

Kind = Literal["gauge", "counter"]

Sample = tuple[Mapping[str, str], float]
"""The labels and the value of one sample."""

WHEELS = ("front_right", "front_left", "rear_left", "rear_right")

US = 1e-6


def text(
    robot: str,
    state: RobotState | None,
    heard: bool,
    viewers: int,
    counts: Mapping[str, int],
    refused: Mapping[str, int],
) -> str:
    """Return the whole exposition.

    Robot metrics come from the last state, and only while `heard` is true.
    """
    lines: list[str] = []

    def add(name: str, kind: Kind, what: str, samples: Iterable[Sample]) -> None:
        lines.extend(_family(f"acsard_{name}", kind, what, robot, samples))

    add("up", "gauge", "1 while messages from the daemon arrive", [({}, float(heard))])
    if state is not None and heard:
        for name, kind, what, samples in _of_robot(state):
            add(name, kind, what, samples)
    add("page_viewers", "gauge", "pages and programs connected", [({}, viewers)])
    add("page_total", "counter", "actions of the page's server, by kind", _by("what", counts))
    add(
        "page_refused_total",
        "counter",
        "requests that the page's server refused, by reason",
        _by("reason", refused),
    )
    return "\n".join(lines) + "\n"


def _of_robot(state: RobotState) -> Iterator[tuple[str, Kind, str, Iterable[Sample]]]:
    modes = [({"mode": mode.value}, float(mode.value == state.mode)) for mode in Mode]
    yield "mode", "gauge", "1 for the robot's present mode, else 0", modes
    links = [({"state": link}, float(link == state.link)) for link in get_args(State)]
    yield (
        "link",
        "gauge",
        "1 for the present state of the link to the microcontroller, else 0",
        links,
    )
    if state.linear is not None and state.angular is not None:
        yield "linear_speed_mps", "gauge", "measured, forward", [({}, state.linear)]
        yield "angular_speed_radps", "gauge", "measured, to the left", [({}, state.angular)]
    pose = [({"axis": a}, v) for a, v in (("x", state.x), ("y", state.y), ("yaw", state.yaw))]
    yield "pose", "gauge", "in odom, m and rad", pose
    wheels = [({"wheel": w}, v) for w, v in zip(WHEELS, state.wheels, strict=False)]
    if wheels:
        yield "wheel_speed_radps", "gauge", "measured", wheels
    yield "robot_total", "counter", "the daemon's counters", _by("what", state.counters)
    figures: list[Sample] = []
    for name, figure in state.latencies.items():
        spread = figure.last_minute
        for at, value in (("p50", spread.p50), ("p99", spread.p99), ("max", spread.max)):
            figures.append(({"latency": name, "at": at}, value * US))
    yield "latency_seconds", "gauge", "latencies of the daemon, over the last minute", figures


def _by(label: str, counts: Mapping[str, int]) -> list[Sample]:
    return [({label: name}, float(count)) for name, count in sorted(counts.items())]


def _family(
    name: str, kind: Kind, what: str, robot: str, samples: Iterable[Sample]
) -> Iterator[str]:
    yield f"# HELP {name} {what}"
    yield f"# TYPE {name} {kind}"
    for labels, value in samples:
        told = {"robot": robot, **labels}
        inner = ",".join(f'{key}="{_escaped(word)}"' for key, word in told.items())
        yield f"{name}{{{inner}}} {value!r}"


def _escaped(word: str) -> str:
    return word.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")
