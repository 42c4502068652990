"""A plan that once broke a promise breaks none now, unless its defect is open.

`--shrink SEED --keep NAME` adds a plan.
"""

from __future__ import annotations

from pathlib import Path

import pytest

from tests.simulate.actors import played
from tests.simulate.shrink import load

pytestmark = pytest.mark.slow

OPEN = {
    "replies_every_50_ms_at_300_hz_behind_a_stall": (
        "after a stall the daemon dates lines that come every 50 ms up to 0.28 s too early, and "
        "loses 7 cm of the way"
    ),
}
"""The plans of defects that are not mended yet, with the defect of each."""

CORPUS = sorted((Path(__file__).parent / "corpus").glob("*.json"))


@pytest.mark.parametrize("path", CORPUS, ids=lambda path: path.stem)
def test_it_breaks_no_promise_any_more(path: Path, request: pytest.FixtureRequest) -> None:
    if path.stem in OPEN:
        request.applymarker(pytest.mark.xfail(reason=OPEN[path.stem], strict=True))
    assert played(load(path)).finding == ""
