"""Tests of the steps from which a guided calibration is built."""

from __future__ import annotations

import numpy as np
import pytest

from acsard.calibration.guided.steps import Ask, Leg, Move, ask, ride


def test_a_leg_lasts_as_long_as_its_moves() -> None:
    assert Leg("", (Move(1.5), Move(2.0, 0.3))).seconds == 3.5


def test_a_number_that_is_sent_is_what_was_asked_for() -> None:
    asking = ask("how far?", "m", 0.0, 2.0, 1.0)
    assert next(asking) == Ask("how far?", "m", 0.0, 2.0, 1.0)
    with pytest.raises(StopIteration) as end:
        asking.send(0.7)
    assert end.value.value == 0.7


def test_what_is_sent_for_a_leg_is_its_run() -> None:
    leg = Leg("", (Move(1.0),))
    riding = ride(leg)
    assert next(riding) is leg
    run = np.zeros(3)
    with pytest.raises(StopIteration) as end:
        riding.send(run)
    assert end.value.value is run
