"""Tests of the configuration as ROS parameters: listing, reading, describing and setting them."""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from typing import Any

import pytest

from acsard.core.config.live import find_live_setting, flat
from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config
from acsard.core.messages.cdr import Cdr, CdrError
from acsard.core.ros import parameters as rcl
from acsard.core.ros.parameters import (
    FloatingPointRange,
    IntegerRange,
    ParameterDescriptor,
    Parameters,
    described,
)
from acsard.core.ros.transports import PARAMETER_SERVICES
from tests.each import each

TABLES: dict[str, object] = {
    "robot": {"id": "acsar"},
    "mcu": {"baud_rate": 115200, "trailing_comma": False, "wheels": {"front_left": "+b"}},
    "drive": {"wheel_radius": 0.05},
    "bus": {"connect": [], "listen": ["tcp/127.0.0.1:7448"]},
    "commands": {"sources": [{"name": "nav", "priority": 10}, {"name": "app", "priority": 50}]},
}


def call(service: str, request: Any, reply: type[Any]) -> Any:
    answer = Parameters(TABLES).answer(service, Cdr(type(request)).encode(request))
    return Cdr(reply).decode(answer)


def names(prefixes: list[str], depth: int = 0) -> list[str]:
    reply: rcl.ListReply = call("list_parameters", rcl.ListRequest(prefixes, depth), rcl.ListReply)
    return reply.names


def value(name: str) -> rcl.ParameterValue:
    reply: rcl.Values = call("get_parameters", rcl.Names([name]), rcl.Values)
    return reply.values[0]


ALL = [
    "robot.id", "mcu.baud_rate", "mcu.trailing_comma", "mcu.wheels.front_left",
    "drive.wheel_radius", "bus.connect", "bus.listen", "commands.sources.nav.priority",
    "commands.sources.app.priority",
]  # fmt: skip


def test_every_parameter_and_its_prefixes_are_listed() -> None:
    reply: rcl.ListReply = call("list_parameters", rcl.ListRequest([], 0), rcl.ListReply)
    assert reply.names == ALL
    assert reply.prefixes == [
        "bus", "commands.sources.app", "commands.sources.nav", "drive", "mcu", "mcu.wheels",
        "robot",
    ]  # fmt: skip


@each(
    ("prefixes", "depth", "expected"),
    [
        ([], 1, []),
        ([], 2, [n for n in ALL if n.count(".") == 1]),
        ([], 3, [n for n in ALL if n.count(".") <= 2]),
        (["mcu"], 0, ["mcu.baud_rate", "mcu.trailing_comma", "mcu.wheels.front_left"]),
        (["mcu"], 1, ["mcu.baud_rate", "mcu.trailing_comma"]),
        (["mcu", "robot"], 1, ["robot.id", "mcu.baud_rate", "mcu.trailing_comma"]),
        (["robot.id"], 0, ["robot.id"]),
        (["mc"], 0, []),
        (["nowhere"], 0, []),
    ],
)
def test_prefixes_and_depth_select_the_listed_parameters(
    prefixes: list[str], depth: int, expected: list[str]
) -> None:
    assert names(prefixes, depth) == expected


def test_an_unknown_parameter_has_no_value_and_no_type() -> None:
    assert value("robot.weight") == rcl.ParameterValue()
    asked = rcl.Names(["robot.weight", "robot.id"])
    assert call("get_parameter_types", asked, rcl.Types).types == [rcl.NOT_SET, rcl.STRING]


def test_the_description_of_a_parameter_is_that_of_its_key() -> None:
    asked = rcl.Names(["drive.wheel_radius", "no.such"])
    found = call("describe_parameters", asked, rcl.Descriptors).descriptors
    unknown = ParameterDescriptor("no.such", rcl.NOT_SET)
    assert found == [described("drive.wheel_radius", rcl.DOUBLE), unknown]


