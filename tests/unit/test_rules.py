"""What contradicts in the bus, access and ROS tables, each with its mend."""

from __future__ import annotations

import pytest

from acsard.config import parse
from acsard.rules import contradictions, warnings
from acsard.settings import AccessConfig, BusConfig, Config, RosConfig


def problems(**tables: object) -> list[str]:
    return contradictions(Config(**tables))  # type: ignore[arg-type]


def test_the_defaults_contradict_nothing_and_surprise_nobody() -> None:
    assert contradictions(Config()) == []
    assert warnings(Config()) == []


@pytest.mark.parametrize("endpoint", ["tls/0.0.0.0:7449", "tls/127.0.0.1:7449"])
def test_a_tls_endpoint_needs_certificates(endpoint: str) -> None:
    (line,) = problems(bus=BusConfig(listen=(endpoint,)))
    assert "acsard lan init" in line
    assert problems(bus=BusConfig(listen=(endpoint,), tls="/etc/acsard/tls")) == []
    assert problems(bus=BusConfig(connect=(endpoint,), tls="/etc/acsard/tls")) == []


@pytest.mark.parametrize("endpoint", ["tcp/0.0.0.0:7448", "tcp/[::]:7448", "tcp/robot:7448"])
def test_a_plain_endpoint_stays_on_this_machine_even_with_certificates(endpoint: str) -> None:
    (line,) = problems(bus=BusConfig(listen=(endpoint,), tls="/etc/acsard/tls"))
    assert "acsard lan init" in line
    assert "bus.insecure = true" in line
    assert problems(bus=BusConfig(listen=(endpoint,), insecure=True)) == []


@pytest.mark.parametrize("endpoint", ["udp/127.0.0.1:1", "tls/:7449", "tls/host", "tls/host:0"])
def test_anything_else_is_no_endpoint(endpoint: str) -> None:
    (line,) = problems(bus=BusConfig(listen=(endpoint,), tls="/etc/acsard/tls"))
    assert "not an endpoint" in line


def test_a_client_needs_somewhere_to_connect_to() -> None:
    (line,) = problems(bus=BusConfig(mode="client"))
    assert 'bus.mode = "client"' in line
    assert problems(bus=BusConfig(mode="client", connect=("tcp/127.0.0.1:7447",))) == []


def test_a_certificate_has_one_role() -> None:
    (line,) = problems(access=AccessConfig(viewers=("a", "b"), maintainers=("b",)))
    assert line.startswith('access.maintainers[0] = "b": access.viewers[1] is the same')


def test_a_namespace_may_not_begin_like_the_native_keys() -> None:
    (line,) = problems(ros=RosConfig(namespace="acsard/acsar"))
    assert "ros.namespace" in line
    assert problems(ros=RosConfig(namespace="acsard", bridge=False)) == []
    assert problems(ros=RosConfig(namespace="acsard2")) == []


def test_a_bus_that_leaves_the_machine_wants_an_id_and_a_namespace() -> None:
    text = b'[bus]\nlisten = ["tls/0.0.0.0:7449"]\ntls = "/etc/acsard/tls"\n'
    first, second = warnings(parse(text))
    assert "robot.id" in first
    assert "ros.namespace" in second
    assert warnings(parse(text + b'[robot]\nid = "r1"\n[ros]\nnamespace = "r1"\n')) == []
    assert len(warnings(parse(text + b"[ros]\nbridge = false\nrmw = false\n"))) == 1
