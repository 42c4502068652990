"""Checks combinations of settings in a configuration.

`contradictions` are errors, `warnings` an effect that a user may not expect. `motion_rules.py` has
the rules about motion, `simulated_faults.py` those about simulated faults.
"""

from __future__ import annotations

import ipaddress
import math
from collections.abc import Callable
from itertools import pairwise
from typing import get_args

from acsard.core.config import motion_rules, simulated_faults
from acsard.core.config.partial import Rule, mistakes
from acsard.core.config.settings import (
    HYSTERESIS,
    SIMULATOR,
    Baud,
    Config,
    McuConfig,
    WheelMap,
    is_tls,
)
from acsard.core.config.validation import show
from acsard.core.config.wire_time import (
    COMFORTABLE_USE,
    FIELD_VALUES,
    STATUS_BYTES,
    STATUS_HZ,
    highest_rate,
    line_bytes,
    wire_ns,
    wire_use,
)
from acsard.core.values import ROOT_KEY, TWO_WHEELS, WHEELS

# Control periods in which a wheel may change its count by half of its range: more looks like the
# other direction. 2 allows for a lost line.
MIN_WRAP_PERIODS = 2

# A board counts for at least 4 ms and takes up to 5 ms until it answers. If it is asked sooner, it
# repeats speeds that look new: a simulated robot with 16 to 96 counts was 20 % too short at 200 Hz,
# 29 % too long at 300 Hz, and looked twice as fast for seconds.
MOST_ASKED_HZ = 111

MIN_RATE_HZ = 0.1  # publishing, if not 0

STDS = ("wheel_separation_multiplier_std", "wheel_radius_ratio_std", "distance_scale_std")

LARGEST_M = {"wheel_radius": 0.5, "wheel_separation": 3.0}  # more was measured in cm

MAX_VOLTS = 99.99  # in a status line


def warnings(config: Config) -> list[str]:
    """Return one warning for each setting that is allowed but has a surprising effect."""
    messages = []
    count = config.mcu.line_bytes
    use = wire_use(config.rate_hz, config.mcu.baud_rate, count)
    if use > COMFORTABLE_USE:
        comfortable = highest_rate(config.mcu.baud_rate, count, COMFORTABLE_USE)
        messages.append(
            f"control.rate = {config.rate_hz:g} takes {use:.0%} of the wire at "
            f"{config.mcu.baud_rate} baud, so the daemon will replace some lines by newer ones "
            f"before they are sent; write {comfortable} or less"
        )
    messages += _count_warnings(config)
    messages += _port_warnings(config.mcu)
    if not config.commands.sources:
        messages.append(
            "commands.sources = []: no program can drive this robot; add a [[commands.sources]] "
            "table, or leave the key out to get the default sources"
        )
    drive, limits = config.drive, config.limits
    for key, most in LARGEST_M.items():
        if (metres := getattr(drive, key)) > most:
            messages.append(
                f"drive.{key} = {metres:g}: the unit is metres; if you measured {metres:g} cm, "
                f"write {metres / 100:g}"
            )
    if exact := [f"odometry.{key} = 0" for key in STDS if getattr(config.odometry, key) == 0]:
        messages.append(
            f"{', '.join(exact)}: nobody measures without an error, so the pose is less certain "
            "than it says; delete the line, or let `acsard calibrate` write what it measures"
        )
    needed = limits.linear_speed / drive.wheel_radius
    if needed > limits.wheel_speed:
        messages.append(
            f"limits.linear_speed = {limits.linear_speed:g} m/s needs wheels at {needed:.1f} "
            f"rad/s, but limits.wheel_speed = {limits.wheel_speed:g}, so the robot will stay "
            "slower; raise limits.wheel_speed or lower limits.linear_speed"
        )
    if config.safety.estop == "off":
        messages.append(
            'safety.estop = "off": the robot ignores an emergency stop that its board reports'
        )
    if config.safety.bumper == "off":
        messages.append('safety.bumper = "off": the robot ignores bumpers that its board reports')
    status_use = wire_use(STATUS_HZ, config.mcu.baud_rate, STATUS_BYTES)
    required = 'safety.estop = "required"' if config.safety.estop == "required" else ""
    if config.safety.needs_bumpers:
        required = required or f"safety.bumpers = {show(config.safety.bumpers)}"
    if required and use + status_use > 1.0:
        possible_hz = highest_rate(config.mcu.baud_rate, count, COMFORTABLE_USE - status_use)
        messages.append(
            f"{required} needs status lines, which take {status_use:.0%} of the wire at "
            f"{config.mcu.baud_rate} baud. The replies at control.rate = {config.rate_hz:g} do "
            f"not fit beside them; write control.rate = {possible_hz} or less"
        )
    if config.bus.insecure:
        messages.append(
            "bus.insecure = true: every program that reaches the bus can drive this robot"
        )
    if config.access.wildcards:
        messages.append(
            "access.wildcards = true: every client with a certificate can stall the bus"
        )
    hosts = [_host(endpoint) for endpoint in (*config.bus.listening, *config.bus.connect)]
    outside = not all(is_loopback(host) for host in hosts if host)
    if outside and config.robot.id == Config().robot.id:
        messages.append(
            f'robot.id = "{config.robot.id}" is the default id, but other machines reach the bus: '
            "a second robot with this id would use the same keys; give each robot its own id"
        )
    ros = config.ros
    if outside and (ros.bridge or ros.rmw) and not ros.namespace:
        messages.append(
            'ros.namespace = "" on a bus that other machines reach: a second robot on this bus '
            "would use the same ROS topics; give each robot its own namespace"
        )
    return messages + simulated_faults.warnings(config)