@each("kind", [rcl.NOT_SET, 5, 6, 7, 8, 10])
def test_a_parameter_cannot_be_unset_nor_be_a_list_of_numbers(kind: int) -> None:
    asked = rcl.SetRequest([rcl.Parameter("log.level", rcl.ParameterValue(kind))])
    with pytest.raises(CdrError, match=r"log\.level"):
        rcl.requested_values(Cdr(rcl.SetRequest).encode(asked))


def test_a_set_reply_has_one_result_per_parameter_and_an_atomic_one_has_one() -> None:
    wish = rcl.Parameter("log.level", rcl.ParameterValue(rcl.STRING, string_value="debug"))
    payload = Cdr(rcl.SetRequest).encode(rcl.SetRequest([wish, wish]))
    result = rcl.SetParametersResult(False, "why")
    each = rcl.outcome("set_parameters", payload, False, "why")
    assert Cdr(rcl.SetReply).decode(each) == rcl.SetReply([result, result])
    reply = rcl.outcome("set_parameters_atomically", payload, False, "why")
    assert Cdr(rcl.SetAtomicallyReply).decode(reply) == rcl.SetAtomicallyReply(result)


@each("service", PARAMETER_SERVICES)
def test_a_request_cut_anywhere_is_refused(service: str) -> None:
    wish = rcl.Parameter("robot.id", rcl.ParameterValue(rcl.STRING, string_value="other"))
    request: Any = {
        "list_parameters": rcl.ListRequest(["mcu"], 0),
        "set_parameters": rcl.SetRequest([wish]),
        "set_parameters_atomically": rcl.SetRequest([wish]),
    }.get(service, rcl.Names(["robot.id"]))
    payload = Cdr(type(request)).encode(request)
    serve: Callable[[bytes], object] = partial(Parameters(TABLES).answer, service)
    if service in rcl.SETTING_SERVICES:
        serve = rcl.requested_values
    assert serve(payload)
    for end in range(len(payload)):
        with pytest.raises(CdrError):
            serve(payload[:end])


def test_every_listed_parameter_of_the_configuration_has_a_value() -> None:
    serve = Parameters(effective(Config())).answer
    listed = Cdr(rcl.ListReply).decode(
        serve("list_parameters", Cdr(rcl.ListRequest).encode(rcl.ListRequest([], 0)))
    )
    reply = Cdr(rcl.Values).decode(
        serve("get_parameters", Cdr(rcl.Names).encode(rcl.Names(listed.names)))
    )
    assert "limits.linear_speed" in listed.names
    assert all(parameter.type != rcl.NOT_SET for parameter in reply.values)


KEYS = [key for key, _ in flat(effective(Config()))]
DOUBLE, INTEGER = 3, 2


@each(
    "expected",
    [
        ParameterDescriptor(
            "limits.linear_stop_deceleration", DOUBLE,
            "deceleration after a stop or a fault: a number from 0.01 to 100 m/s2",
            "may be raised at any time, but lowered only while the robot stands",
            read_only=False, floating_point_range=[FloatingPointRange(0.01, 100.0, 0.0)],
        ),
        ParameterDescriptor(
            "mcu.encoder_counts", INTEGER,
            "a whole number from 0 to 100000 per wheel turn (0 = unknown)",
            "change it in acsard.toml, then restart the daemon",
            integer_range=[IntegerRange(0, 100_000, 1)],
        ),
        ParameterDescriptor("no.such", 0),
    ],
)  # fmt: skip
def test_a_parameter_is_described_by_range_and_condition(
    expected: ParameterDescriptor,
) -> None:
    assert described(expected.name, expected.type) == expected


@each("key", KEYS)
def test_every_key_has_a_description_and_is_read_only_unless_it_can_be_set(key: str) -> None:
    descriptor = described(key, DOUBLE)
    assert descriptor.description
    assert descriptor.read_only == (find_live_setting(key) is None)


def test_a_robot_without_command_sources_describes_the_empty_list() -> None:
    row = described("commands.sources", rcl.STRING_ARRAY)
    assert (row.name, row.read_only) == ("commands.sources", True)
