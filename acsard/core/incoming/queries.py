"""Answers queries from the bus, or turns them into a `Request` to the robot if they call a service.

Only a query for exactly its key calls a service: a get on `<id>/**` must never stop the robot or
clear a latch. Other keys may be queried with a wildcard.
"""

from __future__ import annotations

from collections.abc import Callable

from msgspec import Struct
from msgspec.structs import replace

from acsard.core.config.parsing import effective
from acsard.core.config.settings import Config
from acsard.core.incoming.commands import Receiver, Via, caller_name
from acsard.core.messages.cdr import CdrError
from acsard.core.messages.encodings import (
    FORMATS,
    DecodeError,
    Format,
    detect,
    encode,
    encoding_name,
)
from acsard.core.messages.json_schema import SCHEMAS
from acsard.core.messages.keys_and_roles import (
    JSON_TREE,
    PUBLISHED,
    SERVICES,
    VERBS,
    WHOAMI,
    full_key,
    is_service,
    offered,
    service_key,
    whoami_key,
)
from acsard.core.messages.refusals import MAX_COMMAND_BYTES, invalid_call, not_offered
from acsard.core.messages.schema import (
    MESSAGES,
    Change,
    HardwareInterface,
    Info,
    Interfaces,
    Message,
    ReplyData,
    ServiceReply,
    TopicInfo,
    Topics,
    WhoAmI,
)
from acsard.core.ros.attachments import Attachment, unpack
from acsard.core.ros.parameters import (
    MAX_REQUEST_BYTES,
    SETTING_SERVICES,
    Parameters,
    failure,
    outcome,
    requested_values,
)
from acsard.core.ros.shapes import Trigger
from acsard.core.ros.transports import PARAMETERS_PREFIX, unused_keys
from acsard.core.values import ROLES, Answer, Ns, Request, Status, WallNs

Current = Callable[[str], Message | None]


class Query(Struct, frozen=True):
    """A query as Zenoh delivered it."""

    ticket: int  # number, which each reply has
    topic: str  # the daemon's key that matches, or "schema/<Type>"
    asked: str  # key expression, without exactly `acsard/<id>/`
    fmt: str  # parameter for the encoding of the reply
    payload: bytes
    encoding: str
    arrived_ns: Ns | None = None  # arrival
    via: Via = "native"
    attachment: bytes = b""


class Reply(Struct, frozen=True):
    """A reply to a query."""

    ticket: int
    key: str
    payload: bytes
    encoding: str
    ok: bool = True  # False: an error reply of Zenoh
    attachment: bytes = b""


class _Waiting(Struct, frozen=True):
    # A service call that waits for the answer of the robot.
    key: str
    form: Format  # of the reply
    asked: Attachment | None  # of rmw_zenoh, for the reply's attachment
    wish: bytes = b""  # ROS request to set parameters, for the reply


