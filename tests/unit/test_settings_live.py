"""Tests of the settings that can change while the daemon runs.

The rules for a change are the rules for the configuration file.
"""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import pytest
from msgspec.structs import replace

from acsard.core.config.contradictions import LIVE_RULES, RULES
from acsard.core.config.live import LIVE, changed, describe_changes, find_live_setting, flat, place
from acsard.core.config.parsing import ConfigError, effective, parse
from acsard.core.config.partial import Rule, view_without
from acsard.core.config.settings import (
    Config,
    LimitsConfig,
    RobotConfig,
    SafetyConfig,
    SimConfig,
)
from acsard.core.config.toml_text import document
from acsard.core.config.validation import show
from tests.each import each

CONFIG = Config(robot=RobotConfig("r7"))
KEYS = dict(flat(effective(CONFIG)))


def problems(
    wishes: Mapping[str, object], at_rest: bool = True, config: Config = CONFIG
) -> list[str]:
    with pytest.raises(ConfigError) as caught:
        changed(config, wishes, at_rest)
    return caught.value.problems


def by_file(wishes: dict[str, object]) -> Config | list[str]:
    """Return the configuration that a file with these settings gives, or its problems."""
    tables: dict[str, Any] = effective(CONFIG)
    tables["commands"]["sources"] = list(tables["commands"]["sources"])
    for key, value in wishes.items():
        *path, name = key.split(".")
        inner: Any = tables
        for part in path:
            named = (
                (entry for entry in inner if entry["name"] == part)
                if isinstance(inner, list)
                else ()
            )
            inner = next(iter(named)) if isinstance(inner, list) else inner[part]
        inner[name] = value
    try:
        return parse("\n".join(document(tables)).encode())
    except ConfigError as error:
        return error.problems


def test_every_live_setting_is_a_key_and_every_source_has_a_live_timeout() -> None:
    keys = [key for key in KEYS if find_live_setting(key)]
    assert keys == sorted(keys, key=place)  # the order of the file
    sources = {f"commands.sources.{source.name}.timeout" for source in CONFIG.commands.sources}
    assert set(keys) == {key for key in LIVE if "*" not in key} | sources
    assert all(row.what for row in LIVE.values())


@each(
    "key",
    ["mcu.port", "mcu.wheels.left", "mcu.wheels.rear_left", "drive.wheel_radius",
     "feedback.response_time", "commands.neutral_first",
     "commands.sources.nav.priority", "bus.listen", "access.maintainers", "robot.id",
     "odometry.gyro", "odometry.distance_scale_std", "commands.sources.nav"],
)  # fmt: skip
def test_settings_of_wire_base_and_permissions_need_a_restart(key: str) -> None:
    assert find_live_setting(key) is None


def test_a_change_sets_exactly_the_given_keys() -> None:
    made, news = changed(CONFIG, {"limits.linear_speed": 0.8, "log.level": "debug"}, False)
    after = dict(flat(effective(made)))
    assert {key for key in KEYS if KEYS[key] != after[key]} == {"limits.linear_speed", "log.level"}
    assert (made.limits.linear_speed, made.log.level) == (0.8, "debug")
    assert news == {"limits.linear_speed": (1.0, 0.8), "log.level": ("info", "debug")}
    text = 'limits.linear_speed = 0.8 (was 1.0), log.level = "debug" (was "info")'
    assert describe_changes(news) == text


def test_the_timeout_of_a_source_is_set_by_the_name_of_the_source() -> None:
    made, _ = changed(CONFIG, {"commands.sources.app.timeout": 0.5}, True)
    timeouts = {source.name: source.timeout for source in made.commands.sources}
    assert timeouts == {source.name: 0.25 for source in CONFIG.commands.sources} | {"app": 0.5}


@each("wishes", [{"mcu.port": "sim", "robot.id": "r7"}, dict(KEYS), {}])
def test_setting_a_key_to_its_present_value_changes_nothing(wishes: dict[str, object]) -> None:
    assert changed(CONFIG, wishes, False) == (CONFIG, {})


@pytest.mark.parametrize("rule", [rule for rule in RULES if rule not in LIVE_RULES])
def test_a_rule_that_a_change_skips_reads_no_setting_that_may_change(rule: Rule) -> None:
    # One rule reads `commands.sources`, but only the names.
    live = {key for key in KEYS if find_live_setting(key) and not key.startswith("commands.")}
    safety, sim = SafetyConfig(bumpers=("front",)), SimConfig(faults=("stuck_encoder",))
    config = replace(CONFIG, safety=safety, sim=sim)
    rule(view_without(config, live))  # raises an error if it reads one