def _count_warnings(config: Config) -> list[str]:
    counts, simulated = config.mcu.encoder_counts, config.sim.encoder_counts
    if not counts or not config.mcu.simulated or counts == simulated:
        return []
    return [
        f"mcu.encoder_counts = {counts}, but the simulated robot's encoders have "
        f"sim.encoder_counts = {simulated}: distances may be wrong; write the same number for both "
        "keys"
    ]


def _port_warnings(mcu: McuConfig) -> list[str]:
    if mcu.simulated or "/" in mcu.port:
        return []
    remedy = (
        f'write mcu.port = "{SIMULATOR}" for the simulator'
        if mcu.port.lower() == SIMULATOR
        else f"write the whole path, such as mcu.port = {show(f'/dev/{mcu.port}')}"
    )
    return [f"mcu.port = {show(mcu.port)} is a file in the daemon's working directory; {remedy}"]


def contradictions(config: Config) -> list[str]:
    """Return one error line for each contradiction between settings."""
    return mistakes(RULES, config)


def live_contradictions(config: Config) -> list[str]:
    """Return those to which a setting belongs that may change while the daemon runs."""
    return mistakes(LIVE_RULES, config)


def _wire_problems(config: Config) -> list[str]:
    mcu, rate = config.mcu, config.rate_hz
    count = mcu.line_bytes
    if rate > MOST_ASKED_HZ and not (mcu.wants_samples or mcu.reply_period):
        return [
            f"control.rate = {rate:g}: a board that is asked more than {MOST_ASKED_HZ} times a "
            "second repeats its last speeds, and a robot with coarse encoders looks up to twice as "
            f'fast; write control.rate = {MOST_ASKED_HZ} or less; or mcu.link_check = "on" and '
            "mcu.encoder_counts, if its firmware sends counts; or mcu.reply_period, if it reports "
            "by its own clock"
        ]
    if wire_use(rate, mcu.baud_rate, count) <= 1.0:
        return []
    ms = wire_ns(count, mcu.baud_rate) / 1e6
    most, good = (highest_rate(mcu.baud_rate, count, use) for use in (1.0, COMFORTABLE_USE))
    bauds = [b for b in get_args(Baud) if wire_use(rate, b, count) <= 1.0]
    faster = f"mcu.baud_rate = {bauds[0]} or more; or " if bauds else ""
    return [
        f"control.rate = {rate:g}: a line of {count} B at {mcu.baud_rate} baud takes {ms:.1f} ms, "
        f"so at most {most} Hz is possible, and {good} Hz uses 80 % of the wire; write "
        f'{faster}control.rate = {good} or "auto"'
        f"{_shorter_lines(mcu, rate)}"
    ]


