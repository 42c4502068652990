"""The form of a table of findings: `code -> (level, text, advice)`.

An entry begins with `LEVEL code`, or with `LEVEL subject: outcome` for the code `subject_outcome`,
and maybe ` | figure`: a few words for a column, or the measured values. Its text follows, and
behind `->` the advice: what a person can do. All three are format strings. A text may end with ":",
which then stands between text and advice where both make one sentence; otherwise ";" does.
"""

from __future__ import annotations

import re
from typing import Literal, get_args

from msgspec import Struct

Level = Literal["ok", "warning", "failure"]
# Mild to severe; the index is the number in ROS diagnostics.
LEVELS: tuple[Level, ...] = ("ok", "warning", "failure")

_LEVEL_OF: dict[str, Level] = {
    "OK": "ok", "PASS": "ok", "SKIPPED": "ok", "WARN": "warning", "FAIL": "failure",
}  # fmt: skip


class Entry(Struct, frozen=True):
    """The texts of a code, "" if it has none.

    `mark` is the first word of its head, and `subject` what it is about. `unsure` says whether a
    computer that runs a check too late can cause this outcome: a "?" behind the mark.
    """

    level: Level
    mark: str
    unsure: bool
    subject: str
    figure: str
    text: str
    joint: str
    advice: str


def code_of(name: str) -> str:
    """Return the code of an entry, such as "port_missing" for "port: missing"."""
    return re.sub(r"\W+", "_", name).lower()


# Of a code without an entry, which stops no robot; a test fails.
NO_TEXT = "this version of acsard has no text for this code"


def table(codes: object, text: str) -> dict[str, Entry]:
    """Return the entries by code. `codes` is the `Literal` of their names."""
    entries = {}
    for entry in re.split(r"\n+(?! )", text.strip()):
        head, *rest = entry.splitlines()
        mark, _, head = head.partition(" ")
        name, _, figure = head.partition(" | ")
        subject = name.partition(":")[0]
        words, _, advice = " ".join(line.strip() for line in rest).partition("-> ")
        text, mark, unsure = words.strip(), mark.rstrip("?"), mark.endswith("?")
        entries[code_of(name)] = Entry(
            _LEVEL_OF[mark], mark, unsure, subject, figure,
            text.removesuffix(":"), ":" if text.endswith(":") else ";", advice,
        )  # fmt: skip
    for code in set(map(code_of, get_args(codes))) - entries.keys():
        entries[code] = Entry("failure", "FAIL", False, code, "", NO_TEXT, ";", "")
    return entries
