"""The table of keys has every key of the design and its least role; short texts of messages."""

from __future__ import annotations

import math
import re

import pytest
from msgspec.structs import replace

from acsard.core.config.settings import Config, McuConfig, OdometryConfig
from acsard.core.messages.keys_and_roles import (
    FOLLOWED,
    PUBLISHED,
    SERVICES,
    TOPICS,
    VERBS,
    by_key,
    command_key,
    full_key,
    json_key,
    offered,
    published,
    row_of,
    source_keys,
)
from acsard.core.messages.permissions import USES, has, keys_for, least_role
from acsard.core.messages.report import from_yaw
from acsard.core.messages.schema import (
    MESSAGES,
    Cause,
    Header,
    Odometry,
    Pose,
    PoseStamped,
    PoseWithCovariance,
    Time,
    Twist,
    TwistWithCovariance,
    Vector3,
)
from acsard.core.messages.short_texts import place, short, speeds
from acsard.core.values import ROLES, Role
from tests import promised
from tests.each import each
from tests.promised import PROMISED
from tests.unit.screens import STATE

GYRO = OdometryConfig(gyro=True)
REAL = Config(mcu=McuConfig(port="/dev/ttyACM0"))


def test_the_topic_table_is_that_of_the_design() -> None:
    rows = [(row.key, row.direction, row.type) for row in PROMISED]
    assert sorted((t.key, t.direction, t.type) for t in TOPICS) == sorted(rows)
    assert [topic.key for topic in PUBLISHED] == [row.key for row in promised.PUBLISHED]
    assert all(topic.type in MESSAGES for topic in PUBLISHED)
    assert all(topic.note for topic in TOPICS)
    assert [topic.key for topic in TOPICS if topic.latched] == ["tf_static"]


def keys(config: Config) -> set[str]:
    return {topic.key for topic in offered(config)}


def test_a_robot_offers_the_keys_of_its_configuration() -> None:
    assert keys(Config()) - keys(REAL) == {"sim/pose"}
    for config in (Config(), REAL):
        gyro = replace(config, odometry=GYRO)
        assert keys(gyro) - keys(config) == {"imu"}
        for each_config in (config, gyro):
            rows = offered(each_config)
            # The simulator publishes its gyro.
            own = {"imu"} if each_config is gyro and config != REAL else set()
            expected = [row for row in rows if row in PUBLISHED or row.key in own]
            assert {*published(each_config)} == {*expected}


def test_keys_are_built_from_the_robot_the_source_and_the_certificate() -> None:
    assert full_key("r7", "cmd/teleop") == "acsard/r7/cmd/teleop"
    assert json_key("sim/pose") == "json/sim/pose"
    assert source_keys(["app", "nav"]) == ["cmd/app", "cmd/nav", "wheel_cmd/app", "wheel_cmd/nav"]
    assert source_keys(["app"], "anna") == ["cmd/app/anna", "wheel_cmd/app/anna"]
    assert command_key("cmd", "app") == "cmd/app"
    assert {f"srv/{service}" for service in SERVICES} == set(VERBS)


def test_every_key_of_the_table_has_its_row_and_an_unknown_key_has_no_row() -> None:
    values = {"source": "app", "certificate": "laptop anna", "Type": "Twist", "role": "viewer",
              "verb": "ghost", "key": "<key>"}  # fmt: skip
    for topic in TOPICS:
        filled = re.sub(r"<(\w+)>", lambda found: values[found[1]], topic.key)
        assert row_of(filled) is row_of(topic.key) is topic
    for key in ("", "cmd", "cmd/", "cmd/app/x/y", "cmd//x", "schema/", "odometry", "srv/a/b"):
        assert row_of(key) is None
    assert by_key("cmd/teleop") is None


# roles


def test_a_role_has_its_own_permissions_and_those_of_lower_roles() -> None:
    lower: dict[str, list[Role]] = {
        role: [least for least in ROLES if has(role, least)] for role in ("", *ROLES)
    }
    assert lower.pop("") == []
    assert lower == {role: [*ROLES[: ROLES.index(role) + 1]] for role in ROLES}


