"""The words of the daemon that refuse a query. The client says the same without asking."""

from __future__ import annotations

from collections.abc import Iterable

from acsard.core.config.nearest import hint
from acsard.core.messages.encodings import DecodeError
from acsard.core.messages.keys_and_roles import SERVICES
from acsard.core.messages.schema import ServiceReply
from acsard.core.values import Verb

MAX_COMMAND_BYTES = 4096  # a TwistStamped in JSON is shorter than 300

MAX_VERB_LENGTH = 40  # characters of an unknown verb in a reply

BUSY = "busy: too many queries at once; ask again"

BUSY_ENCODING = "text/plain;busy"  # by which a client knows the error reply `BUSY`


def require_size(verb: Verb, payload: bytes) -> None:
    """Raise `DecodeError` if the payload is too large; a service without one ignores any."""
    if SERVICES[verb].payload and len(payload) > MAX_COMMAND_BYTES:
        raise DecodeError("too_big", f"the payload has over {MAX_COMMAND_BYTES} bytes")


def invalid_call(verb: Verb, error: DecodeError) -> ServiceReply:
    """Return the reply to a service call whose payload is not valid."""
    return ServiceReply(False, f"{error}; send {SERVICES[verb].example}")


def not_offered(verb: str, services: Iterable[str]) -> str:
    """Return the words that refuse a call of a service that the robot does not have."""
    verb, known = verb[:MAX_VERB_LENGTH], list(services)
    why = hint(verb, known, f"its services are {', '.join(known)}")
    return f"{verb!r} is not a service of this robot; {why}"
