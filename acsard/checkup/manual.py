"""Makes findings from the outcomes in `outcomes.py`, which hold all printed words.

A step names its outcome and gives the measured figures that go into the words.
"""

from __future__ import annotations

import re

from msgspec import Struct, convert

from acsard.checkup.findings import Finding, Verdict
from acsard.checkup.outcomes import OUTCOMES


class Unsure(Finding, frozen=True):
    """A finding that may be caused by the lateness of this computer, whatever the board does.

    `margin_s` is how far the measurement is beyond its bound. A smaller delay cannot have caused
    the finding.
    """

    margin_s: float = 0.0


class Outcome(Struct, frozen=True):
    """One outcome. `figure`, `text` and `mend` are templates for the measured values."""

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
    """Return the finding of this outcome with the measured values filled in.

    Args:
        outcome: a key of `MANUAL`; the part before the colon is the finding's name.
        keys: configuration values that the finding suggests.
        seen: the measured values. `name` replaces the name; `margin_s` is the margin of an
            `Unsure`.
    """
    entry = MANUAL[outcome]
    name = str(seen.get("name", outcome.partition(":")[0]))
    figure, text, mend = (s.format(**seen) for s in (entry.figure, entry.text, entry.mend))
    if not entry.unsure:
        return Finding(name, entry.verdict, figure, text, mend, keys or {})
    margin_s = float(str(seen.get("margin_s", 0.0)))
    return Unsure(name, entry.verdict, figure, text, mend, keys or {}, margin_s)


def plain(found: Finding) -> Finding:
    """Return the finding as it is reported, without its margin."""
    return Finding(*(getattr(found, name) for name in Finding.__struct_fields__))