def _shorter_lines(mcu: McuConfig, rate: float) -> str:
    if rate > MOST_ASKED_HZ:
        return ""
    fixes = ((True, "mcu.encoder_counts = 0"), (False, 'mcu.link_check = "off"'))
    for check, fix in fixes:
        count = line_bytes(len(mcu.wheels.names), mcu.trailing_comma, check)
        if count < mcu.line_bytes and wire_use(rate, mcu.baud_rate, count) <= 1.0:
            return f"; or {fix}, which shortens the lines to {count} B"
    return ""


def _count_problems(config: Config) -> list[str]:
    # Counts are modulo 65536, so beyond half of it forward motion could look backward.
    counts, fastest = config.mcu.encoder_counts, config.feedback.wheel_speed / math.tau
    lasts = MIN_WRAP_PERIODS / config.rate_hz
    if fastest * counts * lasts <= FIELD_VALUES / 2:
        return []
    return [
        f"mcu.encoder_counts = {counts}: at feedback.wheel_speed = {config.feedback.wheel_speed:g} "
        "rad/s a wheel's counter could change by half of its range within "
        f"{FIELD_VALUES / 2 / fastest / counts * 1000:.0f} ms, which is less than "
        f"{MIN_WRAP_PERIODS} control periods ({lasts * 1000:.0f} ms); write mcu.encoder_counts = "
        f"{int(FIELD_VALUES / 2 / fastest / lasts)} or less and make the firmware count fewer "
        "edges; or lower feedback.wheel_speed; or write mcu.encoder_counts = 0"
    ]


def _rate_problems(config: Config) -> list[str]:
    return [
        f"rates.{name} = {hz:g} Hz: the rate must be 0 (every sample) or at least {MIN_RATE_HZ:g} "
        f"Hz; write rates.{name} = {MIN_RATE_HZ:g} or more"
        for name, hz in (("odom", config.rates.odom), ("telemetry", config.rates.telemetry))
        if 0.0 < hz < MIN_RATE_HZ
    ]


def _motor_problems(config: Config) -> list[str]:
    wheels, two = config.mcu.wheels, config.mcu.wheels.names == TWO_WHEELS
    missing = [name for name in TWO_WHEELS if two and not getattr(wheels, name)]
    if missing:
        return [
            f'mcu.wheels.{missing[0]} = "": the wheel of the other side has a motor; name both, or '
            'write "" for both if the robot has four driven wheels'
        ]
    others = [name for name in WHEELS if two and getattr(wheels, name) != getattr(WheelMap(), name)]
    if others:
        return [
            f"mcu.wheels.{others[0]} = {show(getattr(wheels, others[0]))}: mcu.wheels.left and "
            "mcu.wheels.right say that two wheels are driven; delete the lines of the four wheels, "
            'or write left = "" and right = ""'
        ]
    motors = zip(wheels.names, wheels.motors, strict=True)
    return _repeated("motor", {f"mcu.wheels.{name}": motor[1] for name, motor in motors})


def _joint_problems(config: Config) -> list[str]:
    joints = zip(config.mcu.wheels.names, config.joint_names, strict=True)
    return _repeated("joint name", {f"joints.{name}": joint for name, joint in joints})


def _source_name_problems(config: Config) -> list[str]:
    sources = enumerate(config.commands.sources)
    return _repeated("source name", {f"commands.sources[{i}].name": s.name for i, s in sources})


