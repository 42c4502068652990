"""Tests of the suggestion for a misspelt word."""

from __future__ import annotations

import time

import pytest

from acsard.core.config.nearest import hint, nearest

KNOWN = ["odom", "state", "tf_static", "limits.linear_speed"]


@pytest.mark.parametrize(
    ("word", "suggestion"),
    [("oddom", "odom"), ("tf-static", "tf_static"), ("linear_speed", "limits.linear_speed")],
)
def test_a_misspelt_word_gets_a_suggestion(word: str, suggestion: str) -> None:
    assert nearest(word, KNOWN) == [suggestion]
    assert hint(word, KNOWN, "look there") == f"did you mean {suggestion}?"


@pytest.mark.parametrize("word", ["nonsense", "", "x" * 1000])
def test_a_word_without_a_similar_one_gets_the_general_hint(word: str) -> None:
    assert nearest(word, KNOWN) == []
    assert hint(word, KNOWN, "look there") == "look there"


def test_a_long_word_costs_no_more_than_a_short_one() -> None:
    def cost(word: str) -> float:
        begun = time.process_time()
        for _ in range(20):
            nearest(word, KNOWN)
        return time.process_time() - begun

    assert cost("od" * 100_000) < 10 * cost("od" * 40) + 0.1
