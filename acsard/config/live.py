"""The settings that can be changed while the daemon runs, and a configuration with some changed.

What lives here: **the** table of them, when each may change, and the check of a change: the same
rules as for the file, whole or not at all. What must not: what a change means for a part of the
robot (its own `use`). All others shape the wire, the bus or the base, and take a start.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal

from msgspec import Struct
from msgspec.structs import fields, replace

from acsard.config.contradictions import contradictions
from acsard.config.nearest import hint
from acsard.config.parsing import ConfigError, effective
from acsard.config.settings import Config
from acsard.config.validation import build, show

When = Literal["always", "raised", "rest"]

WHEN: dict[When, str] = {
    "always": "at any time",
    "raised": "lowered only while the robot stands",
    "rest": "only while the robot stands",
}
"""A lower deceleration could not stop in time a robot that still drives faster than its new limits
allow; the wheels' limit cuts a speed off at once; new timeouts forget who commands."""


class Live(Struct, frozen=True):
    """When a setting may change, and what it is."""

    when: When
    what: str


LIVE: dict[str, Live] = {
    "limits.linear_speed": Live("always", "highest speed, forwards and backwards"),
    "limits.angular_speed": Live("always", "highest turn rate"),
    "limits.linear_acceleration": Live("always", "speeding up"),
    "limits.angular_acceleration": Live("always", "speeding up a turn"),
    "limits.linear_deceleration": Live("raised", "slowing down, also when commands end"),
    "limits.angular_deceleration": Live("raised", "slowing down a turn, also when commands end"),
    "limits.linear_stop_deceleration": Live("raised", "braking by a stop or a fault"),
    "limits.angular_stop_deceleration": Live("raised", "braking a turn by a stop or a fault"),
    "limits.linear_jerk": Live("always", "how fast speeding up may begin"),
    "limits.angular_jerk": Live("always", "how fast speeding up a turn may begin"),
    "limits.wheel_speed": Live("rest", "highest speed of any wheel"),
    "commands.pause": Live("rest", "time that no speed may follow a zero of a shared identity"),
    "commands.sources.*.timeout": Live("rest", "silence after which a source is gone"),
    "odometry.covariance": Live("always", "by the model, or the diagonals as they stand"),
    "odometry.pose_covariance_diagonal": Live(
        "always", "x y z roll pitch yaw: where the robot is set, and of what no wheel measures"
    ),
    "odometry.twist_covariance_diagonal": Live(
        "always", "x y z roll pitch yaw: of what no wheel measures"
    ),
    "odometry.distance_variance_per_metre": Live("always", "error of the distance, m2 per m"),
    "odometry.yaw_variance_per_metre": Live("always", "error of the heading, rad2 per m"),
    "odometry.yaw_variance_per_radian": Live("always", "error of the heading, rad2 per rad"),
    "rates.odom": Live("always", "how often odom and tf are published"),
    "rates.wheel_states": Live("always", "how often wheel_states are published"),
    "rates.cmd_vel_out": Live("always", "how often cmd_vel_out is published"),
    "rates.state": Live("always", "how often state is published"),
    "rates.diagnostics": Live("always", "how often diagnostics are published"),
    "log.level": Live("always", "the least that the log tells"),
}
"""By key as in `acsard.toml`, tables and key joined by dots; a source counts by its name."""

SECTIONS: dict[str, type[Struct]] = {field.name: field.type for field in fields(Config)}


def live(key: str) -> Live | None:
    """The row of a key; None for one that takes a start."""
    parts = key.split(".")
    if parts[:2] == ["commands", "sources"] and len(parts) == 4:
        parts[2] = "*"
    return LIVE.get(".".join(parts))


def flat(value: object, name: str = "") -> Iterator[tuple[str, object]]:
    """Every leaf with its dotted name; a list of named tables counts as tables by those names."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from flat(inner, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list | tuple) and value and isinstance(value[0], Mapping):
        for table in value:
            rest = {key: inner for key, inner in table.items() if key != "name"}
            yield from flat(rest, f"{name}.{table['name']}")
    else:
        yield name, value


def changed(config: Config, wishes: Mapping[str, object], at_rest: bool) -> tuple[Config, str]:
    """The configuration with these settings, and what is new in words; "" for nothing.

    Raises `ConfigError` with every problem; nothing is changed then. A setting that has its value
    already is no change, whichever it is.
    """
    tables: dict[str, Any] = effective(config)
    before = dict(flat(tables))
    news = {key: value for key, value in wishes.items() if not _same(before.get(key), value)}
    fixed = [key for key in news if live(key) is None or key not in before]
    if fixed:
        more = [f"and {len(fixed) - 1} more that cannot be set"] if len(fixed) > 1 else []
        raise ConfigError([_refusal(fixed[0], news[fixed[0]], before), *more])
    problems: list[str] = []
    # As the rules between tables have it: a list of tables, not of structs.
    tables["commands"]["sources"] = list(tables["commands"]["sources"])
    for key, value in news.items():
        _put(tables, key.split("."), value)
    sections = {key.partition(".")[0] for key in news}
    built = {name: build(SECTIONS[name], tables[name], name, problems) for name in sections}
    if problems:
        raise ConfigError(problems)
    made = replace(config, **built)
    after = dict(flat(effective(made)))
    problems = contradictions(made)
    if not at_rest:
        problems += [line for key in news if (line := _must_stand(key, before[key], after[key]))]
    if problems:
        raise ConfigError(problems)
    told = [f"{key} = {show(after[key])} (was {show(before[key])})" for key in news]
    return made, ", ".join(told)


def _same(before: object, value: object) -> bool:
    if isinstance(before, list | tuple) and isinstance(value, list | tuple):
        return list(before) == list(value)
    return before == value and isinstance(before, bool) == isinstance(value, bool)


def _refusal(key: str, value: object, known: Mapping[str, object]) -> str:
    if key in known:
        return (
            f"{key} = {show(value)}: takes a start: change it in acsard.toml and start acsard anew "
            "(`acsard set` lists what does not)"
        )
    return f"{show(key)}: unknown key; {hint(key, known, '`acsard set` lists what can be set')}"


def _put(tables: dict[str, Any], path: list[str], value: object) -> None:
    inner: Any = tables
    for part in path[:-1]:
        if isinstance(inner, list):
            inner = next(table for table in inner if table["name"] == part)
        else:
            inner = inner[part]
    inner[path[-1]] = list(value) if isinstance(value, tuple) else value


def _must_stand(key: str, before: object, after: object) -> str:
    """Why this change waits until the robot stands; "" when it need not."""
    row = live(key)
    if row is None or row.when == "always":
        return ""
    if row.when == "raised":
        if not (isinstance(before, float) and isinstance(after, float) and after < before):
            return ""
        words = f"lower than {show(before)}, which may be set only while the robot stands"
    else:
        words = "may be set only while the robot stands"
    return f"{key} = {show(after)}: {words}; stop it first"
