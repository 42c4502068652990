"""Drive a robot and receive its messages, from Python.

    from acsard.client import connect

    with connect() as robot:
        robot.move(1.0)
        robot.turn(90)
        for odom in robot.messages("odom", timeout=1.0):
            print(odom.time, odom.yaw)

`connect` is for scripts and `connect_async` for asyncio programs. Both offer the same methods and
typed messages (`acsard.core.messages.schema`): `mypy --strict` finds a wrong key or field. The
daemon refuses late commands, and requires a zero (a command with the speed 0) from each sender
before that sender may move the robot. The client follows these rules: each command has its sender,
a number and the newest beat of the daemon, and zeros come before each drive.
When the `with` block ends, even with an exception, the client sends zeros until the robot stands,
for up to 2 s, if its last command was not zero. `drive`, `move` and `turn` raise an error if the
robot does not follow the commands. When they return, the robot stands still, unless something else
moves it.

If you leave out an argument, its value comes from the configuration file that the environment
variable ACSARD_CONFIG names (`bus.listen`, `robot.id`, `bus.tls`). Without that variable, the
client connects to the robot `acsar` on this machine. Unlike the command line, the client ignores an
`acsard.toml` in the current directory, so a program reaches the same robot wherever it is started.

All errors are `AcsardError`s, and most are also the built-in exception in the second column. The
text of an error says what to do:

    UnreachableError   ConnectionError  no daemon listens at the endpoint
    NoAnswerError      TimeoutError     the robot does not exist or is stuck, or you may not query
                                        the key
    ReplyError         RuntimeError     the robot refuses a `call`, `set`, `stop` or `clear`, or
                                        the daemon reports a failure
    NotDrivenError     RuntimeError     the robot does not follow your commands: it is stopped or in
                                        fault, another client drives it, or your role may not drive;
                                        or your program sent no command for 0.5 s, because it was
                                        suspended or the network failed; the text names the causes
    NotPermittedError  PermissionError  your certificate does not allow this, or you may not read
                                        its files
    CertificateError   ValueError       the certificates do not exist or cannot be used
    UsageError         ValueError       an endpoint, id or number is not valid, a key does not
                                        exist (the text has the near name), or the
                                        file that ACSARD_CONFIG names is not valid
    DecodeError                         a payload is not a message of acsard
"""

from typing import TYPE_CHECKING

from acsard.client.identity import ClientIdentity
from acsard.client.synchronous import Client, connect
from acsard.core.messages.encodings import DecodeError
from acsard.core.values import AcsardError, Pose
from acsard.host.errors import (
    CertificateError,
    NoAnswerError,
    NotDrivenError,
    NotPermittedError,
    ReplyError,
    UnreachableError,
    UsageError,
)

if TYPE_CHECKING:
    from acsard.client.asynchronous import AsyncClient, connect_async

__all__ = (
    "AcsardError",
    "AsyncClient",
    "CertificateError",
    "Client",
    "ClientIdentity",
    "DecodeError",
    "NoAnswerError",
    "NotDrivenError",
    "NotPermittedError",
    "Pose",
    "ReplyError",
    "UnreachableError",
    "UsageError",
    "connect",
    "connect_async",
)


def __getattr__(name: str) -> object:
    # asyncio loads for 10 ms, which a program without it does not wait for.
    if name not in ("AsyncClient", "connect_async"):
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
    from acsard.client import asynchronous

    return getattr(asynchronous, name)
