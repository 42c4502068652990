"""A finding of `acsard doctor`."""

from __future__ import annotations

from msgspec import Struct

from acsard.core.codes import CODES, Code, Reason, reason
from acsard.core.tables.finding_table import Level


class Finding(Struct, frozen=True):
    """One result of `acsard doctor`, with advice in `mend` if any is needed."""

    subject: str
    code: str
    level: Level
    text: str
    mend: str = ""


def finding(code: Code, **values: object) -> Finding:
    """Return the finding of a code about the subject of its entry."""
    return about(CODES[code].subject, reason(code, **values))


def about(subject: str, why: Reason) -> Finding:
    return Finding(subject, why.code, why.level, why.text, why.advice)