def _frame_problems(config: Config) -> list[str]:
    frames = {
        "odometry.odom_frame": config.odometry.odom_frame,
        "odometry.base_frame": config.odometry.base_frame,
    }
    if config.lidar.publish_tf:
        frames["lidar.lidar_frame"] = config.lidar.lidar_frame
    return _repeated("frame", frames)


def _battery_problems(config: Config) -> list[str]:
    battery, errors = config.battery, []
    rows = [(f"battery.{level}_below", below) for level, below in battery.bounds.items()]
    for (name, below), (worse, lower) in pairwise(rows):
        if lower >= below:
            errors.append(
                f"{worse} = {lower:g}: not lower than {name} = {below:g}; write a lower {worse}"
            )
    most = 100.0 if battery.measure == "percent" else MAX_VOLTS
    for name, below in rows:
        if below + HYSTERESIS > most:
            errors.append(
                f"{name} = {below:g}: the level ends only {HYSTERESIS:g} above this value, and "
                f"no board reports more than {most:g}; lower the value"
            )
    return errors


def _repeated(
    noun: str, names: dict[str, str], part: Callable[[str], str] = lambda name: name
) -> list[str]:
    # An error for each value that repeats an earlier one of `names`, compared by `part`.
    first: dict[str, str] = {}
    errors = []
    for key, name in names.items():
        same = part(name)
        if same in first:
            errors.append(
                f"{key} = {show(name)}: {first[same]} already has this {noun}; write another"
            )
        first.setdefault(same, key)
    return errors


def _source_problems(config: Config) -> list[str]:
    period = 1.0 / config.rate_hz
    errors = []
    for i, source in enumerate(config.commands.sources):
        if source.timeout < 2 * period:
            errors.append(
                f"commands.sources[{i}].timeout = {source.timeout:g}: shorter than two control "
                f"periods, so the robot would stutter; write {2 * period:g} or more"
            )
    return errors


def _bumper_problems(config: Config) -> list[str]:
    if config.safety.bumper != "away" or config.safety.bumpers:
        return []
    return [
        'safety.bumper = "away" needs the place of each bumper, but safety.bumpers = []; write '
        'safety.bumpers = ["front", "rear"] in the order in which the board reports them, or '
        'safety.bumper = "stop"'
    ]


def _reachability_problems(config: Config) -> list[str]:
    bus, errors = config.bus, []
    if bus.mode == "client" and not bus.connect:
        errors.append(
            'bus.mode = "client" needs an address to connect to; write bus.connect = '
            '["tcp/127.0.0.1:7447"] or bus.mode = "peer"'
        )
    if not bus.listen and bus.mode == "peer":
        errors.append(
            "bus.listen = []: no client could connect to the daemon; write bus.listen = "
            '["tcp/127.0.0.1:7448"]'
        )
    if bus.outside and not bus.plain:
        errors.append(
            f"bus.listen = {show(list(bus.listen))}: the TLS gateway needs a tcp address of this "
            'machine to reach the daemon, but the list has none; add "tcp/127.0.0.1:7448"'
        )
    return errors


def _endpoint_problems(config: Config, key: str) -> list[str]:
    bus, errors = config.bus, []
    for endpoint in bus.listening if key == "listen" else bus.connect:
        where = f"bus.{key} = {show(endpoint)}"
        host = _host(endpoint)
        if host is None:
            errors.append(
                f"{where}: not an endpoint; write it like "
                '"tcp/127.0.0.1:7448", "tcp/[::1]:7448" or "tls/0.0.0.0:7449"'
            )
        elif is_tls(endpoint):
            if not bus.tls:
                errors.append(
                    f"{where}: needs certificates; `acsard tls init` makes them and prints the "
                    "bus.tls to write"
                )
        elif not is_loopback(host) and not bus.insecure:
            errors.append(
                f"{where}: this endpoint is on the network, without encryption or access "
                "control; choose one: (1) write 127.0.0.1, and connect a laptop through an "
                'SSH tunnel; (2) run `acsard tls init`, then write "tls/…"; (3) if anyone on '
                "the network may drive the robot, write bus.insecure = true"
            )
    return errors


