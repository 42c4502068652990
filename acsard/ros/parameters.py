"""The configuration as read-only ROS parameters: what `ros2 param list` and `get` ask a node.

The rcl_interfaces structs live here, since nothing else speaks them; names are those of
`acsard.toml`, joined by dots.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from typing import Annotated, TypeVar

from msgspec import Meta, Struct

from acsard.messages.cdr import Cdr

Unsigned8 = Annotated[int, Meta(extra={"cdr": "B"})]
Signed64 = Annotated[int, Meta(extra={"cdr": "q"})]
Unsigned64 = Annotated[int, Meta(extra={"cdr": "Q"})]

T = TypeVar("T")
Some = Annotated[list[T], Meta(max_length=128)]
"""All parameters at once are fewer; a request of more takes too long to answer in one step."""
Many = Annotated[list[T], Meta(max_length=256)]
"""Of what is quicker to read: names alone."""

MAX_REQUEST_BYTES = 16384
"""As many of the longest names."""

NOT_SET, BOOL, INTEGER, DOUBLE, STRING = range(5)
DOUBLE_ARRAY, STRING_ARRAY = 8, 9

SEPARATOR = "."

Q = TypeVar("Q")


class ParameterValue(Struct, frozen=True):
    """One value; `type` says which field holds it."""

    type: Unsigned8 = NOT_SET
    bool_value: bool = False
    integer_value: Signed64 = 0
    double_value: float = 0.0
    string_value: str = ""
    byte_array_value: list[Unsigned8] = []
    bool_array_value: list[bool] = []
    integer_array_value: list[Signed64] = []
    double_array_value: list[float] = []
    string_array_value: list[str] = []


class Parameter(Struct, frozen=True):
    """A named value."""

    name: str
    value: ParameterValue


class FloatingPointRange(Struct, frozen=True):
    """Bounds of a float."""

    from_value: float
    to_value: float
    step: float


class IntegerRange(Struct, frozen=True):
    """Bounds of an integer."""

    from_value: Signed64
    to_value: Signed64
    step: Unsigned64


class ParameterDescriptor(Struct, frozen=True):
    """What a parameter is."""

    name: str
    type: Unsigned8
    description: str = ""
    additional_constraints: str = ""
    read_only: bool = True
    dynamic_typing: bool = False
    floating_point_range: list[FloatingPointRange] = []
    integer_range: list[IntegerRange] = []


class SetParametersResult(Struct, frozen=True):
    """Was it set, and if not, why."""

    successful: bool
    reason: str


class ListRequest(Struct, frozen=True):
    """`depth` 0 is any depth; no prefixes are all."""

    prefixes: Many[str]
    depth: Unsigned64


class ListReply(Struct, frozen=True):
    """Names, and the prefixes they have."""

    names: list[str]
    prefixes: list[str]


class Names(Struct, frozen=True):
    """The request of get, types and describe."""

    names: Many[str]


class Values(Struct, frozen=True):
    """The reply of get."""

    values: list[ParameterValue]


class Types(Struct, frozen=True):
    """The reply of types."""

    types: list[Unsigned8]


class Descriptors(Struct, frozen=True):
    """The reply of describe."""

    descriptors: list[ParameterDescriptor]


class SetRequest(Struct, frozen=True):
    """The request of both ways to set."""

    parameters: Some[Parameter]


class SetReply(Struct, frozen=True):
    """A result for each."""

    results: list[SetParametersResult]


class SetAtomicallyReply(Struct, frozen=True):
    """One result for all."""

    result: SetParametersResult


REFUSED = SetParametersResult(False, "read-only: change acsard.toml and start acsard anew")


def failure(service: str, why: str) -> bytes:
    """The reply to a request that is not served: as rclcpp, nothing where there is no room for why.

    A client without any reply would wait for ever.
    """
    refused = SetParametersResult(False, why)
    replies: dict[str, Struct] = {
        "list_parameters": ListReply([], []),
        "get_parameters": Values([]),
        "get_parameter_types": Types([]),
        "describe_parameters": Descriptors([]),
        "set_parameters": SetReply([refused]),
        "set_parameters_atomically": SetAtomicallyReply(refused),
    }
    reply = replies[service]
    return Cdr(type(reply)).encode(reply)


class Parameters:
    """Answers the six parameter services from the tables of a configuration."""

    def __init__(self, tables: Mapping[str, object]) -> None:
        self._values = {name: _value(value) for name, value in _flat(tables, "")}
        self._services: dict[str, Callable[[bytes], bytes]] = {
            "list_parameters": _service(ListRequest, self._list),
            "get_parameters": _service(Names, self._get),
            "get_parameter_types": _service(Names, self._types),
            "describe_parameters": _service(Names, self._describe),
            "set_parameters": _service(
                SetRequest, lambda asked: SetReply([REFUSED] * len(asked.parameters))
            ),
            "set_parameters_atomically": _service(
                SetRequest, lambda _: SetAtomicallyReply(REFUSED)
            ),
        }

    def answer(self, service: str, payload: bytes) -> bytes:
        """The reply to a request, both in CDR; raises `CdrError`."""
        return self._services[service](payload)

    def _list(self, asked: ListRequest) -> ListReply:
        def within(name: str) -> bool:
            if not asked.prefixes:
                return not asked.depth or name.count(SEPARATOR) < asked.depth
            return any(_below(name, prefix, asked.depth) for prefix in asked.prefixes)

        names = [name for name in self._values if within(name)]
        prefixes = {name.rpartition(SEPARATOR)[0] for name in names}
        return ListReply(names, sorted(prefixes - {""}))

    def _of(self, asked: Names) -> Iterator[tuple[str, ParameterValue]]:
        for name in asked.names:
            yield name, self._values.get(name, ParameterValue())

    def _get(self, asked: Names) -> Values:
        return Values([value for _, value in self._of(asked)])

    def _types(self, asked: Names) -> Types:
        return Types([value.type for _, value in self._of(asked)])

    def _describe(self, asked: Names) -> Descriptors:
        return Descriptors([ParameterDescriptor(name, v.type) for name, v in self._of(asked)])


def _service(request: type[Q], reply: Callable[[Q], Struct]) -> Callable[[bytes], bytes]:
    asked = Cdr(request)

    def serve(payload: bytes) -> bytes:
        answer = reply(asked.decode(payload))
        return Cdr(type(answer)).encode(answer)

    return serve


def _below(name: str, prefix: str, depth: int) -> bool:
    rest = name.removeprefix(prefix + SEPARATOR)
    return name == prefix or (rest != name and (not depth or rest.count(SEPARATOR) < depth))


def _flat(value: object, name: str) -> Iterator[tuple[str, object]]:
    """Every leaf with its dotted name; a list of named tables counts as tables by those names."""
    if isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _flat(inner, f"{name}{SEPARATOR}{key}" if name else str(key))
    elif isinstance(value, list | tuple) and value and isinstance(value[0], Mapping):
        for table in value:
            rest = {key: inner for key, inner in table.items() if key != "name"}
            yield from _flat(rest, f"{name}{SEPARATOR}{table['name']}")
    else:
        yield name, value


def _value(value: object) -> ParameterValue:
    match value:
        case bool():
            return ParameterValue(BOOL, bool_value=value)
        case int():
            return ParameterValue(INTEGER, integer_value=value)
        case float():
            return ParameterValue(DOUBLE, double_value=value)
        case str():
            return ParameterValue(STRING, string_value=value)
        case [float() | int(), *_]:
            return ParameterValue(
                DOUBLE_ARRAY,
                double_array_value=[float(v) for v in value if isinstance(v, float | int)],
            )
        case list() | tuple():
            return ParameterValue(STRING_ARRAY, string_array_value=[*map(str, value)])
    return ParameterValue()
