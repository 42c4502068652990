"""The exit codes of acsard, after sysexits.h, and an error that ends a verb with one of them.

Modules that other programs may import raise the errors of `errors.py` instead; `cli/exits.py` has
their exit codes.
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
"""Meaning of each exit code, for people."""


class ExitError(MendableError):
    """Ends the program with exit code `code`; the text says what is wrong and how to fix it."""

    def __init__(self, code: Exit, text: str) -> None:
        super().__init__(text)
        self.code = code
