"""The ways that `acsard move` takes."""

from __future__ import annotations

import pytest

from acsard.cli.move import _parsed
from acsard.host.errors import UsageError
from tests.each import each


def test_ways_are_metres_and_degrees_in_their_directions() -> None:
    words = ["forward", "1", "left", "90", "back", "0.5", "right", "45"]
    assert _parsed(words) == [(False, 1.0), (True, 90.0), (False, -0.5), (True, -45.0)]


@each("words", ["up 1", "forward", "forward x", "forward -1", "left nan", "1 forward", "left 1 up"])
def test_other_words_are_refused_with_an_example(words: str) -> None:
    with pytest.raises(UsageError, match="acsard move forward 1 left 90"):
        _parsed(words.split())
