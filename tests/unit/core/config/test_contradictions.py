"""Tests of contradictions in the tables for bus, access and ROS. Each error names a correction."""

from __future__ import annotations

from typing import Literal

import pytest
from msgspec.structs import replace

from acsard.core.config.contradictions import contradictions, warnings
from acsard.core.config.parsing import parse
from acsard.core.config.settings import (
    AccessConfig,
    BatteryConfig,
    BusConfig,
    CommandsConfig,
    Config,
    ControlConfig,
    FeedbackConfig,
    McuConfig,
    RatesConfig,
    RosConfig,
    SafetyConfig,
    SimConfig,
    WebConfig,
)
from acsard.host.errors import UsageError
from acsard.web.listen import parse_listen
from tests.each import each


def problems(**tables: object) -> list[str]:
    return contradictions(Config(**tables))  # type: ignore[arg-type]


def test_the_defaults_have_no_contradictions_and_no_warnings() -> None:
    assert contradictions(Config()) == []
    assert warnings(Config()) == []


HERE = "tcp/127.0.0.1:7448"


@pytest.mark.parametrize("endpoint", ["tls/0.0.0.0:7449", "tls/127.0.0.1:7449"])
def test_a_tls_endpoint_needs_certificates(endpoint: str) -> None:
    listen = (HERE, endpoint)
    (line,) = problems(bus=BusConfig(listen=listen))
    assert "acsard tls init" in line
    assert problems(bus=BusConfig(listen=listen, tls="/etc/acsard/tls")) == []
    assert problems(bus=BusConfig(connect=(endpoint,), tls="/etc/acsard/tls")) == []


def test_the_gateway_needs_a_local_tcp_address_of_the_daemon() -> None:
    (line,) = problems(bus=BusConfig(listen=("tls/0.0.0.0:7449",), tls="/etc/acsard/tls"))
    assert line == (
        'bus.listen = ["tls/0.0.0.0:7449"]: the TLS gateway needs a tcp address of '
        f'this machine to reach the daemon, but the list has none; add "{HERE}"'
    )


@pytest.mark.parametrize("endpoint", ["tcp/0.0.0.0:7448", "tcp/[::]:7448", "tcp/robot:7448"])
def test_a_plain_endpoint_stays_on_this_machine_even_with_certificates(endpoint: str) -> None:
    (line,) = problems(bus=BusConfig(listen=(endpoint,), tls="/etc/acsard/tls"))
    assert "acsard tls init" in line
    assert "bus.insecure = true" in line
    assert problems(bus=BusConfig(listen=(endpoint,), insecure=True)) == []


@each("endpoint", ["udp/127.0.0.1:1", "tls/:7449", "tls/host", "tls/host:0"])
def test_any_other_text_is_not_an_endpoint(endpoint: str) -> None:
    (line,) = problems(bus=BusConfig(listen=(HERE, endpoint), tls="/etc/acsard/tls"))
    assert "not an endpoint" in line


def test_client_mode_needs_an_address_to_connect_to() -> None:
    (line,) = problems(bus=BusConfig(mode="client"))
    assert 'bus.mode = "client"' in line
    assert problems(bus=BusConfig(mode="client", connect=("tcp/127.0.0.1:7447",))) == []


@each("listen", [(), ("nonsense",), ("tcp/0.0.0.0:7448",), ("tls/1.2.3.4:5",)])
def test_listen_endpoints_are_ignored_without_a_warning_in_client_mode(
    listen: tuple[str, ...],
) -> None:
    here = ("tcp/127.0.0.1:7447",)
    bus = BusConfig(mode="client", connect=here, listen=listen)
    client = Config(bus=bus, ros=RosConfig(namespace="r1"))
    assert contradictions(client) == warnings(client) == []
    assert problems(bus=BusConfig(connect=here, listen=listen)) != []


