"""Tests of the ordered list of modes, and of the requests that a mode refuses."""

from __future__ import annotations

from itertools import product
from typing import get_args

import pytest

from acsard.core.motion.modes import REFUSALS, Mode, RefusedError, mode_of, require_allowed
from acsard.core.values import Verb
from tests.each import each

FACTS = ("shutting_down", "fault", "stopped", "inactive", "linked", "commanded")

ALL = [dict(zip(FACTS, values, strict=True)) for values in product((False, True), repeat=6)]

DRAWN = """
    1.....  shutdown
    01....  fault
    001...  stopped
    0001..  inactive
    00000.  waiting
    000011  driving
    000010  ready
"""
"""The whole list of modes drawn by hand. A dot matches both values, in the order of `FACTS`."""


def drawn(facts: dict[str, bool]) -> list[str]:
    bits = "".join(str(int(facts[name])) for name in FACTS)
    rows = [line.split() for line in DRAWN.strip().splitlines()]
    return [
        mode
        for pattern, mode in rows
        if all(cell in (".", bit) for cell, bit in zip(pattern, bits, strict=True))
    ]


@pytest.mark.parametrize("facts", ALL, ids=str)
def test_the_mode_is_the_one_row_of_the_drawing_that_matches(facts: dict[str, bool]) -> None:
    assert drawn(facts) == [mode_of(**facts)]


@each(("mode", "verb"), sorted(REFUSALS))
def test_a_refused_request_says_why(mode: Mode, verb: Verb) -> None:
    with pytest.raises(RefusedError) as caught:
        require_allowed(mode, verb)
    assert str(caught.value) == REFUSALS[mode, verb]


@each(("mode", "verb"), sorted(REFUSALS))
def test_a_refusal_names_clear_only_where_clear_helps(mode: Mode, verb: Verb) -> None:
    assert ("call srv/clear first" in REFUSALS[mode, verb]) == (mode is not Mode.SHUTDOWN)


def test_every_other_request_is_allowed() -> None:
    cells = set(product(Mode, get_args(Verb)))
    for mode, verb in cells - set(REFUSALS):
        require_allowed(mode, verb)
    modes = (Mode.FAULT, Mode.STOPPED, Mode.SHUTDOWN)
    refused = {(mode, verb) for mode in modes for verb in ("activate", "deactivate")}
    assert set(REFUSALS) == refused | {(Mode.SHUTDOWN, "clear")}