VALUES: dict[str, list[object]] = {
    "limits.linear_speed": [0.0, 0.8, 4, 5.1, 10.0, 11.0, -1.0, math.nan, math.inf, "0.8", True],
    "limits.linear_deceleration": [0.1, 0.2, 3.0, 4.0, 100.0],
    "limits.linear_stop_deceleration": [0.4, 0.5, 1.0, 2.0],
    "limits.angular_jerk": [0.0, 0.001, 0.01, 10.0],
    "limits.wheel_speed": [0.1, 72.0, 73.0, 99.0, 100.0],
    "commands.sources.nav.timeout": [0.01, 0.02, 0.03, 10.0],
    "odometry.yaw_variance_per_radian": [0.0, 10.0, 11.0, "1"],
    "rates.telemetry": [0.0, 0.01, 0.1, 1000.0, 1001.0],
    "log.level": ["error", "loud", ""],
}


@pytest.mark.slow
@each(("key", "value"), [(key, value) for key, values in VALUES.items() for value in values])
@each("beside", [{}, {"limits.angular_speed": 20.0, "limits.linear_speed": 4.5}])
def test_a_change_is_judged_as_the_file(key: str, value: object, beside: dict[str, object]) -> None:
    wishes = beside | {key: value}
    judged = by_file(wishes)
    if isinstance(judged, Config):
        assert changed(CONFIG, wishes, True)[0] == judged
    else:
        assert problems(wishes) == judged


@each(
    ("key", "value", "words"),
    [
        ("limits.linear_sped", 1.0, "did you mean limits.linear_speed?"),
        ("nonsense", 1.0, "`acsard set` lists"),
        ("limits", {"linear_speed": 1.0}, "unknown key"),
        ("commands.sources.ghost.timeout", 0.5, "did you mean commands.sources."),
        ("x" * 4000, 1.0, "unknown key"),
        ("use_sim_time", True, "always uses the clock of its host"),
        ("use_sim_time", False, "leave use_sim_time false in the nodes"),
        ("mcu.port", "/dev/x", "only when the daemon starts: change it in acsard.toml"),
        ("mcu.wheels.left", "+l", "only when the daemon starts: change it in acsard.toml"),
        ("mcu.wheels.lefd", "+l", "did you mean mcu.wheels.left?"),
    ],
)
def test_a_setting_that_cannot_be_set_has_a_remedy(key: str, value: object, words: str) -> None:
    (line,) = problems({key: value})
    assert words in line
    assert len(line) < 300


# while it drives

SOFTER = [key for key, row in LIVE.items() if row.when == "raised"]


@each("key", SOFTER)
def test_braking_can_be_made_harder_while_driving_but_softer_only_at_rest(key: str) -> None:
    config = replace(CONFIG, limits=LimitsConfig(linear_speed=0.2, angular_speed=0.2))
    now = dict(flat(effective(config)))[key]
    assert isinstance(now, float)
    harder, softer = {key: now * 1.1}, {key: now * 0.9}
    assert changed(config, harder, False)[1]
    assert changed(config, softer, True)[1]
    (line,) = problems(softer, False, config)
    assert line == (
        f"{key} = {show(now * 0.9)} is lower than the present {show(now)}; this setting may be "
        "lowered only while the robot stands; stop the robot first"
    )


@each(
    ("key", "value"),
    [("limits.wheel_speed", 39.0), ("limits.wheel_speed", 41.0),
     ("commands.sources.nav.timeout", 0.5)],
)  # fmt: skip
def test_what_would_jump_or_reset_the_arbiter_waits_for_rest(key: str, value: float) -> None:
    (line,) = problems({key: value}, at_rest=False)
    assert "only while the robot stands" in line
    assert changed(CONFIG, {key: value}, at_rest=True)[1]


@each("key", [key for key, row in LIVE.items() if row.when == "always"])
def test_all_other_live_settings_may_be_changed_while_driving(key: str) -> None:
    now = KEYS[key]
    other: object = {"info": "debug"}.get(str(now))
    if isinstance(now, tuple | list):
        other = [1.0] * 6
    elif isinstance(now, float):
        other = now / 2 or 0.5
    assert changed(CONFIG, {key: other}, at_rest=False)[1]