@each(
    "addresses",
    [
        ("http://127.0.0.1:8080", "http://localhost:8081", "http://[::1]:8080"),
        ("http://[::ffff:127.0.0.1]:8080",),
        ("http://192.168.0.1:80",),
        ("http://robot:8080",),
        ("https://0.0.0.0:8443", "https://127.0.0.1:8444"),
        ("http://127.0.0.1:0",),
        ("http://127.0.0.1:65536",),
    ],
)
@each("tls", ["", "/etc/acsard/tls"])
def test_the_check_refuses_the_addresses_that_the_page_refuses(
    addresses: tuple[str, ...], tls: str
) -> None:
    try:
        endpoints = [parse_listen(address) for address in addresses]
        refused = any(address.secure for address in endpoints) and not tls
    except UsageError:
        refused = True
    bus, web = BusConfig(tls=tls), WebConfig(address=addresses)
    assert (problems(bus=bus, web=web) != []) == refused


def test_a_second_address_with_the_same_host_and_port_is_refused() -> None:
    web = WebConfig(address=("http://127.0.0.1:8443", "https://127.0.0.1:8443"))
    (line,) = problems(bus=BusConfig(tls="/etc/acsard/tls"), web=web)
    assert line == (
        'web.address[1] = "https://127.0.0.1:8443": web.address[0] already has this host and port; '
        "write another"
    )
    assert len(problems(bus=BusConfig(listen=(HERE, HERE)))) == 1
    client = BusConfig(mode="client", connect=(HERE,), listen=(HERE, HERE))
    assert problems(bus=client) == []


def test_a_certificate_has_one_role() -> None:
    (line,) = problems(access=AccessConfig(viewers=("a", "b"), maintainers=("b",)))
    assert line.startswith('access.maintainers[0] = "b": access.viewers[1] already has this')


def test_a_namespace_may_not_start_with_the_prefix_of_the_native_keys() -> None:
    (line,) = problems(ros=RosConfig(namespace="acsard/acsar"))
    assert "ros.namespace" in line
    assert problems(ros=RosConfig(namespace="acsard", bridge=False)) == []
    assert problems(ros=RosConfig(namespace="acsard2")) == []


def test_a_bus_on_the_network_without_robot_id_and_namespace_is_a_warning() -> None:
    text = b'[bus]\nlisten = ["tcp/127.0.0.1:7448", "tls/0.0.0.0:7449"]\ntls = "/etc/acsard/tls"\n'
    first, second = warnings(parse(text))
    assert "robot.id" in first
    assert "ros.namespace" in second
    assert warnings(parse(text + b'[robot]\nid = "r1"\n[ros]\nnamespace = "r1"\n')) == []
    assert len(warnings(parse(text + b"[ros]\nbridge = false\nrmw = false\n"))) == 1


def test_a_router_on_the_robot_without_a_namespace_is_a_warning() -> None:
    text = b'[bus]\nconnect = ["tcp/127.0.0.1:7447"]\n'
    (line,) = warnings(parse(text))
    assert line.startswith('ros.namespace = "" on a bus with a router')
    for mend in (b'[ros]\nnamespace = "r1"\n', b"[ros]\nbridge = false\nrmw = false\n"):
        assert warnings(parse(text + mend)) == []


# the checked link


def test_checked_lines_reduce_the_highest_control_rate() -> None:
    mcu = McuConfig(baud_rate=9600, link_check="auto")
    (line,) = problems(mcu=mcu, control=ControlConfig(rate=25))
    assert line == (
        "control.rate = 25: a line of 41 B at 9600 baud takes 42.7 ms, so at most 23 Hz is "
        "possible, and 18 Hz uses 80 % of the wire; "
        'write mcu.baud_rate = 19200 or more; or control.rate = 18 or "auto"; or '
        'mcu.link_check = "off", which shortens the lines to 33 B'
    )
    assert Config(mcu=mcu, control=ControlConfig(rate="auto")).rate_hz == 18


def test_sample_fields_reduce_the_highest_control_rate_further() -> None:
    mcu = McuConfig(baud_rate=57600, link_check="require", encoder_counts=3200)
    (line,) = problems(mcu=mcu)
    assert line == (
        "control.rate = 100: a line of 62 B at 57600 baud takes 10.8 ms, so at most 92 Hz is "
        "possible, and 74 Hz uses 80 % of the wire; "
        'write mcu.baud_rate = 115200 or more; or control.rate = 74 or "auto"; or '
        "mcu.encoder_counts = 0, which shortens the lines to 41 B"
    )
    assert problems(mcu=mcu, control=ControlConfig(rate=92)) == []
    (warning,) = warnings(
        Config(
            mcu=mcu,
            control=ControlConfig(rate=80),
            sim=SimConfig(encoder_counts=mcu.encoder_counts),
        )
    )
    assert "control.rate = 80 takes 86% of the wire at 57600 baud" in warning


