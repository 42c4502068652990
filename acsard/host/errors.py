"""Errors with an external cause that a person can fix, and the exit codes of acsard.

Most classes also derive from the built-in exception for the same case (`FileNotFoundError`), so a
caller may catch either. The text says what is wrong and how to fix it. Bugs have no class here, and
neither have states of the robot such as a lost port.
"""

from __future__ import annotations

from enum import IntEnum

import msgspec

from acsard.core.codes import Reason
from acsard.core.values import AcsardError

# Only the first one is documented.
MSGSPEC_ERRORS = msgspec.MsgspecError, UnicodeDecodeError, RecursionError


class Exit(IntEnum):
    """Exit codes of acsard. Those from 64 on follow sysexits.h."""

    OK = 0
    FAILURE = 1
    USAGE = 2
    INCOMPLETE = 65
    NO_PORT = 66
    UNREACHABLE = 69
    IN_USE = 75
    NO_PERMISSION = 77
    BAD_CONFIG = 78


class MendableError(AcsardError):
    """An error whose cause a person can fix. Its text says how."""

    code: Exit = Exit.FAILURE  # exit code of a subcommand that ends with this error

    def __init__(self, text: str, why: Reason | None = None) -> None:
        super().__init__(text)
        self.why = why  # the finding that its text says, if it has a code


class UsageError(MendableError, ValueError):
    """An argument has the wrong form, or names a thing that does not exist."""

    code = Exit.USAGE


class UnreachableError(MendableError, ConnectionError):
    """No daemon or router answers at the endpoint."""

    code = Exit.UNREACHABLE


class NoAnswerError(MendableError, TimeoutError):
    """A program accepts connections at the endpoint, but no daemon answers the query."""

    code = Exit.UNREACHABLE


class ReplyError(MendableError, RuntimeError):
    """The reply is a refusal or a failure, or it cannot be decoded."""


class NotDrivenError(MendableError, RuntimeError):
    """The robot does not follow this client's commands, for a reason that the text names."""


class InUseError(MendableError, OSError):
    """Another process uses the serial port, the bus address or the robot's id."""

    code = Exit.IN_USE


class NoPortError(MendableError, FileNotFoundError):
    """The serial port does not exist."""

    code = Exit.NO_PORT


class NotPermittedError(MendableError, PermissionError):
    """This process may not open a file or device, or the client's role lacks a permission."""

    code = Exit.NO_PERMISSION


class CertificateError(MendableError, ValueError):
    """A TLS certificate is missing or cannot be used."""

    code = Exit.BAD_CONFIG


class RecordingError(MendableError, ValueError):
    """A file is not a recording of acsard, or it cannot be replayed."""


class ExitError(MendableError):
    """Ends acsard with the exit code `code`; `text` says what is wrong and how to fix it."""

    def __init__(self, code: Exit, text: str) -> None:
        super().__init__(text)
        self.code = code
