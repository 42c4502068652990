"""The messages that are published after a step: their content, their stamps and their rates."""

from __future__ import annotations

import math
import random
from collections.abc import Callable
from itertools import pairwise
from typing import Any

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import (
    BusConfig,
    Config,
    DriveConfig,
    LidarConfig,
    McuConfig,
    OdometryConfig,
    RatesConfig,
    RobotConfig,
    WheelMap,
)
from acsard.core.messages.certificate_expiry import DAY_NS, expiry, short_code
from acsard.core.messages.keys_and_roles import BEAT, PUBLISHED
from acsard.core.messages.report import Report, from_yaw
from acsard.core.messages.schema import (
    Battery,
    BatterySummary,
    Header,
    JointState,
    Latency,
    Odometry,
    Pose,
    PoseWithCovariance,
    Quaternion,
    RobotState,
    SourceState,
    Spread,
    TFMessage,
    Time,
    Transform,
    TransformStamped,
    Twist,
    TwistStamped,
    TwistWithCovariance,
    Vector3,
)
from acsard.core.messages.snapshot import Snapshot
from acsard.core.motion.gyro import STATUS
from acsard.core.values import (
    WHEELS,
    BatteryStatus,
    Instant,
)
from tests.each import each
from tests.stepped import Outputs
from tests.unit.examples import ESTIMATE, OUTPUTS, SNAPSHOT, START, at, changed, due, later
from tests.wheels import FOUR, TWO

ALL = {topic.key for topic in PUBLISHED if not topic.simulated} - {BEAT}
"""Keys that a report publishes.

The simulator publishes the true values of a simulated robot itself. A beat has the time of a clock
that a report cannot read.
"""
SUMMARIES = ALL - {"odom", "tf", "tf_static", "wheel_states", "cmd_vel_out", "events"}
"""Keys with their own rate, which are built from a `Snapshot`."""
FRAMES = OdometryConfig(odom_frame="r7/odom", base_frame="r7/base")
CONFIG = Config(robot=RobotConfig("r7"), odometry=FRAMES)


def get_snapshot() -> Snapshot:
    return SNAPSHOT


def never() -> Snapshot:
    raise AssertionError("the snapshot is dear and nobody asked for it")


def published(
    outputs: Outputs = OUTPUTS, config: Config = CONFIG, **changes: Any
) -> dict[str, Any]:
    """Return the messages, keyed by key, that a new daemon publishes after these outputs."""
    shot = changed(SNAPSHOT, **changes)
    return dict(due(Report(config, START), outputs, ALL, lambda: shot))


def state_of(config: Config = CONFIG, ends: dict[str, int] | None = None, **changes: Any) -> Any:
    """Return `state` and the messages of the rows of `diagnostics` by name."""
    report, shot = Report(config, START, ends or {}), changed(SNAPSHOT, **changes)
    due(report, OUTPUTS, set(), never)
    array: Any = report.current("diagnostics", lambda: shot)
    rows = {row.name.removeprefix("acsard: "): row for row in array.status}
    return report.current("state", lambda: shot), rows


# the content

STAMP, OF_STEP = Time(1_700_000_003, 250_000_001), Time(1_700_000_003, 254_000_002)
HALF = Quaternion(0.0, 0.0, math.sin(0.25), math.cos(0.25))


@each(
    ("wheels", "joints"),
    [
        (FOUR, [f"{name}_wheel_joint" for name in WHEELS]),
        (TWO, ["right_wheel_joint", "left_wheel_joint"]),
    ],
)
def test_the_messages_of_a_sample_have_its_stamp_its_values_and_the_configured_frames(
    wheels: WheelMap, joints: list[str]
) -> None:
    messages = published(config=replace(CONFIG, mcu=McuConfig(wheels=wheels)))
    # fmt: off
    pose = [
        0.11, 0.12, 0.0, 0.0, 0.0, 0.16,
        0.12, 0.22, 0.0, 0.0, 0.0, 0.26,
        0.0,  0.0,  1e6, 0.0, 0.0, 0.0,
        0.0,  0.0,  0.0, 1e6, 0.0, 0.0,
        0.0,  0.0,  0.0, 0.0, 1e6, 0.0,
        0.16, 0.26, 0.0, 0.0, 0.0, 0.66,
    ]
    # fmt: on
    twist = [0.0] * 36
    twist[::7] = [0.01, 0.02, 1e6, 1e6, 1e6, 0.06]  # wheels do not measure the other axes
    header, place = Header(STAMP, "r7/odom"), Vector3(1.5, -2.5, 0.0)
    assert messages["odom"] == Odometry(
        header, "r7/base", PoseWithCovariance(Pose(place, HALF), pose),
        TwistWithCovariance(Twist(Vector3(0.25), Vector3(z=-0.75)), twist),
    )  # fmt: skip
    turned = TransformStamped(header, "r7/base", Transform(place, HALF))
    assert messages["tf"] == TFMessage([turned])
    assert messages["wheel_states"] == JointState(
        Header(STAMP, ""), joints, [10.0, 20.0, 30.0, 40.0][: len(joints)],
        [1.0, 2.0, 3.0, 4.0][: len(joints)], [],
    )  # fmt: skip


