"""`acsard.toml` bytes -> one frozen `Config`, or an error that names every key and its mend.

What lives here: decoding, and the rules between keys. The keys themselves are in `settings.py`.
What must not: reading files (the command line does), or anything that uses the values.
"""

from __future__ import annotations

import ipaddress
import tomllib
from collections import Counter

from msgspec import convert, to_builtins

from acsard.mcu.wire import COMFORTABLE_USE, highest_rate, line_bytes, wire_ns, wire_use
from acsard.settings import BusConfig, Config
from acsard.validation import build, show
from acsard.values import AcsardError


class ConfigError(AcsardError):
    """The configuration cannot be used; `problems` has one line per mistake."""

    def __init__(self, problems: list[str]) -> None:
        super().__init__("\n".join(problems))
        self.problems = problems


def parse(text: bytes, overrides: dict[str, dict[str, object]] | None = None) -> Config:
    """Decode a configuration file; raises `ConfigError` with every problem found.

    `overrides` are values from the command line, by table and key; they win over the file.
    """
    try:
        table = tomllib.loads(text.decode("utf-8"))
    except UnicodeDecodeError as error:
        raise ConfigError([f"not UTF-8 text: {error}; save the file as UTF-8"]) from None
    except tomllib.TOMLDecodeError as error:
        raise ConfigError([f"not TOML: {error}; texts need quotes, true/false none"]) from None
    for section, values in (overrides or {}).items():
        inner = table.setdefault(section, {})
        if isinstance(inner, dict):
            inner.update(values)
    problems: list[str] = []
    config = build(Config, table, "", problems)
    if config is not None:
        problems += _contradictions(config)
    if config is None or problems:
        raise ConfigError(problems)
    return config


def from_builtins(data: object) -> Config:
    """The `Config` that `effective` described."""
    return convert(data, Config)


def effective(config: Config) -> dict[str, object]:
    """The configuration in force as plain tables, defaults filled in."""
    plain = to_builtins(config)
    assert isinstance(plain, dict)
    return plain


def warnings(config: Config) -> list[str]:
    """What is allowed but will surprise; a sentence each."""
    found = []
    count = line_bytes(config.mcu.trailing_comma)
    use = wire_use(config.rate_hz, config.mcu.baud_rate, count)
    if use > COMFORTABLE_USE:
        comfortable = highest_rate(config.mcu.baud_rate, count, COMFORTABLE_USE)
        found.append(
            f"control.rate = {config.rate_hz:g} takes {use:.0%} of the wire at "
            f"{config.mcu.baud_rate} baud: lines will be superseded; "
            f"{comfortable} Hz is comfortable"
        )
    drive, limits = config.drive, config.limits
    needed = limits.linear_speed / drive.wheel_radius
    if needed > limits.wheel_speed:
        found.append(
            f"limits.linear_speed = {limits.linear_speed:g} m/s needs {needed:.1f} rad/s but "
            f"limits.wheel_speed = {limits.wheel_speed:g}: the robot will not reach it"
        )
    if config.bus.insecure:
        found.append("bus.insecure = true: everyone who reaches the bus can drive this robot")
    return found


def _contradictions(config: Config) -> list[str]:
    """Rules between keys, each as a line with key, value and mend."""
    return [
        *_wire_problems(config),
        *_name_problems(config),
        *_limit_problems(config),
        *_bus_problems(config.bus),
    ]


def _wire_problems(config: Config) -> list[str]:
    mcu, rate = config.mcu, config.rate_hz
    count = line_bytes(mcu.trailing_comma)
    if wire_use(rate, mcu.baud_rate, count) <= 1.0:
        return []
    ms = wire_ns(count, mcu.baud_rate) / 1e6
    most, good = (highest_rate(mcu.baud_rate, count, use) for use in (1.0, COMFORTABLE_USE))
    bauds = [b for b in (19200, 38400, 57600, 115200) if wire_use(rate, b, count) <= 1.0]
    faster = f"mcu.baud_rate = {bauds[0]} or more, or " if bauds else ""
    return [
        f"control.rate = {rate:g}: {count} B at {mcu.baud_rate} baud = {ms:.1f} ms per line, "
        f'at most {most} Hz, {good} Hz at 80 %; write {faster}control.rate = {good} or "auto"'
    ]


def _name_problems(config: Config) -> list[str]:
    wheels = config.mcu.wheels
    motors = (wheels.front_right, wheels.front_left, wheels.rear_left, wheels.rear_right)
    frames = [config.odometry.odom_frame, config.odometry.base_frame]
    if config.lidar.publish_tf:
        frames.append(config.lidar.lidar_frame)
    if config.footprint.publish_tf:
        frames.append(config.footprint.footprint_frame)
    groups = (
        ("mcu.wheels", "motor letter", [motor[1] for motor in motors]),
        ("joints", "joint name", list(config.joints.as_tuple())),
        ("commands.sources", "source name", [s.name for s in config.commands.sources]),
        ("odometry, lidar, footprint", "frame", frames),
    )
    return [
        f"{where} = {show(name)}: the same {noun} {count} times; give each its own"
        for where, noun, names in groups
        for name, count in Counter(names).items()
        if count > 1
    ]


def _limit_problems(config: Config) -> list[str]:
    limits, period = config.limits, 1.0 / config.rate_hz
    found = []
    for axis in ("linear", "angular"):
        stop, normal = (
            getattr(limits, f"{axis}_{kind}") for kind in ("stop_deceleration", "deceleration")
        )
        if stop < normal:
            found.append(
                f"limits.{axis}_stop_deceleration = {stop:g}: lower than {axis}_deceleration; a "
                f"stop must not brake more softly than a timeout: write {normal:g} or more"
            )
    for i, source in enumerate(config.commands.sources):
        if source.timeout < 2 * period:
            found.append(
                f"commands.sources[{i}].timeout = {source.timeout:g}: shorter than two control "
                f"periods, the robot would stutter; write {2 * period:g} or more"
            )
    return found


def _bus_problems(bus: BusConfig) -> list[str]:
    found = []
    for key, endpoints in (("listen", bus.listen), ("connect", bus.connect)):
        for endpoint in endpoints:
            where = f"bus.{key} = {show(endpoint)}"
            host = _host(endpoint)
            if host is None:
                found.append(
                    f"{where}: not an endpoint; "
                    'write it like "tcp/127.0.0.1:7448" or "tcp/[::1]:7448"'
                )
            elif not _is_loopback(host) and not bus.insecure:
                found.append(
                    f"{where}: leaves this machine, and there is no encryption or access control "
                    "on it; use 127.0.0.1 (a laptop joins by an SSH tunnel), or accept that anyone "
                    "there can drive the robot: bus.insecure = true"
                )
    return found


def _host(endpoint: str) -> str | None:
    scheme, _, address = endpoint.partition("/")
    host, _, port = address.rpartition(":")
    good = scheme == "tcp" and host and port.isascii() and port.isdigit() and int(port) < 65536
    return host.strip("[]") if good else None


def _is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        return ipaddress.ip_address(host).is_loopback
    except ValueError:
        return False
