"""Drive and follow a robot from Python.

    from acsard.client import connect

    with connect() as robot:
        robot.drive(0.5, 0.0, seconds=2.0)
        print(robot.pose())

`connect` is for scripts, `connect_async` for asyncio programs; both give the same verbs and typed
messages (`acsard.messages.schema`). Commands are signed, numbered and stamped, and each drive opens
with zeros, so the daemon's staleness and neutral-first rules are met without thinking of them. A
drive that the robot does not follow is an error, and one that returns has come to a stand.

Where you do not say which robot you mean, the file does that ACSARD_CONFIG names, as for the
command line (`bus.listen`, `robot.id`, `bus.tls`); without that variable it is `acsar` on this
machine. A file in the current directory is not looked for: a program means the same robot wherever
it runs.

Errors are `AcsardError`s and mostly what Python calls such a thing too; their text says what to do:

    UnreachableError   ConnectionError  nobody listens at the endpoint
    NoAnswerError      TimeoutError     no robot of this id there, no such key, or you may not ask
    ReplyError         RuntimeError     the daemon answers that it cannot; a service that refuses
                                        says so in its reply instead
    NotDrivenError   RuntimeError     the robot does not follow your drive: stopped, in fault,
                                        behind somebody else, not allowed; the text says which
    NotPermittedError  PermissionError  your certificate may not do this, or you not read its files
    CertificateError   ValueError       certificates that are not there, or cannot be used
    UsageError         ValueError       an endpoint, an id, a key or a number that cannot be, or the
                                        file that ACSARD_CONFIG names
    DecodeError                         what was sent is not one of our messages
"""

from acsard.bus.identity import Identity
from acsard.bus.subscription import Subscription
from acsard.client.asynchronous import AsyncClient
from acsard.client.connecting import connect, connect_async
from acsard.client.synchronous import Client
from acsard.host.errors import (
    CertificateError,
    NoAnswerError,
    NotDrivenError,
    NotPermittedError,
    ReplyError,
    UnreachableError,
    UsageError,
)
from acsard.messages.encodings import DecodeError
from acsard.values import AcsardError, Pose

__all__ = (
    "AcsardError",
    "AsyncClient",
    "CertificateError",
    "Client",
    "DecodeError",
    "Identity",
    "NoAnswerError",
    "NotDrivenError",
    "NotPermittedError",
    "Pose",
    "ReplyError",
    "Subscription",
    "UnreachableError",
    "UsageError",
    "connect",
    "connect_async",
)