def test_the_messages_of_a_step_have_its_time() -> None:
    messages = published()
    assert messages["cmd_vel_out"] == TwistStamped(
        Header(OF_STEP, "r7/base"), Twist(Vector3(x=0.3), Vector3(z=0.9))
    )
    assert messages["diagnostics"].header.stamp == OF_STEP
    assert messages["state"] == RobotState(
        stamp=OF_STEP, mode="driving", code="commanded", reason="commanded by app",
        x=1.6, y=-2.6, yaw=0.6, linear=0.26, angular=-0.76, wheels=[1.1, 2.1, 3.1, 4.1],
        link="up", source="app", refused="source nav: held up",
        sources=[
            SourceState("app", 50, 0.01, "", "nothing"),
            SourceState("nav", 10, None, "a command", "command"),
        ],
        counters={"lines": 100, "line_malformed": 2, "commands": 7, "command_stale": 3},
        latencies={"period_lateness": Latency(
            Spread(1000, 50.0, 400.0, 900.0), Spread(100, 40.0, 80.0, 90.0))},
        battery=BatterySummary(22.5, 40.0, -1.5, "ok"),
    )  # fmt: skip


@each(
    ("yaw", "z", "w"),
    [(0.0, 0.0, 1.0), (math.pi / 2, 0.5**0.5, 0.5**0.5), (-math.pi / 2, -(0.5**0.5), 0.5**0.5),
     (math.pi, 1.0, 0.0), (math.pi / 3, 0.5, 0.75**0.5)],
)  # fmt: skip
def test_a_yaw_is_converted_to_the_right_quaternion(yaw: float, z: float, w: float) -> None:
    turn = from_yaw(yaw)  # sin(a/2) k + cos(a/2)
    assert (turn.x, turn.y, turn.z, turn.w) == pytest.approx((0.0, 0.0, z, w), abs=1e-12)


def test_the_static_transform_has_the_pose_of_the_lidar_and_the_time_of_the_start() -> None:
    lidar = LidarConfig(lidar_frame="eye", lidar_x_offset=0.1, lidar_y_offset=-0.2, lidar_yaw=0.6)
    report = Report(replace(CONFIG, lidar=lidar), START)
    assert report.current("tf_static", never) == TFMessage([TransformStamped(
        Header(Time(1_700_000_000, 0), "r7/base"), "eye",
        Transform(Vector3(0.1, -0.2, 0.0), from_yaw(0.6)),
    )])  # fmt: skip
    off = replace(CONFIG, lidar=replace(lidar, publish_tf=False))
    assert Report(off, START).tf_static().transforms == []
    (lidar_only,) = Report(Config(), START).tf_static().transforms
    assert lidar_only.child_frame_id == "lidar_link"


def test_without_publish_tf_only_odom_is_published() -> None:
    config = replace(CONFIG, odometry=replace(FRAMES, publish_tf=False))
    assert "odom" in published(config=config)
    assert "tf" not in published(config=config)


def test_the_battery_message_has_the_time_and_values_of_the_boards_report() -> None:
    assert published()["battery"] == Battery(
        Header(Time.from_ns(OUTPUTS.now.wall_ns - 104_000_000)),
        voltage=22.5, current=-1.5, percentage=0.4, power_supply_status=2, present=True,
    )  # fmt: skip
    for amps, status in ((None, 0), (2.0, 1), (-0.01, 2), (0.0, 3)):
        battery = BatteryStatus("ok", 0, 24.0, amps=amps)
        assert published(battery=battery)["battery"].power_supply_status == status
    silent = published(battery=BatteryStatus("unknown"))
    assert silent["battery"] == Battery(Header(Time.from_ns(OUTPUTS.now.wall_ns)))
    assert "battery" not in published(battery=None)