class Queries:
    """Answers queries by constants or the newest messages; makes requests of service calls."""

    def __init__(self, config: Config, info: Info) -> None:
        self.config = config  # in force
        self._fixed: dict[str, object] = {"info": info, "topics": topic_table(config)}
        self._parameters: Parameters | None = None  # of `_parameters_of`
        self._parameters_of = config
        self._waiting: dict[int, _Waiting] = {}

    def serve(
        self, query: Query, current: Current, wall_ns: WallNs, status: Status
    ) -> list[Reply] | Request:
        """Return the replies to a query (maybe none), or the `Request` of a service call.

        Raises `DecodeError` for a ROS request, which the caller answers with `refused`.
        """
        if query.via != "native":
            return self._ros(query, wall_ns)
        try:
            form = _format(query)
            if query.topic in VERBS:
                return self._service(query, form)
            if is_service(query.topic):
                return [_unknown_service(query, form)]
            return [
                Reply(query.ticket, key, encode(value, form), encoding_name(form, name))
                for key, name, value in self._values(query, current, status)
            ]
        except DecodeError as error:
            words = str(error).encode()
            return [Reply(query.ticket, query.topic, words, "text/plain", ok=False)]

    def answered(self, answer: Answer, wall_ns: WallNs) -> Reply | None:
        """Return the reply with the robot's answer to a service call, or None if none waits."""
        waiting = self._waiting.pop(answer.id, None)
        if waiting is None:
            return None
        key, form, message, name = waiting.key, waiting.form, answer.message, "ServiceReply"
        if waiting.wish:
            service, name = key.removeprefix(PARAMETERS_PREFIX), ""
            payload = outcome(service, waiting.wish, answer.success, message)
        else:
            payload = _encoded(ServiceReply(answer.success, message, _data(answer)), form)
        attachment = _echo(waiting.asked, wall_ns)
        return Reply(answer.id, key, payload, encoding_name(form, name), attachment=attachment)

    def _ros(self, query: Query, wall_ns: WallNs) -> list[Reply] | Request:
        asked = unpack(query.attachment) if query.via == "rmw" else None
        by = caller_name(query.via, query.attachment)
        verb = VERBS.get(query.topic)
        if verb is not None:
            self._waiting[query.ticket] = _Waiting(query.topic, "cdr", asked)
            return Request(verb, query.ticket, asked_ns=query.arrived_ns, by=by)
        if len(query.payload) > MAX_REQUEST_BYTES:
            raise DecodeError("too_big", f"the request has over {MAX_REQUEST_BYTES} bytes")
        try:
            service = query.topic.removeprefix(PARAMETERS_PREFIX)
            if service in SETTING_SERVICES:
                wish = requested_values(query.payload)
                self._waiting[query.ticket] = _Waiting(query.topic, "cdr", asked, query.payload)
                ticket, at_ns = query.ticket, query.arrived_ns
                return Request("set", ticket, asked_ns=at_ns, by=by, settings=wish)
            payload = self._in_force().answer(service, query.payload)
        except CdrError as error:
            raise DecodeError("malformed", str(error)) from None
        attachment, encoding = _echo(asked, wall_ns), encoding_name("cdr")
        return [Reply(query.ticket, query.topic, payload, encoding, attachment=attachment)]

    def _in_force(self) -> Parameters:
        # Not made by a `set`: it takes as long as the rest of its step.
        if self._parameters is None or self._parameters_of is not self.config:
            self._parameters, self._parameters_of = Parameters(effective(self.config)), self.config
        return self._parameters

    def _service(self, query: Query, form: Format) -> list[Reply] | Request:
        if query.asked != query.topic:
            return []
        try:
            request = Receiver.request(
                VERBS[query.topic],
                query.ticket,
                query.encoding,
                query.payload,
                query.arrived_ns,
            )
        except DecodeError as error:
            message = invalid_call(VERBS[query.topic], error)
            payload, name = _encoded(message, form), encoding_name(form, "ServiceReply")
            return [Reply(query.ticket, query.topic, payload, name)]
        self._waiting[query.ticket] = _Waiting(query.topic, form, None)
        return replace(request, by=caller_name(query.via, query.attachment))

    def _values(
        self, query: Query, current: Current, status: Status
    ) -> list[tuple[str, str, object]]:
        topic = query.topic
        if topic == "schema/<Type>":
            keys = {f"schema/{name}": value for name, value in SCHEMAS.items()}
            # Zenoh sends only the replies whose key the wildcard includes.
            asked = keys if "*" in query.asked else keys.keys() & {query.asked}
            return [(key, "", keys[key]) for key in asked]
        if topic == WHOAMI:
            roles = [role for role in ROLES if whoami_key(role) == query.asked]
            by = caller_name(query.via, query.attachment)
            return [(query.asked, "WhoAmI", WhoAmI(role, by)) for role in roles]
        if topic == "interfaces":
            return [(topic, "Interfaces", interfaces(self.config, status))]
        if topic == "config":
            return [(topic, "", effective(self.config))]
        if topic in self._fixed:
            value = self._fixed[topic]
            return [(topic, type(value).__name__ if isinstance(value, Message) else "", value)]
        value = current(topic.removeprefix(JSON_TREE))
        return [] if value is None else [(topic, type(value).__name__, value)]