def _listen_twice_problems(config: Config) -> list[str]:
    names = {f"bus.listen[{i}]": endpoint for i, endpoint in enumerate(config.bus.listening)}
    return _repeated("host and port", names, lambda endpoint: endpoint.partition("/")[2])


def _page_problems(config: Config) -> list[str]:
    # `acsard/web/listen.py` applies the same rules when the page starts.
    addresses, errors = config.web.address, []
    for address in addresses:
        where = f"web.address = {show(address)}"
        scheme, _, place = address.partition("://")
        host, _, port = place.rpartition(":")
        if not 0 < int(port) < 65536:
            errors.append(f"{where}: a port is a number from 1 to 65535")
        elif scheme == "http" and not is_loopback(host.strip("[]")):
            errors.append(
                f"{where}: http is only for this machine; write 127.0.0.1, or https:// with the "
                "robot's certificate, like https://0.0.0.0:8443"
            )
        elif scheme == "https" and not config.bus.tls:
            errors.append(
                f"{where}: needs a certificate; `acsard tls init` makes it and prints the bus.tls "
                "to write"
            )
    names = {f"web.address[{i}]": address for i, address in enumerate(addresses)}
    errors += _repeated("host and port", names, lambda address: address.partition("://")[2])
    for everywhere in (address for address in addresses if "//[::]:" in address):
        port = everywhere.rpartition(":")[2]
        errors += [
            f"{key} = {show(address)}: {everywhere} listens at this address, too, because it "
            f"listens at all addresses of this machine; remove one of both"
            for key, address in names.items()
            if address.endswith(f":{port}") and "//[::]:" not in address
        ]
    return errors


def _access_problems(config: Config) -> list[str]:
    members = config.access.members
    names = {f"access.{role}s[{i}]": n for role in members for i, n in enumerate(members[role])}
    return _repeated("certificate", names)


def _ros_problems(config: Config) -> list[str]:
    ros = config.ros
    if ros.bridge and ros.namespace.partition("/")[0] == ROOT_KEY:
        return [
            f"ros.namespace = {show(ros.namespace)}: acsard's own Zenoh keys also begin with "
            f'"{ROOT_KEY}", so the keys of the ROS bridge would mix with acsard\'s; write another '
            'namespace, like "robot1"'
        ]
    return []


def _host(endpoint: str) -> str | None:
    scheme, _, address = endpoint.partition("/")
    if set(endpoint) & set("#?;= \t"):
        # These characters add options for Zenoh to an endpoint. Such options could switch off the
        # protection that these rules give.
        return None
    host, _, port = address.rpartition(":")
    good = (
        scheme in ("tcp", "tls")
        and host
        and port.isascii()
        and port.isdigit()
        and 0 < int(port) < 65536
    )
    return host.strip("[]") if good else None


def is_loopback(host: str) -> bool:
    if host == "localhost":
        return True
    try:
        address = ipaddress.ip_address(host)
    except ValueError:
        return False
    mapped = getattr(address, "ipv4_mapped", None)
    return (mapped or address).is_loopback


# A rule that reads an invalid key finds nothing at all, so each checks one thing and reads few
# keys.
RULES: tuple[Rule, ...] = (
    _rate_problems,
    _wire_problems,
    _count_problems,
    _motor_problems,
    _joint_problems,
    _source_name_problems,
    _frame_problems,
    _battery_problems,
    *motion_rules.RULES,
    _source_problems,
    _bumper_problems,
    _reachability_problems,
    lambda config: _endpoint_problems(config, "listen"),
    lambda config: _endpoint_problems(config, "connect"),
    _listen_twice_problems,
    _page_problems,
    _access_problems,
    _ros_problems,
    *simulated_faults.RULES,
)

LIVE_RULES: tuple[Rule, ...] = (_rate_problems, *motion_rules.RULES, _source_problems)