def test_gyro_and_wheels_are_in_diagnostics_as_in_the_state() -> None:
    wide = replace(CONFIG, drive=DriveConfig(wheel_separation_multiplier=1.5))
    assert state_of()[0].gyro == "off"
    for does in ("used", "silent"):
        state, rows = state_of(wide, gyro=does)
        assert (state.gyro, rows["gyro"].message) == (does, STATUS[does].text)
    text = "rear_left is left out"
    state, rows = state_of(wheel_fault=text)
    assert (state.wheel_fault, rows["wheels"].message) == (text, text)


@each(
    ("days", "level", "words"),
    [(400, 0, "valid for 400 days"), (30, 0, "valid for 30 days"), (29, 1, "expires in 29 days"),
     (0, 1, "expires"), (-2, 2, "expired 2 days ago")],
)  # fmt: skip
def test_a_certificate_that_expires_soon_is_reported(days: int, level: int, words: str) -> None:
    config = replace(CONFIG, bus=BusConfig(tls="/etc/acsard/tls"))
    state, rows = state_of(config, {"": OUTPUTS.now.wall_ns + days * DAY_NS})
    row = rows["certificate"]
    assert state.certificate_expiry.startswith(words)
    assert (state.certificate_days, row.level, row.message) == (
        days, level, state.certificate_expiry,
    )  # fmt: skip
    # Without a report of the gateway; a page has nobody who reports.
    unreadable, _ = state_of(
        replace(config, bus=BusConfig(listen=("tls/0.0.0.0:7449",), tls="/etc"))
    )
    assert "`acsard doctor`" in unreadable.certificate_expiry
    assert unreadable.certificate_days is None
    assert state_of(config)[0].certificate == ""
    plain, _ = state_of(CONFIG, {"": 0})
    assert (plain.certificate_expiry, plain.certificate_days) == ("", None)


def test_the_certificate_that_expires_first_is_named_unless_it_is_the_robot_s_own() -> None:
    now_ns = OUTPUTS.now.wall_ns

    def told(ends: dict[str, int]) -> tuple[str, str]:
        why = expiry(ends, now_ns)
        return short_code(why), why.text

    ends = {"": now_ns + 10 * DAY_NS, "the authority": now_ns + 400 * DAY_NS}
    assert told(ends) == ("expires", "expires in 10 days")
    # The gateway's report is the earlier expiry of its own certificate and of its authority's.
    both = ends | {"the authority": ends[""]}
    assert told(both)[1].endswith(" (certificate of the authority)")
    ends["the router tls/router.local:7447"] = now_ns - 3 * DAY_NS
    text = "expired 3 days ago (certificate of the router tls/router.local:7447)"
    assert told(ends) == ("expired", text)
    ends[""] = now_ns - DAY_NS
    assert told(ends) == ("expired", f"{text}: TLS refuses every client")
    assert told({})[0] == "unknown"


# who gets what


@each("wanted", [set(), *({key} for key in ALL), {"odom", "state"}, ALL])
def test_only_topics_with_subscribers_are_published(wanted: set[str]) -> None:
    messages = due(Report(CONFIG, START), OUTPUTS, wanted, get_snapshot)
    assert sorted(key for key, _ in messages) == sorted(wanted - {"tf_static"})


def test_no_snapshot_is_taken_if_no_summary_is_wanted_and_due() -> None:
    report = Report(CONFIG, START)
    assert len(due(report, at(later(0)), ALL - SUMMARIES, never)) == 5
    due(report, at(later(0)), ALL, get_snapshot)
    assert not due(report, at(later(0.01), estimates=()), {"state", "diagnostics"}, never)


def test_a_step_publishes_each_sample_and_without_feedback_or_tick_nothing_of_them() -> None:
    several = tuple(replace(ESTIMATE, at=Instant(n, n)) for n in (1_000, 2_000, 3_000))
    outputs = replace(OUTPUTS, estimates=several)
    messages: Any = due(Report(CONFIG, START), outputs, {"odom"}, get_snapshot)
    assert [m.header.stamp.nanosec for _, m in messages] == [1_000, 2_000, 3_000]
    assert set(published(replace(OUTPUTS, estimates=()))) == {"cmd_vel_out", "events"} | SUMMARIES
    assert "cmd_vel_out" not in published(replace(OUTPUTS, due=False))


@each("key", sorted(ALL - {"tf_static"}))
def test_the_current_value_is_that_of_the_last_step_even_without_subscribers(key: str) -> None:
    report = Report(CONFIG, START)
    assert report.current(key, never) is None
    due(report, OUTPUTS, set(), never)
    value = report.current(key, get_snapshot)
    assert value == published()[key]
    assert type(value).__name__ == next(t.type for t in PUBLISHED if t.key == key)
    due(report, at(later(9), estimates=()), set(), never)
    if key in ("odom", "tf", "wheel_states"):
        assert report.current(key, get_snapshot) == published()[key]
    for other in ("", "alive", "cmd/app", "info", "nonsense"):
        assert report.current(other, never) is None


