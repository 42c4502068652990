"""The robot's services in the form that viewers call: JSON, with the daemon's own replies."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

import foxglove
import msgspec

from acsard.client import Client
from acsard.core.config.settings import RosConfig
from acsard.core.messages.encodings import DecodeError, Decoder, encode
from acsard.core.messages.json_schema import SCHEMAS
from acsard.core.messages.schema import MESSAGES, ServiceReply
from acsard.core.messages.topics import PLAIN_SERVICES, SERVICES
from acsard.core.ros.names import full_name
from acsard.core.values import AcsardError, Verb

CALLED: tuple[Verb, ...] = tuple(verb for verb in SERVICES if verb != "set")
"""Services that are offered; `set` is left out because viewers set parameters instead."""

STOPS: tuple[Verb, ...] = ("stop",)
"""Services that are offered without `--drive`. Any web page in a local browser can connect, and the
browser does not identify the page, so only a stop is safe."""

NOTHING = {"type": "object", "title": "std_srvs/srv/Trigger_Request", "properties": {}}


def services(robot: Client, ros: RosConfig, verbs: Iterable[Verb]) -> list[foxglove.Service]:
    """Return these services of the robot under their ROS names, for example `/acsard/stop`."""
    return [_service(robot, verb, full_name(ros.namespace, f"{ros.node}/{verb}")) for verb in verbs]


def _service(robot: Client, verb: Verb, name: str) -> foxglove.Service:
    payload = "" if verb in PLAIN_SERVICES else SERVICES[verb].payload

    def answer(request: foxglove.ServiceRequest) -> bytes:
        return encode(called(robot, verb, request.payload), "json")

    schema = foxglove.ServiceSchema(
        f"acsard/srv/{payload}" if payload else "std_srvs/srv/Trigger",
        request=_schema(SCHEMAS[payload] if payload else NOTHING),
        response=_schema(SCHEMAS["ServiceReply"]),
    )
    return foxglove.Service(name, schema=schema, handler=answer)


def called(robot: Client, verb: Verb, payload: bytes) -> ServiceReply:
    """Call a service. An error becomes a negative reply."""
    try:
        fields: dict[str, float] = {}
        if verb not in PLAIN_SERVICES:
            decoder = Decoder(MESSAGES[SERVICES[verb].payload])
            fields = msgspec.structs.asdict(decoder.decode("application/json", payload))
        return robot.call(verb, **fields)
    except DecodeError as error:
        return ServiceReply(False, f"{verb} needs a payload like {SERVICES[verb].example}: {error}")
    except AcsardError as error:
        return ServiceReply(False, str(error))


def _schema(schema: dict[str, Any]) -> foxglove.MessageSchema:
    data = msgspec.json.encode(schema)
    return foxglove.MessageSchema(
        encoding="json",
        schema=foxglove.Schema(name=schema["title"], encoding="jsonschema", data=data),
    )
