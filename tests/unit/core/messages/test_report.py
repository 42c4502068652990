"""Tests of the messages that are published after a step: stamps, frames and covariances."""

from __future__ import annotations

import math
import random
from functools import partial
from itertools import pairwise
from typing import Any

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import (
    BusConfig,
    Config,
    DriveConfig,
    LidarConfig,
    OdometryConfig,
    RatesConfig,
    RobotConfig,
)
from acsard.core.messages.keys_and_roles import BEAT, PUBLISHED
from acsard.core.messages.report import Report, from_yaw
from acsard.core.messages.schema import (
    Battery,
    BatterySummary,
    DiagnosticArray,
    DiagnosticStatus,
    Events,
    Header,
    JointState,
    Latency,
    LogEvent,
    Message,
    Odometry,
    Quaternion,
    RobotState,
    SourceState,
    Spread,
    TFMessage,
    Time,
    TwistStamped,
    Vector3,
)
from acsard.core.motion.arbiter_text import missed
from acsard.core.motion.gyro import STATUS_TEXTS
from acsard.core.values import (
    BatteryStatus,
    Estimate,
    Event,
    GyroDoes,
    GyroStatus,
    Instant,
    RoutersStatus,
    Snapshot,
    WheelsStatus,
)
from tests.each import each
from tests.stepped import Outputs
from tests.unit.core.messages.examples import ESTIMATE, OUTPUTS, SNAPSHOT, START, at, due, later

ALL = {topic.key for topic in PUBLISHED if not topic.simulated} - {BEAT}
"""Keys that a report publishes.

The simulator publishes the true values of a simulated robot itself. A beat has the time of a clock
that a report cannot read.
"""
SUMMARIES = ALL - {
    "odom", "tf", "tf_static", "wheel_states", "cmd_vel_out", "events",
}  # fmt: skip
"""Keys with their own rate, which are built from a `Snapshot`."""
FRAMES = OdometryConfig(
    odom_frame="r7/odom",
    base_frame="r7/base",
)
CONFIG = Config(robot=RobotConfig("r7"), odometry=FRAMES)

HALF = math.sqrt(0.5)


def get_snapshot() -> Snapshot:
    return SNAPSHOT


def never() -> Snapshot:
    raise AssertionError("the snapshot is dear and nobody asked for it")


def published(outputs: Outputs = OUTPUTS, config: Config = CONFIG) -> dict[str, Any]:
    """Return the messages, keyed by key, that a new daemon publishes after these outputs."""
    return dict(due(Report(config, START), outputs, ALL, get_snapshot))


def rates(**hz: float) -> Config:
    return replace(CONFIG, rates=RatesConfig(**hz))


def times_of(key: str, config: Config, steps: int = 1000, **changes: Any) -> list[int]:
    """Return the numbers of the steps at 100 Hz after which `key` was published."""
    report = Report(config, START)
    return [
        step
        for step in range(steps)
        for name, _ in due(report, at(later(step / 100), **changes), {key}, get_snapshot)
        if name == key
    ]


# stamps and frames


def test_all_messages_of_a_sample_carry_the_samples_own_stamp() -> None:
    messages = published()
    stamp = Time(1_700_000_003, 250_000_001)
    assert messages["odom"].header.stamp == stamp
    assert messages["wheel_states"].header.stamp == stamp
    assert [t.header.stamp for t in messages["tf"].transforms] == [stamp]


def test_commands_state_and_diagnostics_carry_the_time_of_the_step() -> None:
    messages = published()
    stamp = Time(1_700_000_003, 254_000_002)
    assert messages["cmd_vel_out"].header.stamp == stamp
    assert messages["state"].stamp == stamp
    assert messages["diagnostics"].header.stamp == stamp


def test_the_frames_are_the_configured_ones() -> None:
    messages = published()
    assert messages["odom"].header.frame_id == "r7/odom"
    assert messages["odom"].child_frame_id == "r7/base"
    (transform,) = messages["tf"].transforms
    assert (transform.header.frame_id, transform.child_frame_id) == ("r7/odom", "r7/base")
    assert messages["cmd_vel_out"].header.frame_id == "r7/base"