def test_each_row_has_a_role_for_exactly_the_uses_of_its_direction() -> None:
    for row in TOPICS:
        followed = row in FOLLOWED or row.key in ("json/<key>", "alive")
        assert row.subscribe == ("viewer" if followed else None)
        assert (row.publish is not None) == (row.direction == "in"), row.key
        assert row.query is not None or row.direction not in ("query", "service"), row.key
    granted = {key for role in ROLES for use in USES for key in keys_for(role, use, TOPICS)}
    # These keys are for the robot's own machine.
    assert not [key for key in granted if key.startswith(("cmd/", "wheel_cmd/", "gateway"))]
    assert set(keys_for("viewer", "subscribe", PUBLISHED)) == {
        key for topic in PUBLISHED for key in (topic.key, f"json/{topic.key}")
    }


@each(
    ("key", "role"),
    [("odom", "viewer"), ("json/sim/pose", "viewer"), ("alive", "viewer"), ("stop", "viewer"),
     ("cmd/app", "operator"), ("wheel_cmd/app/anna", "operator"), ("srv/clear", "operator"),
     ("imu", "maintainer"), ("config", "maintainer"), ("whoami/operator", "operator"),
     *((key, "") for key in ("", "no/such/key", "cmd/", "cmd/a/b/c", "json/nonsense",
                             "whoami/admin"))],
)  # fmt: skip
def test_a_key_has_its_least_role_and_an_unknown_key_none(key: str, role: Role | str) -> None:
    if role:
        assert least_role(key) == role
    else:
        with pytest.raises(LookupError, match="no row"):
            least_role(key)


# a message as one line of text

HEADER = Header(Time(), "odom")


def odometry(x: float, yaw: float, linear: float) -> Odometry:
    covariance = [0.25] * 36
    pose = PoseWithCovariance(Pose(Vector3(x), from_yaw(yaw)), covariance)
    twist = TwistWithCovariance(Twist(Vector3(linear), Vector3()), covariance)
    return Odometry(HEADER, "base_link", pose, twist)


@each("yaw", [-3.1, -0.4, 0.0, 1.0, 3.1, 3.2, 6.0])
def test_the_heading_is_within_half_a_turn(yaw: float) -> None:
    line = short(PoseStamped(HEADER, Pose(Vector3(), from_yaw(yaw))))
    angle = float(re.findall(r"[+-]\d+(?:\.\d+)?", line)[2])
    assert -180.0 <= angle <= 180.0
    assert math.remainder(angle - math.degrees(yaw), 360.0) == pytest.approx(0.0, abs=0.051)


def test_lines_of_odometry_have_the_same_width_and_no_number_makes_them_long() -> None:
    far = [odometry(x, 0.0, v) for x, v in ((0.0, 0.5), (999.9, -0.5), (-99.0, 0.0))]
    assert len({len(short(message)) for message in far}) == 1
    for value in (1e300, -1e12, math.inf, math.nan):
        assert len("".join(place(value, value, 0.0) + speeds(value, value))) < 80


def test_a_stopped_robot_says_why_once_with_its_code_and_the_numbers_that_clear_takes() -> None:
    causes = [Cause(n, "stop", "stopped", "", "", Time(), False, None) for n in (7, 12)]
    state = replace(STATE, mode="stopped", reason="stopped by ann", code="stopped")
    assert short(state).endswith("  stopped by ann [stopped]")
    assert short(replace(state, causes=causes)).endswith("ann [stopped] (causes 7, 12)")
    assert short(replace(state, causes=causes[:1])).endswith("ann [stopped] (cause 7)")
    low = replace(state, reason="battery low", code="battery_empty")
    assert short(low).endswith("  stopped: battery low [battery_empty]")
    assert short(replace(low, code="later")).endswith("  stopped: battery low [later]")
    assert short(replace(low, code="")).endswith("  stopped: battery low")