def test_without_feedback_the_current_odometry_is_at_rest_with_unknown_variances() -> None:
    report, blind = Report(CONFIG, START), changed(SNAPSHOT, linear=None, angular=None, wheels=[])
    due(report, OUTPUTS, set(), never)
    odom: Any = report.current("odom", lambda: blind)
    assert odom.twist.twist == Twist(Vector3(), Vector3())
    assert odom.twist.covariance == [1e6 if cell % 7 == 0 else 0.0 for cell in range(36)]
    wheels: Any = report.current("wheel_states", lambda: blind)
    assert (wheels.position, wheels.velocity) == ([10.0, 20.0, 30.0, 40.0], [])


# rates


def rates(**hz: float) -> Config:
    return replace(CONFIG, rates=RatesConfig(**hz))


def steps_of(
    key: str, config: Config = CONFIG, steps: int = 1000,
    late: Callable[[int], float] = lambda step: 0.0, report: Report | None = None, **changes: Any,
) -> list[int]:  # fmt: skip
    """Return the numbers of the steps at 100 Hz after which `key` was published."""
    report = report or Report(config, START)
    return [
        step
        for step in range(steps)
        for name, _ in due(report, at(later(1 + step / 100 + late(step)), **changes), {key},
                           get_snapshot)
        if name == key
    ]  # fmt: skip


@pytest.mark.slow
@each(
    ("key", "setting", "most"),
    [
        ("odom", "odom", 100.0), ("wheel_states", "telemetry", 100.0),
        ("cmd_vel_out", "telemetry", 100.0), ("state", "telemetry", 10.0),
        ("diagnostics", "telemetry", 1.0), ("battery", "telemetry", 1.0),
    ],
)  # fmt: skip
@each("hz", [0.0, 0.5, 1.0, 3.0, 10.0, 30.0, 50.0, 80.0, 100.0, 1000.0])
def test_the_average_rate_is_as_configured(key: str, setting: str, most: float, hz: float) -> None:
    times = steps_of(key, rates(**{setting: hz}))
    assert abs(len(times) - min(hz or most, most) * 10) <= 1


@pytest.mark.parametrize("hz", [10, 20, 25, 50])
def test_steps_a_little_early_or_late_do_not_make_the_intervals_uneven(hz: int) -> None:
    dice = random.Random(hz)
    for key, config in (("odom", rates(odom=float(hz))), ("state", CONFIG)):
        steps = steps_of(key, config, 1000, lambda step: dice.uniform(-5e-5, 5e-5))
        apart = 100 // hz if key == "odom" else 10
        assert {b - a for a, b in pairwise(steps[2:])} <= {apart}


def test_a_changed_setting_makes_no_message_due_and_counts_from_the_last_message_on() -> None:
    config = rates(odom=20.0, telemetry=10.0)
    for key, most in (("odom", 20), ("wheel_states", 10), ("state", 10), ("battery", 1)):
        report, count = Report(config, START), 0
        for step in range(300):
            report.config = config
            count += len(due(report, at(later(step / 100)), {key}, get_snapshot))
        assert abs(count - 3 * most) <= 1
    report = Report(rates(odom=1.0), START)
    assert steps_of("odom", steps=30, report=report) == [0]
    report.config = rates(odom=2.0)
    # A message may come a twentieth of its period early.
    assert steps_of("odom", steps=100, report=report)[0] in (48, 49, 50)


@pytest.mark.parametrize("key", sorted(SUMMARIES))
def test_a_change_of_the_status_is_published_immediately(key: str) -> None:
    report = Report(CONFIG, START)
    due(report, at(later(0)), {key}, get_snapshot)
    for step in (1, 2, 3):
        changed = at(later(step / 100), status_changed=True)
        assert [name for name, _ in due(report, changed, {key}, get_snapshot)] == [key]


def test_after_a_change_or_a_pause_the_next_state_comes_a_period_later() -> None:
    report = Report(CONFIG, START)
    due(report, at(later(0)), {"state"}, get_snapshot)
    due(report, at(later(0.05), status_changed=True), {"state"}, get_snapshot)
    steps = steps_of("state", steps=25, report=report)  # a second later
    assert steps == [0, 10, 20]
    assert steps_of("state", steps=25, late=lambda _: 500.0, report=report) == [0, 10, 20]