def test_each_message_has_the_type_of_its_topic() -> None:
    report = Report(CONFIG, START)
    list(due(report, OUTPUTS, set(), never))
    for topic in PUBLISHED:
        if topic.key in ALL:
            assert type(report.current(topic.key, get_snapshot)).__name__ == topic.type


# odometry and transforms


def test_odom_has_the_pose_and_the_twist_of_the_sample() -> None:
    odom: Odometry = published()["odom"]
    assert odom.pose.pose.position == Vector3(1.5, -2.5, 0.0)
    assert odom.pose.pose.orientation == from_yaw(0.5)
    assert odom.twist.twist.linear == Vector3(0.25, 0.0, 0.0)
    assert odom.twist.twist.angular == Vector3(0.0, 0.0, -0.75)


def test_the_pose_covariance_has_each_value_in_its_cell() -> None:
    odom: Odometry = published()["odom"]
    # fmt: off
    assert odom.pose.covariance == [
        0.11, 0.12, 0.0, 0.0, 0.0, 0.16,
        0.12, 0.22, 0.0, 0.0, 0.0, 0.26,
        0.0,  0.0,  1e6, 0.0, 0.0, 0.0,
        0.0,  0.0,  0.0, 1e6, 0.0, 0.0,
        0.0,  0.0,  0.0, 0.0, 1e6, 0.0,
        0.16, 0.26, 0.0, 0.0, 0.0, 0.66,
    ]
    # fmt: on


def test_the_twist_covariance_has_measured_axes_of_the_sample_and_large_other_ones() -> None:
    covariance = published()["odom"].twist.covariance
    rows = [covariance[6 * i : 6 * i + 6] for i in range(6)]
    assert [rows[i][i] for i in range(6)] == [0.01, 0.02, 1e6, 1e6, 1e6, 0.06]
    assert all(rows[i][j] == 0.0 for i in range(6) for j in range(6) if i != j)


def test_tf_has_the_same_pose_as_odom() -> None:
    messages = published()
    (transform,) = messages["tf"].transforms
    assert transform.transform.translation == messages["odom"].pose.pose.position
    assert transform.transform.rotation == messages["odom"].pose.pose.orientation


def test_without_publish_tf_only_odom_is_published() -> None:
    config = replace(CONFIG, odometry=replace(FRAMES, publish_tf=False))
    report = Report(config, START)
    keys = [key for key, _ in due(report, OUTPUTS, ALL, get_snapshot)]
    assert "tf" not in keys
    assert "odom" in keys
    assert report.current("tf", never) is None


def test_wheel_states_name_each_wheel_with_its_angle_and_speed() -> None:
    states: JointState = published()["wheel_states"]
    assert states.name == list(CONFIG.joints.as_tuple())
    assert states.position == [10.0, 20.0, 30.0, 40.0]
    assert states.velocity == [1.0, 2.0, 3.0, 4.0]
    assert states.effort == []


def test_cmd_vel_out_is_the_twist_applied_after_the_limits() -> None:
    out: TwistStamped = published()["cmd_vel_out"]
    assert (out.twist.linear, out.twist.angular) == (Vector3(x=0.3), Vector3(z=0.9))


# quaternions

YAWS = [
    (0.0, Quaternion(0, 0, 0, 1)),
    (math.pi / 2, Quaternion(0, 0, HALF, HALF)),
    (-math.pi / 2, Quaternion(0, 0, -HALF, HALF)),
    (math.pi, Quaternion(0, 0, 1, 0)),
    (math.pi / 3, Quaternion(0, 0, 0.5, math.sqrt(0.75))),
]
"""Worked by hand: a turn by a about z is sin(a/2) k + cos(a/2)."""


def close(q: Quaternion, r: Quaternion) -> bool:
    return all(
        math.isclose(a, b, abs_tol=1e-12)
        for a, b in zip((q.x, q.y, q.z, q.w), (r.x, r.y, r.z, r.w), strict=True)
    )


