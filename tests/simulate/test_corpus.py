"""Plays the plans that once broke a promise, and checks that they break none now.

`--shrink SEED --keep NAME` adds a plan.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.simulate.actors import played
from tests.simulate.shrink import load

pytestmark = pytest.mark.slow

CORPUS = sorted((Path(__file__).parent / "corpus").glob("*.json"))


@pytest.mark.parametrize("path", CORPUS, ids=lambda path: path.stem)
def test_it_breaks_no_promise_any_more(path: Path) -> None:
    assert played(load(path)).finding == ""
