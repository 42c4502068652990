"""What a side shows otherwise than commanded is in doubt until the side gives it back."""

from __future__ import annotations

import math

from acsard.core.motion.doubts import Trail
from tests.each import each

STEP_S, LAG_S, FINE, COARSE = 0.05, 0.2, math.tau / 3200, math.tau / 16


class Bench:
    """A side that is commanded, and what its encoders show."""

    def __init__(self, count: float = FINE) -> None:
        self.trail, self.count, self.doubt, self.off = Trail(), count, 0.0, 0.0
        self.ended = 0.0  # of `doubt`, without the open step
        self.speed = 0.0
        self.angle = 0.0
        self.shown = 0.0  # without the part of a count

    def run(
        self,
        command: float,
        seconds: float,
        gain: float = 1.0,
        motor: float = 0.15,
    ) -> None:
        """Let a motor with this lag follow the command; the encoders show `gain` of it."""
        for _ in range(round(seconds / STEP_S)):
            self.speed = command + (self.speed - command) * math.exp(-STEP_S / motor)
            before, self.angle = self.angle, self.angle + self.speed * STEP_S
            turned = self.angle - before
            self.off += turned - gain * turned
            counted = self.count * round(self.shown / self.count)
            self.shown += gain * turned
            shown = self.count * round(self.shown / self.count) - counted
            self.trail.follow(command, shown, STEP_S, LAG_S)
            if self.trail.ends(self.count):
                self.ended += self.trail.due - self.trail.shown
                self.trail.end(LAG_S, self.count)
            self.doubt = self.ended + self.trail.due - self.trail.shown


@each("motor", [0.02, 0.1, 0.3, 0.5])
@each("count", [FINE, COARSE])
def test_a_delay_of_the_motor_gives_back_its_doubt_by_the_next_rest(
    motor: float, count: float
) -> None:
    bench = Bench(count)
    for _ in range(20):
        for speed in (10.0, -6.0, 0.0):
            bench.run(speed, 4.0, motor=motor)
        assert abs(bench.doubt) < 0.01 + count
    assert not bench.trail.differs
    assert not bench.trail.weak


@each(
    ("gain", "count"),
    [
        (-1.0, FINE), (0.5, FINE), (1.5, FINE), (2.0, FINE), (-1.0, COARSE), (2.0, COARSE),
        (0.8, FINE), (0.9, FINE), (0.97, FINE), (1.05, FINE), (1.2, FINE), (1.2, COARSE),
    ],
)  # fmt: skip
def test_the_whole_difference_is_in_doubt_at_once(gain: float, count: float) -> None:
    bench = Bench(count)
    bench.run(10.0, 3.0)
    delay = bench.doubt
    for _ in range(90):
        before = bench.off
        bench.run(10.0, 0.05, gain=gain)
        least = 0.6 * abs(bench.off) - count - abs(bench.off - before)
        assert abs(bench.doubt - delay) > least
    assert bench.trail.differs == (abs(gain - 1.0) > 0.3)


def test_a_difference_that_was_larger_than_a_delay_stays_although_it_is_paid_back() -> None:
    bench = Bench()
    bench.run(10.0, 3.0, gain=0.0)
    bench.run(-10.0, 3.0, gain=0.0)
    bench.run(0.0, 2.0)
    assert bench.trail.differs


@each("gain", [0.8, 0.85, 1.2])
def test_a_weak_difference_is_said_while_it_lasts(gain: float) -> None:
    """It may be a slope: then nothing is wrong. What it left in doubt stays."""
    bench = Bench()
    while not bench.trail.weak:
        bench.run(10.0, 0.1, gain=gain)
        assert bench.angle < 200.0
    bench.run(10.0, 60.0)
    assert abs(bench.doubt) > 0.9 * abs(bench.off) - 0.5
    assert not bench.trail.weak
    assert not bench.trail.differs


@each("gain", [0.96, 1.03])
def test_a_side_that_nearly_obeys_is_not_said(gain: float) -> None:
    bench = Bench()
    bench.run(10.0, 600.0, gain=gain)
    assert not bench.trail.differs
    assert not bench.trail.weak
    assert abs(bench.doubt) < 1.05 * abs(gain - 1.0) * bench.angle


def test_a_pose_that_is_set_has_no_doubt() -> None:
    bench = Bench()
    bench.run(10.0, 3.0, gain=0.0)
    bench.trail.follow(10.0, 0.0, STEP_S, LAG_S)
    bench.trail.forget()
    assert bench.trail.due == 0.0
    assert not bench.trail.differs
    assert bench.trail.astray == 0.0
