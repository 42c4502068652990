"""Plays the plans that once broke a promise, and those that find the planted faults.

`--shrink SEED --keep NAME` adds a plan of the first kind, and `PLANTED.md` has the others' seeds.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.simulate.actors import played
from tests.simulate.plan import make_plan
from tests.simulate.planted import seeds
from tests.simulate.shrink import load

pytestmark = pytest.mark.slow

CORPUS = sorted((Path(__file__).parent / "corpus").glob("*.json"))


@pytest.mark.parametrize("path", CORPUS, ids=lambda path: path.stem)
def test_it_breaks_no_promise_any_more(path: Path) -> None:
    assert played(load(path)).finding == ""


@pytest.mark.parametrize("seed", seeds())
def test_the_product_breaks_no_promise_where_a_planted_fault_does(seed: int) -> None:
    assert played(make_plan(seed)).finding == ""