@each(("counts", "rate", "check", "warned"), [
    (96, 200, "off", True), (96, 100, "off", False), (200, 200, "off", False),
    (96, 200, "auto", False),
])  # fmt: skip
def test_a_rate_so_high_that_lines_repeat_counts_is_a_warning(
    counts: int, rate: float, check: Literal["off", "auto"], warned: bool
) -> None:
    mcu = McuConfig(encoder_counts=counts, link_check=check)
    sim = SimConfig(encoder_counts=counts)
    messages = warnings(Config(mcu=mcu, control=ControlConfig(rate=rate), sim=sim))
    expected = "control.rate = 200 with mcu.encoder_counts = 96: lines follow each other so soon"
    assert any(expected in line for line in messages) == warned


@each(
    ("mcu", "count"),
    [
        (McuConfig(), 33),
        (McuConfig(encoder_counts=3200), 33),
        (McuConfig(trailing_comma=True), 34),
        (McuConfig(link_check="auto"), 41),
        (McuConfig(link_check="require", trailing_comma=True), 42),
        (McuConfig(link_check="auto", encoder_counts=3200), 62),
    ],
)
def test_the_line_length_includes_all_fields_that_the_settings_may_request(
    mcu: McuConfig, count: int
) -> None:
    assert mcu.line_bytes == count
    at_9600 = McuConfig(
        baud_rate=9600,
        trailing_comma=mcu.trailing_comma,
        link_check=mcu.link_check,
        encoder_counts=mcu.encoder_counts,
    )
    rate = Config(mcu=at_9600, control=ControlConfig(rate="auto")).rate_hz
    assert rate == int(0.8 * 9600 / (count * 10))


def test_encoder_counts_without_the_check_cause_no_warning() -> None:
    assert warnings(Config(mcu=McuConfig(encoder_counts=3200))) == []


def test_encoder_counts_that_differ_from_the_simulator_are_a_warning() -> None:
    mcu = McuConfig(link_check="auto", encoder_counts=1600)
    (warning,) = warnings(Config(mcu=mcu))
    assert "sim.encoder_counts = 3200: distances may be wrong; write the same number" in warning
    assert warnings(Config(mcu=mcu, sim=SimConfig(encoder_counts=1600))) == []


def test_counts_that_wrap_within_two_periods_are_refused_with_the_largest_valid_value() -> None:
    control = ControlConfig(rate=10)
    (line,) = problems(mcu=McuConfig(encoder_counts=20_000), control=control)
    assert line.startswith(
        "mcu.encoder_counts = 20000: at feedback.wheel_speed = 80 rad/s a wheel's counter "
    )
    assert (
        "change by half of its range within 129 ms, which is less than 2 control periods (200 ms)"
        in line
    )
    assert "write mcu.encoder_counts = 12867 or less" in line
    assert problems(mcu=McuConfig(encoder_counts=12_867), control=control) == []
    assert problems(mcu=McuConfig(encoder_counts=12_868), control=control) != []
    slower = FeedbackConfig(wheel_speed=50.0)
    assert problems(mcu=McuConfig(encoder_counts=20_000), control=control, feedback=slower) == []


@pytest.mark.parametrize("name", ["odom", "telemetry"])
def test_a_rate_of_publishing_is_zero_or_not_too_low(name: str) -> None:
    (line,) = problems(rates=RatesConfig(**{name: 1e-300}))
    assert line == (
        f"rates.{name} = 1e-300 Hz: the rate must be 0 (every sample) or at least 0.1 Hz; write "
        f"rates.{name} = 0.1 or more"
    )
    assert problems(rates=RatesConfig(**{name: 0.1})) == []


def test_an_ignored_emergency_stop_is_a_warning() -> None:
    (warning,) = warnings(Config(safety=SafetyConfig(estop="off")))
    assert warning == (
        'safety.estop = "off": the robot ignores an emergency stop that its board reports'
    )


