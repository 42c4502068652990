"""Counts the actions and refusals of the page's server, and writes the metrics for Prometheus.

The text of `/metrics` has Prometheus's text format 0.0.4.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from typing import Literal, get_args

from acsard.core.link.link_state import State
from acsard.core.messages.schema import RobotState
from acsard.core.messages.state_warnings import WARNING_KINDS, warnings
from acsard.core.motion.modes import Mode
from acsard.core.values import WHEELS, Event
from acsard.web.callers import Reason

CONTENT_TYPE = "text/plain; version=0.0.4; charset=utf-8"

Kind = Literal["gauge", "counter"]

Sample = tuple[Mapping[str, str], float]


def text(
    robot: str,
    version: str,
    state: RobotState | None,
    is_reachable: bool,
    viewers: int,
    counts: Mapping[str, int],
    refused: Mapping[str, int],
) -> str:
    """Return all metrics in the text format of Prometheus.

    `is_reachable` says whether messages from the daemon arrive. If not, the robot's metrics are
    left out. `viewers` is the number of open WebSockets. `counts` are the numbers of the server's
    actions by name, and `refused` the numbers of its refusals by reason.
    """
    lines: list[str] = []

    def add(name: str, kind: Kind, what: str, samples: Iterable[Sample]) -> None:
        lines.extend(_family(f"acsard_{name}", kind, what, robot, samples))

    add("up", "gauge", "1 while the daemon's messages arrive, else 0", [({}, float(is_reachable))])
    if state is not None and is_reachable:
        add(
            "info",
            "gauge",
            "always 1; the label `version` is the version of the daemon",
            [({"version": version}, 1.0)],
        )
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
    warned = {item.what for item in warnings(state)}
    subjects = [({"what": what}, float(what in warned)) for what in WARNING_KINDS]
    yield "warning", "gauge", "1 while the robot gives this warning, else 0", subjects
    if state.certificate_days is not None:
        left: list[Sample] = [({}, state.certificate_days * 86400.0)]
        yield (
            "certificate_seconds",
            "gauge",
            "seconds until the next expiry of a TLS certificate",
            left,
        )
    if state.emergency_stop:
        pressed = float(state.emergency_stop != "released")
        yield (
            "emergency_stop",
            "gauge",
            "1 while the emergency stop counts as pressed, else 0",
            [({}, pressed)],
        )
    bumpers = [({"bumper": str(n)}, float(item)) for n, item in enumerate(state.bumpers or (), 1)]
    if bumpers:
        yield "bumper", "gauge", "1 while the bumper counts as pressed, else 0", bumpers
    battery = state.battery
    if battery is not None:
        for name, what, value, scale in (
            ("volts", "voltage", battery.volts, 1.0),
            ("amperes", "current; negative while the battery discharges", battery.amps, 1.0),
            ("charge_ratio", "state of charge, 0 to 1", battery.percent, 0.01),
        ):
            if value is not None:
                yield f"battery_{name}", "gauge", what, [({}, value * scale)]
    if state.linear is not None and state.angular is not None:
        yield "linear_speed_mps", "gauge", "measured, forward", [({}, state.linear)]
        yield "angular_speed_radps", "gauge", "measured; left is positive", [({}, state.angular)]
    pose = [({"axis": a}, v) for a, v in (("x", state.x), ("y", state.y), ("yaw", state.yaw))]
    yield "pose", "gauge", "pose in the frame odom, in m and rad", pose
    wheels = [({"wheel": w}, v) for w, v in zip(WHEELS, state.wheels, strict=False)]
    if wheels:
        yield "wheel_speed_radps", "gauge", "measured", wheels
    yield "robot_total", "counter", "the daemon's counters", _by("what", state.counters)
    figures: list[Sample] = []
    for name, figure in state.latencies.items():
        spread = figure.last_minute
        for at, value in (("p50", spread.p50), ("p99", spread.p99), ("max", spread.max)):
            figures.append(({"latency": name, "at": at}, value * 1e-6))
    yield "latency_seconds", "gauge", "latencies of the daemon, over the last minute", figures


def _by(label: str, counts: Mapping[str, int]) -> list[Sample]:
    return [({label: name}, float(count)) for name, count in sorted(counts.items())]


def _family(
    name: str, kind: Kind, what: str, robot: str, samples: Iterable[Sample]
) -> Iterator[str]:
    yield f"# HELP {name} {what}"
    yield f"# TYPE {name} {kind}"
    for labels, value in samples:
        all_labels = {"robot": robot, **labels}
        inner = ",".join(f'{key}="{_escaped(word)}"' for key, word in all_labels.items())
        yield f"{name}{{{inner}}} {value!r}"


def _escaped(word: str) -> str:
    return word.replace("\\", "\\\\").replace('"', '\\"').replace("\n", "\\n")


MAX_NAMED = 5
"""Maximum number of clients that a log line about refusals names: those with the most refusals."""

MAX_COUNTED_CLIENTS = 1000
"""Maximum number of clients whose refusals are counted separately between two log lines. Without
this limit, a client that uses many addresses could fill the memory."""


class Counts:
    """Thread-safe counters of the server's actions, by name, and of its refusals, by reason."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._refused: Counter[str] = Counter()
        self._reported: Counter[str] = Counter()
        self._origins: Counter[str] = Counter()
        """Number of refusals since the last call of `new_refusals`, by the client's address and
        name."""

    def add(self, name: str, more: int = 1) -> None:
        with self._lock:
            self._counts[name] += more

    def refuse(self, reason: Reason, origin: str = "") -> None:
        """Count a refusal. `origin` is the client's address and name; "" if it is unknown."""
        with self._lock:
            self._refused[reason] += 1
            if origin and (origin in self._origins or len(self._origins) < MAX_COUNTED_CLIENTS):
                self._origins[origin] += 1

    def all(self) -> dict[str, int]:
        with self._lock:
            return dict(self._counts)

    def refused(self) -> dict[str, int]:
        with self._lock:
            return dict(self._refused)

    def new_refusals(self) -> Event | None:
        """Return a log event about the refusals since the last call of this method.

        Return None if nothing was refused since then.
        """
        with self._lock:
            new = self._refused - self._reported
            self._reported = Counter(self._refused)
            origins, self._origins = self._origins, Counter()
        if not new:
            return None
        reasons = ", ".join(f"{count} {why.replace('_', ' ')}" for why, count in new.most_common())
        named = origins.most_common(MAX_NAMED)
        whom = ", ".join(f"{count} from {origin}" for origin, count in named)
        if others := new.total() - sum(count for _, count in named):
            whom += f", {others} from others" if whom else ""
        text = f"{reasons}; {whom}" if whom else reasons
        return Event("page_refused", text, "warning", count=new.total())