@each(("yaw", "turn"), YAWS)
def test_a_yaw_is_converted_to_the_right_quaternion(yaw: float, turn: Quaternion) -> None:
    assert close(from_yaw(yaw), turn)


# transforms that never change

LIDAR = LidarConfig(
    lidar_frame="eye",
    lidar_x_offset=0.1,
    lidar_y_offset=-0.2,
    lidar_yaw=0.6,
)


def static(lidar: LidarConfig) -> TFMessage:
    return Report(replace(CONFIG, lidar=lidar), START).tf_static()


def test_the_static_transform_has_the_pose_of_the_lidar_and_the_time_of_the_start() -> None:
    (lidar,) = static(LIDAR).transforms
    assert lidar.header == Header(Time(1_700_000_000, 0), "r7/base")
    assert lidar.child_frame_id == "eye"
    assert lidar.transform.translation == Vector3(0.1, -0.2, 0.0)
    assert lidar.transform.rotation == from_yaw(0.6)


def test_a_lidar_that_is_switched_off_has_no_transform() -> None:
    assert static(replace(LIDAR, publish_tf=False)).transforms == []


def test_by_default_only_the_lidar_transform_is_published() -> None:
    names = [t.child_frame_id for t in Report(Config(), START).tf_static().transforms]
    assert names == ["lidar_link"]


# state and diagnostics


def test_state_is_the_summary_of_outputs_and_snapshot() -> None:
    assert published()["state"] == RobotState(
        stamp=Time(1_700_000_003, 254_000_002),
        mode="driving",
        code="commanded",
        reason="commanded by app",
        x=1.6,
        y=-2.6,
        yaw=0.6,
        linear=0.26,
        angular=-0.76,
        wheels=[1.1, 2.1, 3.1, 4.1],
        link="up",
        source="app",
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
    )


def values(status: DiagnosticStatus) -> dict[str, str]:
    return {pair.key: pair.value for pair in status.values}


def test_estimated_encoder_counts_are_in_the_state_and_in_the_row_of_the_link() -> None:
    report = Report(CONFIG, START)
    list(due(report, OUTPUTS, set(), never))

    def seen() -> Snapshot:
        return replace(SNAPSHOT, encoders=(20, 0, 0, 400))

    state, array = report.current("state", seen), report.current("diagnostics", seen)
    assert isinstance(state, RobotState)
    assert isinstance(array, DiagnosticArray)
    assert state.encoder_counts == [20, 0, 0, 400]
    (row,) = (status for status in array.status if status.name == "acsard: serial link")
    counts = {key: value for key, value in values(row).items() if key.startswith("counts")}
    assert counts == {"counts_front_right": "20", "counts_rear_right": "400"}


@pytest.mark.parametrize(
    ("routers", "level", "message", "fields"),
    [
        (RoutersStatus(("a",)), 0, "connected", {"a": "connected"}),
        (
            RoutersStatus(("a",), ("b",)),
            1,
            "not connected to b",
            {"a": "connected", "b": "not connected"},
        ),
        (
            RoutersStatus(("a", "b"), peers=("b",)),
            1,
            "connected; b is not a router: clients that connect to this daemon see only this robot",
            {"a": "connected", "b": "a peer, not a router"},
        ),
    ],
)
def test_a_router_that_is_missing_is_a_warning(
    routers: RoutersStatus, level: int, message: str, fields: dict[str, str]
) -> None:
    report = Report(CONFIG, START)
    list(due(report, OUTPUTS, ALL, get_snapshot))
    array = report.current("diagnostics", lambda: replace(SNAPSHOT, routers=routers))
    assert isinstance(array, DiagnosticArray)
    (row,) = (status for status in array.status if status.name == "acsard: router")
    shown = {key: value for key, value in values(row).items() if key != "advice"}
    assert (row.level, row.message, shown) == (level, message, fields)


def test_a_daemon_without_routers_has_no_router_row() -> None:
    assert "acsard: router" not in {status.name for status in published()["diagnostics"].status}


