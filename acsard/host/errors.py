"""Errors with an external cause that a person can fix.

Each is an `AcsardError` and also the built-in exception that Python uses for such a case, so either
can be caught. The text says what is wrong and how to fix it. `cli/exits.py` maps them to exit
codes. Bugs are not among them, and neither are states of the robot, such as a lost port or a stale
command.
"""

from __future__ import annotations

from acsard.values import AcsardError


class MendableError(AcsardError):
    """Base class of these errors."""


class UsageError(MendableError, ValueError):
    """An argument is not written correctly, or names something that does not exist."""


class UnreachableError(MendableError, ConnectionError):
    """No process listens at this endpoint."""


class NoAnswerError(MendableError, TimeoutError):
    """A process listens at the endpoint, but no daemon answers this query."""


class ReplyError(MendableError, RuntimeError):
    """The reply is a failure, or it cannot be decoded."""


class NotDrivenError(MendableError, RuntimeError):
    """The robot does not follow this client's commands; the text is the daemon's reason."""


class InUseError(MendableError, OSError):
    """Another process uses the serial port, the bus address or the robot's id."""


class NoPortError(MendableError, FileNotFoundError):
    """The serial port does not exist."""


class NotPermittedError(MendableError, PermissionError):
    """This process is not permitted to read or open the file or device."""


class RouterFileError(MendableError, ValueError):
    """The configuration file of a router cannot be used."""


class CertificateError(MendableError, ValueError):
    """The certificates that the configuration names cannot be used."""


class RecordingError(MendableError, ValueError):
    """A file is not a recording of acsard, or it cannot be replayed."""
