"""The planted faults fit the product that they are planted into, and the simulator finds each."""

from __future__ import annotations

import ast
from typing import Any

import pytest

from acsard.core.values import REST, Command
from tests.simulate.planted import CASE_MINUTES, FAULT_MINUTES, TABLE, edited, read, text_of
from tests.simulate.planted_cases import CASES
from tests.simulate.planted_faults import FAULTS, FRESHNESS, Fault

ALL = (*FAULTS, *CASES)
ADDED = [fault for fault in ALL if not all(edit.old for edit in fault.edits)]

OPEN = {
    "arbiter equal", "arbiter keeps", "neutral newest",
    "limits jerk", "limits saturated", "kinematics curvature",
}  # fmt: skip
"""Faults whose row has not been measured yet."""


@pytest.mark.parametrize("fault", ALL, ids=lambda fault: fault.name)
def test_a_fault_fits_the_product_and_is_still_a_program(fault: Fault) -> None:
    for text in edited(fault).values():
        ast.parse(text)


@pytest.mark.parametrize("fault", ADDED, ids=lambda fault: fault.name)
def test_code_that_a_fault_adds_to_freshness_runs_there(fault: Fault) -> None:
    names: dict[str, Any] = {"__name__": "planted"}
    exec(compile(edited(fault)[FRESHNESS], FRESHNESS, "exec"), names)
    verdict = names["Freshness"]().judge(Command("app", REST, 5, 3, "clock"), 10**9)
    assert verdict in ("first", "unproven", "fresh")


def test_there_are_fifty_six_faults_and_eleven_cases() -> None:
    assert len(FAULTS) == len({fault.name for fault in FAULTS}) == 56
    assert len(CASES) == 11


@pytest.mark.parametrize(("faults", "minutes"), [(FAULTS, FAULT_MINUTES), (CASES, CASE_MINUTES)])
def test_the_table_says_that_each_fault_was_found_in_time(
    faults: tuple[Fault, ...], minutes: float
) -> None:
    rows = read()
    faults = tuple(fault for fault in faults if fault.name not in OPEN)
    assert [f.name for f in faults if f.name not in rows or not rows[f.name].seed] == []
    assert [f.name for f in faults if rows[f.name].breaks != f.breaks] == []
    assert [f.name for f in faults if float(rows[f.name].core) > minutes] == []


def test_the_page_names_the_present_version_of_the_plans() -> None:
    assert TABLE.read_text(encoding="utf-8") == text_of(read())


def test_the_table_has_no_fault_that_is_not_planted_any_more() -> None:
    assert read().keys() <= {"name", *(fault.name for fault in ALL)}
