"""Lists the settings that may change while the daemon runs, and checks such a change.

A change must satisfy the same rules as the file, and is applied completely or not at all. A setting
that is not in the table `LIVE` takes effect only at the next start of the daemon.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal

from msgspec import Struct
from msgspec.structs import replace

from acsard.core.config.contradictions import contradictions
from acsard.core.config.nearest import hint
from acsard.core.config.parsing import ConfigError, effective
from acsard.core.config.removed import why_removed
from acsard.core.config.settings import Config
from acsard.core.config.validation import build, show
from acsard.core.values import Plain

When = Literal["always", "raised", "rest"]

WHEN_TEXTS: dict[When, str] = {
    "always": "at any time",
    "raised": "may be raised at any time, but lowered only while the robot stands",
    "rest": "only while the robot stands",
}
"""Texts for users that say when a setting may change, by the value of `Live.when`.

- "always": The change is safe at any time.
- "raised": The setting is a deceleration. A lower deceleration makes the stopping distance longer,
  so it must not be lowered while the robot drives.
- "rest": The change would disturb a moving robot. A lower `limits.wheel_speed` reduces the speed
  without a ramp. After a change in `commands`, no sender drives the robot until it has sent a
  zero.
"""


class Live(Struct, frozen=True):
    """A setting that may change while the daemon runs.

    `when` says at which moments it may change, and `WHEN_TEXTS` explains the values of `when`.
    `what` describes the setting for users.
    """

    when: When
    what: str


LIVE: dict[str, Live] = {
    "limits.linear_speed": Live("always", "highest speed, forwards and backwards"),
    "limits.angular_speed": Live("always", "highest turn rate"),
    "limits.linear_acceleration": Live("always", "acceleration"),
    "limits.angular_acceleration": Live("always", "acceleration of a turn"),
    "limits.linear_deceleration": Live(
        "raised", "deceleration toward a slower command, and after the commands end"
    ),
    "limits.angular_deceleration": Live(
        "raised", "deceleration of a turn toward a slower command, and after the commands end"
    ),
    "limits.linear_stop_deceleration": Live("raised", "deceleration after a stop or a fault"),
    "limits.angular_stop_deceleration": Live(
        "raised", "deceleration of a turn after a stop or a fault"
    ),
    "limits.linear_jerk": Live("always", "how fast the acceleration may grow"),
    "limits.angular_jerk": Live("always", "how fast the acceleration of a turn may grow"),
    "limits.wheel_speed": Live("rest", "highest speed of any wheel"),
    "commands.sources.*.timeout": Live(
        "rest", "time without a command after which the robot stops following the source"
    ),
    "odometry.distance_variance_per_metre": Live(
        "always", "added variance of the distance per metre driven, m2 per m"
    ),
    "odometry.yaw_variance_per_metre": Live(
        "always", "added variance of the heading per metre driven, rad2 per m"
    ),
    "odometry.yaw_variance_per_radian": Live(
        "always", "added variance of the heading per radian turned, rad2 per rad"
    ),
    "rates.odom": Live("always", "how often the messages odom and tf are published"),
    "rates.telemetry": Live("always", "how often the other messages are published at most"),
    "log.level": Live("always", "lowest level of the events that are logged"),
}
"""The settings that may change while the daemon runs, by their dotted keys in `acsard.toml`. In the
key of a command source, "*" stands for the name of the source, as in `commands.sources.*.timeout`.
"""


def find_live_setting(key: str) -> Live | None:
    """Return the entry of a setting in `LIVE`, the table of settings that may change at run time.

    `key` is the dotted key of the setting. The result is None if the setting takes effect only at
    the next start of the daemon.
    """
    parts = key.split(".")
    if parts[:2] == ["commands", "sources"] and len(parts) == 4:
        parts[2] = "*"
    return LIVE.get(".".join(parts))


def flat(value: object, name: str = "") -> Iterator[tuple[str, object]]:
    """Yield the dotted key and the value of each setting in nested tables.

    `name` is the dotted key of `value`, or "" for the whole configuration. A table in a list, such
    as a command source, appears in a dotted key with its own `name` instead of its index. For
    example, the key of the timeout of the source "app" is `commands.sources.app.timeout`.
    """
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from flat(inner, f"{name}.{key}" if name else str(key))
    elif isinstance(value, list | tuple) and value and isinstance(value[0], Mapping):
        for table in value:
            rest = {key: inner for key, inner in table.items() if key != "name"}
            yield from flat(rest, f"{name}.{table['name']}")
    else:
        yield name, value


class Difference(Struct, frozen=True):
    """The two values of a setting that differs between the daemon and the configuration file."""

    its: object
    """Value in force in the daemon; None if the setting does not exist there."""
    ours: object
    """Value in the configuration file; None if the setting does not exist there."""

    def describe(self, key: str) -> str:
        """Return a text with both values, such as `log.level = "info", not "debug"`.

        The value in force comes first. `key` is the dotted key of the setting.
        """
        # A command source may be in only one of the two configurations. Its keys have no value in
        # the other one.
        its, ours = ("absent" if value is None else show(value) for value in (self.its, self.ours))
        return f"{key} = {its}, not {ours}"


def differences(runs: Config, file: Config) -> dict[str, Difference]:
    """Return the settings whose values differ between two configurations, by dotted key.

    `runs` is the configuration in force. `file` is the configuration in the file.
    """
    its, ours = dict(flat(effective(runs))), dict(flat(effective(file)))
    return {
        key: Difference(its.get(key), ours.get(key))
        for key in its | ours
        if its.get(key) != ours.get(key)
    }


Changes = dict[str, tuple[Plain, Plain]]
"""Old and new value of each changed setting, by dotted key."""


def describe_changes(changes: Changes) -> str:
    """Return a text that lists the changes, such as "log.level = debug (was info)"."""
    return ", ".join(
        f"{key} = {show(new)} (was {show(old)})" for key, (old, new) in changes.items()
    )


def changed(config: Config, wishes: Mapping[str, object], at_rest: bool) -> tuple[Config, Changes]:
    """Return a pair: `config` with new values of settings, and the changes.

    The change is applied completely or not at all. A value that is already in force is ignored. It
    causes no error, even if its setting cannot be changed.

    Args:
        config: the configuration in force.
        wishes: the requested values, by dotted key.
        at_rest: True if the robot stands still. Some settings may change only then.

    Raises:
        ConfigError: the change is not allowed. The error says why.
    """
    tables: dict[str, Any] = effective(config)
    before = dict(flat(tables))
    new = {key: value for key, value in wishes.items() if not _same(before.get(key), value)}
    fixed = [key for key in new if find_live_setting(key) is None or key not in before]
    if fixed:
        more = [f"and {len(fixed) - 1} more of these keys cannot be set"] if len(fixed) > 1 else []
        raise ConfigError([_refusal(fixed[0], new[fixed[0]], before), *more])
    problems: list[str] = []
    # `build` accepts the tables of the sources only as a list, as a TOML file has them.
    tables["commands"]["sources"] = list(tables["commands"]["sources"])
    for key, value in new.items():
        _set_value(tables, key.split("."), value)
    sections = {key.partition(".")[0] for key in new}
    built = {
        name: build(type(getattr(config, name)), tables[name], name, problems) for name in sections
    }
    if problems:
        raise ConfigError(problems)
    made = replace(config, **built)
    after = dict(flat(effective(made)))
    problems = contradictions(made)
    if not at_rest:
        problems += [line for key in new if (line := _must_stand(key, before[key], after[key]))]
    if problems:
        raise ConfigError(problems)
    return made, {key: (_plain(before[key]), _plain(after[key])) for key in new}


def _plain(value: Any) -> Plain:
    plain: Plain = list(value) if isinstance(value, tuple) else value
    return plain


def _same(before: object, value: object) -> bool:
    if isinstance(before, list | tuple) and isinstance(value, list | tuple):
        return list(before) == list(value)
    return before == value and isinstance(before, bool) == isinstance(value, bool)


def _refusal(key: str, value: object, known: Mapping[str, object]) -> str:
    if key in known:
        return (
            f"{key} = {show(value)}: this key is read only when the daemon starts: change it in "
            "acsard.toml and restart acsard (`acsard set` lists the keys that can change "
            "without a restart)"
        )
    if advice := why_removed(key):
        return f"{key} = {show(value)}: {advice}"
    if key == "use_sim_time":  # each node of rclcpp and rclpy has this parameter
        return (
            "use_sim_time: the daemon does not support this ROS parameter, because it always uses "
            "the clock of its host; leave use_sim_time false in the nodes that use this robot"
        )
    return f"{show(key)}: unknown key; {hint(key, known, '`acsard set` lists the settings')}"


def _set_value(tables: dict[str, Any], path: list[str], value: object) -> None:
    inner: Any = tables
    for part in path[:-1]:
        if isinstance(inner, list):
            inner = next(table for table in inner if table["name"] == part)
        else:
            inner = inner[part]
    inner[path[-1]] = list(value) if isinstance(value, tuple) else value


def _must_stand(key: str, before: object, after: object) -> str:
    row = find_live_setting(key)
    if row is None or row.when == "always":
        return ""
    if row.when == "raised":
        if not (isinstance(before, float) and isinstance(after, float) and after < before):
            return ""
        words = (
            f" is lower than the present {show(before)}; this setting may be lowered only while "
            "the robot stands"
        )
    else:
        words = ": may be changed only while the robot stands"
    return f"{key} = {show(after)}{words}; stop the robot first"