# keys without subscribers


@each("wanted", [set(), *({key} for key in ALL), {"odom", "state"}, ALL])
def test_only_topics_with_subscribers_are_published(wanted: set[str]) -> None:
    messages = due(Report(CONFIG, START), OUTPUTS, wanted, get_snapshot)
    assert sorted(key for key, _ in messages) == sorted(wanted - {"tf_static"})


def test_no_snapshot_is_taken_for_a_summary_without_subscribers() -> None:
    assert len(list(due(Report(CONFIG, START), OUTPUTS, ALL - SUMMARIES, never))) == 5


def test_no_snapshot_is_taken_for_a_summary_that_is_not_due() -> None:
    report = Report(CONFIG, START)
    list(due(report, at(later(0)), ALL, get_snapshot))
    assert not list(due(report, at(later(0.01), estimates=()), {"state", "diagnostics"}, never))


def test_events_are_kept_without_subscribers_and_published_with_earlier_events() -> None:
    report = Report(CONFIG, START)
    assert report.current("events", get_snapshot) is None
    many = tuple(Event("commander", f"the {n}. takes over", by="app", count=2) for n in range(25))
    assert not list(due(report, replace(OUTPUTS, events=many, due=False), set(), get_snapshot))
    assert not list(due(report, replace(OUTPUTS, events=()), {"events"}, get_snapshot))
    quiet = replace(OUTPUTS, now=later(7), due=False, estimates=())
    ((key, message),) = due(report, quiet, {"events"}, never)
    assert isinstance(message, Events)
    assert (key, message.total, len(message.events)) == ("events", 26, 20)
    assert message.events[0].text == "the 6. takes over"
    assert message.events[0].count == 2
    assert message.events[0].stamp == Time.from_ns(OUTPUTS.now.wall_ns)
    assert message.events[-1] == LogEvent(message.stamp, "stop", "info", "stopped", "phone", 1)
    assert message.stamp == Time.from_ns(quiet.now.wall_ns)
    assert report.current("events", never) == message


def test_a_fault_stays_in_the_list_during_a_repeated_event() -> None:
    report, fault = Report(CONFIG, START), Event("fault", "a wheel is dead", "error")
    for second, event in enumerate([fault, *[missed(3, 10_000_000)] * 100]):
        list(due(report, replace(OUTPUTS, events=(event,), now=later(second)), set(), get_snapshot))
    message = report.current("events", never)
    assert isinstance(message, Events)
    assert [(row.name, row.count) for row in message.events] == [
        ("fault", 1),
        ("missed_periods", 300),
    ]


def test_every_sample_of_a_step_is_published_in_order() -> None:
    estimates: list[Estimate] = [replace(ESTIMATE, at=Instant(n, n)) for n in (1_000, 2_000, 3_000)]
    messages = due(
        Report(CONFIG, START), replace(OUTPUTS, estimates=tuple(estimates)), {"odom"}, get_snapshot
    )
    stamps = [m.header.stamp.nanosec for _, m in messages if isinstance(m, Odometry)]
    assert stamps == [1_000, 2_000, 3_000]


def test_a_step_without_feedback_publishes_no_odometry() -> None:
    left = {"cmd_vel_out", "events"} | SUMMARIES
    assert set(published(replace(OUTPUTS, estimates=()))) == left


def test_a_step_without_a_tick_publishes_no_cmd_vel_out() -> None:
    assert "cmd_vel_out" not in published(replace(OUTPUTS, due=False))


# publishing rates


@each("key", ["odom", "tf", "wheel_states", "cmd_vel_out"])
def test_a_rate_of_zero_publishes_every_sample(key: str) -> None:
    assert times_of(key, CONFIG) == list(range(1000))


