"""Checks that each fault can be planted into the product, and that the simulator finds it."""

from __future__ import annotations

import ast
import re

import pytest

from tests.each import each
from tests.simulate.planted import CASE_MINUTES, FAULT_MINUTES, TABLE, edited, read, text_of
from tests.simulate.planted_faults import CASES, FAULTS, Fault

ALL = (*FAULTS, *CASES)

RAISES = {"commands raise"}
"""Faults that raise an exception. Each seed finds a fault that does so by a mistake in its text."""


@each("fault", ALL)
def test_a_fault_fits_the_product_and_is_still_a_program(fault: Fault) -> None:
    for text in edited(fault).values():
        ast.parse(text)


@pytest.mark.parametrize(("faults", "minutes"), [(FAULTS, FAULT_MINUTES), (CASES, CASE_MINUTES)])
def test_the_table_says_that_each_fault_was_found_in_time(
    faults: tuple[Fault, ...], minutes: float
) -> None:
    rows = read()
    assert [f.name for f in faults if f.name not in rows or not rows[f.name].seed] == []
    assert [f.name for f in faults if rows[f.name].breaks != f.breaks] == []
    assert [f.name for f in faults if float(rows[f.name].core) > minutes] == []
    raised = {row.name for row in rows.values() if row.promise == "no exception ever"}
    assert raised == RAISES


def test_the_page_is_the_one_that_the_program_writes() -> None:
    assert TABLE.read_text(encoding="utf-8") == text_of(read())
    assert read().keys() == {"name", *(fault.name for fault in ALL)}


def test_each_promise_is_broken_by_a_planted_fault() -> None:
    """Otherwise nobody knows whether its judge sees anything."""
    judges = " ".join(path.read_text() for path in TABLE.parent.glob("*.py"))
    promises = re.findall(r'BrokenError\(\s*f?"([^"]+)"', judges)
    found = [row.promise for row in read().values()]
    assert len(promises) > 60
    for promise in promises:
        pattern = re.sub(r"\{\w+\}", ".+", promise)
        assert any(re.fullmatch(pattern, name) for name in found), promise
