"""Keeps the limits that `acsard set` has lowered, so that a restart does not raise them again.

A limit is lowered if its value is below the value in the configuration file. Lowered decelerations
are not kept, because a robot with a lower deceleration brakes more softly, which is not safer. A
jerk limit of 0 means "no limit", so it is treated as the highest value.
"""

from __future__ import annotations

import math
from collections.abc import Mapping

from acsard.core.config.live import changed
from acsard.core.config.parsing import ConfigError
from acsard.core.config.settings import Config, LimitsConfig
from acsard.core.values import Event

LIMITS_PREFIX = "limits."


def survives_restart(key: str) -> bool:
    """Return whether a lowered value of the setting `key` is kept over a restart of the daemon.

    `key` is the dotted key of the setting.
    """
    return key.startswith(LIMITS_PREFIX) and not key.endswith("_deceleration")


def lowered(file: LimitsConfig, now: LimitsConfig) -> dict[str, float]:
    """Return the limits that are lower in `now` than in `file`, without the decelerations.

    `now` contains the limits in force, and `file` the limits in the configuration file. The result
    maps dotted keys to the values in `now`.
    """
    return {
        LIMITS_PREFIX + name: getattr(now, name)
        for name in file.__struct_fields__
        if survives_restart(LIMITS_PREFIX + name)
        and _rank(name, getattr(now, name)) < _rank(name, getattr(file, name))
    }


def with_lowered(config: Config, saved_limits: Mapping[str, float]) -> tuple[Config, list[Event]]:
    """Return a pair: `config` with the lowered limits, and events that report the changes.

    A lowered limit is applied only if it is below the value in `config`. The configuration file may
    have changed since the limits were lowered. So the lowered limits may contradict other settings
    of the file. In this case, the limits are applied one after another. A limit that causes a
    contradiction is dropped, and an event reports this.

    Args:
        config: the content of the configuration file.
        saved_limits: the limits that were lowered before the restart, by dotted key.
    """
    limits = config.limits
    wishes: dict[str, object] = {
        key: value
        for key, value in saved_limits.items()
        if survives_restart(key)
        and (name := key.removeprefix(LIMITS_PREFIX)) in limits.__struct_fields__
        and _rank(name, value) < _rank(name, getattr(limits, name))
    }
    try:
        return _applied(config, wishes)
    except ConfigError:
        events: list[Event] = []
        for key, value in wishes.items():
            try:
                config, more = _applied(config, {key: value})
                events += more
            except ConfigError as error:
                text = (
                    f"{key} was lowered to {value} before the restart. The value of the "
                    f"configuration file applies now, because the lowered one is refused: {error}"
                )
                events.append(Event("set", text, "warning"))
        return config, events


def _applied(config: Config, wishes: Mapping[str, object]) -> tuple[Config, list[Event]]:
    if not wishes:
        return config, []
    made, news = changed(config, wishes, at_rest=True)
    why = "it was lowered before the restart and stays lowered"
    if len(wishes) > 1:
        why = "they were lowered before the restart and stay lowered"
    return made, [Event("set", f"{news}: {why}", "warning")]


def _rank(name: str, value: float) -> float:
    # A jerk limit of 0 means "no limit".
    return math.inf if name.endswith("_jerk") and value == 0.0 else value