@pytest.mark.slow
@each(
    ("key", "setting", "most"),
    [
        ("odom", "odom", 100.0), ("wheel_states", "telemetry", 100.0),
        ("cmd_vel_out", "telemetry", 100.0), ("state", "telemetry", 10.0),
        ("diagnostics", "telemetry", 1.0), ("battery", "telemetry", 1.0),
    ],
)  # fmt: skip
@each("hz", [0.5, 1.0, 3.0, 10.0, 30.0, 50.0, 80.0, 100.0])
def test_the_average_rate_is_the_configured_one(
    key: str, setting: str, most: float, hz: float
) -> None:
    times = times_of(key, rates(**{setting: hz}))
    assert abs(len(times) - min(hz, most) * 10) <= 1


@pytest.mark.parametrize("hz", [10.0, 30.0, 50.0])
def test_steps_a_little_early_or_late_do_not_change_the_average(hz: float) -> None:
    report, count = Report(rates(odom=hz), START), 0
    for step in range(1000):
        late = (step * 7 % 11 - 5) * 1e-4  # up to half a millisecond early or late
        count += len(list(due(report, at(later(1.0 + step / 100 + late)), {"odom"}, get_snapshot)))
    assert abs(count - hz * 10) <= 1


@pytest.mark.parametrize(("hz", "steps"), [(20.0, 5), (25.0, 4), (50.0, 2)])
def test_steps_a_little_early_or_late_do_not_make_the_intervals_uneven(
    hz: float, steps: int
) -> None:
    report, indices = Report(rates(odom=hz), START), []
    for step in range(1000):
        late = (5 - step * 7 % 11) * 1e-5  # the first step is the latest of all
        if list(due(report, at(later(1.0 + step / 100 + late)), {"odom"}, get_snapshot)):
            indices.append(step)
    assert {b - a for a, b in pairwise(indices)} == {steps}


def test_a_rate_above_the_sample_rate_publishes_every_sample() -> None:
    assert times_of("odom", rates(odom=1000.0)) == list(range(1000))


def test_odom_and_tf_are_published_together_at_a_limited_rate() -> None:
    report = Report(rates(odom=10.0), START)
    for step in range(300):
        keys = [key for key, _ in due(report, at(later(step / 100)), {"odom", "tf"}, get_snapshot)]
        assert keys in ([], ["odom", "tf"])


def test_state_has_10_hz_and_diagnostics_have_1_hz_by_default() -> None:
    assert abs(len(times_of("state", CONFIG)) - 100) <= 1
    assert abs(len(times_of("diagnostics", CONFIG)) - 10) <= 1


@each(("key", "most"), [("odom", 20), ("wheel_states", 10), ("state", 10), ("battery", 1)])
def test_a_change_of_a_setting_makes_no_message_due(key: str, most: int) -> None:
    config = rates(odom=20.0, telemetry=10.0)
    report, count = Report(config, START), 0
    for step in range(1000):
        report.config = config
        count += len(list(due(report, at(later(step / 100)), {key}, get_snapshot)))
    assert abs(count - 10 * most) <= 1


def test_a_new_rate_counts_from_the_last_message_on() -> None:
    report, steps = Report(rates(odom=1.0), START), []
    for step in range(200):
        if step == 30:
            report.config = rates(odom=2.0)
        if list(due(report, at(later(step / 100)), {"odom"}, get_snapshot)):
            steps.append(step)
    assert steps[0] == 0
    assert 48 <= steps[1] <= 50  # a message may come a twentieth of its period early


@pytest.mark.parametrize("key", sorted(SUMMARIES))
def test_a_change_of_the_status_is_published_immediately(key: str) -> None:
    report = Report(CONFIG, START)
    list(due(report, at(later(0)), {key}, get_snapshot))
    for step in (1, 2, 3):
        changed = at(later(step / 100), status_changed=True)
        assert [name for name, _ in due(report, changed, {key}, get_snapshot)] == [key]


def test_after_a_change_the_next_state_comes_a_period_later() -> None:
    report = Report(CONFIG, START)
    steps = [
        step
        for step in range(60)
        if list(
            due(report, at(later(step / 100), status_changed=step == 25), {"state"}, get_snapshot)
        )
    ]
    after = [step for step in steps if step > 25]
    assert 25 in steps
    assert 9 <= after[0] - 25 <= 10


