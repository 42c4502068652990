"""The outputs of one step. All numbers differ, so that a test notices two swapped fields."""

from __future__ import annotations

from collections.abc import Callable, Collection
from typing import Any

from msgspec.structs import replace

from acsard.core.messages.report import Report
from acsard.core.messages.schema import (
    BatterySummary,
    Latency,
    Message,
    RobotState,
    SourceState,
    Spread,
    Time,
)
from acsard.core.messages.snapshot import Snapshot
from acsard.core.values import (
    BatteryStatus,
    Estimate,
    Event,
    Instant,
    Pose,
    PoseCovariance,
    SourceStatus,
    Status,
    Twist,
    TwistVariances,
    Wait,
    WheelSpeeds,
)
from tests.stepped import Outputs, news_of

START = Instant(100_000_000_000, 1_700_000_000_000_000_000)

ESTIMATE = Estimate(
    at=Instant(104_000_000_000, 1_700_000_003_250_000_001),
    pose=Pose(1.5, -2.5, 0.5),
    twist=Twist(0.25, -0.75),
    covariance=PoseCovariance(0.11, 0.12, 0.16, 0.22, 0.26, 0.66),
    twist_variances=TwistVariances(0.01, 0.02, 0.06),
    positions=(10.0, 20.0, 30.0, 40.0),
    speeds=WheelSpeeds(1.0, 2.0, 3.0, 4.0),
)

OUTPUTS = Outputs(
    now=Instant(104_004_000_000, 1_700_000_003_254_000_002),
    due=True,
    line=None,
    speeds=WheelSpeeds(5.0, 6.0, 7.0, 8.0),
    applied=Twist(0.3, 0.9),
    linked=True,
    estimates=(ESTIMATE,),
    mode="driving",
    code="commanded",
    reason="commanded by app",
    link="up",
    source="app",
    command_ns=103_990_000_000,
    status_changed=False,
    events=(Event("stop", "stopped", by="phone"),),
)

STATUS = Status("driving", "commanded", "commanded by app", "up", "app")

SNAPSHOT = Snapshot(
    RobotState(
        stamp=Time(),
        mode=STATUS.mode,
        reason=STATUS.reason,
        code=STATUS.code,
        x=1.6,
        y=-2.6,
        yaw=0.6,
        linear=0.26,
        angular=-0.76,
        wheels=[1.1, 2.1, 3.1, 4.1],
        link=STATUS.link,
        source=STATUS.source,
        sources=[
            SourceState("app", 50, 0.01, "", "nothing"),
            SourceState("nav", 10, None, "a command", "command"),
        ],
        refused="source nav: held up",
        counters={"lines": 100, "line_malformed": 2, "commands": 7, "command_stale": 3},
        latencies={
            "period_lateness": Latency(
                Spread(1000, 50.0, 400.0, 900.0), Spread(100, 40.0, 80.0, 90.0)
            )
        },
        battery=BatterySummary(22.5, 40.0, -1.5, "ok"),
    ),
    applied=Twist(0.3, 0.9),
    sources=(
        SourceStatus("app", 50, 0.01, Wait("nothing")),
        SourceStatus("nav", 10, None, Wait("command")),
    ),
    battery=BatteryStatus("ok", 103_900_000_000, 22.5, 40.0, -1.5, 21.75),
)


def changed(snapshot: Snapshot, **changes: Any) -> Snapshot:
    """Return a snapshot with other values, of its own fields or else of those of `state`."""
    own = {name: changes.pop(name) for name in snapshot.__struct_fields__ if name in changes}
    return replace(snapshot, state=replace(snapshot.state, **changes), **own)


def due(
    report: Report, outputs: Outputs, wanted: Collection[str], get_snapshot: Callable[[], Snapshot]
) -> list[tuple[str, Message]]:
    """Return the keys and messages that are due after a step with these outputs."""
    news = news_of(outputs)
    return report.due(
        outputs.now,
        news,
        outputs.applied if outputs.due else None,
        wanted,
        lambda: with_outputs(get_snapshot(), outputs),
    )


def with_outputs(snapshot: Snapshot, outputs: Outputs) -> Snapshot:
    return changed(
        snapshot,
        mode=outputs.mode,
        code=outputs.code,
        reason=outputs.reason,
        link=outputs.link,
        source=outputs.source,
        applied=outputs.applied,
    )


def at(instant: Instant, **changes: Any) -> Outputs:
    """Return the outputs of a step at this time, with one odometry estimate of the same time."""
    estimate = replace(ESTIMATE, at=instant)
    return replace(OUTPUTS, now=instant, **({"estimates": (estimate,)} | changes))


def later(seconds: float) -> Instant:
    """Return the instant this many seconds after `START` on both clocks."""
    ns = round(seconds * 1e9)
    return Instant(START.mono_ns + ns, START.wall_ns + ns)
