"""Counts the actions and refusals of the page's server, and writes the metrics for Prometheus."""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Iterable, Mapping
from typing import Any, get_args

from prometheus_client import CONTENT_TYPE_LATEST, generate_latest
from prometheus_client.core import CounterMetricFamily, GaugeMetricFamily, Metric
from prometheus_client.registry import Collector

from acsard.core.link.link_state import LinkState
from acsard.core.messages.schema import RobotState
from acsard.core.messages.state_warnings import WARNING_KINDS, warnings
from acsard.core.motion.modes import Mode
from acsard.core.values import Event, wheel_names
from acsard.web.callers import Reason

CONTENT_TYPE = CONTENT_TYPE_LATEST


class Metrics(Collector):
    """The metrics of one robot, all with the label `robot`."""

    def __init__(self, robot: str) -> None:
        self._robot = robot
        self._families: list[Metric] = []

    def collect(self) -> list[Metric]:
        return self._families

    def gauge(self, name: str, what: str, value: float | None) -> None:
        self.gauges(name, what, (), {(): value})

    def gauges(
        self,
        name: str,
        what: str,
        labels: tuple[str, ...],
        samples: Mapping[Any, float | None],
    ) -> None:
        """Add a sample for each known value, by the values of its labels."""
        family = GaugeMetricFamily(f"acsard_{name}", what, labels=("robot", *labels))
        for words, value in samples.items():
            if value is not None:
                family.add_metric((self._robot, *words), value)
        if family.samples:
            self._families.append(family)

    def one_of(self, name: str, what: str, label: str, values: Iterable[str], now: object) -> None:
        """Add a sample for each of the values: 1 for the present one, else 0."""
        samples = {(value,): float(value == now) for value in values}
        self.gauges(name, f"1 for {what}, else 0", (label,), samples)

    def counters(self, name: str, what: str, label: str, counts: Mapping[str, int]) -> None:
        family = CounterMetricFamily(f"acsard_{name}", what, labels=("robot", label))
        for word, count in sorted(counts.items()):
            family.add_metric((self._robot, word), count)
        if counts:
            self._families.append(family)


def text(
    robot: str,
    version: str,
    state: RobotState | None,
    is_reachable: bool,
    viewers: int,
    counts: Mapping[str, int],
    refused: Mapping[str, int],
) -> bytes:
    """Return all metrics in the text format of Prometheus.

    `is_reachable` says whether the daemon's messages arrive. If not, the robot's metrics are left
    out. `viewers` is the number of open WebSockets. `counts` are the numbers of the server's
    actions by name, and `refused` the numbers of its refusals by reason.
    """
    metrics = Metrics(robot)
    metrics.gauge("up", "1 while the daemon's messages arrive, else 0", float(is_reachable))
    if state is not None and is_reachable:
        what = "always 1; the label `version` is the version of the daemon"
        metrics.gauges("info", what, ("version",), {(version,): 1.0})
        _add_state(metrics, state)
    metrics.gauge("page_viewers", "pages and programs connected", viewers)
    metrics.counters("page", "actions of the page's server, by kind", "what", counts)
    what = "requests that the page's server refused, by reason"
    metrics.counters("page_refused", what, "reason", refused)
    return generate_latest(metrics)


def _add_state(metrics: Metrics, state: RobotState) -> None:
    metrics.one_of("mode", "the robot's present mode", "mode", Mode, state.mode)
    what = "the present state of the link to the microcontroller"
    metrics.one_of("link", what, "state", get_args(LinkState), state.link)
    warned = {item.what for item in warnings(state)}
    subjects = {(kind,): float(kind in warned) for kind in WARNING_KINDS}
    metrics.gauges("warning", "1 while the robot gives this warning, else 0", ("what",), subjects)
    if state.certificate_days is not None:
        what = "seconds until the next expiry of a TLS certificate"
        metrics.gauge("certificate_seconds", what, state.certificate_days * 86400.0)
    if state.emergency_stop:
        what = "1 while the emergency stop counts as pressed, else 0"
        metrics.gauge("emergency_stop", what, float(state.emergency_stop != "released"))
    bumpers = {(str(number),): float(one) for number, one in enumerate(state.bumpers or (), 1)}
    what = "1 while the bumper counts as pressed, else 0"
    metrics.gauges("bumper", what, ("bumper",), bumpers)
    if (battery := state.battery) is not None:
        metrics.gauge("battery_volts", "voltage", battery.volts)
        what = "current; negative while the battery discharges"
        metrics.gauge("battery_amperes", what, battery.amps)
        share = None if battery.percent is None else 0.01 * battery.percent
        metrics.gauge("battery_charge_ratio", "state of charge, 0 to 1", share)
    metrics.gauge("linear_speed_mps", "measured, forward", state.linear)
    metrics.gauge("angular_speed_radps", "measured; left is positive", state.angular)
    pose = {("x",): state.x, ("y",): state.y, ("yaw",): state.yaw}
    metrics.gauges("pose", "pose in the frame odom, in m and rad", ("axis",), pose)
    named = zip(wheel_names(len(state.wheels)), state.wheels, strict=False)
    wheels = {(wheel,): speed for wheel, speed in named}
    metrics.gauges("wheel_speed_radps", "measured", ("wheel",), wheels)
    metrics.counters("robot", "the daemon's counters", "what", state.counters)
    latencies = {
        (name, at): getattr(latency.last_minute, at) * 1e-6
        for name, latency in state.latencies.items()
        if latency.last_minute.count  # else nothing was measured
        for at in ("p50", "p99", "max")
    }
    what = "latencies of the daemon, over the last minute"
    metrics.gauges("latency_seconds", what, ("latency", "at"), latencies)


# Clients with the most refusals that a log line names.
MAX_NAMED = 5

# Counted separately between two log lines, because a client of many addresses could fill the
# memory.
MAX_COUNTED_CLIENTS = 1000


class Counts:
    """Thread-safe counters of the server's actions, by name, and of its refusals, by reason."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._counts: Counter[str] = Counter()
        self._refused: Counter[str] = Counter()
        self._reported: Counter[str] = Counter()
        self._origins: Counter[str] = Counter()  # refusals since the last call of `new_refusals`

    def add(self, name: str, more: int = 1) -> None:
        with self._lock:
            self._counts[name] += more

    def refuse(self, reason: Reason, origin: str = "") -> None:
        """Count a refusal of the client with an address and a name, if it is known."""
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
        """Return a log event about the refusals since the last call, if there are any."""
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
