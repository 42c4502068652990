"""Tests of contradictions in the tables for bus, access and ROS. Each error names a correction."""

from __future__ import annotations

from acsard.core.config.contradictions import contradictions, warnings
from acsard.core.config.settings import (
    BusConfig,
    Config,
    ControlConfig,
    McuConfig,
    RosConfig,
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


# the checked link


@each(
    ("mcu", "count"),
    [
        (McuConfig(), 33),
        (McuConfig(encoder_counts=3200), 33),
        (McuConfig(trailing_comma=True), 34),
        (McuConfig(link_check="on"), 41),
        (McuConfig(link_check="on", trailing_comma=True), 42),
        (McuConfig(link_check="on", encoder_counts=3200), 62),
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