def test_no_burst_of_messages_follows_a_pause() -> None:
    report = Report(CONFIG, START)
    list(due(report, at(later(0)), {"state"}, get_snapshot))
    steps = [
        s for s in range(500, 520) if list(due(report, at(later(s / 100)), {"state"}, get_snapshot))
    ]
    assert steps[0] == 500
    assert len(steps) <= 3


# last values


@each("key", sorted(ALL - {"tf_static"}))
def test_a_topic_has_no_current_value_before_the_first_step(key: str) -> None:
    assert Report(CONFIG, START).current(key, never) is None


def test_the_static_transforms_are_available_before_the_first_step() -> None:
    report = Report(CONFIG, START)
    assert report.current("tf_static", never) == report.tf_static()


@each("key", sorted(ALL - {"tf_static"}))
def test_the_current_value_equals_the_published_message_even_without_subscribers(key: str) -> None:
    report = Report(CONFIG, START)
    list(due(report, OUTPUTS, set(), never))
    assert report.current(key, get_snapshot) == published()[key]


def test_the_last_sample_stays_the_current_value_without_new_feedback() -> None:
    report = Report(CONFIG, START)
    list(due(report, OUTPUTS, set(), never))
    due(report, at(later(9), estimates=()), set(), never)
    odom: Message | None = report.current("odom", get_snapshot)
    assert odom == published()["odom"]


@each("key", ["", "alive", "cmd/app", "info", "nonsense"])
def test_a_topic_that_is_not_published_has_no_current_value(key: str) -> None:
    report = Report(CONFIG, START)
    due(report, OUTPUTS, ALL, get_snapshot)
    assert report.current(key, never) is None


def test_state_at_10_hz_has_even_intervals_despite_jitter() -> None:
    report, rnd = Report(Config(), START), random.Random(1)
    steps: list[int] = []
    for step in range(3000):
        late = rnd.uniform(0, 1e-4)
        if list(due(report, at(later(1.0 + step / 100 + late)), {"state"}, get_snapshot)):
            steps.append(step)
    assert {b - a for a, b in pairwise(steps[2:])} == {10}


# the battery


def with_battery(battery: BatteryStatus | None) -> dict[str, Any]:
    return dict(
        due(Report(CONFIG, START), OUTPUTS, ALL, lambda: replace(SNAPSHOT, battery=battery))
    )


def test_the_battery_message_has_the_time_and_values_of_the_boards_report() -> None:
    messages = published()
    assert messages["battery"] == Battery(
        Header(Time.from_ns(OUTPUTS.now.wall_ns - 104_000_000)),
        voltage=22.5,
        current=-1.5,
        percentage=0.4,
        power_supply_status=2,
        present=True,
    )


@each(("amps", "status"), [(None, 0), (2.0, 1), (-0.01, 2), (0.0, 3)])
def test_the_current_shows_whether_the_battery_is_charged(amps: float | None, status: int) -> None:
    battery = with_battery(BatteryStatus("ok", 0, 24.0, amps=amps))["battery"]
    assert battery.power_supply_status == status


def test_a_battery_that_is_no_longer_reported_is_not_present() -> None:
    messages = with_battery(BatteryStatus("unknown"))
    assert messages["battery"] == Battery(Header(Time.from_ns(OUTPUTS.now.wall_ns)))
    assert messages["state"].battery == BatterySummary(None, None, None, "unknown")


def test_a_board_that_never_reported_a_battery_has_no_message_and_null_in_state() -> None:
    messages = with_battery(None)
    assert "battery" not in messages
    assert messages["state"].battery is None


def test_the_battery_is_published_once_per_second() -> None:
    assert abs(len(times_of("battery", CONFIG)) - 10) <= 1


# the gyro


