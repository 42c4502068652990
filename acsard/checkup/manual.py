"""All that the check can say, as it is printed: what each outcome of a step means, and its mend.

A step looks, and names the outcome with the figures that belong to it; the words are those of
`outcomes.py`.
"""

from __future__ import annotations

import re

from msgspec import Struct, convert

from acsard.checkup.findings import Finding, Verdict
from acsard.checkup.outcomes import OUTCOMES


class Unsure(Finding, frozen=True):
    """A finding that a computer which is late can make, whatever the board does.

    `margin_s` is by how much it is beyond its bound: one that is less late cannot have made it.
    """

    margin_s: float = 0.0


class Outcome(Struct, frozen=True):
    """One entry: `figure`, `text` and `mend` take what was seen in braces."""

    verdict: Verdict
    unsure: bool
    figure: str
    text: str
    mend: str


def _read(manual: str) -> dict[str, Outcome]:
    found = {}
    for entry in re.split(r"\n+(?! )", manual.strip()):
        head, *rest = entry.splitlines()
        verdict, _, head = head.partition(" ")
        outcome, _, figure = head.partition(" | ")
        text, _, mend = " ".join(line.strip() for line in rest).partition("-> ")
        parts = {"verdict": verdict.rstrip("?"), "unsure": verdict.endswith("?"), "figure": figure}
        found[outcome] = convert(parts | {"text": text.strip(), "mend": mend}, Outcome)
    return found


MANUAL = _read(OUTCOMES)


def find(outcome: str, keys: dict[str, object] | None = None, **seen: object) -> Finding:
    """The finding of this outcome, with what was seen; it bears the name of the step, or `name`,
    and has the margin `margin_s` where a late computer can make it."""
    entry = MANUAL[outcome]
    name = str(seen.get("name", outcome.partition(":")[0]))
    figure, text, mend = (s.format(**seen) for s in (entry.figure, entry.text, entry.mend))
    if not entry.unsure:
        return Finding(name, entry.verdict, figure, text, mend, keys or {})
    margin_s = float(str(seen.get("margin_s", 0.0)))
    return Unsure(name, entry.verdict, figure, text, mend, keys or {}, margin_s)


def plain(found: Finding) -> Finding:
    """As it is told: without what it needs to be doubted."""
    return Finding(*(getattr(found, name) for name in Finding.__struct_fields__))
