"""The one table from an error to the exit code of the process."""

from __future__ import annotations

from acsard.host.errors import (
    CertificateError,
    Exit,
    ExitError,
    InUseError,
    MendableError,
    NoAnswerError,
    NoPortError,
    NotDrivenError,
    NotPermittedError,
    RecordingError,
    ReplyError,
    RouterFileError,
    UnreachableError,
    UsageError,
)

CODES: dict[type[MendableError], Exit] = {
    ReplyError: Exit.FAILURE,
    NotDrivenError: Exit.FAILURE,
    RecordingError: Exit.FAILURE,
    UsageError: Exit.USAGE,
    NoPortError: Exit.NO_PORT,
    UnreachableError: Exit.UNREACHABLE,
    NoAnswerError: Exit.UNREACHABLE,
    InUseError: Exit.IN_USE,
    NotPermittedError: Exit.NO_PERMISSION,
    CertificateError: Exit.BAD_CONFIG,
    RouterFileError: Exit.BAD_CONFIG,
}


def code_of(error: MendableError) -> Exit:
    """Return the exit code of the process for this error."""
    return error.code if isinstance(error, ExitError) else CODES[type(error)]
