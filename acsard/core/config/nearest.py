"""Suggests the known word that a user probably meant."""

from __future__ import annotations

from collections.abc import Iterable

MAX_COMPARED_LENGTH = 80  # characters of a mistyped word, so that a long one takes a short time


def nearest(word: str, known: Iterable[str]) -> list[str]:
    """Return the known word that is most similar, in a list, or []."""
    import difflib  # most words are right

    return difflib.get_close_matches(word[:MAX_COMPARED_LENGTH], list(known), n=1, cutoff=0.6)


def hint(word: str, known: Iterable[str], otherwise: str) -> str:
    """Return "did you mean WORD?", or `otherwise` if no known word is similar."""
    near = nearest(word, known)
    return f"did you mean {near[0]}?" if near else otherwise
