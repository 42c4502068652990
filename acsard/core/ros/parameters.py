"""Offers the configuration as ROS parameters, for `ros2 param` and `rqt_reconfigure`.

A parameter has the dotted key in `acsard.toml`, and description and range of
`core/config/settings.py`. Those of `core/config/live.py` can be set; requests are decoded here, and
`core/robot.py` accepts or refuses them. The structs are types of rcl_interfaces.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from contextlib import suppress
from functools import cache
from typing import Annotated, TypeVar

from msgspec import Meta, Struct, inspect
from msgspec.structs import fields

from acsard.core.config.live import WHEN_TEXTS, find_live_setting, flat
from acsard.core.config.settings import Config
from acsard.core.config.validation import expected
from acsard.core.messages.cdr import Cdr, CdrError
from acsard.core.values import Plain

Unsigned8 = Annotated[int, Meta(extra={"cdr": "B"})]
Signed64 = Annotated[int, Meta(extra={"cdr": "q"})]
Unsigned64 = Annotated[int, Meta(extra={"cdr": "Q"})]


class FloatingPointRange(Struct, frozen=True):
    """Allowed range of a parameter that is a float."""

    from_value: float
    to_value: float
    step: float


class IntegerRange(Struct, frozen=True):
    """Allowed range of a parameter that is an integer."""

    from_value: Signed64
    to_value: Signed64
    step: Unsigned64


class ParameterDescriptor(Struct, frozen=True):
    """Type, description and range of a parameter, as `ros2 param describe` shows them."""

    name: str
    type: Unsigned8
    description: str = ""
    additional_constraints: str = ""
    read_only: bool = True
    dynamic_typing: bool = False
    floating_point_range: list[FloatingPointRange] = []
    integer_range: list[IntegerRange] = []


def described(name: str, type_of: int) -> ParameterDescriptor:
    """Return the descriptor of a parameter; `type_of` is its ROS type, or 0 if it is missing."""
    if not type_of:
        return ParameterDescriptor(name, type_of)
    return _described(name, type_of)


# The cache stays small, because only about a hundred names exist.
@cache
def _described(name: str, type_of: int) -> ParameterDescriptor:
    kind, row = kind_of(name), find_live_setting(name)
    words = expected(kind)
    bounds = kind.type if isinstance(kind, inspect.Metadata) else kind
    floats, whole = [], []
    match bounds:
        case inspect.FloatType(ge=float(low), le=float(high)):
            floats = [FloatingPointRange(low, high, 0.0)]
        case inspect.IntType(ge=int(low), le=int(high)):
            whole = [IntegerRange(low, high, 1)]
    return ParameterDescriptor(
        name,
        type_of,
        words if row is None else f"{row.what}: {words}",
        "change it in acsard.toml, then restart the daemon"
        if row is None
        else WHEN_TEXTS[row.when],
        read_only=row is None,
        floating_point_range=floats,
        integer_range=whole,
    )


def kind_of(name: str) -> inspect.Type:
    """Return the declared type of a setting by its dotted key. Raises `KeyError` for a table.

    The key of a command source has its name, as in `commands.sources.app.timeout`.
    """
    cls: type[Struct] = Config
    parts = iter(name.split("."))
    for part in parts:
        (field,) = (field for field in fields(cls) if field.encode_name == part)
        kind = inspect.type_info(field.type)
        if isinstance(kind, inspect.VarTupleType) and isinstance(
            kind.item_type, inspect.StructType
        ):
            # Without a source, the configuration has the empty list itself as a setting.
            if next(parts, None) is None:
                return kind
            kind = kind.item_type
        if not isinstance(kind, inspect.StructType):
            return kind
        cls = kind.cls
    raise KeyError(name)


T = TypeVar("T")
# Parameters of a request to set: decoding more would take too much of a control step.
ParameterList = Annotated[list[T], Meta(max_length=128)]
NameList = Annotated[list[T], Meta(max_length=256)]  # of names, which are decoded faster

MAX_REQUEST_BYTES = 16384  # with the names of all parameters, it is smaller

NOT_SET, BOOL, INTEGER, DOUBLE, STRING = range(5)
STRING_ARRAY = 9

SEPARATOR = "."

Q = TypeVar("Q")


class ParameterValue(Struct, frozen=True):
    """Value of a parameter, in the field that `type` says."""

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
    """A parameter with its value."""

    name: str
    value: ParameterValue


class SetParametersResult(Struct, frozen=True):
    """Result of setting a parameter, with the reason if it failed."""

    successful: bool
    reason: str


class ListRequest(Struct, frozen=True):
    prefixes: NameList[str]  # all names without any
    depth: Unsigned64  # parts after the prefix; 0 is any number


class ListReply(Struct, frozen=True):
    """Reply of `list_parameters`; `prefixes` are the parts before a last dot."""

    names: list[str]
    prefixes: list[str]


class Names(Struct, frozen=True):
    """Request with names of parameters."""

    names: NameList[str]


class Values(Struct, frozen=True):
    """Reply of `get_parameters`: the value of each requested parameter, in order."""

    values: list[ParameterValue]


class Types(Struct, frozen=True):
    """Reply of `get_parameter_types`: the ROS type of each requested parameter, in order."""

    types: list[Unsigned8]


class Descriptors(Struct, frozen=True):
    """Reply of `describe_parameters`: the descriptor of each requested parameter, in order."""

    descriptors: list[ParameterDescriptor]


class SetRequest(Struct, frozen=True):
    """Request of `set_parameters` and of `set_parameters_atomically`."""

    parameters: ParameterList[Parameter]


class SetReply(Struct, frozen=True):
    """Reply of `set_parameters`, with one result for each parameter."""

    results: list[SetParametersResult]


class SetAtomicallyReply(Struct, frozen=True):
    """Reply of `set_parameters_atomically`, with one result for all parameters."""

    result: SetParametersResult


# Not answered by `Parameters.answer`.
SETTING_SERVICES = ("set_parameters", "set_parameters_atomically")


def failure(service: str, why: str, request: bytes) -> bytes:
    """Return the reply to a refused request, in CDR: without one, the client would wait forever.

    Only `SETTING_SERVICES` have the reason; other replies are empty, as in rclcpp.
    """
    if service in SETTING_SERVICES:
        with suppress(CdrError):
            return outcome(service, request, successful=False, reason=why)
    replies: dict[str, Struct] = {
        "list_parameters": ListReply([], []),
        "get_parameters": Values([]),
        "get_parameter_types": Types([]),
        "describe_parameters": Descriptors([]),
        # The number of parameters in a damaged request is not known.
        "set_parameters": SetReply([SetParametersResult(False, why)]),
    }
    reply = replies[service]
    return Cdr(type(reply)).encode(reply)


class Parameters:
    """Answers the services that only read parameters, by the `effective()` tables."""

    def __init__(self, tables: Mapping[str, object]) -> None:
        self._values = {name: _value(value) for name, value in flat(tables)}
        self._services: dict[str, Callable[[bytes], bytes]] = {
            "list_parameters": _service(ListRequest, self._list),
            "get_parameters": _service(Names, self._get),
            "get_parameter_types": _service(Names, self._types),
            "describe_parameters": _service(Names, self._describe),
        }

    def answer(self, service: str, payload: bytes) -> bytes:
        """Return the reply to a request, both in CDR. Raises `CdrError`."""
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
        return Descriptors([described(name, value.type) for name, value in self._of(asked)])


def requested_values(payload: bytes) -> dict[str, Plain]:
    """Return the new values in a request to set. Raises `CdrError`, also for a repetition."""
    asked = Cdr(SetRequest).decode(payload)
    wishes: dict[str, Plain] = {}
    for parameter in asked.parameters:
        if parameter.name in wishes:
            raise CdrError(f"{parameter.name} is in the request twice; nothing was set")
        wishes[parameter.name] = _plain(parameter)
    return wishes


def outcome(service: str, payload: bytes, successful: bool, reason: str) -> bytes:
    """Return the reply to a request to set, in CDR: all get the same result.

    Raises `CdrError` for an invalid `set_parameters`.
    """
    result = SetParametersResult(successful, reason)
    if service == "set_parameters_atomically":
        return Cdr(SetAtomicallyReply).encode(SetAtomicallyReply(result))
    asked = Cdr(SetRequest).decode(payload)
    return Cdr(SetReply).encode(SetReply([result] * len(asked.parameters)))


def _plain(parameter: Parameter) -> Plain:
    value = parameter.value
    fields: dict[int, Plain] = {
        BOOL: value.bool_value,
        INTEGER: value.integer_value,
        DOUBLE: value.double_value,
        STRING: value.string_value,
        STRING_ARRAY: [*value.string_array_value],
    }
    if value.type not in fields:
        raise CdrError(f"{parameter.name}: no setting can have a value of this type")
    return fields[value.type]


def _service(request: type[Q], reply: Callable[[Q], Struct]) -> Callable[[bytes], bytes]:
    asked = Cdr(request)

    def serve(payload: bytes) -> bytes:
        answer = reply(asked.decode(payload))
        return Cdr(type(answer)).encode(answer)

    return serve


def _below(name: str, prefix: str, depth: int) -> bool:
    rest = name.removeprefix(prefix + SEPARATOR)
    return name == prefix or (rest != name and (not depth or rest.count(SEPARATOR) < depth))


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
        case list() | tuple():
            return ParameterValue(STRING_ARRAY, string_array_value=[*map(str, value)])
    return ParameterValue()
