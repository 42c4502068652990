"""Print how fast the daemon is on this machine, in 20 s.

pytest -s -m bench tests/bench/test_figures.py
"""

from __future__ import annotations

import pytest

from tests.bench.matching import staircase
from tests.bench.rig import ACSARD
from tests.bench.rigs import config, delays_us, rig, share, waits_us

pytestmark = pytest.mark.bench


def test_the_figures_of_this_machine() -> None:
    settings = config()
    with rig(settings, ACSARD) as running:
        followed, commanded = running.follow(5.0), running.command(15.0, staircase)
        record = running.end()
    figures = {"command to wire": waits_us(record), "feedback to bus": delays_us(settings, record)}
    print(f"\n{'us':20}{'count':>9}{'p50':>9}{'p99':>9}{'max':>9}")
    for name, values in figures.items():
        p50, p99, most = (share(values, part) for part in (0.5, 0.99, 1.0))
        print(f"{name:20}{len(values):9}{p50:9.0f}{p99:9.0f}{most:9.0f}")
    print(
        f"processor: {100 * followed:.1f} % of a core with one subscriber, "
        f"{100 * commanded:.1f} % with 25 commands a second as well"
    )
    assert len(figures["command to wire"]) == len(record.sent)
    assert len(figures["feedback to bus"]) >= 0.95 * len(record.feedback_lines)
