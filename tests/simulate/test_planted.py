"""The planted faults still fit the product that they are planted into."""

from __future__ import annotations

import ast

import pytest

from tests.simulate.planted import edited
from tests.simulate.planted_cases import CASES
from tests.simulate.planted_faults import FAULTS, Fault

ALL = (*FAULTS, *CASES)


@pytest.mark.parametrize("fault", ALL, ids=lambda fault: fault.name)
def test_a_fault_fits_the_product_and_is_still_a_program(fault: Fault) -> None:
    for text in edited(fault).values():
        ast.parse(text)


def test_there_are_fifty_faults_and_eleven_cases() -> None:
    assert len(FAULTS) == len({fault.name for fault in FAULTS}) == 50
    assert len(CASES) == 11
