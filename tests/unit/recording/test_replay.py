"""Tests of the counters of a replay; the scenarios prove that it finds each kind of difference."""

from __future__ import annotations

import pytest

from acsard.core.config.settings import Config
from acsard.recording.replay import Replay
from acsard.recording.rows import decode, encode
from tests.scenarios.taped import Tape
from tests.scenarios.world import World


@pytest.mark.slow
def test_a_replay_counts_lines_poses_and_modes_and_has_the_last_pose() -> None:
    tape = Tape()
    world = World(recorder=tape)
    world.drive(0.5, seconds=2.0)
    replay = Replay(Config())
    for step in decode(encode(0, tape.taken)):
        assert replay.step(step) is None
    comparison = replay.comparison
    assert comparison.same
    assert comparison.steps == comparison.modes_same == len(tape.taken)
    assert (
        comparison.lines
        == comparison.lines_same
        == sum(t.outputs.line is not None for t in tape.taken)
    )
    assert (
        comparison.poses
        == comparison.poses_same
        == sum(len(t.outputs.estimates) for t in tape.taken)
    )
    assert comparison.fastest == (1000, 1000)
    assert comparison.end is not None
    then, now = comparison.end
    assert then == now
    assert 0.5 < then[0] / 1e6 < 1.0
    assert comparison.apart == 0.0