def with_gyro(status: GyroStatus) -> tuple[RobotState, list[DiagnosticStatus]]:
    report = Report(replace(CONFIG, drive=DriveConfig(wheel_separation_multiplier=1.5)), START)
    list(due(report, OUTPUTS, set(), never))

    def seen() -> Snapshot:
        return replace(SNAPSHOT, gyro=status)

    state, array = report.current("state", seen), report.current("diagnostics", seen)
    assert isinstance(state, RobotState)
    assert isinstance(array, DiagnosticArray)
    return state, [row for row in array.status if row.name == "acsard: gyro"]


def test_without_a_gyro_the_state_is_off_and_diagnostics_have_no_row() -> None:
    state, rows = with_gyro(GyroStatus())
    assert (state.gyro, rows) == ("off", [])


@each(
    ("does", "level"),
    [
        ("waiting for rest", 0),
        ("waiting for turn", 0),
        ("used", 0),
        ("silent", 1),
        ("disagrees", 1),
        ("reversed", 1),
        ("in degrees", 1),
        ("dead", 1),
        ("not believed", 1),
    ],
)
def test_the_state_of_the_gyro_is_reported_with_its_level(does: GyroDoes, level: int) -> None:
    state, (row,) = with_gyro(GyroStatus(does))
    assert (state.gyro, row.level, row.message) == (does, level, STATUS_TEXTS[does])


# suspect wheels


def test_the_verdicts_on_the_wheels_are_reported() -> None:
    doubt = WheelsStatus("rear_left is left out", ("rear_left",), ("right",))
    for status, level in ((WheelsStatus(), 0), (doubt, 1)):
        report, snapshot = Report(CONFIG, START), replace(SNAPSHOT, doubt=status)
        list(due(report, OUTPUTS, set(), never))
        provider = partial(replace, snapshot)
        state, array = report.current("state", provider), report.current("diagnostics", provider)
        assert isinstance(state, RobotState)
        assert isinstance(array, DiagnosticArray)
        (row,) = [entry for entry in array.status if entry.name == "acsard: wheels"]
        assert (state.wheel_fault, row.level) == (status.text, level)
        assert row.message == (status.text or "every wheel obeys its command")
    assert {pair.key: pair.value for pair in row.values if pair.key != "advice"} == {
        "left_out": "rear_left",
        "slipping": "right",
    }


# the certificate of the bus

DAY_NS = 86400 * 10**9


@each(
    ("days", "level", "words"),
    [
        (400, 0, "valid for 400 days"),
        (30, 0, "valid for 30 days"),
        (29, 1, "expires in 29 days"),
        (-2, 2, "expired 2 days ago"),
    ],
)
def test_a_certificate_that_expires_soon_is_reported(days: int, level: int, words: str) -> None:
    config = replace(CONFIG, bus=BusConfig(tls="/etc/acsard/tls"))
    made = Report(config, START, {"": OUTPUTS.now.wall_ns + days * DAY_NS})
    due(made, OUTPUTS, set(), lambda: SNAPSHOT)
    state = made.current("state", lambda: SNAPSHOT)
    assert isinstance(state, RobotState)
    assert state.certificate_expiry.startswith(words)
    assert state.certificate_days == days
    array = made.current("diagnostics", lambda: SNAPSHOT)
    assert isinstance(array, DiagnosticArray)
    (status,) = [entry for entry in array.status if entry.name == "acsard: certificate"]
    assert (status.level, status.message) == (level, state.certificate_expiry)


def test_an_unreadable_certificate_is_reported_with_the_remedy() -> None:
    made = Report(replace(CONFIG, bus=BusConfig(tls="/etc/acsard/tls")), START)
    due(made, OUTPUTS, set(), lambda: SNAPSHOT)
    state = made.current("state", lambda: SNAPSHOT)
    assert isinstance(state, RobotState)
    assert "`acsard doctor`" in state.certificate_expiry
    assert state.certificate_days is None


def test_without_tls_the_state_has_no_certificate_fields() -> None:
    made = Report(CONFIG, START, {"": 0})
    due(made, OUTPUTS, set(), lambda: SNAPSHOT)
    state = made.current("state", lambda: SNAPSHOT)
    assert isinstance(state, RobotState)
    assert (state.certificate_expiry, state.certificate_days) == ("", None)