def test_a_robot_without_command_sources_is_a_warning() -> None:
    (line,) = warnings(Config(commands=CommandsConfig(sources=())))
    assert line.startswith("commands.sources = []: no program can drive this robot; ")


@each(
    ("port", "remedy"),
    [
        ("SIM", 'write mcu.port = "sim" for the simulator'),
        ("ttyUSB0", 'write the whole path, such as mcu.port = "/dev/ttyUSB0"'),
    ],
)
def test_a_port_in_the_working_directory_is_a_warning(port: str, remedy: str) -> None:
    (line,) = warnings(Config(mcu=McuConfig(port=port)))
    assert line.startswith(f'mcu.port = "{port}" is a file in the daemon\'s working directory')
    assert line.endswith(remedy)
    assert warnings(Config(mcu=McuConfig(port=f"/dev/{port}"))) == []


def test_ignored_bumpers_are_a_warning() -> None:
    (warning,) = warnings(Config(safety=SafetyConfig(bumper="off")))
    assert warning == 'safety.bumper = "off": the robot ignores bumpers that its board reports'


def test_motion_away_from_a_bumper_needs_its_place() -> None:
    away = Config(safety=SafetyConfig(bumper="away"))
    assert contradictions(away) == [
        'safety.bumper = "away" needs the place of each bumper, but safety.bumpers = []; write '
        'safety.bumpers = ["front", "rear"] in the order in which the board reports them, or '
        'safety.bumper = "stop"'
    ]
    placed = Config(safety=SafetyConfig(bumpers=("rear",), bumper="away"))
    assert contradictions(placed) == []


@each(
    ("battery", "problem"),
    [
        (
            BatteryConfig(warning_below=22.0, stop_below=22.0),
            "battery.stop_below = 22: not lower than battery.warning_below = 22; write a lower "
            "battery.stop_below",
        ),
        (
            BatteryConfig(warning_below=22.0, stop_below=23.0),
            "battery.stop_below = 23: not lower than battery.warning_below = 22; write a lower "
            "battery.stop_below",
        ),
        (
            BatteryConfig("percent", warning_below=99.8),
            "battery.warning_below = 99.8: the level ends only 0.5 above this value, and no "
            "board reports more than 100; lower the value",
        ),
        (
            BatteryConfig(stop_below=99.7),
            "battery.stop_below = 99.7: the level ends only 0.5 above this value, and no "
            "board reports more than 99.99; lower the value",
        ),
    ],
)
def test_contradicting_battery_thresholds_are_refused(battery: BatteryConfig, problem: str) -> None:
    assert contradictions(Config(battery=battery)) == [problem]


def test_battery_thresholds_in_order_are_accepted() -> None:
    for battery in (
        BatteryConfig(),
        BatteryConfig(warning_below=22.0, stop_below=21.0),
        BatteryConfig("percent", warning_below=99.5, stop_below=10.0),
    ):
        assert contradictions(Config(battery=battery)) == []


def test_a_slow_wire_without_room_for_required_status_lines_is_a_warning() -> None:
    slow = McuConfig(baud_rate=9600)
    config = Config(mcu=slow, control=ControlConfig(rate="auto"))
    assert warnings(config) == []
    (warning,) = warnings(replace(config, safety=SafetyConfig(estop="required")))
    assert warning == (
        'safety.estop = "required" needs status lines, which take 29% of the wire at 9600 '
        "baud. The replies at control.rate = 23 do not fit beside them; write "
        "control.rate = 14 or less"
    )
    bumpers = SafetyConfig(bumpers=("front", "rear"))
    (warning,) = warnings(replace(config, safety=bumpers))
    assert warning.startswith(
        'safety.bumpers = ["front", "rear"] needs status lines, which take 29%'
    )
    assert len(warnings(replace(config, safety=replace(bumpers, bumper="off")))) == 1
    safe = SafetyConfig(estop="required")
    assert warnings(Config(mcu=slow, control=ControlConfig(rate=14.0), safety=safe)) == []
    assert warnings(Config(safety=safe)) == []