def refused(query: Query, why: str, wall_ns: WallNs, encoding: str = "text/plain") -> Reply | None:
    """Return the reply that refuses a query, or None if the client could not read any.

    A ROS client receives no error replies of Zenoh, so it gets a response that says that the call
    failed.
    """
    if query.via == "native":
        return Reply(query.ticket, query.topic, why.encode(), encoding, ok=False)
    try:
        asked = unpack(query.attachment) if query.via == "rmw" else None
    except DecodeError:
        return None
    if query.topic in VERBS:
        payload, name = _encoded(ServiceReply(False, why), "cdr"), "ServiceReply"
    else:
        payload, name = failure(query.topic.removeprefix(PARAMETERS_PREFIX), why, query.payload), ""
    cdr, attachment = encoding_name("cdr", name), _echo(asked, wall_ns)
    return Reply(query.ticket, query.topic, payload, cdr, attachment=attachment)


def _unknown_service(query: Query, form: Format) -> Reply:
    verb = query.topic.removeprefix(service_key(""))
    reply = ServiceReply(False, not_offered(verb, SERVICES))
    payload, name = _encoded(reply, form), encoding_name(form, "ServiceReply")
    return Reply(query.ticket, query.topic, payload, name)


def _encoded(reply: ServiceReply, form: Format) -> bytes:
    return encode(Trigger(reply.success, reply.message) if form == "cdr" else reply, form)


def _data(answer: Answer) -> ReplyData:
    changes = {key: Change(old, new) for key, (old, new) in answer.changes.items()}
    return ReplyData(list(answer.numbers), changes, answer.loan)


def most_bytes(topic: str) -> int:
    """Return the largest payload of a query for a key, bytes."""
    return MAX_REQUEST_BYTES if topic.startswith(PARAMETERS_PREFIX) else MAX_COMMAND_BYTES


def _echo(asked: Attachment | None, wall_ns: WallNs) -> bytes:
    # rmw_zenoh matches a reply with its request by this.
    return b"" if asked is None else Attachment(asked.sequence, wall_ns, asked.gid).pack()


def _format(query: Query) -> Format:
    for form in FORMATS:
        if query.fmt == form:
            return form
    if query.fmt:
        raise DecodeError(
            "unknown_format", f"fmt={query.fmt}: write fmt=json, fmt=msgpack or fmt=cdr"
        )
    if is_service(query.topic) and query.payload:
        try:
            return detect(query.encoding, query.payload)
        except DecodeError:
            pass  # a service that needs no payload ignores a payload that cannot be decoded
    return "json"


def offered_services() -> dict[str, list[str]]:
    """Return the services of a daemon of this version, with the fields of their payloads."""
    return {
        verb: list(MESSAGES[service.payload].__struct_fields__) if service.payload else []
        for verb, service in SERVICES.items()
    }


def topic_table(config: Config) -> Topics:
    """Return the daemon's keys, as full keys, without those on which it never sends."""
    robot, silent = config.robot.id, unused_keys(config)
    return Topics(
        [
            TopicInfo(full_key(robot, t.key), t.direction, t.type, t.rate, t.note)
            for t in offered(config)
            if t.direction != "out" or t.key not in silent
        ]
    )


def interfaces(config: Config, status: Status) -> Interfaces:
    """Return the command and state interfaces of the joints, named as in ros2_control."""
    linked, claimed = status.link == "up", status.mode == "driving"
    joints = config.joint_names
    return Interfaces(
        [HardwareInterface(f"{j}/velocity", "command", "rad/s", linked, claimed) for j in joints]
        + [
            HardwareInterface(f"{j}/{name}", "state", unit, linked, False)
            for j in joints
            for name, unit in (("position", "rad"), ("velocity", "rad/s"))
        ]
    )


assert all(topic.type in MESSAGES for topic in PUBLISHED)
