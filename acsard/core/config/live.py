"""Lists the settings that may change while the daemon runs, and checks such a change.

It must satisfy the rules of the file, and is applied completely or not at all. A setting that is
not in `LIVE` takes effect at the next start.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from typing import Any, Literal, TypeVar

from msgspec import Struct
from msgspec.structs import replace

from acsard.core.config.contradictions import live_contradictions
from acsard.core.config.nearest import hint
from acsard.core.config.parsing import ConfigError, effective
from acsard.core.config.settings import Config
from acsard.core.config.validation import build_value, keys_of, show
from acsard.core.values import Plain

When = Literal["always", "raised", "rest"]

# raised: a lower deceleration makes the stopping distance longer. rest: the change would disturb a
# moving robot, as `limits.wheel_speed` has no ramp, and `commands` makes senders send a zero.
WHEN_TEXTS: dict[When, str] = {
    "always": "at any time",
    "raised": "may be raised at any time, but lowered only while the robot stands",
    "rest": "only while the robot stands",
}


class Live(Struct, frozen=True):
    """A setting that may change while the daemon runs, at the moments `when`."""

    when: When
    what: str


# Settings by dotted key, in the order of the file; "*" is the name of a command source.
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


def find_live_setting(key: str) -> Live | None:
    """Return the entry of a dotted key in `LIVE`, or None."""
    return LIVE.get(_row(key))


def place(key: str) -> int:
    """Return a number by which live settings have the order of the file."""
    return list(LIVE).index(_row(key))


def _row(key: str) -> str:
    # The key in `LIVE`, if it is a live setting.
    parts = key.split(".")
    if parts[:2] == ["commands", "sources"] and len(parts) == 4:
        parts[2] = "*"
    return ".".join(parts)


def flat(value: object, name: str = "") -> Iterator[tuple[str, object]]:
    """Yield the dotted key and the value of each setting; a table in a list has its name.

    So the timeout of the source "app" is `commands.sources.app.timeout`.
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
    """The two values of a setting that differs between the daemon and its file."""

    its: object  # in force, or None
    ours: object  # in the file, or None

    def describe(self, key: str) -> str:
        """Return a text such as `log.level = "info", not "debug"`, the value in force first."""
        # A command source may be in only one of the two configurations. Its keys have no value in
        # the other one.
        its, ours = ("absent" if value is None else show(value) for value in (self.its, self.ours))
        return f"{key} = {its}, not {ours}"


def differences(runs: Config, file: Config) -> dict[str, Difference]:
    """Return the settings that differ between the configuration in force and the file."""
    its, ours = dict(flat(effective(runs))), dict(flat(effective(file)))
    return {
        key: Difference(its.get(key), ours.get(key))
        for key in its | ours
        if its.get(key) != ours.get(key)
    }


Changes = dict[str, tuple[Plain, Plain]]  # old and new value by dotted key


def describe_changes(changes: Changes) -> str:
    """Return a text such as "log.level = debug (was info)"."""
    return ", ".join(
        f"{key} = {show(new)} (was {show(old)})" for key, (old, new) in changes.items()
    )


def changed(config: Config, wishes: Mapping[str, object], at_rest: bool) -> tuple[Config, Changes]:
    """Return `config` with new values, and the changes; all or nothing. Raises `ConfigError`.

    A value that is in force is ignored, even if its setting cannot change. A step of the control
    loop calls this, so only a refusal looks at all settings.
    """
    tables = effective(config)
    before = {key: _in_force(tables, key) for key in wishes}
    new = {key: value for key, value in wishes.items() if not _same(before[key], value)}
    fixed = [key for key in new if find_live_setting(key) is None or before[key] is None]
    if fixed:
        more = [f"and {len(fixed) - 1} more of these keys cannot be set"] if len(fixed) > 1 else []
        raise ConfigError([_refusal(fixed[0], new[fixed[0]], tables), *more])
    problems: list[str] = []
    made = config
    for key, value in new.items():
        made = _with(made, key, value, problems)
    if problems:
        raise ConfigError(problems)
    after = effective(made)
    changes = {key: (_plain(before[key]), _plain(_in_force(after, key))) for key in new}
    problems = live_contradictions(made)
    if not at_rest:
        problems += [line for key in changes if (line := _must_stand(key, *changes[key]))]
    if problems:
        raise ConfigError(problems)
    return made, changes


def _in_force(tables: object, key: str) -> object:
    # The value of a dotted key, or None: no setting has it.
    inner = tables
    for part in key.split("."):
        if isinstance(inner, list | tuple):
            inner = {table["name"]: {**table, "name": None} for table in inner}
        inner = inner.get(part) if isinstance(inner, Mapping) else None
    is_table = isinstance(inner, Mapping) or (
        isinstance(inner, list | tuple) and any(isinstance(one, Mapping) for one in inner)
    )
    return None if is_table else inner


def _with(config: Config, key: str, raw: object, problems: list[str]) -> Config:
    # The value of a live setting, converted and checked like that of a file.
    section, *middle, name = key.split(".")
    table = getattr(config, section)
    if not middle:
        made = _with_value(table, name, raw, key, problems)
    else:
        sources = list(config.commands.sources)
        at = [source.name for source in sources].index(middle[-1])
        where = f"commands.sources[{at}].{name}"
        sources[at] = _with_value(sources[at], name, raw, where, problems)
        made = replace(table, sources=tuple(sources))
    return replace(config, **{section: made})


S = TypeVar("S", bound=Struct)


def _with_value(table: S, name: str, raw: object, where: str, problems: list[str]) -> S:
    key = keys_of(type(table))[name]
    value = build_value(key, raw, where, problems, set())
    return table if value is None else replace(table, **{key.field.name: value})


def _plain(value: Any) -> Plain:
    plain: Plain = list(value) if isinstance(value, tuple) else value
    return plain


def _same(before: object, value: object) -> bool:
    if isinstance(before, list | tuple) and isinstance(value, list | tuple):
        return list(before) == list(value)
    return before == value and isinstance(before, bool) == isinstance(value, bool)


def _refusal(key: str, value: object, tables: Mapping[str, object]) -> str:
    if _in_force(tables, key) is not None:
        return (
            f"{key} = {show(value)}: this key is read only when the daemon starts: change it in "
            "acsard.toml and restart acsard (`acsard set` lists the keys that can change "
            "without a restart)"
        )
    if key == "use_sim_time":  # each node of rclcpp and rclpy has this parameter
        return (
            "use_sim_time: the daemon does not support this ROS parameter, because it always uses "
            "the clock of its host; leave use_sim_time false in the nodes that use this robot"
        )
    known = dict(flat(tables))
    return f"{show(key)}: unknown key; {hint(key, known, '`acsard set` lists the settings')}"


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
