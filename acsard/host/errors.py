"""What goes wrong outside of us and a person can mend: each an `AcsardError`, and what Python
calls such a thing, so that either may be caught.

The text says what was wrong and what to do. What the command line ends with for each is in
`cli/exits.py`. What must not live here: bugs, and what is a state of the robot (a lost port, a
stale command).
"""

from __future__ import annotations

from acsard.values import AcsardError


class MendableError(AcsardError):
    """Base of them all."""


class UsageError(MendableError, ValueError):
    """What was asked for is not written as it must be, or does not exist."""


class UnreachableError(MendableError, ConnectionError):
    """Nobody listens at this endpoint."""


class NoAnswerError(MendableError, TimeoutError):
    """Somebody listens there, but nobody answers this."""


class ReplyError(MendableError, RuntimeError):
    """The answer is that it cannot be done, or none that can be read."""


class NotDrivenError(MendableError, RuntimeError):
    """The robot does not follow our commands; the text is the daemon's reason."""


class InUseError(MendableError, OSError):
    """Somebody else has the serial port, the bus address or the robot's id."""


class NoPortError(MendableError, FileNotFoundError):
    """There is no such serial port."""


class NotPermittedError(MendableError, PermissionError):
    """We may not read or open it."""


class RouterFileError(MendableError, ValueError):
    """The file of a router cannot be used."""


class CertificateError(MendableError, ValueError):
    """The certificates that the configuration names cannot be used."""


class RecordingError(MendableError, ValueError):
    """A file is no recording of acsard's, or cannot be lived again."""
