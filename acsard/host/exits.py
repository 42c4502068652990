"""Why acsard ends, as exit codes after sysexits.h, and the error of a verb that ends with one.

What others may import raises the errors of `errors.py` instead; `cli/exits.py` has their codes.
"""

from __future__ import annotations

from enum import IntEnum

from acsard.host.errors import MendableError


class Exit(IntEnum):
    OK = 0
    FAILURE = 1
    USAGE = 2
    NO_PORT = 66
    UNREACHABLE = 69
    IN_USE = 75
    NO_PERMISSION = 77
    BAD_CONFIG = 78


WORDS: dict[int, str] = {
    Exit.OK: "done",
    Exit.FAILURE: "failure",
    Exit.USAGE: "usage",
    Exit.NO_PORT: "no such port",
    Exit.UNREACHABLE: "daemon unreachable",
    Exit.IN_USE: "port, bus address or robot id in use",
    Exit.NO_PERMISSION: "no permission",
    Exit.BAD_CONFIG: "bad configuration",
}
"""What a code means, for people."""


class ExitError(MendableError):
    """Ends the program with `code`; the text says what was wrong and what to do."""

    def __init__(self, code: Exit, text: str) -> None:
        super().__init__(text)
        self.code = code
