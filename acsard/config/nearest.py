"""What was probably meant by a word that nothing is called."""

from __future__ import annotations

import difflib
from collections.abc import Iterable

LONGEST = 80
"""Characters of a word that are looked at; a stranger's may be any."""


def nearest(word: str, known: Iterable[str]) -> list[str]:
    """The known word that is like it, or none."""
    return difflib.get_close_matches(word[:LONGEST], list(known), n=1, cutoff=0.6)


def hint(word: str, known: Iterable[str], otherwise: str) -> str:
    """The same as a question, or what helps where nothing is like it."""
    near = nearest(word, known)
    return f"did you mean {near[0]}?" if near else otherwise
